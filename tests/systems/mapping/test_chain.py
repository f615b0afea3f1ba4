from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from systems.mapping.chain import Chain, ambiguity, gated_chain, naive_chain, nearest_rotation
from systems.mapping.gathering import gather
from systems.mapping.sightings import Sightings
from systems.markers.planar_pose import planar_poses
from tests.mapping_world import CAMERA, SIZE, Circuit, circuit

Array = NDArray[np.float64]
CHAINS = [naive_chain, gated_chain]
both = pytest.mark.parametrize("chain", CHAINS)


def anchored(chain: Any, world: Circuit, noise: float, seed: int = 0) -> Chain:
    X = RigidTransform(RotationMatrix(world.scene.R_WT[0]), world.scene.p_WT[0])
    found = chain(world.sightings(noise, seed), anchor=0, X_W_anchor=X)
    assert isinstance(found, Chain)
    return found


def tag_errors(found: Chain, world: Circuit) -> Array:
    return np.linalg.norm(found.scene.p_WT - world.scene.p_WT, axis=1)[found.tags][1:]


@both
def test_without_noise_the_chain_closes(chain: Any) -> None:
    world = circuit()
    found = anchored(chain, world, 0.0)
    assert found.tags.all()
    np.testing.assert_allclose(found.scene.p_WT, world.scene.p_WT, atol=1e-6)
    np.testing.assert_allclose(found.scene.R_WT, world.scene.R_WT, atol=1e-6)
    assert found.frames.all()
    np.testing.assert_allclose(found.scene.positions(), world.scene.positions(), atol=1e-6)
    np.testing.assert_allclose(found.scene.R_CW, world.scene.R_CW, atol=1e-6)


def test_the_anchor_places_the_naive_camera_wherever_it_is_seen() -> None:
    world = circuit()
    found = anchored(naive_chain, world, 0.3)
    s = world.sightings(0.3)
    poses = planar_poses(s.rays, s.by_ray, s.sizes[s.tag])
    with_anchor = np.flatnonzero(s.tag == 0)
    assert len(with_anchor) > 5
    for k in with_anchor:  # world_T_cam = world_T_tag0 (cam_T_tag0)^-1
        X_CT = RigidTransform(RotationMatrix(poses.R[k, 0]), poses.p[k, 0])
        X_WT = RigidTransform(RotationMatrix(world.scene.R_WT[0]), world.scene.p_WT[0])
        camera = found.scene.positions()[s.frame[k]]
        np.testing.assert_allclose(camera, (X_WT @ X_CT.inverse()).translation(), atol=1e-9)


def test_errors_grow_along_the_way_and_the_gate_lessens_them() -> None:
    naive, gated, near, far = [], [], [], []
    for seed in range(10):
        world = circuit(seed=seed)
        naive.append(tag_errors(anchored(naive_chain, world, 0.3, seed), world).mean())
        found = anchored(gated_chain, world, 0.3, seed)
        assert found.tags.all()
        errors = tag_errors(found, world)  # the first and the last one are beside the anchor
        near.append(errors[[0, 1, -2, -1]].mean())
        far.append(errors[9:14].mean())
        gated.append(errors.mean())
    assert np.median(far) > 1.5 * np.median(near)
    # What bundle adjustment is measured against: decimetres, and some centimetres.
    assert 0.3 < np.median(naive) < 2.0
    assert 0.03 < np.median(gated) < 0.15


def test_a_mean_of_rotations() -> None:
    turns = [RollPitchYaw(0.1, 0.2, 0.3 + d).ToRotationMatrix().matrix() for d in (-0.2, 0.2)]
    expected = RollPitchYaw(0.1, 0.2, 0.3).ToRotationMatrix().matrix()
    np.testing.assert_allclose(nearest_rotation(np.mean(turns, axis=0)), expected, atol=1e-12)


