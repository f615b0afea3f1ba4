"""The camera's motion by wheel odometry: exact where the wheels are, as uncertain as said."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from systems.mapping.gathering import gather
from systems.mapping.mapping import build_map
from systems.mapping.odometry import OdometryParameters, motion_of_odometry
from systems.mapping.scene import rotation_vector
from systems.markers.pnp import rotation_from_vector
from tests.mapping_world import CAMERA, SIZE, Circuit, circuit

Array = NDArray[np.float64]

X_BC = RigidTransform(RollPitchYaw(-np.pi / 2, 0.0, -np.pi / 2), [0.12, -0.05, 0.2])


def driven(world: Circuit) -> Array:
    """The planar poses (frames, 3) of the body below the camera."""
    R_WB = world.scene.R_CW.swapaxes(1, 2) @ X_BC.rotation().matrix().T
    p = world.scene.positions() - R_WB @ X_BC.translation()
    return np.column_stack([p[:, :2], np.arctan2(R_WB[:, 1, 0], R_WB[:, 0, 0])])


def test_exact_wheels_give_the_exact_motion_of_the_camera() -> None:
    world = circuit(frames=50)
    times = np.arange(50) / 10
    found = motion_of_odometry(times, times, driven(world), X_BC=X_BC)
    scene = world.scene
    R = scene.R_CW[:-1] @ scene.R_CW[1:].swapaxes(1, 2)
    np.testing.assert_allclose(found.R, R, atol=1e-9)
    p = scene.p_CW[:-1] - (R @ scene.p_CW[1:, :, None])[..., 0]
    np.testing.assert_allclose(found.p, p, atol=1e-9)


def test_errors_of_the_wheels_are_those_of_the_camera_as_told() -> None:
    p = OdometryParameters(slip=0.05, turn=0.2)
    poses = np.array([[0.0, 0.0, 0.3], [0.08, 0.05, 0.5]])
    found = motion_of_odometry(np.array([0.0, 0.5]), np.array([0.0, 0.5]), poses, X_BC=X_BC,
                               parameters=p)  # fmt: skip
    place = 0.05 * np.hypot(0.08, 0.05) + p.position_floor
    deviation = [p.tilt, p.tilt, 0.2 * 0.2 + p.heading_floor, place, place, p.height]
    rng = np.random.default_rng(0)
    X_WB = [RigidTransform(RollPitchYaw(0, 0, a), [x, y, 0]) for x, y, a in poses]
    X_BB = X_WB[0].inverse() @ X_WB[1]
    errors = []
    for step in rng.standard_normal((4000, 6)) * deviation:
        turn = RotationMatrix.ProjectToRotationMatrix(rotation_from_vector(step[None, :3])[0])
        wrong = RigidTransform(turn @ X_BB.rotation(), X_BB.translation() + step[3:])
        X_CC = X_BC.inverse() @ wrong @ X_BC
        off = X_CC.rotation().matrix() @ found.R[0].T
        errors.append([*rotation_vector(off[None])[0], *(X_CC.translation() - found.p[0])])
    said = np.linalg.inv(found.root[0].T @ found.root[0])
    np.testing.assert_allclose(np.cov(np.transpose(errors)), said, atol=0.06 * said.max())


def test_where_wheels_were_silent_nothing_is_known() -> None:
    frames = np.arange(10.0) / 2
    stamps = np.delete(np.linspace(0.4, 4.2, 39), np.arange(12, 25))  # a gap from 1.5 to 2.9 s
    found = motion_of_odometry(frames, stamps, np.zeros((26, 3)), X_BC=X_BC)
    known = found.root.any(axis=(1, 2))
    assert known.tolist() == [False, True, True, False, False, False, True, True, False]
    whole = found.over(np.array([1, 3, 6, 8]))
    assert whole.root.any(axis=(1, 2)).tolist() == [True, False, True]


def test_wheels_steady_the_way_where_little_is_seen() -> None:
    world = circuit(frames=120)
    scene = world.scene
    few = [d.select(np.arange(len(d)) == k % max(len(d), 1)) for k, d in
           enumerate(world.detections(1.0))]  # fmt: skip
    known = {
        k: RigidTransform(RotationMatrix(scene.R_WT[k]), scene.p_WT[k])
        for k in range(len(scene.p_WT))
    }
    gathered = gather(few, camera=CAMERA, size=SIZE, min_frames=1)
    times = np.arange(120) / 10
    motion = motion_of_odometry(gathered.stamps, times, driven(world), X_BC=X_BC)
    off = []
    for wheels in (None, motion):
        tag_map = build_map(gathered, known=known, motion=wheels)
        true = scene.positions()[np.rint(10 * tag_map.stamps).astype(int)]
        off.append(np.linalg.norm(tag_map.adjustment.scene.positions() - true, axis=1).mean())
    assert off[1] < off[0] / 2


def test_nonsense_is_refused() -> None:
    pose = np.zeros((2, 3))
    with pytest.raises(ValueError, match="odometry is 'unordered': must be ascending"):
        motion_of_odometry(np.zeros(1), np.array([1.0, 1.0]), pose, X_BC=X_BC)
    with pytest.raises(ValueError, match="odometry is 1: must be two samples"):
        motion_of_odometry(np.zeros(1), np.zeros(1), pose[:1], X_BC=X_BC)
    with pytest.raises(ValueError, match="slip is -1"):
        OdometryParameters(slip=-1)
