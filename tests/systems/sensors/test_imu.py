from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from plants.body_state import BodyState
from systems.sensors.imu import GRAVITY, Imu, ImuParameters, ideal_sample

# --- What a perfect sensor measures ---


def test_at_rest_it_reads_g_upward() -> None:
    still = np.zeros(6)
    for rpy, expected in (
        ([0.0, 0.0, 0.7], [0.0, 0.0, GRAVITY]),
        ([np.pi / 2, 0.0, 0.0], [0.0, GRAVITY, 0.0]),  # its y axis points up
        ([0.0, np.pi / 2, 0.0], [-GRAVITY, 0.0, 0.0]),
        ([np.pi, 0.0, 0.0], [0.0, 0.0, -GRAVITY]),
    ):
        X_WB = RigidTransform(RollPitchYaw(rpy), [1.0, 2.0, 3.0])
        sample = ideal_sample(X_WB, still, still, np.array([0.1, 0.2, 0.3]))
        np.testing.assert_allclose(sample, [0.0, 0.0, 0.0, *expected], atol=1e-12)


def test_on_a_turntable_an_offset_feels_the_centripetal_acceleration() -> None:
    omega, alpha, r = 3.0, 0.5, 0.2
    for theta in (0.0, 1.0, 2.5):
        sample = ideal_sample(
            RigidTransform(RollPitchYaw(0, 0, theta), np.zeros(3)),
            np.array([0.0, 0.0, omega, 0.0, 0.0, 0.0]),
            np.array([0.0, 0.0, alpha, 0.0, 0.0, 0.0]),
            np.array([r, 0.0, 0.1]),
        )
        expected = [0.0, 0.0, omega, -(omega**2) * r, alpha * r, GRAVITY]
        np.testing.assert_allclose(sample, expected, atol=1e-12)


def test_the_accelerometer_feels_the_second_derivative_of_its_own_path() -> None:
    # A body that tumbles about a fixed axis at a changing rate while it flies along a curve.
    axis = np.array([1.0, -2.0, 0.5]) / np.linalg.norm([1.0, -2.0, 0.5])
    p_BS = np.array([0.3, -0.1, 0.2])

    def angle(t: float) -> float:
        return 0.4 + 1.5 * t + 0.8 * t**2

    def place(t: float) -> np.ndarray:
        return np.array([np.sin(2 * t), t**3, 0.5 * np.cos(3 * t)])

    def body(t: float) -> RigidTransform:
        a = angle(t)
        W = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        R = np.eye(3) + np.sin(a) * W + (1 - np.cos(a)) * W @ W
        return RigidTransform(RotationMatrix(R), place(t))

    t, h = 0.6, 1e-4
    sensor = [body(t + k * h).multiply(p_BS) for k in (-1, 0, 1)]
    acceleration = (sensor[0] - 2 * sensor[1] + sensor[2]) / h**2
    V = np.concatenate(
        [axis * (1.5 + 1.6 * t), [2 * np.cos(2 * t), 3 * t**2, -1.5 * np.sin(3 * t)]]
    )
    A = np.concatenate([axis * 1.6, [-4 * np.sin(2 * t), 6 * t, -4.5 * np.cos(3 * t)]])
    R_BW = body(t).rotation().matrix().T
    expected = [*(R_BW @ V[:3]), *(R_BW @ (acceleration + np.array([0.0, 0.0, GRAVITY])))]
    np.testing.assert_allclose(ideal_sample(body(t), V, A, p_BS), expected, atol=1e-5)


# --- The block ---


def samples(n: int, **arguments: Any) -> np.ndarray:
    """(n, 6) successive samples at rest."""
    imu = Imu(**arguments)
    simulator = Simulator(imu)
    context = simulator.get_mutable_context()
    imu.pose_input_port().FixValue(context, RigidTransform())
    imu.spatial_velocity_input_port().FixValue(context, np.zeros(6))
    imu.spatial_acceleration_input_port().FixValue(context, np.zeros(6))
    rate = arguments.get("rate", 100.0)
    rows = []
    for k in range(n):
        simulator.AdvanceTo((k + 0.5) / rate)
        rows.append(imu.sample_output_port().Eval(context).copy())
    return np.array(rows)


NOISY = ImuParameters(
    gyro_noise_density=0.002,
    gyro_bias=[0.1, -0.2, 0.3],
    accel_noise_density=0.03,
    accel_bias=[1.0, -2.0, 3.0],
)


