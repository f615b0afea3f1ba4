from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.geometry import Box, Capsule, Cylinder, HalfSpace, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder

from plants.differential_drive import DifferentialDriveParameters, add_differential_drive
from plants.footprint import footprint
from plants.planar_shapes import PlanarShapes


def footprint_of(*solids: tuple[Shape, RigidTransform]) -> PlanarShapes:
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.01)
    model = plant.AddModelInstance("thing")
    body = plant.AddRigidBody("base_link", model, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    stranger = plant.AddModelInstance("stranger")
    other = plant.AddRigidBody("other", stranger, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    friction = CoulombFriction(1.0, 1.0)
    plant.RegisterCollisionGeometry(other, RigidTransform(), Sphere(9.0), "not mine", friction)
    for k, (shape, X_BG) in enumerate(solids):
        plant.RegisterCollisionGeometry(body, X_BG, shape, f"solid_{k}", friction)
    # Wherever it stands, its own frame counts.
    X_WB = RigidTransform(RollPitchYaw(0.0, 0.0, 1.0), [4.0, 5.0, 0.0])
    plant.SetDefaultFloatingBaseBodyPose(body, X_WB)
    plant.Finalize()
    return footprint(plant, scene_graph.model_inspector(), model)


def at(x: float, y: float, *rpy: float) -> RigidTransform:
    return RigidTransform(RollPitchYaw(*(rpy or (0.0, 0.0, 0.0))), [x, y, 0.3])


@pytest.mark.parametrize(
    ("shape", "X_BG", "corners", "radius"),
    [
        (Box(0.4, 0.2, 0.1), at(1.0, 2.0), [[1.2, 2.1], [0.8, 2.1], [0.8, 1.9], [1.2, 1.9]], 0.0),
        (Box(0.4, 0.2, 0.1), at(0.0, 0.0, 0.0, 0.0, math.pi / 2),
         [[-0.1, 0.2], [-0.1, -0.2], [0.1, -0.2], [0.1, 0.2]], 0.0),
        (Sphere(0.2), at(1.0, 0.0, 0.4, 0.5, 0.6), [[1.0, 0.0]] * 4, 0.2),
        (Cylinder(0.2, 1.0), at(1.0, 0.0), [[1.0, 0.0]] * 4, 0.2),
        (Cylinder(0.2, 0.1), at(0.0, 1.0, math.pi / 2, 0.0, 0.0),  # a wheel
         [[0.2, 1.05], [-0.2, 1.05], [-0.2, 0.95], [0.2, 0.95]], 0.0),
        (Capsule(0.1, 0.4), at(0.0, 0.0, 0.0, math.pi / 2, 0.0),  # along x
         [[0.3, 0.1], [-0.3, 0.1], [-0.3, -0.1], [0.3, -0.1]], 0.0),
        # Pitched by 45 degrees: half its length and half its height, over the square root of two.
        (Box(0.4, 0.2, 0.2), at(0.0, 0.0, 0.0, math.pi / 4, 0.0),
         [[0.3 / 2**0.5, 0.1], [-0.3 / 2**0.5, 0.1], [-0.3 / 2**0.5, -0.1], [0.3 / 2**0.5, -0.1]],
         0.0),
    ],
)  # fmt: skip
def test_one_solid_seen_from_above(
    shape: Shape, X_BG: RigidTransform, corners: list[list[float]], radius: float
) -> None:
    found = footprint_of((shape, X_BG))
    np.testing.assert_allclose(found.corners(), [corners], atol=1e-9)
    np.testing.assert_allclose(found.radii, [radius])


def test_a_part_within_another_is_left_out() -> None:
    big, small = (Box(1.0, 0.5, 0.1), at(0.0, 0.0)), (Sphere(0.2), at(0.3, 0.0))
    assert len(footprint_of(big, small)) == 1
    assert len(footprint_of(small, big)) == 1
    assert len(footprint_of(big, big, big)) == 1
    assert len(footprint_of(big, (Sphere(0.2), at(0.31, 0.0)))) == 2


def test_what_has_no_footprint_is_refused() -> None:
    with pytest.raises(ValueError, match="model 'thing' has no collision geometry"):
        footprint_of()
    with pytest.raises(ValueError, match="solid_0' is unbounded: it has no footprint"):
        footprint_of((HalfSpace(), RigidTransform()))


def test_the_robot_is_its_chassis_and_two_wheels() -> None:
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.01)
    p = DifferentialDriveParameters()
    model = add_differential_drive(plant, p, "robot")
    plant.Finalize()
    found = footprint(plant, scene_graph.model_inspector(), model)
    corners, radii = found.corners(), found.radii
    order = np.argsort(radii + corners[:, 0, 1] * 1e-3)
    np.testing.assert_allclose(radii[order], [0.0, p.wheel_radius, p.wheel_radius])
    half = np.array([p.length, p.width]) / 2
    np.testing.assert_allclose(np.abs(corners[order[0]]), [half] * 4, atol=1e-9)
    for k, y in zip(order[1:], (-p.base / 2, p.base / 2), strict=True):
        np.testing.assert_allclose(corners[k], [[0.0, y]] * 4, atol=1e-9)
