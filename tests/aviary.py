"""TagSLAM's recording of a room with tag boards: what was seen, and TagSLAM's own result."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from diagrams.mapping_source import Observed, observe
from systems.io.bag import BagReader
from systems.io.ros_types import time_from_ros
from systems.mapping.gathering import Gathered, gather
from tests.recordings import FOLDER

Array = NDArray[np.float64]

AVIARY = FOLDER / "tagslam_aviary"
RECORDING = AVIARY / "tag_detections.bag"
CAMERA = AVIARY / "cameras.yaml"
SIZE = 0.12  # m


@cache
def aviary() -> tuple[Observed, Gathered]:
    """Returns what was seen."""
    observed = observe(RECORDING, camera=CAMERA)
    return observed, gather(observed.detections, camera=observed.camera, size=SIZE)


def tagslams_way() -> tuple[Array, Array]:
    """Returns stamps (n,) s and positions (n, 3) m of the camera, as TagSLAM has them.

    The camera's pose on its rig is the identity (`camera_poses.yaml`).
    """
    stamps, places = [], []
    for _, _, message in BagReader(AVIARY / "reference.bag").messages(["/tagslam/odom/body_rig"]):
        p = message.pose.pose.position
        stamps.append(time_from_ros(message.header.stamp))
        places.append((p.x, p.y, p.z))
    return np.array(stamps), np.array(places)


def rms_after_alignment(found: Array, reference: Array) -> float:
    """Returns the root mean square distance of points (n, 3) after the best rotation and shift.

    Source: Kabsch, "A solution for the best rotation to relate two sets of vectors", 1976.
    """
    a, b = found - found.mean(axis=0), reference - reference.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    return float(np.sqrt(((a @ U @ flip @ Vt - b) ** 2).sum(axis=1).mean()))


def rms_to_tagslam(stamps: Array, places: Array) -> tuple[float, int]:
    """Returns the RMS distance to TagSLAM's way after alignment, m, and over how many frames."""
    theirs_at, theirs = tagslams_way()
    nearest = np.abs(theirs_at[:, None] - stamps).argmin(axis=1)
    common = np.abs(stamps[nearest] - theirs_at) < 1e-3
    return rms_after_alignment(places[nearest[common]], theirs[common]), int(common.sum())