def test_ambiguity_tells_which_pose_could_be_flipped() -> None:
    def squared(tilt_deg: float, seed: int) -> Array:
        corners = CAMERA.project(_corners(np.radians(tilt_deg), 1.0))
        noise = 0.3 * np.random.default_rng(seed).standard_normal(corners.shape)
        rays, by_ray = CAMERA.rays((corners + noise)[None])
        return planar_poses(rays, by_ray, np.array([SIZE])).squared_error

    def mean_of(tilt_deg: float) -> float:
        return float(np.mean([ambiguity(squared(tilt_deg, seed))[0] for seed in range(20)]))

    assert mean_of(40.0) < 0.1
    assert mean_of(2.0) > 0.3
    # By hand: RMS of 1 and 4 px; certainty; none at all.
    errors = np.array([[4.0, 64.0], [0.0, 1.0], [np.inf, np.inf]])
    np.testing.assert_allclose(ambiguity(errors), [0.25, 0.0, np.inf])


def _corners(tilt: float, distance: float) -> Array:
    """Corners (4, 3) in C of a square before the camera, turned about its vertical axis."""
    h = SIZE / 2
    across, up = np.array([-h, h, h, -h]), np.array([-h, -h, h, h])
    x, z = across * np.cos(tilt), distance + across * np.sin(tilt)
    return np.stack([x, up, z], axis=1)


@both
def test_what_is_not_connected_has_no_pose(chain: Any) -> None:
    s = circuit().sightings()
    # What only the first hundred frames show has no place ...
    late = s.select(s.frame >= 100)
    part = chain(late, anchor=0, X_W_anchor=RigidTransform())
    assert not part.frames[:100].any()
    assert set(np.unique(late.tag)) == set(np.flatnonzero(part.tags))
    assert part.tags.sum() < s.tags
    # ... and without the anchor nothing has a place.
    lost = chain(s.select(s.tag != 0), anchor=0, X_W_anchor=RigidTransform())
    assert np.flatnonzero(lost.tags).tolist() == [0]
    assert not lost.frames.any()


@both
def test_the_map_moves_with_the_anchor(chain: Any) -> None:
    world = circuit()
    s = world.sightings(0.3)
    X = RigidTransform(RollPitchYaw(0.2, -0.1, 2.0), [3.0, -1.0, 0.5])
    here = chain(s, anchor=0, X_W_anchor=RigidTransform())
    there = chain(s, anchor=0, X_W_anchor=X)
    moved = here.scene.p_WT @ X.rotation().matrix().T + X.translation()
    np.testing.assert_allclose(there.scene.p_WT, moved, atol=1e-4)


@both
def test_a_recording_s_detections_can_be_chained(chain: Any) -> None:
    world = circuit()
    gathered = gather(world.detections(0.3), camera=CAMERA, size=SIZE)
    found = chain(gathered.sightings, anchor=0, X_W_anchor=RigidTransform())
    assert found.tags.all()


@both
def test_nonsense_corners_are_not_used(chain: Any) -> None:
    world = circuit()
    s = world.sightings()
    rays = s.rays.copy()
    bad = s.tag == 5
    rays[bad] = rays[bad][:, [0, 2, 1, 3]]  # a bow: no convex square
    broken = Sightings(s.frame, s.tag, rays, s.by_ray, s.sizes, s.frames)
    X = RigidTransform(RotationMatrix(world.scene.R_WT[0]), world.scene.p_WT[0])
    found = chain(broken, anchor=0, X_W_anchor=X)
    assert not found.tags[5]
    assert found.tags.sum() == s.tags - 1
    others = np.arange(s.tags) != 5
    np.testing.assert_allclose(found.scene.p_WT[others], world.scene.p_WT[others], atol=1e-6)


def test_no_pose_passes_a_gate_of_zero() -> None:
    s = circuit().sightings(0.3)
    found = gated_chain(s, anchor=0, X_W_anchor=RigidTransform(), max_ambiguity=0.0)
    assert np.flatnonzero(found.tags).tolist() == [0]
    # The camera is placed by the anchor all the same.
    assert set(np.flatnonzero(found.frames)) == set(s.frame[s.tag == 0])


def test_bad_arguments() -> None:
    s = circuit(frames=24).sightings()
    for chain in CHAINS:
        with pytest.raises(ValueError, match="anchor is 24: must be the number of a tag, 0 to 23"):
            chain(s, anchor=24, X_W_anchor=RigidTransform())
    with pytest.raises(ValueError, match="max_ambiguity is -1"):
        gated_chain(s, anchor=0, X_W_anchor=RigidTransform(), max_ambiguity=-1)
    with pytest.raises(ValueError, match="pictures is 0"):
        gated_chain(s, anchor=0, X_W_anchor=RigidTransform(), pictures=0)
