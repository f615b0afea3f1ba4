"""Where to begin the search for robots that may be anywhere, from bearings and rough distances.

Gauss-Newton from where a robot was before a move can end in another valley. One sighting with its
distance says where a robot is to within centimetres, even where distances are not to count.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from systems.estimators.formation_model import SIDES, Layout, Sightings

Array = NDArray[np.float64]


def guess(layout: Layout, x: Array, sightings: Sightings, unknown: NDArray[np.intp]) -> Array:
    """Returns the state with the poses of unknown robots set to what sightings make likely.

    Two or more markers that a robot sees give its pose (the rigid motion that fits best); one gives
    its heading when others say where it is. When it sees none, the side that it shows gives the
    heading, to within an eighth of a turn.

    Args:
        layout: of the state.
        x: (size,).
        sightings: of the unknown robots and by them.
        unknown: the robots to be placed; those without sightings stay where x has them.
    """
    x = x.copy()
    poses = x[: layout.poses].reshape(-1, 3)
    errors = x[layout.poses :].reshape(layout.robots, layout.cameras)
    direction = (
        layout.camera_yaws[sightings.camera]
        + errors[sightings.observer, sightings.camera]
        + sightings.values[:, 0]
    )
    distance = np.exp(sightings.values[:, 1])[:, None]
    in_observer = distance * np.column_stack([np.cos(direction), np.sin(direction)])
    side = sightings.marker % SIDES * (np.pi / 2)
    known = ~np.isin(np.arange(layout.robots), unknown)
    for robot in unknown:
        own = (sightings.observer == robot) & known[sightings.target]
        shown = (sightings.target == robot) & known[sightings.observer]
        # Where the markers are that it sees, and where the others see its own.
        target, angle = poses[sightings.target[own]], side[own]
        markers = target[:, :2] + layout.marker_offset * _unit(target[:, 2] + angle)
        observer = poses[sightings.observer[shown]]
        toward = observer[:, 2] + direction[shown]
        there = observer[:, :2] + (distance[shown] + layout.marker_offset) * _unit(toward)
        if own.sum() >= 2:
            heading = _turn(in_observer[own], markers)
            place = markers.mean(axis=0) - _rotate(in_observer[own].mean(axis=0), heading)
        elif shown.any():
            place = there.mean(axis=0)
            if own.any():
                line = markers[0] - place
                heading = float(np.arctan2(line[1], line[0]) - direction[own][0])
            else:
                back = _unit(toward + np.pi - side[shown]).sum(axis=0)
                heading = float(np.arctan2(back[1], back[0]))
        else:
            continue
        turns = np.round((poses[robot, 2] - heading) / (2 * np.pi))
        poses[robot] = [*place, heading + 2 * np.pi * turns]
    return x


def _turn(a: Array, b: Array) -> float:
    """Returns the angle by which points a (n, 2) are to be turned to fit b best, n >= 2."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    sine = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    return float(np.arctan2(sine, (a * b).sum()))


def _rotate(p: Array, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * p[0] - s * p[1], s * p[0] + c * p[1]])


def _unit(angle: Array) -> Array:
    return np.column_stack([np.cos(angle), np.sin(angle)])
