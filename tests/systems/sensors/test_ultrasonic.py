from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from pydrake.geometry import Box, Cylinder, Shape, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder

from systems.angles import spatial_pose
from systems.messages import Scan
from systems.raycasting import Solids
from systems.sensors.ultrasonic import (
    UltrasonicParameters,
    UltrasonicRing,
    cone_rays,
    measured_ranges,
    true_ranges,
)

EXACT = UltrasonicParameters(
    range_noise=0.0, range_noise_part=0.0, resolution=0.0, dropout_probability=0.0
)
HEIGHT = RigidTransform([0.0, 0.0, 0.1])


def solids(*placed: tuple[Shape, list[float]]) -> Solids:
    return Solids([shape for shape, _ in placed], [RigidTransform(p) for _, p in placed])


def test_a_cone_s_rays_fill_it_to_its_edge() -> None:
    half_angle = math.radians(7.5)
    rays = cone_rays(half_angle, 4)
    assert len(rays) == 1 + 6 + 12 + 18 + 24
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0)
    tilts = np.arccos(np.clip(rays[:, 0], -1, 1))
    assert tilts.max() == pytest.approx(half_angle)
    np.testing.assert_allclose(rays.mean(axis=0)[1:], 0.0, atol=1e-12)
    # No direction in the cone is farther from a ray than a ring is wide.
    random = np.random.default_rng(0)
    tilt, turn = half_angle * np.sqrt(random.random(500)), random.uniform(0, 2 * np.pi, 500)
    inside = np.stack(
        [np.cos(tilt), np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn)], axis=-1
    )
    nearest = np.arccos(np.clip((inside @ rays.T).max(axis=1), -1, 1))
    assert nearest.max() <= half_angle / 4


def test_a_wall_ahead_and_a_ball_behind_by_hand() -> None:
    around = solids((Box(0.1, 9.0, 2.0), [2.05, 0.0, 0.0]), (Sphere(0.5), [-1.5, 0.0, 0.1]))
    ranges = true_ranges(around, HEIGHT, replace(EXACT, sensors=4))
    assert ranges[0] == pytest.approx(2.0 - EXACT.offset)
    assert ranges[2] == pytest.approx(1.0 - EXACT.offset)
    assert np.isinf(ranges[[1, 3]]).all()


@pytest.mark.parametrize("aside", [5.0, 7.0, 9.0, 12.0])
def test_a_post_is_heard_in_the_cone_only(aside: float) -> None:
    angle = math.radians(aside)
    post = solids((Cylinder(0.02, 1.0), [1.0 * math.cos(angle), 1.0 * math.sin(angle), 0.1]))
    half_width = math.degrees(math.asin(0.02))
    parameters = replace(EXACT, offset=0.0)
    heard = np.isfinite(true_ranges(post, HEIGHT, parameters)[0])
    assert heard == (aside < 7.5 + half_width)


def test_the_nearest_surface_in_the_cone_counts() -> None:
    # A wall that is seen at 60 degrees from its normal: the cone's edge meets it first.
    half_angle, tilt, distance = EXACT.half_angle, math.radians(60.0), 1.0
    X = spatial_pose(np.array([0.0, 0.0, tilt]), 0.1)
    wall = solids((Box(0.2, 20.0, 4.0), [distance + 0.1, 0.0, 0.0]))
    found = true_ranges(wall, X, replace(EXACT, offset=0.0))[0]
    assert found == pytest.approx(distance / math.cos(tilt - half_angle), rel=1e-6)
    assert found < distance / math.cos(tilt)


def test_all_look_where_they_are_said_to() -> None:
    n = 8
    for k in range(n):
        angle = 2 * math.pi * k / n
        ball = solids((Sphere(0.1), [2.0 * math.cos(angle), 2.0 * math.sin(angle), 0.1]))
        ranges = true_ranges(ball, HEIGHT, EXACT)
        assert np.flatnonzero(np.isfinite(ranges)).tolist() == [k]
        turned = true_ranges(ball, spatial_pose(np.array([0.0, 0.0, angle]), 0.1), EXACT)
        assert np.flatnonzero(np.isfinite(turned)).tolist() == [0]


def test_noise_has_the_said_moments() -> None:
    parameters = replace(EXACT, range_noise=0.003, range_noise_part=0.01)
    told = measured_ranges(np.full(40_000, 2.0), parameters, np.random.default_rng(1))
    assert told.mean() == pytest.approx(2.0, abs=5 * 0.0202 / 200)
    assert told.std() == pytest.approx(math.hypot(0.003, 0.02), rel=0.02)


def test_lost_echoes_steps_and_limits() -> None:
    random = np.random.default_rng(2)
    lost = measured_ranges(np.full(20_000, 1.0), replace(EXACT, dropout_probability=0.2), random)
    assert np.isinf(lost).mean() == pytest.approx(0.2, abs=0.015)
    stepped = measured_ranges(np.array([1.0, 1.0014]), replace(EXACT, resolution=0.003), random)
    np.testing.assert_allclose(stepped, [0.999, 1.002], atol=1e-6)
    edge = measured_ranges(np.array([0.001, np.inf, 4.1, 3.9]), EXACT, random)
    np.testing.assert_allclose(edge, [0.02, np.inf, np.inf, 3.9], rtol=1e-6)


def ring_in_a_room(seed: int) -> tuple[Diagram, UltrasonicRing]:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    wall = RigidTransform([1.55, 0.0, 0.5])
    plant.RegisterCollisionGeometry(
        plant.world_body(), wall, Box(0.1, 9.0, 1.0), "wall", CoulombFriction(1.0, 1.0)
    )
    plant.Finalize()
    ring = builder.AddSystem(
        UltrasonicRing(
            parent_frame=scene_graph.world_frame_id(),
            X_PU=HEIGHT,
            parameters=replace(EXACT, rate=10.0, range_noise=0.003),
            latency=0.03,
            seed=seed,
        )
    )
    builder.Connect(scene_graph.get_query_output_port(), ring.query_object_input_port())
    builder.ExportOutput(ring.scan_output_port(), "scan")
    return builder.Build(), ring


def scans_of(seed: int) -> list[Scan]:
    diagram, _ = ring_in_a_room(seed)
    simulator = Simulator(diagram)
    found = []
    for t in (0.02, 0.05, 0.15):
        simulator.AdvanceTo(t)
        found.append(diagram.GetOutputPort("scan").Eval(simulator.get_context()))
    return found


def test_the_block_sends_scans_after_their_latency() -> None:
    before, first, second = scans_of(7)
    assert math.isnan(before.stamp)
    assert len(before) == 0
    assert (first.stamp, second.stamp) == (0.0, 0.1)
    assert len(first) == 8
    assert first.ranges[0] == pytest.approx(1.4, abs=0.03)
    np.testing.assert_allclose(np.degrees(first.angles), 45.0 * np.arange(8), atol=1e-4)
    assert first.ranges[0] != second.ranges[0]
    np.testing.assert_array_equal(scans_of(7)[2].ranges, second.ranges)
    assert scans_of(8)[2].ranges[0] != second.ranges[0]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("rate", 0.0),
        ("sensors", 0),
        ("rings", 0),
        ("half_angle", 1.0),
        ("range_min", 5.0),
        ("offset", -0.1),
        ("range_noise", math.nan),
        ("dropout_probability", 1.5),
    ],
)
def test_nonsense_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"{field} is .*: must be"):
        UltrasonicParameters(**{field: value})  # type: ignore[arg-type]
