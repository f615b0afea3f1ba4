"""A flat world of discs and walls, a unicycle that drives in it, and the lidar on top of it.

The scans, the contacts and the robot are analytic and know nothing of the blocks under test.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from systems.controllers.waypoints import WaypointParameters, drive_toward
from systems.messages import AvoiderState, Scan

Array = NDArray[np.float64]

HULL = (0.11, 0.11, 0.0975)
RANGE_MIN, RANGE_MAX = 0.15, 12.0
RAYS = 360
TURN = 1 / 5.5  # s, of the lidar


@dataclass
class World:
    """Discs (x, y, radius), walls (x1, y1, x2, y2), and discs that move: t -> (x, y, radius)."""

    discs: Sequence[tuple[float, float, float]] = ()
    walls: Sequence[tuple[float, float, float, float]] = ()
    movers: Sequence[Callable[[float], tuple[float, float, float]]] = ()

    def discs_at(self, t: float) -> Array:
        return np.array([*self.discs, *(mover(t) for mover in self.movers)]).reshape(-1, 3)

    def ranges(self, x: Any, y: Any, directions: Array, t: float = 0.0) -> Array:
        """How far rays from (x, y) get; x and y may be one for each ray."""
        c, s = np.cos(directions)[:, None], np.sin(directions)[:, None]
        x, y = (np.broadcast_to(value, directions.shape)[:, None] for value in (x, y))
        nearest = np.full(len(directions), math.inf)
        discs = self.discs_at(t)
        if len(discs):
            dx, dy = discs[:, 0] - x, discs[:, 1] - y
            along, aside = c * dx + s * dy, c * dy - s * dx
            with np.errstate(invalid="ignore"):
                hit = along - np.sqrt(discs[:, 2] ** 2 - aside**2)
            nearest = np.fmin(nearest, np.where(hit > 0, hit, math.inf).min(axis=1))
        if len(self.walls):
            ax, ay, bx, by = np.array(self.walls).T
            ex, ey = bx - ax, by - ay
            with np.errstate(divide="ignore", invalid="ignore"):
                denominator = c * ey - s * ex
                hit = ((ax - x) * ey - (ay - y) * ex) / denominator
                part = ((ax - x) * s - (ay - y) * c) / denominator
            sound = (hit > 0) & (part >= 0) & (part <= 1)
            nearest = np.minimum(nearest, np.where(sound, hit, math.inf).min(axis=1))
        return nearest

    def scan(self, poses: Array, stamp: float, increment: float = 0.0) -> Scan:
        """One turn; poses are (3,) or one for each ray."""
        poses = np.broadcast_to(poses, (RAYS, 3))
        step = 2 * math.pi / RAYS
        directions = poses[:, 2] - math.pi + step * np.arange(RAYS)
        ranges = self.ranges(poses[:, 0], poses[:, 1], directions, stamp + increment * RAYS / 2)
        ranges = np.where(ranges > RANGE_MAX, math.inf, ranges)
        ranges[ranges < RANGE_MIN] = math.nan
        return Scan(stamp, "lidar", -math.pi, step, increment, RANGE_MIN, RANGE_MAX, ranges)

    def clearance(self, pose: Array, t: float) -> float:
        """From the robot's hull, sampled every 5 mm, to the nearest obstacle; negative inside."""
        c, s = math.cos(pose[2]), math.sin(pose[2])
        outline = OUTLINE @ np.array([[c, s], [-s, c]]) + pose[:2]
        discs = self.discs_at(t)
        found = [math.inf]
        if len(discs):
            offsets = outline[:, None] - discs[:, :2]
            found.append((np.hypot(*offsets.transpose(2, 0, 1)) - discs[:, 2]).min())
        for ax, ay, bx, by in self.walls:
            a, e = np.array([ax, ay]), np.array([bx - ax, by - ay])
            part = np.clip((outline - a) @ e / (e @ e), 0, 1)
            found.append(np.hypot(*(outline - a - part[:, None] * e).T).min())
            ends = np.array([[ax, ay], [bx, by]]) - pose[:2]
            x, y = (ends @ np.array([[c, -s], [s, c]])).T
            inside = (x < HULL[0]) & (x > -HULL[1]) & (np.abs(y) < HULL[2])
            found.append(-0.01 if inside.any() else math.inf)
        return min(found)


def _outline() -> Array:
    front, rear, half = HULL
    xs, ys = np.arange(-rear, front + 1e-9, 0.005), np.arange(-half, half + 1e-9, 0.005)
    long = [np.stack([xs, np.full_like(xs, y)], 1) for y in (-half, half)]
    short = [np.stack([np.full_like(ys, x), ys], 1) for x in (-rear, front)]
    return np.concatenate(long + short)


