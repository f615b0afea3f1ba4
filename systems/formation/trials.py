"""Trials of building one triangle: many robots at once, each in a world of its own.

Kinematics and projection only. The beacons stand where they should and are points; a picture shows
those that fall inside its width. Pixels carry noise and the error of the principal point, and
arrive late. The wheels err by a constant scale. Each robot begins where it leaves the old triangle,
with the errors of the way there, and looks back at the beacons.

The conditions are those under which Algorithm I has the errors that [FORM] 4.2 measures; the paper
states neither speed nor latency nor tolerances, so these are ours.

[FORM]: Kang, Kwon, Bae, Kim, "Monocular Vision-Based Swarm Robot Localization Using Equilateral
Triangular Formations".
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
from systems.formation.triangles import HEIGHT, arrival_heading, components, gates, next_vertex
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]


@dataclass
class TrialParameters:
    """Conditions of the trials; speed and tolerances are those of the law that drives.

    Attributes:
        side: of the triangle, m.
        focal_length: px.
        half_width: of the picture, px.
        period: of pictures and commands, s.
        latency: of the pictures, s; taken as a whole number of periods.
        pixel_noise: of a lateral pixel, standard deviation, px.
        centre_bias: by how much the principal point shows too far right, the same in all trials,
            px.
        along_std: of the start, m.
        lateral_std: of the start, m.
        heading_std: of the start, rad.
        wheel_scale_std: of each trial's scale of distance, and of angle.
        limit: time after which a trial never ends, s.
    """

    side: float = 1.5
    focal_length: float = 485.0
    half_width: float = 320.0
    period: float = 0.05
    latency: float = 0.2
    pixel_noise: float = 0.5
    centre_bias: float = 3.0
    along_std: float = 0.05
    lateral_std: float = 0.022
    heading_std: float = math.radians(3.0)
    wheel_scale_std: float = 0.01
    limit: float = 180.0

    def __post_init__(self) -> None:
        numbers = dict(vars(self))
        bias = numbers.pop("centre_bias")
        require(math.isfinite(bias), "centre_bias", bias, "a finite number")
        errors = ("latency", "pixel_noise", "along_std", "lateral_std", "heading_std")
        require_non_negative(**{name: numbers.pop(name) for name in (*errors, "wheel_scale_std")})
        require_positive(**numbers)
        require(
            self.limit >= self.period, "limit", self.limit, f"period = {self.period:g} s or more"
        )


@dataclass
class Outcome:
    """How n trials ended.

    Attributes:
        along: (n,) longitudinal error: too far from the anchor, m.
        aside: (n,) lateral error: to the left as the robot faces away from the anchor, m.
        seconds: (n,) until done; NaN where it never was.
        nees: (n,) of the estimate at the end, by degrees of freedom; NaN without one.
    """

    along: Array
    aside: Array
    seconds: Array
    nees: Array


def beacons_of(side: float) -> Array:
    """Returns the beacons (3, 2) of the trials, m: the anchor in the origin, the vertex along x."""
    return side * np.array([[HEIGHT, -0.5], [HEIGHT, 0.5], [0.0, 0.0]])


class Algorithm1Trials:
    """Errors of triangles that Algorithm I builds, each drawn by simulating it: a `StepErrors`.

    Args:
        parameters: conditions.
        algorithm: thresholds and gains.

    Raises:
        ValueError: the picture cannot hold the side beacons at the vertex.
    """

    def __init__(
        self,
        parameters: TrialParameters | None = None,
        *,
        algorithm: Algorithm1Parameters | None = None,
    ) -> None:
        self._parameters = parameters or TrialParameters()
        self._algorithm = algorithm or Algorithm1Parameters()
        half = self._parameters.half_width
        fits = self._algorithm.dt < half
        require(fits, "dt", self._algorithm.dt, f"less than half_width = {half:g} px")

    def draw(self, random: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Returns (*shape, 2) errors [lateral, longitudinal], m; NaN for trials that never ended.

        Args:
            random: of all noise.
            shape: of the trials.
        """
        outcome = build_by_algorithm1(math.prod(shape), random, self._parameters, self._algorithm)
        errors = np.stack([outcome.aside, outcome.along], axis=-1)
        errors[np.isnan(outcome.seconds)] = np.nan
        return errors.reshape(*shape, 2)


def build_by_algorithm1(
    number: int,
    seed: int | np.random.Generator,
    parameters: TrialParameters | None = None,
    algorithm: Algorithm1Parameters | None = None,
) -> Outcome:
    """Builds `number` triangles by Algorithm I.

    Args:
        number: of trials.
        seed: or a generator, which is used up.
        parameters: conditions.
        algorithm: thresholds and gains.
    """
    world = _World(number, seed, parameters or TrialParameters())
    p, algorithm = world.parameters, algorithm or Algorithm1Parameters()
    direction, command = np.full(number, FORWARD), np.zeros((number, 2))
    seconds = np.full(number, np.nan)
    for step in range(round(p.limit / p.period)):
        u = world.look()
        if u is not None:
            motion = algorithm1(u, direction, p.focal_length, algorithm)
            direction = motion.direction
            seconds = np.where(motion.done & np.isnan(seconds), step * p.period, seconds)
            command = np.where(np.isnan(seconds)[:, None], motion.command, 0.0)
        world.drive(command)
        if np.isfinite(seconds).all():
            break
    return Outcome(*world.errors(), seconds, np.full(number, np.nan))


