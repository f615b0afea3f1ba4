"""Our adjustment beside GTSAM's, on the same small problem."""

from __future__ import annotations

import numpy as np
import pytest

from systems.mapping.adjustment import adjust, robust_cost
from systems.mapping.sightings import Sightings
from tests.mapping_world import circuit

pytest.importorskip("gtsam", reason="GTSAM is not installed")


@pytest.mark.parametrize("spoiled", [False, True])
def test_gtsam_ends_at_the_same_cost_and_poses(spoiled: bool) -> None:
    from tests.benchmarks.gtsam_mapping import solve

    world = circuit(frames=60)
    s = world.sightings(0.3, seed=1)
    rays = s.rays.copy()
    if spoiled:
        rays[::9] += 0.05  # 24 px: Huber's linear part
    sightings = Sightings(s.frame, s.tag, rays, s.by_ray, s.sizes, s.frames)
    rng = np.random.default_rng(2)
    off = 0.02 * rng.standard_normal((s.tags, 6))
    off[0] = 0
    start = world.scene.moved(0.02 * rng.standard_normal((s.frames, 6)), off)
    ours = adjust(start, sightings, anchor=0, pixel_noise=0.3, tolerance=1e-12, iterations=200)
    theirs = solve(start, sightings, anchor=0, pixel_noise=0.3, tolerance=1e-12)
    cost = float(robust_cost(ours.scene, sightings, 0.3).sum())
    assert cost == pytest.approx(theirs.cost, rel=1e-6)
    assert (cost > 10000) == spoiled
    np.testing.assert_allclose(ours.scene.p_WT, theirs.scene.p_WT, atol=2e-4)
    np.testing.assert_allclose(ours.scene.p_CW, theirs.scene.p_CW, atol=2e-4)
    np.testing.assert_allclose(ours.scene.R_WT, theirs.scene.R_WT, atol=1e-3)
