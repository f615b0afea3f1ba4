"""A robot with its camera on the shell of 25 markers, without Drake's scene."""

from __future__ import annotations

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from systems.cameras import PinholeCamera
from systems.markers.layout import MarkerMap
from systems.markers.projector import ProjectorParameters, project_markers
from systems.messages import Detections
from systems.shell.angles import rotation
from systems.shell.layout import shell_markers

RADIUS = 0.075
HEIGHT = 0.004  # of base_link
CAMERA = PinholeCamera.from_focal_length(640, 480, 481.0)
# 10 mm over the shell, looking at it; the picture's right is the robot's right.
X_BC = RigidTransform(
    RotationMatrix(np.column_stack([(0.0, -1, 0), (-1, 0, 0), (0, 0, -1)])),
    [0.0, 0.0, 0.010 - HEIGHT],
)
MAP = shell_markers(radius=RADIUS)


def pose(angles: np.ndarray) -> RigidTransform:
    """`X_RB` of a robot that stands there."""
    R = rotation(np.asarray(angles, float))
    return RigidTransform(RotationMatrix(R), (RADIUS + HEIGHT) * R[:, 2])


def detections(
    X_RB: RigidTransform,
    *,
    markers: MarkerMap = MAP,
    mounting: RigidTransform = X_BC,
    noise: float = 0.0,
    seed: int = 0,
    stamp: float = 0.0,
    missed: float = 0.0,
) -> Detections:
    """What the camera's picture shows."""
    placed = list(markers)
    index, corners = project_markers(
        camera=CAMERA,
        X_WC=X_RB @ mounting,
        X_WM=np.array([marker.X_WM.GetAsMatrix34() for marker in placed]),
        sizes=np.array([marker.size for marker in placed]),
        cells=markers.family.cells,
        parameters=ProjectorParameters(pixel_noise=noise, miss_probability=missed),
        random=np.random.default_rng(seed),
    )
    return Detections(
        stamp=stamp,
        family=markers.family.name,
        ids=np.array([placed[k].id for k in index], np.int64),
        corners=corners,
        hamming=np.zeros(len(index), np.int64),
        decision_margin=np.full(len(index), 50.0),
    )
