"""Errors of a robot that finds its way by its wheels and its heading alone, for many runs at once.

The model that [FORM] compares its triangles with, after Gebre-Egziabher (heading) and Vezinet
(wheels): the heading's error is a Gauss-Markov process and white noise, the speed's a scale factor
and white noise. The robot drives its path exactly; what it believes runs away from it.

White noise on a speed has no meaning without a sampling period: the error of the way grows with the
square root of time and of the period. At 0.5 s, our default, the model gives 0.78 and 0.20 m at
5.8 rad/s on the two paths of `diagrams.formation_table`, where table 1 of [FORM] has 0.81 and
0.20 m (at 0.1 s 0.62 and 0.13 m, at 1 s 0.94 and 0.27 m). At 2.9 rad/s the table has about twice as
much, 1.43 and 0.42 m, the model 1.04 and 0.28 m. No period makes it double: what is white grows
with the root of time, and what is slow does not care how long a path takes if that is shorter than
its correlation. Only an integrated bias of the heading's rate doubles. One of 0.012 deg/s brings
the first path's two cells within 15 %; the second path's cell takes 0.1 deg/s, with which the first
path's are four times too large.

[FORM]: Kang, Kwon, Bae, Kim, "Monocular Vision-Based Swarm Robot Localization Using Equilateral
Triangular Formations".
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

_NUMBERS = 2**15  # of steps and runs at once, few enough to stay in the processor's cache


@dataclass
class DeadReckoningParameters:
    """Noise of heading and wheel speed.

    Attributes:
        heading_deviation: of the Gauss-Markov part of the heading's error, rad.
        heading_time: correlation time of that part, s.
        heading_noise: deviation of the white part, rad.
        speed_noise: deviation of the white noise of the speed, m/s.
        speed_scale: error of the speed's scale, a factor less 1. Illegible in [FORM]; ours is 0. So
            is its bias of the wheels' radius, which it calls negligible and which acts alike.
        period: for which a sample of the white noises holds, s.
        gyro_bias: deviation, from run to run, of a constant bias of the heading's rate, which the
            heading integrates, rad/s. Not in [FORM].
    """

    heading_deviation: float = math.radians(2.5)
    heading_time: float = 120.0
    heading_noise: float = math.radians(0.8)
    speed_noise: float = 0.045
    speed_scale: float = 0.0
    period: float = 0.5
    gyro_bias: float = 0.0

    def __post_init__(self) -> None:
        require_positive(heading_time=self.heading_time, period=self.period)
        require_non_negative(
            heading_deviation=self.heading_deviation,
            heading_noise=self.heading_noise,
            speed_noise=self.speed_noise,
            gyro_bias=self.gyro_bias,
        )
        scale = self.speed_scale
        require(math.isfinite(scale) and scale > -1, "speed_scale", scale, "greater than -1")


class ErrorsOverTime(NamedTuple):
    """Errors of many runs at some instants.

    Attributes:
        times: (k,) s.
        errors: (runs, k, 2) m, in W: where the robot believes to be, less where it is.
    """

    times: Array
    errors: Array


def dead_reckoning_errors(
    path: ArrayLike,
    *,
    speed: float,
    runs: int,
    random: np.random.Generator,
    parameters: DeadReckoningParameters | None = None,
    instants: int = 1,
) -> ErrorsOverTime:
    """Returns the errors of robots that drive along a path at constant speed and turn in no time.

    Args:
        path: (n, 2) m, corners from the start to the end.
        speed: m/s.
        runs: how many.
        random: where the noise comes from.
        parameters: of the noise.
        instants: how many to return, evenly spaced, the last of them at the end of the path.

    Raises:
        ValueError: an argument is out of range.
    """
    p = parameters or DeadReckoningParameters()
    require_positive(speed=speed)
    require(runs >= 1, "runs", runs, "1 or more")
    require(instants >= 1, "instants", instants, "1 or more")
    times, steps = _true_steps(path, speed, p.period)
    count = len(steps)
    kept = np.unique(np.rint(np.linspace(0, count, instants + 1)[1:]).astype(int) - 1)
    kept = kept[kept >= 0]
    lengths, headings = np.hypot(*steps.T)[:, None], np.arctan2(steps[:, 1], steps[:, 0])[:, None]
    waits, middles = np.diff(times)[:, None], ((times[1:] + times[:-1]) / 2)[:, None]

    slow = p.heading_deviation * random.standard_normal(runs)  # as if it had run for long
    rate = p.gyro_bias * random.standard_normal(runs)
    reached = np.zeros((2, runs))  # believed less true
    errors = np.empty((len(kept), 2, runs))
    block = max(1, _NUMBERS // runs)
    for first in range(0, count, block):
        now = slice(first, first + block)
        noise = random.standard_normal((len(steps[now]), 3, runs))
        wandering = gauss_markov(
            slow, noise[:, 0], step=p.period, time=p.heading_time, deviation=p.heading_deviation
        )
        slow = wandering[-1]
        heading = headings[now] + wandering[:-1]
        heading += p.heading_noise * noise[:, 1] + rate * middles[now]
        length = (1 + p.speed_scale) * lengths[now] + waits[now] * p.speed_noise * noise[:, 2]
        way = np.stack([length * np.cos(heading), length * np.sin(heading)], axis=1)
        way -= steps[now, :, None]
        way[0] += reached
        np.cumsum(way, axis=0, out=way)
        reached = way[-1]
        here = (kept >= first) & (kept < first + block)
        errors[here] = way[kept[here] - first]
    return ErrorsOverTime(times=times[kept + 1], errors=np.moveaxis(errors, 2, 0))


def gauss_markov(
    value: Array, noise: Array, *, step: float, time: float, deviation: float
) -> Array:
    """Returns a stationary first-order Gauss-Markov process now and k steps on, exactly.

    Its covariance over t is deviation^2 exp(-t / time).

    Args:
        value: (runs,) now.
        noise: (k, runs) standard normal numbers.
        step: s.
        time: correlation time, s.
        deviation: of the process.

    Returns:
        (k + 1, runs).
    """
    kept = math.exp(-step / time)
    # expm1 keeps the digits that 1 - kept^2 would lose for short steps.
    new = deviation * math.sqrt(-math.expm1(-2 * step / time))
    values = np.concatenate([value[None], new * noise])
    for before, after in itertools.pairwise(values):
        after += kept * before
    return values


def _true_steps(path: ArrayLike, speed: float, period: float) -> tuple[Array, Array]:
    """Returns the samples' limits (k + 1,) s and the displacements (k, 2) m between them."""
    corners = np.asarray(path, float)
    fits = corners.ndim == 2 and corners.shape[1] == 2 and bool(np.isfinite(corners).all())
    require(fits, "path", path, "points [x, y] of finite numbers, m")
    passed = np.concatenate([[0.0], np.linalg.norm(np.diff(corners, axis=0), axis=1).cumsum()])
    require(passed[-1] > 0, "path", path, "longer than 0 m")
    duration = passed[-1] / speed
    count = max(1, math.ceil(duration / period - 1e-9))
    times = np.minimum(np.arange(count + 1) * period, duration)
    times[-1] = duration
    at = np.stack([np.interp(times * speed, passed, corner) for corner in corners.T], axis=1)
    return times, np.diff(at, axis=0)
