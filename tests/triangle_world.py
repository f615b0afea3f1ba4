"""Many robots at once that build a triangle, each in a world of its own: kinematics and sight.

Points stand for beacons. A picture shows the one that falls inside its width; pixels carry noise
and the principal point's error, and arrive late. The wheels err by a constant scale.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from systems.formation import bearing_filter
from systems.formation.bearing_filter import BearingFilterParameters, moved
from systems.formation.bearings import in_robot, lateral_pixels
from systems.formation.building import (
    FORWARD,
    HOLD,
    Algorithm1Parameters,
    SettlingParameters,
    algorithm1,
    settle,
)
from systems.formation.triangles import arrival_heading, components, gates, next_vertex

Array = NDArray[np.float64]

FOCAL = 485.0
HALF_WIDTH = 320.0
SIDE = 1.5
ANCHOR = np.array([0.0, 0.0])
BEACONS = np.array(
    [[1.5 * SIDE * math.sqrt(3) / 3, -SIDE / 2], [1.5 * SIDE * math.sqrt(3) / 3, SIDE / 2], ANCHOR]
)
VERTEX = next_vertex(BEACONS)
DT = 0.05


@dataclass
class Conditions:
    """What the issue states, and where the build begins: at the exit.

    Attributes:
        pixel_noise: px.
        centre_bias: error of the principal point, px.
        latency: of the pictures, s.
        lateral_std: of the start, m.
        along_std: of the start, m.
        heading_std: of the start, rad.
        wheel_scale_std: of each trial's scale of distance, and of angle.
        limit: time after which a trial counts as failed, s.
    """

    pixel_noise: float = 0.5
    centre_bias: float = 3.0
    latency: float = 0.2
    lateral_std: float = 0.022
    along_std: float = 0.05
    heading_std: float = math.radians(3.0)
    wheel_scale_std: float = 0.01
    limit: float = 180.0


@dataclass
class Outcome:
    """How the trials ended.

    Attributes:
        along: (n,) longitudinal error, m.
        aside: (n,) lateral error, m.
        seconds: (n,) until done; NaN where it never was.
        nees: (n,) of the estimate at the end, by degrees of freedom; NaN without one.
    """

    along: Array
    aside: Array
    seconds: Array
    nees: Array


def see(pose: Array, points: Array, conditions: Conditions, random: np.random.Generator) -> Array:
    """Returns (n, 3) lateral pixels in the picture behind; NaN where it does not show."""
    behind = in_robot(pose, points)[..., 0] < 0
    u = lateral_pixels(pose, points, FOCAL)[0] + conditions.centre_bias
    u = u + conditions.pixel_noise * random.standard_normal(u.shape)
    return np.where(behind & (np.abs(u) < HALF_WIDTH), u, np.nan)


class Trials:
    """The true robots, and the pictures on their way."""

    def __init__(self, number: int, seed: int, conditions: Conditions) -> None:
        self.conditions, self.random = conditions, np.random.default_rng(seed)
        draw = self.random.standard_normal((number, 5))
        heading = arrival_heading(VERTEX, ANCHOR)
        exit_middle = gates(BEACONS)[1]
        self.pose = np.empty((number, 3))
        self.pose[:, 0] = exit_middle[0] + conditions.along_std * draw[:, 0]
        self.pose[:, 1] = exit_middle[1] + conditions.lateral_std * draw[:, 1]
        self.pose[:, 2] = heading + conditions.heading_std * draw[:, 2]
        self.scale = 1 + conditions.wheel_scale_std * draw[:, 3:]
        self.under_way: list[Array] = []
        self.delay = round(conditions.latency / DT)

    def look(self) -> Array | None:
        """Takes a picture; returns the one that arrives now, taken `delay` steps ago."""
        self.under_way.append(see(self.pose, BEACONS, self.conditions, self.random))
        return self.under_way.pop(0) if len(self.under_way) > self.delay else None

    def drive(self, command: Array) -> None:
        """Drives for one step."""
        self.pose = moved(self.pose, command * self.scale * DT)

    def errors(self) -> tuple[Any, Any]:
        """Returns how far along and aside of the vertex the robots are, m."""
        return components(self.pose[:, :2] - VERTEX, arrival_heading(VERTEX, ANCHOR))


def build_by_algorithm1(
    number: int,
    seed: int,
    conditions: Conditions,
    parameters: Algorithm1Parameters | None = None,
) -> Outcome:
    """Runs Algorithm I in `number` trials."""
    parameters = parameters or Algorithm1Parameters()
    trials = Trials(number, seed, conditions)
    direction, command = np.full(number, FORWARD), np.zeros((number, 2))
    seconds = np.full(number, np.nan)
    for step in range(round(conditions.limit / DT)):
        u = trials.look()
        if u is not None:
            motion = algorithm1(u, direction, FOCAL, parameters)
            direction = motion.direction
            seconds = np.where(motion.done & np.isnan(seconds), step * DT, seconds)
            command = np.where(np.isnan(seconds)[:, None], motion.command, 0.0)
        trials.drive(command)
        if np.isfinite(seconds).all():
            break
    return Outcome(*trials.errors(), seconds, np.full(number, np.nan))


def build_by_resection(
    number: int,
    seed: int,
    conditions: Conditions,
    parameters: SettlingParameters | None = None,
    noise: BearingFilterParameters | None = None,
) -> Outcome:
    """Runs the resection controller in `number` trials, from an estimate with the start's errors.

    The filter's state is of the time of the last picture; commands since then carry it on.
    """
    parameters, noise = parameters or SettlingParameters(), noise or BearingFilterParameters()
    trials = Trials(number, seed, conditions)
    guess = np.array([*gates(BEACONS)[1], arrival_heading(VERTEX, ANCHOR)])
    stds = [conditions.along_std, conditions.lateral_std, conditions.heading_std]
    x, P = bearing_filter.start(np.tile(guess, (number, 1)), np.diag(np.square(stds)), noise)
    sent: list[Array] = []
    located = np.zeros(number, bool)  # by three beacons in one picture
    direction, held = np.full(number, FORWARD), np.zeros(number)
    seconds = np.full(number, np.nan)
    for step in range(round(conditions.limit / DT)):
        u = trials.look()
        if u is not None:
            if len(sent) > trials.delay:
                x, P = bearing_filter.predict(x, P, sent.pop(0), noise)
            fresh = np.isfinite(u).all(axis=1) & ~located
            if fresh.any():
                x_new, P_new, found = bearing_filter.restart(
                    u, BEACONS, FOCAL, x[:, :3], noise, rear=True
                )
                fresh &= found
                x, P = np.where(fresh[:, None], x_new, x), np.where(fresh[:, None, None], P_new, P)
                located |= fresh
                u = np.where(fresh[:, None], np.nan, u)
            for k in range(3):
                x, P, _, _ = bearing_filter.correct(
                    x, P, u[:, k], BEACONS[k], FOCAL, noise, rear=True
                )
        now = x[:, :3]
        for travel in sent:
            now = moved(now, travel)
        motion = settle(now, VERTEX, ANCHOR, direction, held, parameters)
        direction = motion.direction
        held = np.where(direction == HOLD, held + DT, 0.0)
        seconds = np.where(motion.done & np.isnan(seconds), step * DT, seconds)
        command = np.where(np.isnan(seconds)[:, None], motion.command, 0.0)
        sent.append(command * DT)
        trials.drive(command)
        if np.isfinite(seconds).all():
            break
    error = now - trials.pose
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(P[:, :3, :3]), error) / 3
    return Outcome(*trials.errors(), seconds, nees)
