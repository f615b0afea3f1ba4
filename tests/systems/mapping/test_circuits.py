"""Whole circuits: as exact as can be, far better than a chain, and never wrong in silence."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from systems.cameras import PinholeCamera
from systems.mapping.gathering import gather
from systems.mapping.mapping import TagMap, build_map
from tests.benchmarks.validate_mapping import is_wrong
from tests.mapping_chain import chained, tag_errors
from tests.mapping_world import CAMERA, SIZE, Circuit, circuit


def mapped(world: Circuit, seed: int, camera: PinholeCamera = CAMERA) -> TagMap:
    gathered = gather(world.detections(0.3, seed), camera=camera, size=SIZE)
    X = RigidTransform(RotationMatrix(world.scene.R_WT[0]), world.scene.p_WT[0])
    return build_map(gathered, anchor=0, X_W_anchor=X)


def test_a_lap_is_mapped_to_centimetres_where_a_chain_errs_by_decimetres() -> None:
    world = circuit(frames=600, seed=1)
    truth = world.scene
    ours = tag_errors(mapped(world, 1).adjustment.scene.p_WT, truth, 0)
    sightings = world.sightings(0.3, 1)
    chain = chained(sightings, anchor=0, R_WA=truth.R_WT[0], p_WA=truth.p_WT[0])
    assert ours.mean() < 0.012
    assert tag_errors(chain, truth, 0).mean() > 5 * ours.mean()


def test_a_chain_without_noise_is_exact() -> None:
    world = circuit(frames=200)
    truth = world.scene
    chain = chained(world.sightings(), anchor=0, R_WA=truth.R_WT[0], p_WA=truth.p_WT[0])
    assert tag_errors(chain, truth, 0).max() < 1e-3


@pytest.mark.parametrize("turn_deg", [5, 10, 15, 20])
def test_tags_seen_from_the_front_are_mapped_right_or_refused(turn_deg: float) -> None:
    for seed in range(3):
        world = circuit(frames=60, turn_deg=turn_deg, seed=seed)
        tag_map = mapped(world, seed)
        assert tag_map.suspects or not is_wrong(tag_map, world)


def test_a_wrong_minimum_is_told_from_the_right_one() -> None:
    world = circuit(frames=80)
    tag_map = mapped(world, 0)
    assert not is_wrong(tag_map, world)
    tag_map.adjustment.scene.R_WT[5] = tag_map.adjustment.scene.R_WT[5] @ np.diag([1.0, -1, -1])
    assert is_wrong(tag_map, world)