def build_by_resection(
    number: int,
    seed: int | np.random.Generator,
    parameters: TrialParameters | None = None,
    settling: SettlingParameters | None = None,
    noise: BearingFilterParameters | None = None,
) -> Outcome:
    """Builds `number` triangles by the resection controller, from the start it is told.

    The filter's state is of the time of the last picture; commands since then carry it on.

    Args:
        number: of trials.
        seed: or a generator, which is used up.
        parameters: conditions.
        settling: speeds, gains and tolerances.
        noise: what the filter knows of sight and motion.
    """
    world = _World(number, seed, parameters or TrialParameters())
    p, settling = world.parameters, settling or SettlingParameters()
    noise = noise or BearingFilterParameters()
    stds = [p.along_std, p.lateral_std, p.heading_std]
    x, P = bearing_filter.start(np.tile(world.start, (number, 1)), np.diag(np.square(stds)), noise)
    sent: list[Array] = []
    located = np.zeros(number, bool)  # by three beacons in one picture
    direction, held = np.full(number, FORWARD), np.zeros(number)
    seconds = np.full(number, np.nan)
    now = x[:, :3]
    for step in range(round(p.limit / p.period)):
        u = world.look()
        if u is not None:
            if len(sent) > world.delay:
                x, P = bearing_filter.predict(x, P, sent.pop(0), noise)
            fresh = np.isfinite(u).all(axis=1) & ~located
            if fresh.any():
                x_new, P_new, found = bearing_filter.restart(
                    u, world.beacons, p.focal_length, x[:, :3], noise, rear=True
                )
                fresh &= found
                x, P = np.where(fresh[:, None], x_new, x), np.where(fresh[:, None, None], P_new, P)
                located |= fresh
                u = np.where(fresh[:, None], np.nan, u)
            for k in range(3):
                x, P, _, _ = bearing_filter.correct(
                    x, P, u[:, k], world.beacons[k], p.focal_length, noise, rear=True
                )
        now = x[:, :3]
        for travel in sent:
            now = moved(now, travel)
        motion = settle(now, world.vertex, world.beacons[2], direction, held, settling)
        direction = motion.direction
        held = np.where(direction == HOLD, held + p.period, 0.0)
        seconds = np.where(motion.done & np.isnan(seconds), step * p.period, seconds)
        command = np.where(np.isnan(seconds)[:, None], motion.command, 0.0)
        sent.append(command * p.period)
        world.drive(command)
        if np.isfinite(seconds).all():
            break
    error = now - world.pose
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(P[:, :3, :3]), error) / 3
    return Outcome(*world.errors(), seconds, nees)


class _World:
    """The true robots, and the pictures on their way.

    Attributes:
        beacons: (3, 2) m.
        vertex: (2,) m.
        start: (3,) where the robots begin, but for their errors.
        pose: (n, 3) of the robots.
        delay: of the pictures, periods.
    """

    def __init__(
        self, number: int, seed: int | np.random.Generator, parameters: TrialParameters
    ) -> None:
        self.parameters = p = parameters
        self.beacons = beacons_of(p.side)
        self.vertex = next_vertex(self.beacons)
        self.heading = float(arrival_heading(self.vertex, self.beacons[2]))
        self.start = np.array([*gates(self.beacons)[1], self.heading])
        self.delay = round(p.latency / p.period)
        self._random = np.random.default_rng(seed)
        draw = self._random.standard_normal((number, 5))
        self.pose = self.start + [p.along_std, p.lateral_std, p.heading_std] * draw[:, :3]
        self._scale = 1 + p.wheel_scale_std * draw[:, 3:]
        self._under_way: list[Array] = []

    def look(self) -> Array | None:
        """Takes pictures behind; returns the lateral pixels (n, 3) of those that arrive now.

        NaN where a beacon does not show; None while the first are on their way.
        """
        p = self.parameters
        behind = in_robot(self.pose, self.beacons)[..., 0] < 0
        with np.errstate(divide="ignore", invalid="ignore"):  # of a beacon exactly beside the robot
            u = lateral_pixels(self.pose, self.beacons, p.focal_length)[0] + p.centre_bias
        u = u + p.pixel_noise * self._random.standard_normal(u.shape)
        self._under_way.append(np.where(behind & (np.abs(u) < p.half_width), u, np.nan))
        return self._under_way.pop(0) if len(self._under_way) > self.delay else None

    def drive(self, command: Array) -> None:
        """Drives for one period by commands (n, 2) [v (m/s), omega (rad/s)]."""
        self.pose = moved(self.pose, command * self._scale * self.parameters.period)

    def errors(self) -> tuple[Any, Any]:
        """Returns how far along and aside of the vertex the robots are, (n,) each, m."""
        return components(self.pose[:, :2] - self.vertex, self.heading)
