"""Poses of camera and body, their covariances, and frames that nobody can place."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from systems.mapping.gathering import gather
from systems.mapping.mapping import TagMap, build_map
from systems.mapping.scene import rotation_vector
from systems.mapping.trajectory import Trajectory, trajectory
from tests.mapping_world import CAMERA, SIZE, Circuit, circuit

MOUNTING = RigidTransform(RollPitchYaw(-1.6, 0.1, -1.5), [0.12, -0.03, 0.2])


def localized(world: Circuit, seed: int = 0, only: int | None = None) -> TagMap:
    scene = world.scene
    found = world.detections(0.3, seed)
    if only is not None:
        found = [d.select(d.ids == only) for d in found]
    known = {
        k: RigidTransform(RotationMatrix(scene.R_WT[k]), scene.p_WT[k])
        for k in range(len(scene.p_WT))
    }
    return build_map(gather(found, camera=CAMERA, size=SIZE, min_frames=1), known=known)


@pytest.mark.parametrize("mounting", [None, MOUNTING])
def test_poses_are_near_the_truth_and_as_near_as_said(mounting: RigidTransform | None) -> None:
    world = circuit(frames=60)
    X_CB = (mounting or RigidTransform()).inverse()
    R_WC = world.scene.R_CW.swapaxes(1, 2)
    R_WB = R_WC @ X_CB.rotation().matrix()
    p_WB = world.scene.positions() + R_WC @ X_CB.translation()
    nees = []
    for seed in range(4):
        way, left_out = trajectory(localized(world, seed), X_BC=mounting)
        assert left_out == 0
        assert way.stamps.tolist() == [k / 10 for k in range(60)]
        turn = rotation_vector(way.R_WB @ R_WB.swapaxes(1, 2))
        error = np.concatenate([turn, way.p_WB - p_WB], axis=1)
        nees.append((error * np.linalg.solve(way.covariance, error[..., None])[..., 0]).sum(1) / 6)
    assert np.mean(nees) == pytest.approx(1.0, abs=0.12)


def test_frames_of_one_tag_with_two_poses_are_left_out() -> None:
    world = circuit(frames=200, turn_deg=25.0)
    tag_map = localized(world, only=7)
    way, left_out = trajectory(tag_map)
    everything, none = trajectory(tag_map, margin=-1e9)
    assert (left_out > 3, none) == (True, 0)
    assert len(way) + left_out == len(everything) == len(tag_map.stamps)
    assert turned(way, world).max() < 0.1  # none is flipped
    assert turned(everything, world).max() > 0.25  # some of those that go are


def turned(way: Trajectory, world: Circuit) -> NDArray[np.float64]:
    """Returns (n,) by how much the poses are turned from the true ones, rad."""
    frames = np.rint(10 * way.stamps).astype(int)
    return np.linalg.norm(rotation_vector(way.R_WB @ world.scene.R_CW[frames]), axis=1)
