"""A map in Meshcat: tags as boards, the camera on its way through the recording."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, Cylinder, Mesh, Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix

from plants.boards import PLATE_THICKNESS, face_mesh, marker_texture
from systems.mapping.trajectory import Trajectory
from systems.markers.layout import MarkerMap

Array = NDArray[np.float64]

_ROOT = "map"
_FRAMES_PER_SECOND = 32.0
_LONGEST = 60.0  # s of the replay: longer recordings run faster
_PAUSE = 2.0  # s without a frame, after which the camera jumps instead of gliding
_VISIBLE = 0.04  # of the whole map's reach: length of the moving frame's axes
_COLOURS = (Rgba(0.9, 0.1, 0.1), Rgba(0.1, 0.7, 0.1), Rgba(0.1, 0.2, 0.9))


def show_map(
    meshcat: Meshcat,
    marker_map: MarkerMap,
    way: Trajectory,
    X_BC: RigidTransform | None = None,
) -> None:
    """Shows a map and records the way through it, for `StaticHtml`.

    Args:
        meshcat: where.
        marker_map: the tags.
        way: of the camera, or of what it is mounted on.
        X_BC: pose of the camera's optical frame in the moving frame; None if that is the camera.
    """
    for marker in marker_map:
        cells = marker_map.family.cells
        side = marker.size * (cells + 2) / cells
        name = f"{_ROOT}/tags/{marker.id}"
        meshcat.SetTransform(name, marker.X_WM)
        plate = RigidTransform([-PLATE_THICKNESS, 0.0, 0.0])
        meshcat.SetObject(
            f"{name}/plate", Box(PLATE_THICKNESS, side, side), Rgba(0.85, 0.85, 0.85, 1)
        )
        meshcat.SetTransform(f"{name}/plate", plate)
        face = face_mesh(marker_texture(marker_map.family, marker.id), side)
        meshcat.SetObject(f"{name}/face", Mesh(face, 1.0))
    if len(way) == 0:
        return
    meshcat.SetLine(f"{_ROOT}/way", np.asfortranarray(way.p_WB.T), 2.0, Rgba(0.1, 0.4, 0.9))
    places = np.concatenate([way.p_WB, [marker.X_WM.translation() for marker in marker_map]])
    size = _VISIBLE * float(np.linalg.norm(np.ptp(places, axis=0)))
    _draw_frame(meshcat, f"{_ROOT}/moving/axes", size)
    _draw_sight(meshcat, f"{_ROOT}/moving/sight", size)
    meshcat.SetTransform(f"{_ROOT}/moving/sight", X_BC or RigidTransform())
    _record(meshcat, way)
    _look(meshcat, places)


def _draw_frame(meshcat: Meshcat, name: str, length: float) -> None:
    """Draws axes x, y, z in red, green, blue."""
    turns = (
        RotationMatrix.MakeYRotation(np.pi / 2),
        RotationMatrix.MakeXRotation(-np.pi / 2),
        RotationMatrix(),
    )
    for axis, (turn, colour) in enumerate(zip(turns, _COLOURS, strict=True)):
        path = f"{name}/{'xyz'[axis]}"
        meshcat.SetObject(path, Cylinder(0.04 * length, length), colour)
        meshcat.SetTransform(path, RigidTransform(turn, length / 2 * np.eye(3)[axis]))


def _draw_sight(meshcat: Meshcat, name: str, length: float) -> None:
    """Draws the edges of a camera's field of view, the optical axis along z."""
    meshcat.SetObject(f"{name}/eye", Sphere(0.08 * length), Rgba(0.1, 0.1, 0.1))
    rim = length * np.array([[-0.6, -0.45, 1], [0.6, -0.45, 1], [0.6, 0.45, 1], [-0.6, 0.45, 1]])
    starts = np.concatenate([np.zeros((4, 3)), rim])
    ends = np.concatenate([rim, np.roll(rim, -1, axis=0)])
    meshcat.SetLineSegments(
        f"{name}/edges", np.asfortranarray(starts.T), np.asfortranarray(ends.T), 2.0,
        Rgba(1.0, 0.75, 0.1),
    )  # fmt: skip


def _record(meshcat: Meshcat, way: Trajectory) -> None:
    seconds = way.stamps - way.stamps[0]
    rate = max(1.0, float(seconds[-1]) / _LONGEST)
    meshcat.StartRecording(
        frames_per_second=_FRAMES_PER_SECOND, set_visualizations_while_recording=False
    )
    X = [
        RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)
        for R, p in zip(way.R_WB, way.p_WB, strict=True)
    ]
    for k, t in enumerate(seconds):
        if k and t - seconds[k - 1] > _PAUSE:
            meshcat.SetTransform(f"{_ROOT}/moving", X[k - 1], t / rate - 1 / _FRAMES_PER_SECOND)
        meshcat.SetTransform(f"{_ROOT}/moving", X[k], t / rate)
    meshcat.StopRecording()
    meshcat.PublishRecording()


def _look(meshcat: Meshcat, places: Array) -> None:
    """Puts the viewer where all places (n, 3) are in sight, obliquely from above."""
    low, high = places.min(axis=0), places.max(axis=0)
    middle = (low + high) / 2
    reach = float(np.linalg.norm(high - low))
    meshcat.SetCameraPose(middle + 0.5 * reach * np.array([-0.5, -0.8, 0.9]), middle)
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", True)
