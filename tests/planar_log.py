"""A drive that never was, in plain numpy, and filters that hear of it: truth, inputs, pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput

from systems.angles import spatial_pose, wrap
from systems.messages import PoseEstimate

Array = NDArray[np.float64]

RATE = 100.0
FINE = 10  # steps of the truth in a tick


@dataclass(frozen=True)
class Truth:
    """What the filters are not told.

    Attributes:
        scale: true speed by commanded speed.
        bias: of the gyro, rad/s.
        gyro_scale: true turn by measured turn.
        scale_walk: how the scale changes from there, 1/sqrt(s).
        bias_walk: how the bias changes from there, rad/s/sqrt(s).
        speed_noise: random walk of the distance by time, m/sqrt(s).
        slip: random walk of the distance by the distance, m/sqrt(m).
        side: random walk of the sideways position by turning, m/sqrt(rad).
        gyro_noise: rad/s/sqrt(Hz).
        turn_noise: random walk of the measured heading by turning, rad/sqrt(rad).
        stamp_noise: how far pictures are taken from their stamps, s.
        lag: time constant of the motors, s.
        latency: least and most, s.
        deviations: least and most of a picture's position error, m; its heading error (rad) is
            half as large as a number.
        picture_rate: Hz.
    """

    scale: float = 1.03
    bias: float = 0.02
    gyro_scale: float = 1.02
    scale_walk: float = 0.003
    bias_walk: float = 1e-4
    speed_noise: float = 0.003
    slip: float = 0.01
    side: float = 0.002
    gyro_noise: float = 8.7e-5
    turn_noise: float = 0.003
    stamp_noise: float = 0.003
    lag: float = 0.0
    latency: tuple[float, float] = (0.02, 0.06)
    deviations: tuple[float, float] = (0.002, 0.02)
    picture_rate: float = 15.0


@dataclass(frozen=True, eq=False)
class PlanarLog:
    """A drive.

    Attributes:
        command: (n, 2) during each tick.
        yaw_rate: (n,) as the gyro is heard of at each tick: one tick after it measured.
        marker_poses: (n,) the PoseEstimate on the port at each tick.
        truth: (n, 3) pose at each tick.
        alternatives: (n,) likewise, if there are any.
    """

    command: Array
    yaw_rate: Array
    marker_poses: Sequence[PoseEstimate]
    truth: Array
    alternatives: Sequence[PoseEstimate] | None = None

    def __len__(self) -> int:
        return len(self.command)


def drive(
    command: Array, seed: int, truth: Truth | None = None, dark: tuple[float, float] | None = None
) -> PlanarLog:
    """Drives along commands.

    Args:
        command: (n, 2) [v, omega] of each tick.
        seed: of all noise.
        truth: what is wrong with the robot.
        dark: no picture is taken between these times, s.
    """
    truth = truth or Truth()
    rng = np.random.default_rng(seed)
    n, dt = len(command), 1 / RATE
    h = dt / FINE
    fine = np.repeat(command, FINE, axis=0)
    if truth.lag > 0:
        moved = np.zeros(2)
        for i, target in enumerate(fine):
            moved = moved + (target - moved) * (1 - math.exp(-h / truth.lag))
            fine[i] = moved
    normals = rng.standard_normal((5, len(fine)))
    speed, turning = np.abs(fine[:, 0]), np.abs(fine[:, 1])
    scale = truth.scale + truth.scale_walk * np.cumsum(normals[0]) * math.sqrt(h)
    bias = truth.bias + truth.bias_walk * np.cumsum(normals[1]) * math.sqrt(h)
    along = scale * fine[:, 0] * h + normals[2] * np.sqrt(
        (truth.speed_noise**2 + truth.slip**2 * speed) * h
    )
    across = normals[3] * truth.side * np.sqrt(turning * h)
    unseen = normals[4] * np.sqrt((truth.gyro_noise**2 + truth.turn_noise**2 * turning) / h)
    start = rng.uniform([-1, -1, -3], [1, 1, 3])
    theta = start[2] + np.concatenate([[0.0], np.cumsum(fine[:, 1] * h)])
    middle = (theta[1:] + theta[:-1]) / 2
    c, s = np.cos(middle), np.sin(middle)
    steps = np.column_stack([c * along - s * across, s * along + c * across])
    path = np.column_stack([start[:2] + np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]), theta])
    # The mean rate of a tick is known at its end, and heard of one tick later.
    measured = (fine[:, 1] / truth.gyro_scale + bias + unseen).reshape(n, FINE).mean(axis=1)
    yaw_rate = np.concatenate([[0.0, 0.0], measured[:-2]])
    pictures = []
    for i in range(int(n * dt * truth.picture_rate)):
        stamp = round(i / truth.picture_rate * 1e9) / 1e9
        latency, deviation = rng.uniform(*truth.latency), rng.uniform(*truth.deviations)
        if dark and dark[0] <= stamp < dark[1]:
            continue
        taken = stamp + truth.stamp_noise * rng.standard_normal()
        pose = np.array([np.interp(taken / h, np.arange(len(path)), path[:, j]) for j in range(3)])
        A = rng.standard_normal((3, 3)) * deviation * np.array([[1.0], [1.0], [0.5]])
        R = A @ A.T / 3 + np.diag(np.square(deviation * np.array([0.3, 0.3, 0.15])))
        z = pose + np.linalg.cholesky(R) @ rng.standard_normal(3)
        pictures.append((stamp + latency, estimate(z, R, stamp)))
    return PlanarLog(command, yaw_rate, on_port(pictures, n), wrapped(path[::FINE][:n]))


def estimate(
    z: Any, R: Array, stamp: float, *, markers: int = 2, ambiguous: bool = False
) -> PoseEstimate:
    """Returns the message of a planar pose; what is not planar in its covariance is 9."""
    covariance = 9.0 * np.eye(6)
    covariance[np.ix_([3, 4, 2], [3, 4, 2])] = R
    pose = spatial_pose(np.asarray(z, float))
    return PoseEstimate(
        stamp=stamp, pose=pose, covariance=covariance, markers=markers, ambiguous=ambiguous
    )


def on_port(pictures: Sequence[tuple[float, PoseEstimate]], n: int) -> list[PoseEstimate]:
    """Returns what is on the port at each tick of (time of arrival, message): the last.

    Of two that arrive in one tick, one is shown a tick later.
    """
    waiting = sorted(pictures, key=lambda item: -item[0])
    shown, current = [], PoseEstimate()
    for k in range(n):
        if waiting and waiting[-1][0] <= k / RATE + 1e-9:
            current = waiting.pop()[1]
        shown.append(current)
    return shown


def arcs(seconds: float, seed: int, speed: float | None = None) -> Array:
    """Returns commands of arcs of half a second to two seconds: (n, 2)."""
    rng = np.random.default_rng([seed, 1])
    n = round(seconds * RATE)
    command = np.zeros((0, 2))
    while len(command) < n:
        v = rng.uniform(0.05, 0.3) if speed is None else speed
        ticks = int(rng.uniform(0.5, 2.0) * RATE)
        command = np.vstack([command, np.tile([v, rng.uniform(-0.8, 0.8)], (ticks, 1))])
    return command[:n]


def wrapped(poses: Array) -> Array:
    """Returns the poses with their headings in (-pi, pi]."""
    return np.column_stack([poses[:, :2], wrap(poses[:, 2])])


@dataclass(frozen=True, eq=False)
class Result:
    """What one filter said.

    Attributes:
        pose: (n, 3) at each tick.
        covariance: (n, 3, 3).
        nis: (m,) of each update.
        counts: of its health.
        context: at the end.
        simulator: owns the context.
        block: the filter.
    """

    pose: Array
    covariance: Array
    nis: Array
    counts: dict[str, int]
    context: Context
    simulator: Simulator
    block: Any

    def errors(self, log: PlanarLog) -> Array:
        """Returns (n, 3) estimate minus truth."""
        return wrapped(self.pose - log.truth)

    def nees(self, log: PlanarLog) -> Array:
        """Returns (n,) e' P^-1 e by dimension."""
        e = self.errors(log)
        return np.einsum("ni,ni->n", e, np.linalg.solve(self.covariance, e[..., None])[..., 0]) / 3


