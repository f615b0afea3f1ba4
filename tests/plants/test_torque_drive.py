"""The multibody robot turned by motors: what they make of its mass, its friction and the ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Demultiplexer, MatrixGain

from plants.arena import ArenaParameters, Wall, add_arena
from plants.differential_drive import (
    DifferentialDriveParameters,
    add_differential_drive,
    servo_matrix,
)
from plants.motors import DcMotors, MotorModel, MotorParameters
from systems.markers.family import family
from systems.markers.layout import MarkerMap

ROBOT = DifferentialDriveParameters()
EQUAL = MotorParameters(right_gain=1.0, left_gain=1.0)
BRAKING = replace(EQUAL, chopped="inputs")
R = ROBOT.wheel_radius
WHEEL = 0.5 * ROBOT.wheel_mass * R**2  # kg m^2


def inertia(motor: MotorModel) -> float:
    """Of one wheel with its rotor and half of the robot's mass, straight on, kg m^2."""
    return WHEEL + motor.inertia + (ROBOT.mass + 2 * ROBOT.wheel_mass) / 2 * R**2


class Rig:
    """The robot in an arena, its motors fed with pulse widths."""

    def __init__(
        self, motors: MotorParameters, *, time_step: float = 0.005, wall: float | None = None
    ) -> None:
        builder = DiagramBuilder()
        config = MultibodyPlantConfig(
            time_step=time_step, discrete_contact_approximation="lagged",
            use_sampled_output_ports=False,
        )  # fmt: skip
        plant, _ = AddMultibodyPlant(config, builder)
        walls = [] if wall is None else [Wall(start=[wall, 1.0], end=[wall, -1.0])]
        add_arena(plant, ArenaParameters(walls=walls), MarkerMap(family("DICT_4X4_50"), 0.1))
        self.motor = MotorModel(motors)
        self.model = add_differential_drive(plant, ROBOT, "robot", self.motor)
        plant.Finalize()
        self.block = builder.AddSystem(DcMotors(parameters=motors))
        servos = builder.AddSystem(MatrixGain(servo_matrix(plant, self.model)))
        state = builder.AddSystem(Demultiplexer([15, 2]))
        builder.Connect(plant.get_state_output_port(self.model), state.get_input_port())
        builder.Connect(state.get_output_port(1), self.block.wheel_speeds_input_port())
        builder.Connect(self.block.servo_speeds_output_port(), servos.get_input_port())
        builder.Connect(servos.get_output_port(), plant.get_desired_state_input_port(self.model))
        builder.ExportInput(self.block.pwm_input_port(), "pwm")
        self.plant = plant
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        self.pwm(0.0, 0.0)

    def pwm(self, right: float, left: float) -> None:
        self.diagram.GetInputPort("pwm").FixValue(self.context, [right, left])

    def run(self, duration: float) -> None:
        self.simulator.AdvanceTo(self.context.get_time() + duration)

    @property
    def wheels(self) -> np.ndarray:
        """How fast the wheels turn, [right, left] (rad/s)."""
        return self.velocities()[6:]

    @property
    def position(self) -> np.ndarray:
        """Where base_link is on the ground."""
        own = self.plant.GetMyContextFromRoot(self.context)
        return self.plant.GetPositions(own, self.model)[4:6].copy()

    def velocities(self) -> np.ndarray:
        """Of base_link, rotation first, then of the wheels."""
        own = self.plant.GetMyContextFromRoot(self.context)
        return self.plant.GetVelocities(own, self.model).copy()

    def moving(self, v: float) -> None:
        """Lets it roll straight on at once."""
        own = self.plant.GetMyMutableContextFromRoot(self.context)
        self.plant.SetVelocities(own, self.model, [0, 0, 0, v, 0, 0, v / R, v / R])


@pytest.mark.parametrize("motors", [EQUAL, BRAKING])
@pytest.mark.parametrize("pwm", [255, 128, -90])
def test_on_flat_ground_it_reaches_the_steady_speed(motors: MotorParameters, pwm: float) -> None:
    rig = Rig(motors)
    rig.moving(0.9 * R * float(rig.motor.steady_speed(pwm / 255)))
    rig.pwm(pwm, pwm)
    rig.run(5.0)
    expected = rig.motor.steady_speed(pwm / 255)
    np.testing.assert_allclose(rig.wheels, expected, rtol=0.005)
    assert rig.velocities()[3] == pytest.approx(R * expected, rel=0.01)


@pytest.mark.parametrize("motors", [EQUAL, BRAKING])
@pytest.mark.parametrize(("time_step", "tolerance"), [(0.001, 0.015), (0.01, 0.09)])
@pytest.mark.parametrize("pwm", [255, 150])
def test_it_speeds_up_as_torque_and_inertia_say(
    motors: MotorParameters, time_step: float, tolerance: float, pwm: float
) -> None:
    rig = Rig(motors, time_step=time_step)
    rig.run(0.1)
    rig.pwm(pwm, pwm)
    rig.run(0.15)
    w, h = 0.0, 1e-5  # the same by hand: J w' = torque - friction
    for _ in range(15000):
        torque = float(rig.motor.torque(pwm / 255, w)) - rig.motor.friction
        w += h * torque / inertia(rig.motor)
    np.testing.assert_allclose(rig.wheels, w, rtol=tolerance)


