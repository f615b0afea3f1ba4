from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia, UnitInertia
from pydrake.systems.framework import DiagramBuilder

from plants.body_state import BodyState, TwinPositions, TwinState
from plants.differential_drive import DifferentialDriveParameters, add_differential_drive
from systems.angles import planar_pose

OUTPUTS = ("pose", "planar_pose", "spatial_velocity", "spatial_acceleration")


def inertia(mass: float) -> SpatialInertia:
    return SpatialInertia(mass, np.array([0.02, -0.01, 0.03]), UnitInertia(0.03, 0.04, 0.05))


def flying_robots() -> Any:
    """Two floating bodies with a wheel each, turned and moving; of the second one is asked."""
    builder = DiagramBuilder()
    plant = builder.AddSystem(MultibodyPlant(0.0))
    models = []
    for name in ("first", "second"):
        model = plant.AddModelInstance(name)
        body = plant.AddRigidBody("base_link", model, inertia(2.0))
        wheel = plant.AddRigidBody("wheel", model, inertia(0.5))
        plant.AddJoint(
            RevoluteJoint("axle", body.body_frame(), wheel.body_frame(), np.array([0.0, 1.0, 0.0]))
        )
        models.append(model)
    plant.Finalize()
    state = BodyState.AddToBuilder(builder, plant, models[1])
    diagram = builder.Build()
    return plant, models[1], state, diagram


@pytest.mark.parametrize("seed", range(5))
def test_it_says_what_the_plant_says(seed: int) -> None:
    plant, model, state, diagram = flying_robots()
    context = diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    rng = np.random.default_rng(seed)
    body = plant.GetBodyByName("base_link", model)
    for name in ("first", "second"):
        other = plant.GetBodyByName("base_link", plant.GetModelInstanceByName(name))
        q = rng.normal(size=4)
        rotation = RotationMatrix(Quaternion(q / np.linalg.norm(q)))
        plant.SetFreeBodyPose(own, other, RigidTransform(rotation, rng.normal(size=3)))
    plant.SetVelocities(own, rng.normal(size=plant.num_velocities()))
    pose, planar, velocity, acceleration = (
        state.GetOutputPort(name).Eval(state.GetMyContextFromRoot(context)) for name in OUTPUTS
    )
    X_WB = plant.EvalBodyPoseInWorld(own, body)
    assert pose.IsNearlyEqualTo(X_WB, 1e-12)
    np.testing.assert_allclose(planar, planar_pose(X_WB), atol=1e-12)
    V_WB = plant.EvalBodySpatialVelocityInWorld(own, body).get_coeffs()
    np.testing.assert_allclose(velocity, V_WB, atol=1e-12)
    A_WB = plant.EvalBodySpatialAccelerationInWorld(own, body).get_coeffs()
    np.testing.assert_allclose(acceleration, A_WB, atol=1e-9)
    assert np.abs(A_WB[:3]).max() > 0.1  # it does tumble


def test_a_quaternion_that_drifted_is_no_harm() -> None:
    state = BodyState(num_positions=7, num_velocities=6)
    context = state.CreateDefaultContext()
    q = np.array([0.9, 0.1, -0.2, 0.3])
    state.GetInputPort("state").FixValue(context, [*(1.001 * q), 1.0, 2.0, 3.0, *np.zeros(6)])
    expected = RigidTransform(Quaternion(q / np.linalg.norm(q)), [1.0, 2.0, 3.0])
    assert state.GetOutputPort("pose").Eval(context).IsNearlyEqualTo(expected, 1e-12)
    found = state.GetOutputPort("planar_pose").Eval(context)
    np.testing.assert_allclose(found, planar_pose(expected), atol=1e-12)


def test_a_model_that_does_not_float_is_refused() -> None:
    with pytest.raises(ValueError, match="num_positions is 2: must be at least 7"):
        BodyState(num_positions=2, num_velocities=2)


# --- Kinematic twins ---


def twin_state(pose: Any, velocity: Any) -> list[Any]:
    twin = TwinState()
    context = twin.CreateDefaultContext()
    twin.GetInputPort("twin_pose").FixValue(context, pose)
    twin.GetInputPort("twin_velocity").FixValue(context, velocity)
    return [twin.GetOutputPort(name).Eval(context) for name in OUTPUTS]


def test_a_twin_says_the_same_of_its_motion() -> None:
    pose, planar, velocity, acceleration = twin_state([1.0, 2.0, np.pi / 2], [0.5, 2.0])
    # Heading along y on a circle to the left: the centre, and the acceleration, is toward -x.
    expected = RigidTransform(RollPitchYaw(0, 0, np.pi / 2), [1.0, 2.0, 0.0])
    assert pose.IsNearlyEqualTo(expected, 1e-12)
    np.testing.assert_allclose(planar, [1.0, 2.0, np.pi / 2])
    np.testing.assert_allclose(velocity, [0, 0, 2.0, 0, 0.5, 0], atol=1e-12)
    np.testing.assert_allclose(acceleration, [0, 0, 0, -1.0, 0, 0], atol=1e-12)


def test_a_twins_velocity_and_acceleration_are_derivatives() -> None:
    v, omega, theta0, h = 0.4, -1.5, 0.7, 1e-4

    def place(t: float) -> np.ndarray:
        theta = theta0 + omega * t
        return v / omega * np.array([np.sin(theta), -np.cos(theta), 0.0])

    _, _, velocity, acceleration = twin_state([*place(0)[:2], theta0], [v, omega])
    np.testing.assert_allclose(velocity[3:], (place(h) - place(-h)) / (2 * h), atol=1e-6)
    second = (place(h) - 2 * place(0) + place(-h)) / h**2
    np.testing.assert_allclose(acceleration[3:], second, atol=1e-5)


def test_a_twins_heading_is_wrapped() -> None:
    planar = twin_state([0.0, 0.0, 7.0], [0.0, 0.0])[1]
    np.testing.assert_allclose(planar, [0.0, 0.0, 7.0 - 2 * np.pi])


def test_twins_put_their_robots_in_place() -> None:
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.01)
    parameters = DifferentialDriveParameters()
    for name in ("blue", "red"):
        add_differential_drive(plant, parameters, name)
    plant.Finalize()
    twins = TwinPositions(plant=plant, models=["red", "blue"])
    context = twins.CreateDefaultContext()
    poses = {"red": [1.0, 2.0, 2.5], "blue": [-1.0, 0.5, -9.0]}
    for name, pose in poses.items():
        twins.GetInputPort(name).FixValue(context, pose)
    q = twins.GetOutputPort("positions").Eval(context)
    own = plant.CreateDefaultContext()
    plant.SetPositions(own, q)
    for name, (x, y, theta) in poses.items():
        model = plant.GetModelInstanceByName(name)
        X_WB = plant.EvalBodyPoseInWorld(own, plant.GetBodyByName("base_link", model))
        expected = RigidTransform(RollPitchYaw(0.0, 0.0, theta), [x, y, 0.0])
        assert X_WB.IsNearlyEqualTo(expected, 1e-12)
        for side in ("right", "left"):
            assert plant.GetJointByName(f"{side}_wheel", model).get_angle(own) == 0.0
