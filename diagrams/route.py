"""`tagtrail route`: a drivable route from a marker map and a taught trajectory."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from diagrams.route_plot import plot_route
from diagrams.trajectories import read_tum
from systems.cameras import PinholeCamera, load_camera
from systems.markers.layout import load_map
from systems.planners.route_limits import RouteLimits
from systems.planners.route_plan import RoutePlan, plan_route
from systems.planners.tag_view import TagView
from systems.planners.taught_path import taught_path
from systems.validation import nearest, require

Array = NDArray[np.float64]

# The LIMO's, where no camera file is at hand: 640x480 px, 67 degrees from side to side.
DEFAULT_CAMERA = PinholeCamera.from_focal_length(640, 480, 480.0)
_LEVEL = 0.7  # cosine; more tilted than that neither a robot nor its camera stands
_R_BC = RotationMatrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))


@dataclass(frozen=True)
class Mounting:
    """Where the camera sits on the robot, level and looking ahead.

    Attributes:
        ahead: of base_link, m.
        height: above base_link, m; of a camera's own trajectory, which tells it, not used.
    """

    ahead: float = 0.0
    height: float = 0.2


def make_route(
    map_file: Path,
    trajectory: Path,
    *,
    out: Path,
    camera: Path | None = None,
    mounting: Mounting | None = None,
    closed: bool | None = None,
    changes: Sequence[str] = (),
) -> RoutePlan:
    """Makes a route and writes `out`, its report and its figure.

    Args:
        map_file: marker map (JSON).
        trajectory: TUM file of the camera's optical frame or of base_link; which one shows in how
            it stands.
        out: route file (JSON). Beside it come `{name}_report.json` and `{name}.png`.
        camera: camera file; without one, `camera.yaml` beside the map, else `DEFAULT_CAMERA`.
        mounting: of the camera.
        closed: whether the route is to be closed; None finds out.
        changes: limits, `KEY=VALUE` each.

    Raises:
        ValueError: files that cannot be read, or limits that cannot be kept; in one line.
    """
    limits = limits_from(changes)
    tags = load_map(map_file)
    mounting = mounting or Mounting()
    t, spatial = read_tum(trajectory)
    try:
        poses, height = planar_poses(spatial, mounting)
        X_BC = RigidTransform(_R_BC, [mounting.ahead, 0.0, height])
        view = TagView(tags, _camera(camera, map_file), X_BC)
        plan = plan_route(taught_path(t, poses, closed), tags, limits, view)
    except ValueError as error:
        raise ValueError(f"{trajectory} in {map_file}: {error}") from error
    out.parent.mkdir(parents=True, exist_ok=True)
    plan.route.save(out)
    report = {
        "map": str(map_file),
        "trajectory": str(trajectory),
        "closed": plan.route.closed,
        "limits": vars(limits),
        "metrics": plan.metrics(),
        "binds": plan.binds,
    }
    beside(out, "_report.json").write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")
    plot_route(beside(out, ".png"), plan, tags)
    return plan


def beside(out: Path, ending: str) -> Path:
    """Returns the file of another ending beside the route's."""
    return out.with_name(out.stem + ending)


def limits_from(changes: Sequence[str]) -> RouteLimits:
    """Returns the limits with changes, `KEY=VALUE` each.

    Raises:
        ValueError: an unknown limit, or a value that is no number or out of range.
    """
    known = {entry.name: entry.type for entry in fields(RouteLimits)}
    values: dict[str, float] = {}
    for change in changes:
        name, _, text = change.partition("=")
        if name not in known:
            raise ValueError(f"unknown limit {name!r}: {nearest(name, known)}")
        try:
            values[name] = int(text) if known[name] == "int" else float(text)
        except ValueError:
            kind = "a whole number" if known[name] == "int" else "a number"
            raise ValueError(f"{name} is {text!r}: must be {kind}") from None
    return RouteLimits(**values)  # type: ignore[arg-type]


def planar_poses(spatial: Array, mounting: Mounting) -> tuple[Array, float]:
    """Returns the poses of base_link on the ground (n, 3), and the camera's height there, m.

    Args:
        spatial: (n, 7) quaternion w, x, y, z, then x, y, z (m): of the camera's optical frame,
            whose y points down, or of base_link, whose z points up.
        mounting: of the camera.

    Raises:
        ValueError: neither: the map's z does not point up, or the robot lies on its side.
    """
    R = np.array([RotationMatrix(Quaternion(q)).matrix() for q in spatial[:, :4]])
    up, down = float(np.median(R[:, 2, 2])), float(np.median(-R[:, 2, 1]))
    require(
        max(up, down) > _LEVEL,
        "the trajectory's upright axis",
        f"{np.degrees(np.arccos(np.clip(max(up, down), -1, 1))):.0f} deg from the map's z",
        "below 45 deg: base_link's z or the camera's -y",
    )
    ahead = R[:, :2, 2] if down > up else R[:, :2, 0]
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    base = spatial[:, 4:6].copy()
    height = mounting.height + float(np.median(spatial[:, 6]))
    if down > up:
        base -= mounting.ahead * np.column_stack([np.cos(heading), np.sin(heading)])
        height = float(np.median(spatial[:, 6]))
    return np.column_stack([base, heading]), height


def _camera(camera: Path | None, map_file: Path) -> PinholeCamera:
    if camera is not None:
        return load_camera(camera)
    found = map_file.parent / "camera.yaml"
    return load_camera(found) if found.is_file() else DEFAULT_CAMERA
