from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.symbolic import Expression, Variable
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from plants.arena import ArenaParameters, add_arena
from plants.body_state import BodyState
from plants.differential_drive import (
    DifferentialDriveParameters,
    KinematicDifferentialDrive,
    add_differential_drive,
    body_velocity,
    hull_radius,
    wheel_speeds,
)
from systems.markers.family import family
from systems.markers.layout import MarkerMap
from systems.sensors.imu import ideal_sample
from systems.sensors.imu_parameters import GRAVITY

DEFAULT = DifferentialDriveParameters()
LARGE = DifferentialDriveParameters(
    wheel_radius=0.05, base=0.3, width=0.2, length=0.35, mass=3.0, height=0.12, clearance=0.04,
    caster_radius=0.02,
)  # fmt: skip
SMALL = DifferentialDriveParameters(
    wheel_radius=0.02, base=0.1, width=0.07, length=0.1, mass=0.3, height=0.04, clearance=0.02,
    caster_radius=0.01, wheel_mass=0.01,
)  # fmt: skip
HIGH_WHEELS = DifferentialDriveParameters(wheel_radius=0.1, base=0.17, width=0.1, mass=2.0)
ROBOTS = [DEFAULT, LARGE, SMALL, HIGH_WHEELS]
COMMANDS = [[0.3, 0.0], [-0.2, 0.0], [0.0, 1.5], [0.25, 0.8], [-0.2, -0.5], [0.15, -1.2]]

# --- Wheel kinematics ---


def test_known_wheel_speeds() -> None:
    # r = 32.5 mm, b = 0.16 m: 0.325 m/s is 10 rad/s; 1 rad/s about the middle is 80 mm/s a wheel.
    np.testing.assert_allclose(wheel_speeds([0.325, 0.0], DEFAULT), [10.0, 10.0])
    np.testing.assert_allclose(wheel_speeds([0.0, 1.0], DEFAULT), [0.08 / 0.0325, -0.08 / 0.0325])
    # Both wheels forward is forward, the right one faster is to the left.
    np.testing.assert_allclose(body_velocity([10.0, 10.0], DEFAULT), [0.325, 0.0])
    np.testing.assert_allclose(body_velocity([1.0, 0.0], DEFAULT), [0.01625, 0.0325 / 0.16])


@pytest.mark.parametrize("robot", ROBOTS)
def test_wheel_speeds_are_the_inverse(robot: DifferentialDriveParameters) -> None:
    for command in np.random.default_rng(0).uniform(-2, 2, (20, 2)):
        np.testing.assert_allclose(body_velocity(wheel_speeds(command, robot), robot), command)


def test_the_hull_holds_chassis_and_wheels() -> None:
    assert hull_radius(DEFAULT) == pytest.approx(math.hypot(0.11, 0.06))
    assert hull_radius(HIGH_WHEELS) == pytest.approx(math.hypot(0.1, (0.17 + 0.026) / 2))


@pytest.mark.parametrize("field", list(vars(DEFAULT)))
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_nonsense_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}: must be greater than 0"):
        DifferentialDriveParameters(**{field: value})


def test_parts_that_do_not_fit_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"width is 0\.14: must be at most base - wheel_width = 0\.13"
    ):
        DifferentialDriveParameters(width=0.14)
    with pytest.raises(ValueError, match=r"caster_radius is 0\.02: must be at most half the clear"):
        DifferentialDriveParameters(caster_radius=0.02)


# --- Multibody model ---


class Rig:
    """The multibody robot on the ground of an arena."""

    def __init__(self, robot: DifferentialDriveParameters, time_step: float = 0.005) -> None:
        builder = DiagramBuilder()
        config = MultibodyPlantConfig(
            time_step=time_step, discrete_contact_approximation="lagged",
            use_sampled_output_ports=False,
        )  # fmt: skip
        self.plant, _ = AddMultibodyPlant(config, builder)
        add_arena(self.plant, ArenaParameters(), MarkerMap(family("DICT_4X4_50"), 0.1))
        self.model = add_differential_drive(self.plant, robot, "robot")
        self.plant.Finalize()
        self.state = BodyState.AddToBuilder(builder, self.plant, self.model)
        builder.ExportInput(self.plant.get_desired_state_input_port(self.model), "servos")
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        self.robot = robot
        self.command(0.0, 0.0)

    def command(self, v: float, omega: float) -> None:
        speeds = wheel_speeds([v, omega], self.robot)
        self.diagram.GetInputPort("servos").FixValue(self.context, [0.0, 0.0, *speeds])

    def output(self, name: str) -> Any:
        return self.state.GetOutputPort(name).Eval(self.state.GetMyContextFromRoot(self.context))

    def body_twist(self) -> np.ndarray:
        """Angular velocity, then velocity, in the body's axes."""
        R_BW = self.output("pose").rotation().matrix().T
        V = self.output("spatial_velocity")
        return np.concatenate([R_BW @ V[:3], R_BW @ V[3:]])


