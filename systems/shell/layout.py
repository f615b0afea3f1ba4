"""The markers of a spherical shell: 25 small ones, upright toward the pole, laid onto the sphere.

Source: [SNAIL], Zhang, Lam, "Relative Localization System Design for SnailBot: A Modular
Self-reconfigurable Robot": id 1 at pitch 90; 2-5 at pitch 60, yaw every 90; 6-13 at pitch 30, yaw
every 45; 14-25 at pitch 0, yaw every 30 degrees; DICT_4X4_50, 5 mm. It gives no radius. Each ring
starts at yaw 0 here, which it does not say.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap
from systems.markers.pnp import rotation_from_vector
from systems.noise import generator, stream_key
from systems.shell.angles import SHELL_FRAME, nearest_rotation, upright
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

SHELL_RADIUS = 0.075  # m
MARKER_SIZE = 0.005  # m
_RINGS = ((60, 4), (30, 8), (0, 12))  # pitch (degrees) and number of markers


def marker_places() -> dict[int, tuple[float, float]]:
    """Returns pitch and yaw (rad) of each marker by id.

    The one at the pole has yaw 180 degrees: so it stands upright toward yaw 0.
    """
    places = {1: (math.pi / 2, math.pi)}
    for pitch, count in _RINGS:
        for k in range(count):
            places[len(places) + 1] = (math.radians(pitch), 2 * math.pi * k / count)
    return places


def depth(radius: float, size: float) -> float:
    """Returns how far below the tangent plane a marker's corners lie, m.

    They are coplanar: 0.083 mm below it for 5 mm on a radius of 75 mm.
    """
    return radius - math.sqrt(radius**2 - size**2 / 2)


def shell_markers(*, radius: float = SHELL_RADIUS, size: float = MARKER_SIZE) -> MarkerMap:
    """Returns the 25 markers, in frame R of the sphere.

    The map's planes are those through the corners, which lie on the sphere: so the poses of planar
    markers are exact although the markers are bent. (Their middles bulge out by `depth`.)

    Args:
        radius: of the sphere, m.
        size: straight from corner to corner, m. A print of 5 mm loses 2 micrometres by being bent
            to a radius of 75 mm.

    Raises:
        ValueError: not positive, or neighbours would overlap.
    """
    require_positive(radius=radius, size=size)
    # The nearest neighbours are 30 degrees apart: along the equator, and from ring to ring.
    gap = 2 * radius * math.sin(math.radians(15))
    require(
        size * math.sqrt(2) < gap,
        "size",
        size,
        f"less than {gap / math.sqrt(2):.3g} m, or the markers of a sphere of {radius:g} m overlap",
    )
    reach = radius - depth(radius, size)
    markers = {}
    for marker_id, (pitch, yaw) in marker_places().items():
        R_RM = upright(pitch, yaw)
        X_RM = RigidTransform(RotationMatrix(R_RM), reach * R_RM[:, 0])
        markers[marker_id] = Marker(marker_id, X_RM, size)
    return MarkerMap(family("DICT_4X4_50"), size, markers, frame=SHELL_FRAME)


def check_on_shell(marker_map: MarkerMap, radius: float, tolerance: float = 2e-4) -> None:
    """Refuses markers whose corners do not lie on the sphere, or that face its centre.

    Args:
        marker_map: in frame R.
        radius: of the sphere, m.
        tolerance: m; the default lets markers through that were placed on the tangent plane.

    Raises:
        ValueError: names the first such marker and by how much it is off.
    """
    require_positive(radius=radius, tolerance=tolerance)
    for marker in marker_map:
        off = np.linalg.norm(marker.corners(), axis=1) - radius
        worst = float(off[np.argmax(np.abs(off))])
        if not abs(worst) <= tolerance:
            raise ValueError(
                f"marker {marker.id} is off the shell: a corner lies {abs(worst) * 1e3:.3g} mm "
                f"{'outside' if worst > 0 else 'inside'} the sphere of radius {radius * 1e3:g} mm"
                f" (allowed: {tolerance * 1e3:g} mm)"
            )
        if marker.X_WM.rotation().matrix()[:, 0] @ marker.X_WM.translation() <= 0:
            raise ValueError(f"marker {marker.id} faces the centre of the shell: must face outward")


def misplaced(marker_map: MarkerMap, *, bound: float, seed: int) -> MarkerMap:
    """Returns the map with every marker shifted on the sphere and turned on the spot.

    Each is turned about the sphere's centre by a rotation vector whose three components (about the
    marker's normal, its right, its up) are drawn uniformly from within the bound, so that it stays
    on the sphere. A marker's error depends on its id and the seed alone.

    Args:
        marker_map: in frame R.
        bound: rad.
        seed: of the draw.
    """
    require_non_negative(bound=bound)
    key = stream_key(seed, "marker placement")
    markers = {}
    for marker in marker_map:
        turn = generator(key, marker.id).uniform(-bound, bound, 3)
        R_RM = marker.X_WM.rotation().matrix()
        turn_R = R_RM @ rotation_from_vector(turn) @ R_RM.T
        moved = RotationMatrix(nearest_rotation(turn_R @ R_RM))
        X_RM = RigidTransform(moved, turn_R @ marker.X_WM.translation())
        markers[marker.id] = Marker(marker.id, X_RM, marker.size)
    return MarkerMap(marker_map.family, marker_map.size, markers, marker_map.frame)