@pytest.mark.parametrize("time_step", [0.002, 0.01])
def test_it_coasts_to_a_stop_by_the_gears_friction_and_stays(time_step: float) -> None:
    rig = Rig(EQUAL, time_step=time_step)
    v = 0.25
    rig.moving(v)
    deceleration = rig.motor.friction * R / inertia(rig.motor)
    rig.run(v / deceleration + 0.3)
    length = rig.position[0]
    # The solver adds up to d h to the wheel's inertia: it rolls that much farther.
    added = rig.motor.damping * time_step / inertia(rig.motor)
    assert length == pytest.approx(v**2 / 2 / deceleration * (1 + added), rel=0.03)
    rig.run(5.0)
    assert rig.position[0] == pytest.approx(length, abs=1e-6)


def test_shorted_between_pulses_it_stops_sooner() -> None:
    lengths = []
    for motors in (EQUAL, BRAKING):
        rig = Rig(motors)
        rig.moving(0.25)
        rig.run(2.0)
        lengths.append(rig.position[0])
    assert lengths[1] < 0.75 * lengths[0]


def test_in_the_dead_band_it_stands() -> None:
    rig = Rig(EQUAL)
    rig.pwm(32, -32)
    rig.run(3.0)
    assert np.abs(rig.position).max() < 1e-4
    assert np.abs(rig.wheels).max() < 2e-3
    rig.pwm(40, 40)
    rig.run(1.0)
    assert rig.position[0] > 0.005


@pytest.mark.parametrize("gains", [(0.95, 1.05), (1.02, 0.99)])
def test_unequal_motors_drive_it_on_a_circle(gains: tuple[float, float]) -> None:
    # Both wheels' speeds are in the ratio of the gains: b/2 (g_r + g_l) / (g_r - g_l).
    right, left = gains
    rig = Rig(replace(BRAKING, right_gain=right, left_gain=left))
    rig.pwm(200, 200)
    rig.run(2.0)
    v, omega = np.hypot(*rig.velocities()[3:5]), rig.velocities()[2]
    radius = ROBOT.base / 2 * (right + left) / (right - left)
    assert v / omega == pytest.approx(radius, rel=0.01)
    # And the track itself: three points of a circle of that radius.
    points = []
    for _ in range(3):
        points.append(rig.position)
        rig.run(2.0)
    a, b, c = (np.linalg.norm(points[i] - points[j]) for i, j in ((0, 1), (1, 2), (0, 2)))
    area = abs(np.linalg.det(np.array([points[1] - points[0], points[2] - points[0]]))) / 2
    assert a * b * c / (4 * area) == pytest.approx(abs(radius), rel=0.02)


def test_held_by_a_wall_it_draws_the_stall_current() -> None:
    # 6 V over 5.15 Ohm; 0.0683 N m at the wheel is less than the ground can bear.
    rig = Rig(EQUAL, wall=0.2)
    rig.pwm(255, 255)
    rig.run(3.0)
    assert np.abs(rig.wheels).max() < 0.1
    assert 0.05 < rig.position[0] < 0.1
    found = rig.block.current_output_port().Eval(rig.block.GetMyContextFromRoot(rig.context))
    np.testing.assert_allclose(found, 6.0 / 5.15, rtol=0.01)


STRONG = replace(EQUAL, stall_torque=1.0, no_load_speed=30.0)


def slip(rig: Rig) -> float:
    """How much faster the right wheel's rim is than the robot, m/s."""
    return float(R * rig.wheels[0] - rig.velocities()[3])


def test_a_strong_motor_spins_its_wheels_and_a_weak_one_does_not() -> None:
    # The ground bears mu times the weight on the wheels. What the casters carry is not theirs.
    traction = 9.81 * R * (ROBOT.mass + 2 * ROBOT.wheel_mass) / 2
    for motors, slips in ((EQUAL, False), (STRONG, True)):
        rig = Rig(motors)
        assert (rig.motor.torque(1.0, 0.0) > traction) == slips
        rig.run(0.2)
        rig.pwm(255, 255)
        rig.run(0.05)
        assert (slip(rig) > 0.2) == slips
        v = rig.velocities()[3]
        rig.run(0.02)
        acceleration = (rig.velocities()[3] - v) / 0.02
        assert acceleration < 9.81  # mu = 1
        if slips:
            assert acceleration > 0.5 * 9.81
        rig.run(1.5)  # it grips again at speed
        assert abs(slip(rig)) < 0.02 * R * rig.wheels[0]


@pytest.mark.parametrize("time_step", [0.005, 0.01])
def test_no_motor_is_too_stiff_for_the_time_step(time_step: float) -> None:
    # Torque by speed, over inertia, is 60 (or 30) times what an explicit step bears.
    stiff = replace(BRAKING, stall_torque=3.0, rotor_inertia=0.0, no_load_current=0.01)
    rig = Rig(stiff, time_step=time_step)
    assert rig.motor.damping * time_step / WHEEL > 30 * 2
    rig.pwm(150, 150)
    speeds = []
    for _ in range(200):
        rig.run(time_step)
        speeds.append(rig.wheels[0])
    expected = float(rig.motor.steady_speed(150 / 255))
    assert max(speeds) < 1.01 * expected
    np.testing.assert_allclose(speeds[-20:], expected, rtol=0.01)
    assert np.abs(np.diff(speeds[10:])).max() < 0.01 * expected  # once the wheels have gripped
