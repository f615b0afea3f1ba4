from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from scipy.spatial.transform import Rotation

from plants.rocking import RockingBody
from plants.rocking_motion import RockingParameters, Waves, draw_waves, tilt, tilted
from systems.noise import generator, stream_key
from systems.sensors.imu import ideal_sample

STRONG = RockingParameters(bound=0.4)  # rad: 100 times the robot's, so that every term shows


def waves(seed: int = 0, parameters: RockingParameters = STRONG) -> Waves:
    return draw_waves(parameters, np.random.default_rng(seed))


# --- The motion ---


@pytest.mark.parametrize("t", [0.05, 0.23, 0.49, 0.51, 3.0, 97.0])
def test_the_derivatives_are_those_of_the_tilt(t: float) -> None:
    drawn, h = waves(), 1e-5
    before, now, after = (tilt(drawn, t + k * h) for k in (-1, 0, 1))
    for k in (0, 1):
        np.testing.assert_allclose((after[k] - before[k]) / (2 * h), now[k + 1], atol=1e-6)


def test_it_fades_in_from_rest_and_nothing_jumps() -> None:
    drawn = waves()
    for value in tilt(drawn, 0.0):
        assert (value == 0).all()
    for t in (0.0, 0.5):
        for before, after in zip(tilt(drawn, max(t - 1e-7, 0)), tilt(drawn, t + 1e-7), strict=True):
            np.testing.assert_allclose(before, after, atol=1e-3)


def test_its_deviation_and_its_band_are_as_said() -> None:
    p = RockingParameters(bound=0.01, lowest=0.5, highest=2.0)
    spectra, values = [], []
    for seed in range(20):
        drawn = waves(seed, p)
        r = np.array([tilt(drawn, 1 + k / 20)[0] for k in range(4000)])  # 200 s at 20 Hz
        values.append(r)
        spectra.append(np.abs(np.fft.rfft(r * np.hanning(len(r))[:, None], axis=0)) ** 2)
    every = np.concatenate(values)
    np.testing.assert_allclose(every.std(axis=0), 0.01 / math.sqrt(3), rtol=0.03)
    np.testing.assert_allclose(every.mean(axis=0), 0.0, atol=2e-4)
    assert abs(np.corrcoef(every.T)[0, 1]) < 0.05
    assert 0.04 < (np.abs(every) > 0.01).mean() < 0.1  # a normal one: 0.083
    power, frequency = np.mean(spectra, axis=(0, 2)), np.fft.rfftfreq(4000, 1 / 20)
    inside = (frequency > 0.45) & (frequency < 2.05)
    assert power[~inside].sum() < 1e-3 * power.sum()
    quarters = [
        power[(frequency >= low) & (frequency < low + 0.375)].sum() / power[inside].sum()
        for low in (0.5, 0.875, 1.25, 1.625)
    ]
    np.testing.assert_allclose(quarters, 0.25, atol=0.04)


