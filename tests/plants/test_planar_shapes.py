from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.geometry import Box, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder

from plants.planar_shapes import PlanarShapes


def rectangle(
    x: float, y: float, heading: float, length: float, width: float, radius: float = 0.0
) -> PlanarShapes:
    return PlanarShapes(
        centres=[[x, y]], headings=[heading], sizes=[[length, width]], radii=[radius]
    )


def disc(x: float, y: float, radius: float) -> PlanarShapes:
    return rectangle(x, y, 0.4, 0.0, 0.0, radius)


def distance(a: PlanarShapes, b: PlanarShapes) -> float:
    return float(a.distances(b)[0, 0])


UNIT = rectangle(0.0, 0.0, 0.0, 2.0, 1.0)  # |x| <= 1, |y| <= 0.5
DIAMOND = math.sqrt(0.5)  # half a diagonal of the unit square


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        (rectangle(3.0, 0.0, 0.0, 2.0, 1.0), 1.0),  # side by side
        (rectangle(2.3, 1.4, 0.0, 2.0, 1.0), 0.5),  # corner to corner: 3, 4, 5
        (rectangle(3.0, 0.0, math.pi / 2, 2.0, 1.0), 1.5),
        (rectangle(3.0, 0.2, math.pi / 4, 1.0, 1.0), 2.0 - DIAMOND),  # corner to side
        (rectangle(1.9, 0.0, 0.0, 2.0, 1.0), -0.1),
        (rectangle(0.0, 0.0, math.pi / 2, 4.0, 0.2), -1.1),  # a cross: out to the side
        (rectangle(0.0, 0.0, 0.0, 0.2, 0.2), -0.6),  # one within the other
        (disc(1.5, 0.0, 0.2), 0.3),
        (disc(1.3, 0.9, 0.1), 0.4),  # off the corner
        (disc(0.0, 0.6, 0.2), -0.1),
        (disc(0.8, 0.0, 0.1), -0.3),  # its centre is within
        (disc(0.0, 0.0, 0.3), -0.8),
        (rectangle(0.0, 2.0, 0.0, 3.0, 0.0, 0.25), 1.25),  # a path that something round takes
        (rectangle(0.0, 0.0, math.pi / 2, 9.0, 0.0), -1.0),
    ],
)
def test_distances_drawn_by_hand(other: PlanarShapes, expected: float) -> None:
    assert distance(UNIT, other) == pytest.approx(expected, abs=1e-12)
    assert distance(other, UNIT) == pytest.approx(expected, abs=1e-12)


def test_two_discs() -> None:
    assert distance(disc(0, 0, 0.5), disc(3, 4, 1.0)) == pytest.approx(3.5)
    assert distance(disc(1, 1, 0.5), disc(1, 1, 1.0)) == pytest.approx(-1.5)


def random_shapes(rng: np.random.Generator, n: int) -> PlanarShapes:
    return PlanarShapes(
        centres=rng.uniform(-1.2, 1.2, (n, 2)),
        headings=rng.uniform(-4, 4, n),
        sizes=rng.uniform(0.05, 1.2, (n, 2)) * (rng.random((n, 1)) > 0.3),
        radii=rng.uniform(0.05, 0.4, n) * (rng.random(n) > 0.4),
    )


def test_many_at_once_are_as_one_by_one_and_no_frame_is_special() -> None:
    rng = np.random.default_rng(0)
    a, b = random_shapes(rng, 7), random_shapes(rng, 9)
    together = a.distances(b)
    assert together.shape == (7, 9)
    np.testing.assert_allclose(together, b.distances(a).T, atol=1e-12)
    pose = [3.0, -2.0, 0.7]
    np.testing.assert_allclose(a.moved(pose).distances(b.moved(pose)), together, atol=1e-12)
    np.testing.assert_allclose(PlanarShapes.joined([a, b]).distances(b)[:7], together, atol=1e-12)
    centres = a.corners().mean(axis=1)
    np.testing.assert_allclose(
        a.at(centres + np.array([1.0, 2.0])).distances(b.moved([1, 2, 0])), together
    )