@pytest.mark.parametrize("robot", ROBOTS)
def test_its_mass_and_wheels_are_where_they_should_be(robot: DifferentialDriveParameters) -> None:
    rig = Rig(robot)
    plant = rig.plant
    own = plant.GetMyContextFromRoot(rig.context)
    models = [rig.model]
    assert plant.CalcTotalMass(own, models) == pytest.approx(robot.mass + 2 * robot.wheel_mass)
    com = plant.CalcCenterOfMassPositionInWorld(own, models)
    np.testing.assert_allclose(com, [0.0, 0.0, robot.wheel_radius], atol=1e-12)
    for side, y in (("right", -1), ("left", 1)):
        wheel = plant.EvalBodyPoseInWorld(own, plant.GetBodyByName(f"{side}_wheel"))
        expected = [0.0, y * robot.base / 2, robot.wheel_radius]
        np.testing.assert_allclose(wheel.translation(), expected, atol=1e-12)
    # Ports and states count the right one first.
    names = plant.GetActuatorNames(rig.model)
    assert [name.split("_")[1 if name.startswith("robot_") else 0] for name in names] == [
        "right",
        "left",
    ]


@pytest.mark.parametrize("robot", ROBOTS)
def test_at_rest_it_stays_at_rest_and_upright(robot: DifferentialDriveParameters) -> None:
    rig = Rig(robot)
    rig.simulator.AdvanceTo(3.0)
    X_WB = rig.output("pose")
    assert np.abs(X_WB.translation()).max() < 1e-4
    assert np.abs(X_WB.rotation().matrix() - np.eye(3)).max() < 1e-4
    assert np.abs(rig.output("spatial_velocity")).max() < 1e-6
    assert np.abs(rig.output("spatial_acceleration")).max() < 1e-4


@pytest.mark.parametrize("robot", ROBOTS)
def test_it_moves_as_its_wheels_roll(robot: DifferentialDriveParameters) -> None:
    # Within 0.3 % of the kinematics, and without slipping aside, hopping or tilting.
    for v, omega in COMMANDS:
        rig = Rig(robot)
        rig.command(v, omega)
        rig.simulator.AdvanceTo(1.0)  # the servos are there
        twist = rig.body_twist()
        np.testing.assert_allclose(twist[2], omega, rtol=0.003, atol=1e-4)
        np.testing.assert_allclose(twist[3], v, rtol=0.003, atol=1e-4)
        np.testing.assert_allclose(twist[[0, 1, 4, 5]], 0.0, atol=5e-3)
        assert rig.output("pose").rotation().matrix()[2, 2] > np.cos(np.deg2rad(0.5))


@pytest.mark.parametrize("command", COMMANDS)
def test_it_drives_where_its_kinematic_twin_does(command: list[float]) -> None:
    rig = Rig(DEFAULT)
    rig.command(*command)
    rig.simulator.AdvanceTo(0.5)
    twin = KinematicDifferentialDrive(parameters=DEFAULT)
    simulator = Simulator(twin)
    context = simulator.get_mutable_context()
    twin.wheel_speeds_input_port().FixValue(context, wheel_speeds(command, DEFAULT))
    start = rig.output("planar_pose").copy()
    context.SetContinuousState(start)
    simulator.AdvanceTo(2.0)
    rig.simulator.AdvanceTo(2.5)
    pose, expected = rig.output("planar_pose"), twin.pose_output_port().Eval(context)
    length, turn = abs(command[0]) * 2.0, abs(command[1]) * 2.0
    np.testing.assert_allclose(pose[:2], expected[:2], atol=0.003 * length + 1e-4)
    assert np.angle(np.exp(1j * (pose[2] - expected[2]))) == pytest.approx(
        0, abs=0.003 * turn + 1e-4
    )


def test_it_drives_straight() -> None:
    rig = Rig(DEFAULT)
    rig.command(0.3, 0.0)
    rig.simulator.AdvanceTo(5.0)
    x, y, theta = rig.output("planar_pose")
    assert x > 1.4
    assert abs(y) < 1e-3
    assert abs(theta) < 1e-3