OUTLINE = _outline()


@dataclass
class Run:
    """What became of a drive."""

    times: list[float] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    states: list[AvoiderState] = field(default_factory=list)
    clearances: list[float] = field(default_factory=list)
    commands: list[Array] = field(default_factory=list)
    reached: bool = False

    @property
    def contacts(self) -> int:
        touching = np.array(self.clearances) < 0.003
        return int((touching[1:] & ~touching[:-1]).sum() + touching[0])

    @property
    def statuses(self) -> set[str]:
        return {state.status for state in self.states}

    @property
    def length(self) -> float:
        steps = np.diff(np.array(self.poses)[:, :2], axis=0)
        return float(np.hypot(*steps.T).sum())


class Bench:
    """One avoider, stepped by hand with what a drive and a lidar would give it.

    Args:
        avoider: with `command` output, or followed by the waypoint controller.
        rate: of the avoider, Hz.
    """

    def __init__(self, avoider: Any, rate: float = 10.0) -> None:
        self.avoider, self.rate = avoider, rate
        self.context = avoider.CreateDefaultContext()
        self.drives = avoider.HasOutputPort("command")
        self.last: dict[str, Any] = {}

    def look(self, t: float, **inputs: Any) -> None:
        self.last.update(inputs)
        self.context.SetTime(t)
        for name, value in inputs.items():
            self.avoider.GetInputPort(name).FixValue(self.context, value)
        state = self.avoider.EvalUniquePeriodicDiscreteUpdate(self.context)
        self.context.get_mutable_discrete_state().SetFrom(state)

    def output(self, name: str) -> Any:
        value = self.avoider.GetOutputPort(name).Eval(self.context)
        return value.copy() if isinstance(value, np.ndarray) else value

    def command(self, pose: Array) -> Array:
        if self.drives:
            return self.output("command")
        self.avoider.GetInputPort("pose").FixValue(self.context, pose)
        return np.array(drive_toward(pose, self.output("goal"), WaypointParameters()))


def drive(
    avoider: Any,
    world: World,
    *,
    start: Sequence[float] = (0.0, 0.0, 0.0),
    goal: Sequence[float] = (3.0, 0.0),
    duration: float = 60.0,
    rate: float = 10.0,
    arrived: float = 0.15,
    scale: Callable[[float, Scan], Scan] = lambda _, scan: scan,
) -> Run:
    """Drives until the goal is reached, it has given up, or the time is over.

    The lidar turns while the robot moves; a scan arrives when its turn is done. The drive takes
    commands at 50 Hz, with the limits of speed and acceleration of `WheelDrive`.

    Args:
        avoider: the block.
        world: where.
        start: [x, y, theta].
        goal: [x, y].
        duration: s.
        rate: of the avoider, Hz.
        arrived: distance at which the goal counts as reached, m.
        scale: what to make of each scan before it is handed over, by time.
    """
    bench, run = Bench(avoider, rate), Run()
    dt = 0.01
    pose, sent, scan = np.array(start, float), np.zeros(2), Scan()
    limit, change = np.array([0.5, 3.0]), np.array([1.0, 10.0]) * 0.02
    path: list[Array] = []
    turn_steps = round(TURN / dt)
    increment = turn_steps * dt / RAYS
    for k in range(round(duration / dt)):
        t = k * dt
        path.append(pose.copy())
        if k and k % turn_steps == 0:
            began = (k - turn_steps) * dt
            recent = np.array(path[-turn_steps - 1 :])
            when = began + increment * np.arange(RAYS)
            nodes = began + dt * np.arange(len(recent))
            rays = np.stack([np.interp(when, nodes, column) for column in recent.T], axis=1)
            scan = scale(t, world.scan(rays, began, increment))
        if k % round(1 / rate / dt) == 0:
            bench.look(t, pose=pose, goal=np.array(goal), scan=scan, command=sent)
            run.times.append(t)
            run.states.append(bench.output("state"))
            run.poses.append(pose.copy())
            run.commands.append(sent.copy())
        if k % 2 == 0:
            wanted = np.clip(bench.command(pose), -limit, limit)
            sent = sent + np.clip(wanted - sent, -change, change)
        if k % 4 == 0:
            run.clearances.append(world.clearance(pose, t))
        half = pose[2] + sent[1] * dt / 2
        pose = pose + dt * np.array([sent[0] * math.cos(half), sent[0] * math.sin(half), sent[1]])
        run.reached = math.hypot(*(pose[:2] - goal)) < arrived
        if run.reached or (run.states[-1].status == "blocked" and not sent.any()):
            break
    run.commands.append(sent)
    return run
