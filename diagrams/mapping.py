"""`tagtrail map`: a marker map and the camera's way out of anyone's recording."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RotationMatrix

from diagrams.mapping_frames import frame_rows, worst_frames, write_frames
from diagrams.mapping_plots import plot_map
from diagrams.mapping_source import Observed, observe, wheel_odometry
from diagrams.mapping_viewer import show_map
from diagrams.report import finite
from diagrams.schema import ScenarioError
from diagrams.trajectories import write_poses
from systems.cameras import PinholeCamera
from systems.mapping.camera_check import Freed, suspect_camera
from systems.mapping.gathering import Gathered, gather
from systems.mapping.mapping import MappingParameters, TagMap, build_map
from systems.mapping.odometry import motion_of_odometry
from systems.mapping.residuals import Residuals, residuals_of
from systems.mapping.trajectory import Trajectory, trajectory
from systems.markers.layout import Marker, MarkerMap, load_map
from systems.messages import Detections
from systems.validation import require_positive

Array = NDArray[np.float64]

RESULTS = (
    "map.json",
    "trajectory.tum",
    "covariances.npz",
    "frames.csv",
    "report.json",
    "summary.png",
    "replay.html",
)
_THINNED = 150  # frames, about, that a camera is tried with
_MIN_FRAMES = 3  # a tag seen in fewer gets no place in a map


@dataclass(frozen=True)
class Sizes:
    """Sides of the tags' black squares, m.

    Attributes:
        usual: of tags that have no size of their own.
        own: by id.
    """

    usual: float
    own: dict[int, float] = field(default_factory=dict)


@dataclass(frozen=True)
class MappingRun:
    """A mapping that has ended.

    Attributes:
        report: what `report.json` holds.
        tag_map: what was found.
        path: of camera or body.
        observed: what it was found in.
    """

    report: dict[str, Any]
    tag_map: TagMap
    path: Trajectory
    observed: Observed

    @property
    def succeeded(self) -> bool:
        """Whether the map is to be trusted."""
        return self.report["outcome"] != "refused"


def map_recording(
    recording: Path,
    *,
    out: Path,
    family: str | None = None,
    size: float | None = None,
    own_sizes: dict[int, float] | None = None,
    anchor: int | None = None,
    camera: Path | None = None,
    topic: str | None = None,
    odometry: str | None = None,
    known: Path | None = None,
    localize_only: bool = False,
    connected_only: bool = False,
    parameters: MappingParameters | None = None,
    meshcat: Meshcat | None = None,
    progress: Callable[[float, float], None] | None = None,
) -> MappingRun:
    """Maps the tags of a recording and writes the results into a folder.

    `map.json` is a marker map, `trajectory.tum` the poses in it: of the camera's optical frame, or
    of the frame that the recording's /tf_static mounts it on. `covariances.npz` holds the marginal
    covariances of both (`ids`, `tags` (n, 6, 6); `stamps`, `poses` (m, 6, 6); rotation first, as a
    small rotation vector in the map's frame, then the position). A map that cannot be trusted is
    not written: the report says why. The report has the residuals by tag and of the worst frames;
    `frames.csv` has them of every frame (see `mapping_frames`), also where the map is refused.

    Args:
        recording: see `diagrams.mapping_source.observe`.
        out: folder of the results; an earlier run's are replaced.
        family: of the markers; None takes what the recording or the known map says, else 36h11.
        size: side of the black square of new tags, m; None takes the known map's.
        own_sizes: of those new tags, by id, that have another one.
        anchor: id of the tag that is the map's origin; None takes the one seen most often.
        camera: camera file; None takes the recording's own.
        topic: of detections or pictures, where a recording has several.
        odometry: topic of the body's odometry, which smooths the way; None takes none.
        known: marker map whose tags stay where it has them; others are added.
        localize_only: add none.
        connected_only: leave tags out that no picture connects to the others, instead of refusing.
        parameters: what is trusted.
        meshcat: where it is shown, and `replay.html` comes from.
        progress: called with the frames done and the whole (inf: unknown).

    Raises:
        ValueError: bad input, in one line.
    """
    started = time.perf_counter()
    parameters = parameters or MappingParameters()
    given = load_map(known) if known is not None else None
    sizes = _sizes(size, own_sizes, given, localize_only)
    if given is not None and anchor is not None:
        raise ScenarioError("--anchor: --map says where its tags are, leave one of them out")
    if given is not None and family is None:
        family = given.family.name
    observed = observe(recording, family=family, camera=camera, topic=topic, progress=progress)
    if given is not None and observed.family != given.family:
        raise ScenarioError(
            f"marker map {known} is of {given.family.name}, the recording of {observed.family.name}"
        )
    detections, unknown = observed.detections, 0
    if localize_only and given is not None:
        detections, unknown = _of_map(detections, given)
    wheels = None if odometry is None else wheel_odometry(recording, odometry, observed)
    poses = None if given is None else {marker.id: marker.X_WM for marker in given}

    def mapped(camera: PinholeCamera, thinned: bool = False) -> tuple[Gathered, TagMap]:
        step = max(1, len(detections) // _THINNED) if thinned else 1
        gathered = gather(
            detections[::step],
            camera=camera,
            size=sizes.usual,
            sizes=sizes.own,
            min_frames=1 if localize_only or thinned else _MIN_FRAMES,
        )
        motion = None
        if wheels is not None and observed.X_BC is not None:
            motion = motion_of_odometry(gathered.stamps, *wheels, X_BC=observed.X_BC)
        found = build_map(
            gathered, anchor=anchor, known=poses, motion=motion, parameters=parameters
        )
        return gathered, found

    before = time.perf_counter()
    gathered, tag_map = mapped(observed.camera)
    solved = time.perf_counter() - before
    freed, reasons = suspect_camera(
        tag_map,
        observed.camera,
        remap=lambda camera: mapped(camera, thinned=True)[1],
        sizes=given is not None,
    )
    reasons |= tag_map.suspects
    if connected_only:
        reasons.pop("disconnected", None)
    path, ambiguous = trajectory(tag_map, X_BC=observed.X_BC, margin=parameters.flip_margin)
    of_tags, of_frames = residuals_of(tag_map)
    frames = frame_rows(tag_map, of_frames, path)
    outcome = "refused" if reasons else "localized" if localize_only else "mapped"
    report = {
        "recording": str(recording),
        "outcome": outcome,
        "reasons": reasons,
        "solve_seconds": solved,
        "wall_seconds": 0.0,
        "metrics": _metrics(tag_map, path),
        "health": {
            "recording": observed.dropped | {"unknown_tag": unknown},
            "sightings": gathered.dropped
            | {
                "disconnected": len(gathered.sightings) - len(tag_map.all_sightings),
                "outlier": len(tag_map.all_sightings) - len(tag_map.sightings),
            },
            "trajectory": {"ambiguous_frame": ambiguous},
        },
        "map": {
            "family": observed.family.name,
            "size": sizes.usual,
            "held": tag_map.ids[tag_map.held].tolist(),
            "source": observed.source,
            "trajectory_of": observed.body or observed.frame_id or "camera",
        },
        "camera": camera_row(observed.camera, freed),
        "tags": tag_rows(tag_map, of_tags),
        "worst_frames": worst_frames(frames),
    }
    marker_map = as_marker_map(tag_map, observed, sizes, given)
    _write(out, reasons, marker_map, tag_map, path, localize_only)
    write_frames(out / "frames.csv", frames)
    plot_map(out / "summary.png", tag_map, path, marker_map, report, frames)
    if meshcat is not None:
        show_map(meshcat, marker_map, path, observed.X_BC)
        (out / "replay.html").write_text(meshcat.StaticHtml())
    report["wall_seconds"] = time.perf_counter() - started
    (out / "report.json").write_text(json.dumps(finite(report), indent=1) + "\n")
    return MappingRun(report, tag_map, path, observed)


def as_marker_map(
    tag_map: TagMap, observed: Observed, sizes: Sizes, given: MarkerMap | None = None
) -> MarkerMap:
    """Returns the marker map, with known tags that were not seen too."""
    markers = dict(given.markers) if given is not None else {}
    scene = tag_map.adjustment.scene
    for k, marker_id in enumerate(tag_map.ids.tolist()):
        R = RotationMatrix.ProjectToRotationMatrix(scene.R_WT[k])
        X_WM = RigidTransform(R, scene.p_WT[k])
        size = float(tag_map.sightings.sizes[k])
        markers.setdefault(marker_id, Marker(marker_id, X_WM, size))
    frame = given.frame if given is not None else "map"
    return MarkerMap(observed.family, sizes.usual, dict(sorted(markers.items())), frame)


def camera_row(camera: PinholeCamera, freed: Freed) -> dict[str, float]:
    """Returns the camera as it was told, and as the recording alone would have it."""
    focal = math.sqrt(camera.K[0, 0] * camera.K[1, 1])
    return {
        "focal_length_px": focal,
        "focal_length_freed_px": focal * freed.focal[0],
        "focal_length_freed_sigma_px": focal * freed.focal[1],
        "k1": float(camera.D[0]),
        "k1_freed": float(camera.D[0]) + freed.radial[0],
        "chi2_explained_fraction": freed.explained,
    }


def tag_rows(tag_map: TagMap, of_tags: Residuals) -> list[dict[str, Any]]:
    """Returns for each tag how often it was seen, its residuals and standard deviations."""
    turn, place = _tag_sigmas(tag_map)
    return [
        {
            "ID": int(marker_id),
            "sightings": int(of_tags.used[k]),
            "outliers": int(of_tags.outliers[k]),
            "reprojection_rms_px": float(of_tags.rms[k]),
            "largest_px": float(of_tags.largest[k]),
            "sigma_deg": math.degrees(turn[k]),
            "sigma_m": float(place[k]),
        }
        for k, marker_id in enumerate(tag_map.ids)
    ]


def _tag_sigmas(tag_map: TagMap) -> tuple[Array, Array]:
    """Returns (tags,) standard deviations of the rotation, rad, and of the position, m."""
    P = tag_map.adjustment.tag_covariance
    turn, place = (
        np.sqrt(np.maximum(np.trace(part, axis1=1, axis2=2), 0.0))
        for part in (P[:, :3, :3], P[:, 3:, 3:])
    )
    return turn, place


def _metrics(tag_map: TagMap, path: Trajectory) -> dict[str, float | int]:
    sigma = np.sqrt(np.trace(path.covariance[:, 3:, 3:], axis1=1, axis2=2))
    return {
        "reprojection_rms_px": tag_map.rms(),
        "corners_used_fraction": tag_map.used,
        "chi2_per_dof": tag_map.chi2_per_dof(),
        "pixel_noise_px": tag_map.pixel_noise,
        "tags": len(tag_map.ids),
        "frames": len(path),
        "tag_sigma_max_m": float(_tag_sigmas(tag_map)[1].max()),
        "pose_sigma_median_m": float(np.median(sigma)) if len(sigma) else math.nan,
    }


def _sizes(
    size: float | None, own: dict[int, float] | None, given: MarkerMap | None, localize_only: bool
) -> Sizes:
    """Returns the sizes; those of known tags are the known map's."""
    if localize_only and given is None:
        raise ScenarioError("--localize-only needs --map FILE")
    if localize_only and size is not None:
        raise ScenarioError("--size: --localize-only adds no tags, their sizes are the map's")
    if size is None and given is None:
        raise ScenarioError("--size: how large are the tags? (side of the black square, metres)")
    if size is not None:
        require_positive(**{"--size": size})
    for i, s in (own or {}).items():
        require_positive(**{f"--size of tag {i}": s})
        if given is not None and i in given and given.markers[i].size != s:
            raise ScenarioError(
                f"--size of tag {i} is {s:g}: the map has it at {given.markers[i].size:g}"
            )
    known = {marker.id: marker.size for marker in given} if given is not None else {}
    usual = size if size is not None else given.size if given is not None else math.nan
    return Sizes(usual, (own or {}) | known)


def _of_map(detections: list[Detections], given: MarkerMap) -> tuple[list[Detections], int]:
    """Returns the detections of the map's tags, and how many others there were."""
    kept, dropped = [], 0
    for entry in detections:
        mine = np.isin(entry.ids, list(given.markers))
        dropped += int((~mine).sum())
        kept.append(entry.select(mine))
    return kept, dropped


def _write(
    out: Path,
    reasons: dict[str, str],
    marker_map: MarkerMap,
    tag_map: TagMap,
    path: Trajectory,
    localize_only: bool,
) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in RESULTS:
            (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise ScenarioError(f"--out {out}: {error.strerror}") from error
    if reasons:
        return
    if not localize_only:
        marker_map.save(out / "map.json")
    rotations = map(RotationMatrix.ProjectToRotationMatrix, path.R_WB)
    quaternions = [R.ToQuaternion().wxyz() for R in rotations]
    write_poses(
        out / "trajectory.tum",
        path.stamps,
        np.column_stack([np.reshape(quaternions, (-1, 4)), path.p_WB]),
    )
    np.savez_compressed(
        out / "covariances.npz",
        ids=tag_map.ids,
        tags=tag_map.adjustment.tag_covariance,
        stamps=path.stamps,
        poses=path.covariance,
    )