def test_the_motors_are_no_stronger_than_they_may_be() -> None:
    # What drives it is at most the torque of two wheels: a < 2 tau / (r m).
    weak = DifferentialDriveParameters(max_torque=0.01)
    rig = Rig(weak)
    rig.command(1.0, 0.0)
    limit = 2 * 0.01 / 0.0325 / (1.1 + 2 * 0.035)
    rig.simulator.AdvanceTo(0.2)
    before = rig.body_twist()[3]
    rig.simulator.AdvanceTo(0.7)
    acceleration = (rig.body_twist()[3] - before) / 0.5
    assert 0.8 * limit < acceleration < limit
    assert rig.output("spatial_acceleration")[3] == pytest.approx(acceleration, rel=0.02)


def test_an_inertial_sensor_on_it_feels_the_turn() -> None:
    rig = Rig(DEFAULT)
    v, omega = 0.3, 1.2
    rig.command(v, omega)
    rig.simulator.AdvanceTo(2.0)
    motion = [rig.output(n) for n in ("pose", "spatial_velocity", "spatial_acceleration")]
    for x, z in ((0.0, 0.0), (0.08, 0.05)):
        # Centripetal to the left; ahead of the axle also backward, toward the turn's centre.
        expected = [0.0, 0.0, omega, -(omega**2) * x, v * omega, GRAVITY]
        sample = ideal_sample(*motion, np.array([x, 0.0, z]))
        np.testing.assert_allclose(sample, expected, rtol=0.005, atol=0.005)


# --- Kinematic twin ---


def run_twin(robot: DifferentialDriveParameters, command: Any, start: Any, t: float) -> np.ndarray:
    twin = KinematicDifferentialDrive(parameters=robot)
    simulator = Simulator(twin)
    context = simulator.get_mutable_context()
    twin.wheel_speeds_input_port().FixValue(context, wheel_speeds(command, robot))
    context.SetContinuousState(start)
    simulator.AdvanceTo(t)
    np.testing.assert_allclose(twin.velocity_output_port().Eval(context), command, atol=1e-12)
    return twin.pose_output_port().Eval(context)


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_twin_drives_on_arcs(robot: DifferentialDriveParameters) -> None:
    v, omega, t = 0.4, 0.7, 3.0
    x, y, theta = 0.5, -0.2, 2.8
    radius = v / omega
    expected = [
        x + radius * (np.sin(theta + omega * t) - np.sin(theta)),
        y - radius * (np.cos(theta + omega * t) - np.cos(theta)),
        theta + omega * t,  # not wrapped
    ]
    np.testing.assert_allclose(run_twin(robot, [v, omega], [x, y, theta], t), expected, atol=1e-3)
    straight = run_twin(robot, [v, 0.0], [x, y, theta], t)
    expected = [x + v * t * np.cos(theta), y + v * t * np.sin(theta), theta]
    np.testing.assert_allclose(straight, expected, atol=1e-9)


def test_the_twin_in_automatic_derivatives() -> None:
    twin = KinematicDifferentialDrive(parameters=DEFAULT).ToAutoDiffXd()
    context = twin.CreateDefaultContext()
    r, b = DEFAULT.wheel_radius, DEFAULT.base
    for x in np.random.default_rng(1).uniform(-2, 2, (10, 5)):
        ad = InitializeAutoDiff(x).ravel()
        context.SetContinuousState(ad[:3])
        twin.wheel_speeds_input_port().FixValue(context, ad[3:])
        found = twin.EvalTimeDerivatives(context).CopyToVector()
        c, s, (v, omega) = np.cos(x[2]), np.sin(x[2]), body_velocity(x[3:], DEFAULT)
        np.testing.assert_allclose(ExtractValue(found).ravel(), [v * c, v * s, omega], atol=1e-12)
        expected = [
            [0, 0, -v * s, r * c / 2, r * c / 2],
            [0, 0, v * c, r * s / 2, r * s / 2],
            [0, 0, 0, r / b, -r / b],
        ]
        np.testing.assert_allclose(ExtractGradient(found), expected, atol=1e-12)


def test_the_twin_in_symbols() -> None:
    twin = KinematicDifferentialDrive(parameters=LARGE).ToSymbolic()
    context = twin.CreateDefaultContext()
    theta, right, left = Variable("theta"), Variable("right"), Variable("left")
    context.SetContinuousState([Expression(0.0), Expression(0.0), Expression(theta)])
    speeds = np.array([Expression(right), Expression(left)])
    twin.wheel_speeds_input_port().FixValue(context, speeds)
    found = twin.EvalTimeDerivatives(context).CopyToVector()
    environment = {theta: 0.3, right: 4.0, left: 1.0}
    v, omega = body_velocity([4.0, 1.0], LARGE)
    values = [expression.Evaluate(environment) for expression in found]
    np.testing.assert_allclose(values, [v * np.cos(0.3), v * np.sin(0.3), omega])
