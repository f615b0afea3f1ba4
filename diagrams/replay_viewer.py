"""What Meshcat shows of a replay beyond the robot: the route, and the tags as the robot knows them.

The tags' boards are where they are; a frame floats where the map has each, so that an error of the
map is seen as a frame that does not sit in its board.
"""

from __future__ import annotations

import numpy as np
from pydrake.geometry import Meshcat, Rgba

from diagrams.frames_viewer import add_triad
from systems.markers.layout import MarkerMap
from systems.planners.route import Route

_STEP = 0.05  # m, between the points of the line
_HEIGHT = 0.004  # m over the ground


def show_route(meshcat: Meshcat, route: Route, known: MarkerMap) -> None:
    """Draws the route as a line on the ground, and the frames of the known tags.

    Args:
        meshcat: where.
        route: in the map's frame.
        known: the tags as the robot knows them.
    """
    run = np.arange(0.0, route.length + _STEP, _STEP)
    x, y, _ = route.poses_at(route.time_at(np.minimum(run, route.length - 1e-9))).T
    line = np.stack([x, y, np.full(len(x), _HEIGHT)])
    meshcat.SetLine("replay/route", line, 3.0, Rgba(0.1, 0.4, 0.9, 1.0))
    for tag in known:
        path = f"replay/known tags/{tag.id}"
        add_triad(meshcat, path, length=tag.size / 2, radius=0.004)
        meshcat.SetTransform(path, tag.X_WM)