def test_clearances_are_the_least_distances_of_a_body_at_its_pose() -> None:
    rng = np.random.default_rng(1)
    body, others = random_shapes(rng, 4), random_shapes(rng, 9)
    for pose in rng.uniform(-4, 4, (50, 3)):
        expected = body.moved(pose).distances(others).min(axis=0)
        np.testing.assert_allclose(body.clearances(others, pose), expected, atol=1e-12)
    # By hand: turned to the left, the disc ahead of the centre is at (1, 4).
    dumbbell = PlanarShapes.joined([disc(0, 0, 0.5), disc(2, 0, 0.25)])
    pose = np.array([1.0, 2.0, math.pi / 2])
    found = dumbbell.clearances(PlanarShapes.joined([disc(1, 6, 1.0), disc(1, -1, 1.0)]), pose)
    np.testing.assert_allclose(found, [0.75, 1.5])


def test_centres_are_given_back() -> None:
    centres = np.array([[1.0, -2.0], [0.5, 3.0]])
    shapes = PlanarShapes(centres=centres, headings=[0, 1], sizes=np.ones((2, 2)), radii=[0, 1])
    np.testing.assert_array_equal(shapes.centres, centres)


def test_no_shape_has_no_distances() -> None:
    none = PlanarShapes.joined([])
    assert len(none) == 0
    assert UNIT.distances(none).shape == (1, 0)
    assert UNIT.clearances(none, np.zeros(3)).shape == (0,)
    assert none.distances_from(np.zeros((2, 2))).shape == (0, 2)


def test_the_distance_of_points_is_that_of_tiny_discs() -> None:
    rng = np.random.default_rng(1)
    shapes, points = random_shapes(rng, 20), rng.uniform(-1.5, 1.5, (30, 2))
    dots = PlanarShapes(
        centres=points, headings=np.zeros(30), sizes=np.zeros((30, 2)), radii=np.zeros(30)
    )
    by_shapes = shapes.distances(dots)
    assert (by_shapes < 0).sum() > 25
    np.testing.assert_allclose(shapes.distances_from(points), by_shapes, atol=1e-12)


def test_a_depth_is_the_shortest_push_that_parts_them() -> None:
    rng = np.random.default_rng(2)
    directions = np.array([[math.cos(a), math.sin(a)] for a in np.radians(np.arange(0, 360, 0.5))])
    checked = 0
    for _ in range(120):
        a, b = random_shapes(rng, 1), random_shapes(rng, 1)
        depth = -distance(a, b)
        if depth <= 0.01:
            continue
        checked += 1
        centre = b.corners().mean(axis=1)
        too_short = [distance(a, b.at(centre + 0.98 * depth * d[None])) for d in directions]
        long_enough = [distance(a, b.at(centre + 1.02 * depth * d[None])) for d in directions]
        assert max(too_short) < 0 < max(long_enough)
    assert checked > 25


def solid(rng: np.random.Generator) -> tuple[Shape, PlanarShapes]:
    """A tall box or a sphere, and its ground plan, both at the origin.

    Not a cylinder: of one pair in three hundred Drake says 14 mm too much.
    """
    if rng.random() < 0.4:
        radius = float(rng.uniform(0.05, 0.5))
        return Sphere(radius), disc(0.0, 0.0, radius)
    length, width = rng.uniform(0.05, 1.0, 2)
    return Box(length, width, 20.0), rectangle(0.0, 0.0, 0.0, length, width)


def test_drake_measures_the_same_between_boxes_and_spheres() -> None:
    rng = np.random.default_rng(3)
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    plans, bodies, ids = [], [], []
    for k in range(24):
        shape, plan = solid(rng)
        body = plant.AddRigidBody(f"body_{k}", SpatialInertia.SolidSphereWithMass(1.0, 1.0))
        friction = CoulombFriction(1.0, 1.0)
        ids.append(
            plant.RegisterCollisionGeometry(body, RigidTransform(), shape, "solid", friction)
        )
        plans.append(plan)
        bodies.append(body)
    plant.Finalize()
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    apart = overlapping = 0
    for _ in range(6):
        poses = rng.uniform([-2, -2, -3], [2, 2, 3], (len(bodies), 3))
        for body, (x, y, theta) in zip(bodies, poses, strict=True):
            plant.SetFreeBodyPose(own, body, RigidTransform(RollPitchYaw(0, 0, theta), [x, y, 0]))
        query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
        placed = [plan.moved(pose) for plan, pose in zip(plans, poses, strict=True)]
        for i in range(len(bodies)):
            for j in range(i):
                drake = query.ComputeSignedDistancePairClosestPoints(ids[i], ids[j]).distance
                ours = distance(placed[i], placed[j])
                assert ours == pytest.approx(drake, abs=1e-6)
                apart += drake > 0
                overlapping += drake < -0.01
    assert apart > 100
    assert overlapping > 100