class LogPlayer(LeafSystem):
    """Sends what a filter hears of a drive."""

    def __init__(self, log: PlanarLog) -> None:
        super().__init__()
        imu = np.zeros((len(log), 6))
        imu[:, 2] = log.yaw_rate
        alternatives = log.alternatives or [PoseEstimate()] * len(log)
        for name, rows in (("command", log.command), ("imu", imu)):
            self.DeclareVectorOutputPort(
                name, rows.shape[1],
                lambda context, output, rows=rows: output.SetFromVector(rows[self._tick(context)]),
                {self.time_ticket()},
            )  # fmt: skip
        for name, messages in (
            ("marker_pose", log.marker_poses),
            ("marker_alternative", alternatives),
        ):
            self.DeclareAbstractOutputPort(
                name, lambda: AbstractValue.Make(PoseEstimate()),
                lambda context, output, messages=messages: output.set_value(
                    messages[self._tick(context)]
                ),
                {self.time_ticket()},
            )  # fmt: skip
        self._last = len(log) - 1

    def _tick(self, context: Context) -> int:
        return min(round(context.get_time() * RATE), self._last)


def listen(log: PlanarLog, *filters: LeafSystem) -> list[Result]:
    """Lets filters hear of a drive, all of the same."""
    builder = DiagramBuilder()
    player = builder.AddSystem(LogPlayer(log))
    sinks = []
    for block in filters:
        builder.AddSystem(block)
        for name in ("command", "imu", "marker_pose", "marker_alternative"):
            builder.Connect(player.GetOutputPort(name), block.GetInputPort(name))
        sinks.append(
            [
                LogVectorOutput(block.GetOutputPort(name), builder, 1 / RATE)
                for name in ("pose", "covariance", "nis")
            ]
        )
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo((len(log) - 0.5) / RATE)
    root = simulator.get_context()
    results = []
    for block, logged in zip(filters, sinks, strict=True):
        pose, covariance, nis = (sink.FindLog(root).data().T.copy() for sink in logged)
        new = np.flatnonzero(np.diff(nis[:, 1]) > 0) + 1
        context = block.GetMyContextFromRoot(root)
        counts = block.GetOutputPort("health").Eval(context).counts
        results.append(
            Result(
                pose, covariance.reshape(-1, 3, 3), nis[new, 0],
                {reason: number for reason, number in counts.items() if number},
                context, simulator, block,
            )
        )  # fmt: skip
    return results