@pytest.mark.parametrize("scale", [1e-9, 0.04, 0.0999, 0.1001, 0.8])  # 0.1: series and closed form
def test_a_tilted_body_turns_as_it_is_turned(scale: float) -> None:
    """Against SciPy's exponential and difference quotients of it."""
    rng = np.random.default_rng(1)
    r, r_dot, r_ddot = rng.normal(size=(3, 2))
    r *= scale / np.linalg.norm(r)
    h = 1e-4

    def turned(dt: float) -> Rotation:
        moved = r + dt * r_dot + dt * dt / 2 * r_ddot
        return Rotation.from_rotvec([*moved, 0.0])

    def rate(dt: float) -> np.ndarray:
        return (turned(dt + h) * turned(dt - h).inv()).as_rotvec() / (2 * h)

    R, w, alpha = tilted(r, r_dot, r_ddot)
    np.testing.assert_allclose(R, turned(0.0).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(w, rate(0.0), atol=1e-6)
    np.testing.assert_allclose(alpha, (rate(h) - rate(-h)) / (2 * h), atol=1e-5)


def test_known_answer_of_a_tilt_about_one_axis() -> None:
    R, w, alpha = tilted(np.array([0.3, 0.0]), np.array([2.0, 0.0]), np.array([-5.0, 0.0]))
    np.testing.assert_allclose(R, RotationMatrix.MakeXRotation(0.3).matrix(), atol=1e-15)
    np.testing.assert_allclose(w, [2.0, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(alpha, [-5.0, 0.0, 0.0], atol=1e-15)


# --- The block ---


class Chassis:
    """One that flies and turns by polynomials, differentiated by hand."""

    def __init__(self, seed: int) -> None:
        self.p, self.w = np.random.default_rng(seed).normal(size=(2, 3, 3))
        self.start = RotationMatrix(RollPitchYaw(0.4, -0.3, 1.2))

    def rpy(self, t: float) -> list[np.ndarray]:
        a, b, c = self.w
        return [a + b * t + c * t * t, b + 2 * c * t, 2 * c]

    def __call__(self, t: float) -> tuple[RigidTransform, np.ndarray, np.ndarray]:
        a, b, c = self.p
        angles, rates, bends = self.rpy(t)
        rpy = RollPitchYaw(angles)
        X = RigidTransform(rpy, a + b * t + c * t * t)
        w = rpy.CalcAngularVelocityInParentFromRpyDt(rates)
        h = 1e-6
        later = RollPitchYaw(angles + h * rates).CalcAngularVelocityInParentFromRpyDt(
            rates + h * bends
        )
        earlier = RollPitchYaw(angles - h * rates).CalcAngularVelocityInParentFromRpyDt(
            rates - h * bends
        )
        alpha = (later - earlier) / (2 * h)
        return X, np.concatenate([w, b + 2 * c * t]), np.concatenate([alpha, 2 * c])


def state_of(X: RigidTransform, V: np.ndarray) -> np.ndarray:
    """What the plant tells of a body that floats; its quaternion is not quite of length 1."""
    return np.concatenate([1.001 * X.rotation().ToQuaternion().wxyz(), X.translation(), V])


def set_chassis(
    block: RockingBody, context: Context, t: float, chassis: Chassis
) -> tuple[RigidTransform, np.ndarray, np.ndarray]:
    """What the body does at t."""
    X, V, A = chassis(t)
    context.SetTime(t)
    block.state_input_port().FixValue(context, state_of(X, V))
    block.generalized_acceleration_input_port().FixValue(context, A)
    return (
        RigidTransform(block.pose_output_port().Eval(context)),
        block.spatial_velocity_output_port().Eval(context).copy(),
        block.spatial_acceleration_output_port().Eval(context).copy(),
    )


@pytest.mark.parametrize("t", [0.3, 1.7])
@pytest.mark.parametrize("seed", range(3))
def test_pose_velocity_and_acceleration_are_one_motion(seed: int, t: float) -> None:
    block, chassis, h = RockingBody(parameters=STRONG, seed=seed), Chassis(seed), 1e-5
    context = block.CreateDefaultContext()
    before, now, after = (set_chassis(block, context, t + k * h, chassis) for k in (-1, 0, 1))
    turn = (
        Rotation.from_matrix(after[0].rotation().matrix())
        * Rotation.from_matrix(before[0].rotation().matrix()).inv()
    )
    np.testing.assert_allclose(turn.as_rotvec() / (2 * h), now[1][:3], atol=1e-5)
    v = (after[0].translation() - before[0].translation()) / (2 * h)
    np.testing.assert_allclose(v, now[1][3:], atol=1e-8)
    np.testing.assert_allclose((after[1] - before[1]) / (2 * h), now[2], atol=1e-4)
    # Wrong on purpose: without the Coriolis part.
    X, _, A = chassis(t)
    alpha = tilted(*tilt(drawn_for(seed), t))[2]
    wrong = A[:3] + X.rotation().matrix() @ alpha
    assert np.abs(wrong - now[2][:3]).max() > 0.1
    # And it rocks against the chassis by what was drawn, about its origin.
    tilt_now = X.rotation().inverse() @ now[0].rotation()
    x, y, z = Rotation.from_matrix(tilt_now.matrix()).as_rotvec()
    np.testing.assert_allclose([x, y], tilt(drawn_for(seed), t)[0], atol=1e-12)
    assert abs(z) < 1e-12
    np.testing.assert_allclose(now[0].translation(), X.translation())


def drawn_for(seed: int) -> Waves:
    return draw_waves(STRONG, generator(stream_key(seed, "rocking"), 0))


def test_an_imu_on_it_feels_the_rocking() -> None:
    block = RockingBody(parameters=RockingParameters(bound=0.005))
    context = block.CreateDefaultContext()
    at_rest = Chassis(0)
    at_rest.p[:], at_rest.w[:] = 0.0, 0.0
    shares = []
    for t in np.arange(1.0, 9.0, 0.01):
        X, V, A = set_chassis(block, context, float(t), at_rest)
        sample = ideal_sample(X, V, A, np.zeros(3))
        tilted_by = Rotation.from_matrix(X.rotation().matrix()).as_rotvec()
        # Gravity's part of the accelerometer: g times the tilt.
        np.testing.assert_allclose(
            sample[3:5], 9.81 * np.array([-tilted_by[1], tilted_by[0]]), atol=1e-3
        )
        shares.append(sample[:2])
    assert 0.5 < np.std(shares) / (0.005 / math.sqrt(3) * 2 * math.pi * 1.8) < 1.5


def test_the_seed_is_a_parameter_and_repeats() -> None:
    block, chassis = RockingBody(seed=7), Chassis(0)
    first, second = block.CreateDefaultContext(), block.CreateDefaultContext()
    a, b = (set_chassis(block, c, 2.0, chassis)[0] for c in (first, second))
    assert a.IsExactlyEqualTo(b)
    second.get_mutable_numeric_parameter(0).SetAtIndex(0, 8.0)
    c = set_chassis(block, second, 2.0, chassis)[0]
    assert not a.IsNearlyEqualTo(c, 1e-6)
    second.get_mutable_numeric_parameter(0).SetAtIndex(0, 7.0)
    assert set_chassis(block, second, 2.0, chassis)[0].IsExactlyEqualTo(a)


def test_without_a_bound_it_is_the_chassis() -> None:
    block, chassis = RockingBody(parameters=RockingParameters(bound=0.0)), Chassis(2)
    context = block.CreateDefaultContext()
    for told, true in zip(set_chassis(block, context, 1.0, chassis), chassis(1.0), strict=True):
        if isinstance(true, RigidTransform):
            assert told.IsNearlyEqualTo(true, 1e-15)
        else:
            np.testing.assert_allclose(told, true, atol=1e-12)
    assert block.frame_pose_output_port().Eval(context).size() == 0


def test_over_a_plants_body_it_rocks_in_the_scene() -> None:
    """Thrown and turning, with a joint of its own: against the plant's own pose and motion."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
    model = plant.AddModelInstance("robot")
    inertia = SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.2, 0.3)
    base, arm = (plant.AddRigidBody(name, model, inertia) for name in ("base_link", "arm"))
    axis = [0.0, 0.0, 1.0]
    plant.AddJoint(RevoluteJoint("joint", base.body_frame(), arm.body_frame(), axis))
    plant.Finalize()
    block = RockingBody.AddToBuilder(
        builder, plant, model, scene_graph, parameters=STRONG, name="body"
    )
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    own = plant.GetMyMutableContextFromRoot(context)
    velocities = [0.4, -0.8, 1.1, 0.2, 0.3, -0.1, 2.0]
    plant.SetVelocities(own, model, np.array(velocities))
    simulator.AdvanceTo(1.3)
    rocking = block.GetMyContextFromRoot(context)
    told = block.pose_output_port().Eval(rocking)
    X_WB0 = base.EvalPoseInWorld(own)
    V_WB0 = base.EvalSpatialVelocityInWorld(own).get_coeffs()
    A_WB0 = base.EvalSpatialAccelerationInWorld(own).get_coeffs()
    reference = RockingBody(parameters=STRONG, name="body")
    alone = reference.CreateDefaultContext()
    alone.SetTime(1.3)
    reference.state_input_port().FixValue(alone, state_of(X_WB0, V_WB0))
    reference.generalized_acceleration_input_port().FixValue(alone, A_WB0)
    assert told.IsNearlyEqualTo(reference.pose_output_port().Eval(alone), 1e-12)
    assert not told.IsNearlyEqualTo(X_WB0, 0.01)
    # The plant tells the acceleration of its next step, of which a millisecond is known.
    for port, rtol in (("spatial_velocity", 1e-12), ("spatial_acceleration", 1e-3)):
        values = (b.GetOutputPort(port).Eval(c) for b, c in ((block, rocking), (reference, alone)))
        np.testing.assert_allclose(*values, rtol=rtol, atol=1e-9)
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    assert block.frame_id is not None
    assert query.GetPoseInWorld(block.frame_id).IsNearlyEqualTo(told, 1e-12)
    assert query.inspector().GetName(block.frame_id) == "body"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"bound": -0.1}, "bound is -0.1"),
        ({"lowest": 0.0}, "lowest is 0.0"),
        ({"lowest": 3.0, "highest": 3.0}, "highest is 3.0: must be greater than lowest, 3 Hz"),
        ({"highest": math.inf}, "highest is inf"),
    ],
)
def test_bad_parameters_are_refused(arguments: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RockingParameters(**arguments)


def test_a_bad_seed_and_a_body_that_does_not_float_are_refused() -> None:
    with pytest.raises(ValueError, match="seed is -1"):
        RockingBody(seed=-1)
    with pytest.raises(ValueError, match="num_positions is 3: must be at least 7"):
        RockingBody(num_positions=3)
