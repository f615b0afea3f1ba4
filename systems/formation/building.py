"""Laws by which a robot settles on the vertex of a new triangle, looking back at three beacons.

Algorithm I uses three lateral pixels and nothing else; ours drives by an estimated pose. Both
shunt: the robot goes a little beyond the vertex and backs in, because only from there all three
beacons are inside the picture, and because a robot on two wheels moves sideways only while it
drives.

Leading dimensions are batches; a batch of none is one robot.

[FORM]: Kang, Kwon, Bae, Kim, "Monocular Vision-Based Swarm Robot Localization Using Equilateral
Triangular Formations".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap
from systems.formation.triangles import arrival_heading, components
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

FORWARD, BACK, HOLD = 1.0, -1.0, 0.0


@dataclass
class Algorithm1Parameters:
    """Thresholds and gains of Algorithm I.

    Attributes:
        speed: m/s.
        dt: lateral distance of beacons 1 and 2 from the anchor at the vertex, px ([FORM]: 280).
        difference_tolerance: done when the two differ by less, px.
        mean_tolerance: and their mean is nearer to `dt` than this, px.
        beyond: how far the mean falls below `dt` before the robot backs in, px. 0 is the rule as
            printed: back as soon as not both exceed `dt`.
        short: how far it rises above `dt` before the robot goes forward again, px.
        k_heading: turning rate by the error of heading, 1/s.
        k_lateral: heading to steer by, by the difference, rad/px.
        max_steering: of that heading, rad; what the beacons at the picture's edge allow.
        max_turn_rate: rad/s.
    """

    speed: float = 0.1
    dt: float = 280.0
    difference_tolerance: float = 24.0
    mean_tolerance: float = 7.0
    beyond: float = 25.0
    short: float = 15.0
    k_heading: float = 1.0
    k_lateral: float = 0.001
    max_steering: float = math.radians(2.0)
    max_turn_rate: float = 0.3

    def __post_init__(self) -> None:
        gains = dict(vars(self))
        require_non_negative(
            beyond=gains.pop("beyond"),
            short=gains.pop("short"),
            k_lateral=gains.pop("k_lateral"),
            max_steering=gains.pop("max_steering"),
        )
        require_positive(**gains)


class Motion(NamedTuple):
    """What a law wants.

    Attributes:
        command: (..., 2) [v (m/s), omega (rad/s)].
        direction: (...) FORWARD, BACK or HOLD: state of the shunt.
        done: (...) whether the robot is there.
    """

    command: Array
    direction: Any
    done: Any


def algorithm1(
    u: Array, direction: Any, focal_length: float, parameters: Algorithm1Parameters
) -> Motion:
    """Algorithm I: heading keeps the anchor centred, the side beacons tell forward or back.

    A difference of the two distances is steered away while driving: the anchor is kept a little
    beside the centre, on the side that depends on the direction of driving.

    Args:
        u: (..., 3) lateral pixels of beacons 1, 2 and 3 behind; NaN where one is not seen. Without
            a side beacon it drives forward, without the anchor it stands.
        direction: (...) FORWARD or BACK, as returned the last time.
        focal_length: px.
        parameters: thresholds and gains.
    """
    p = parameters
    distances = np.abs(u[..., :2] - u[..., 2:])
    mean = distances.mean(axis=-1)
    with np.errstate(invalid="ignore"):
        done = np.abs(distances[..., 0] - distances[..., 1]) < p.difference_tolerance
        done &= np.abs(mean - p.dt) < p.mean_tolerance
        direction = np.where(mean <= p.dt - p.beyond, BACK, direction)
        direction = np.where(~(mean <= p.dt + p.short), FORWARD, direction)
    # Positive when the robot is right of the axis, whichever beacon stands on which side.
    difference = np.nan_to_num(u[..., 0] + u[..., 1] - 2 * u[..., 2])
    steering = np.clip(p.k_lateral * difference, -p.max_steering, p.max_steering) * direction
    heading = np.arctan(u[..., 2] / focal_length)
    omega = np.clip(p.k_heading * (steering - heading), -p.max_turn_rate, p.max_turn_rate)
    command = np.stack([p.speed * direction, omega], axis=-1)
    moving = ~done & np.isfinite(u[..., 2])
    return Motion(np.where(moving[..., None], command, 0.0), direction, done)


@dataclass
class SettlingParameters:
    """Speeds, gains and tolerances of settling on a vertex by an estimated pose.

    Attributes:
        speed: m/s.
        min_speed: at the end, m/s.
        k_speed: speed by the distance that is left, 1/s.
        beyond: how far the robot goes past the vertex before it backs in, m.
        lookahead: distance in which a lateral error is steered away, m.
        max_steering: heading to steer by, against the arrival's, rad.
        max_turn_rate: rad/s.
        stop: the robot stops when so little is left, m.
        settle: how long it then stands and looks, s.
        tolerance: it is done when the estimate is no farther from the vertex than this, along and
            aside, m; else it shunts again.
    """

    speed: float = 0.1
    min_speed: float = 0.01
    k_speed: float = 1.0
    beyond: float = 0.2
    lookahead: float = 0.06
    max_steering: float = math.radians(8.0)
    max_turn_rate: float = 0.3
    stop: float = 0.0005
    settle: float = 1.5
    tolerance: float = 0.002

    def __post_init__(self) -> None:
        require_positive(**vars(self))
        require(
            self.min_speed <= self.speed,
            "min_speed",
            self.min_speed,
            f"at most speed = {self.speed:g} m/s",
        )


def settle(
    pose: Array,
    vertex: Array,
    anchor: Array,
    direction: Any,
    held: Any,
    parameters: SettlingParameters,
) -> Motion:
    """Drives along the line from the anchor through the vertex, past it, back, and stands there.

    Args:
        pose: (..., 3) as estimated now.
        vertex: (..., 2) m.
        anchor: (..., 2) m.
        direction: (...) FORWARD, BACK or HOLD, as returned the last time.
        held: (...) since when it holds, s.
        parameters: gains and tolerances.
    """
    p = parameters
    heading = arrival_heading(vertex, anchor)
    along, aside = components(pose[..., :2] - vertex, heading)
    there = (np.abs(along) <= p.tolerance) & (np.abs(aside) <= p.tolerance)
    rested = (direction == HOLD) & (held >= p.settle)
    done = rested & there
    # A miss along the line alone is driven off straight; one aside needs room to be steered away.
    again = np.where(np.abs(aside) > p.tolerance, FORWARD, -np.sign(along))
    turned = np.where(rested & ~done, again, direction)
    turned = np.where((turned == FORWARD) & (along >= p.beyond), BACK, turned)
    turned = np.where((turned == BACK) & (along <= p.stop), HOLD, turned)
    left = np.where(turned == FORWARD, p.beyond - along, along)
    v = turned * np.clip(p.k_speed * left, p.min_speed, p.speed)
    # e'' = -(v / L)^2 e - 2 |v| / L e' for the lateral error e, driving either way.
    steering = -turned * np.clip(aside / (2 * p.lookahead), -p.max_steering, p.max_steering)
    error = wrap(np.asarray(pose[..., 2] - heading)) - steering
    omega = np.clip(-2 * np.abs(v) / p.lookahead * error, -p.max_turn_rate, p.max_turn_rate)
    return Motion(np.stack([v, omega], axis=-1), turned, done)