@pytest.mark.parametrize("rate", [50.0, 400.0])
def test_noise_is_white_of_the_density_and_about_the_bias(rate: float) -> None:
    n = 2000
    found = samples(n, parameters=NOISY, rate=rate)
    mean = np.array([0.1, -0.2, 0.3, 1.0, -2.0, 3.0 + GRAVITY])
    deviation = np.repeat([0.002, 0.03], 3) * np.sqrt(rate)
    white = (found - mean) / deviation
    assert np.abs(white.mean(axis=0)).max() < 5 / np.sqrt(n)
    np.testing.assert_allclose(white.std(axis=0), 1.0, atol=5 / np.sqrt(2 * n))
    assert np.abs(np.corrcoef(white.T) - np.eye(6)).max() < 5 / np.sqrt(n)
    assert np.abs((white[1:] * white[:-1]).mean(axis=0)).max() < 5 / np.sqrt(n)


def test_without_noise_it_is_exact() -> None:
    expected = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, GRAVITY], (3, 1))
    np.testing.assert_array_equal(samples(3), expected)


def test_a_seed_repeats_the_noise_and_a_name_makes_it_its_own() -> None:
    first = samples(5, parameters=NOISY, seed=3, name="imu")
    np.testing.assert_array_equal(samples(5, parameters=NOISY, seed=3, name="imu"), first)
    for other in ({"seed": 4, "name": "imu"}, {"seed": 3, "name": "other"}):
        assert not np.isin(samples(5, parameters=NOISY, **other), first).any()


def test_a_sample_is_held_until_the_next() -> None:
    imu = Imu(rate=10.0)
    simulator = Simulator(imu)
    context = simulator.get_mutable_context()
    imu.pose_input_port().FixValue(context, RigidTransform())
    imu.spatial_acceleration_input_port().FixValue(context, np.zeros(6))
    found = []
    np.testing.assert_array_equal(imu.sample_output_port().Eval(context), np.zeros(6))
    for t in (0.01, 0.05, 0.09, 0.11, 0.15, 0.21):
        imu.spatial_velocity_input_port().FixValue(context, [0, 0, t, 0, 0, 0])
        simulator.AdvanceTo(t)
        found.append(imu.sample_output_port().Eval(context)[2])
    assert found == [0.01, 0.01, 0.01, 0.11, 0.11, 0.21]


def test_in_free_fall_it_feels_nothing_but_its_own_spin() -> None:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.001)
    model = plant.AddModelInstance("stone")
    inertia = SpatialInertia(2.0, np.zeros(3), UnitInertia.SolidSphere(0.1))
    body = plant.AddRigidBody("stone", model, inertia)
    plant.Finalize()
    p_BS = np.array([0.1, 0.0, 0.05])
    state = BodyState.AddToBuilder(builder, plant, model)
    imus = [builder.AddSystem(Imu(rate=50.0, p_BS=p)) for p in (np.zeros(3), p_BS)]
    for imu in imus:
        for name in ("pose", "spatial_velocity", "spatial_acceleration"):
            builder.Connect(state.GetOutputPort(name), imu.GetInputPort(name))
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    own = plant.GetMyMutableContextFromRoot(context)
    plant.SetFreeBodyPose(own, body, RigidTransform(RollPitchYaw(0.3, 0.2, 0.1), [0, 0, 100.0]))
    w = np.array([0.0, 0.0, 4.0])
    R_WB = plant.EvalBodyPoseInWorld(own, body).rotation().matrix()
    velocity = np.concatenate([R_WB @ w, [1.0, 2.0, 3.0]])
    plant.SetVelocities(own, model, velocity)
    simulator.AdvanceTo(1.01)
    middle, edge = (
        imu.sample_output_port().Eval(imu.GetMyContextFromRoot(context)) for imu in imus
    )
    np.testing.assert_allclose(middle, [*w, 0.0, 0.0, 0.0], atol=1e-3)
    expected = np.cross(w, np.cross(w, p_BS))
    np.testing.assert_allclose(edge, [*w, *expected], atol=1e-2)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("gyro_noise_density", -1.0),
        ("accel_noise_density", math.nan),
        ("gyro_bias", [0.0, 0.0]),
        ("accel_bias", [0.0, math.inf, 0.0]),
    ],
)
def test_nonsense_is_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{field} is .*: must be "):
        ImuParameters(**{field: value})


@pytest.mark.parametrize(
    ("field", "value"),
    [("rate", 0.0), ("seed", -1), ("p_BS", [0.0, 0.0]), ("p_BS", [0, 0, np.nan])],
)
def test_a_block_of_nonsense_is_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{field} is .*: must be "):
        Imu(**{field: value})
