from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import RevoluteJoint
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from plants.body_state import BodyState
from plants.magnets import MagneticAdhesion, MagnetParameters
from plants.shell import (
    ShellMotion,
    ShellMotionParameters,
    ShellParameters,
    add_moving_shell,
    add_shell,
)
from plants.snailbot import (
    SnailBotParameters,
    add_snailbot,
    body_velocity,
    carried_shell_pose,
    half_track,
    servo_matrix,
    stance,
    wheel_centres,
    wheel_speeds,
)
from systems.sensors.imu import ideal_sample
from systems.sensors.imu_parameters import GRAVITY
from systems.shell.angles import angle_differences, rotation, rotation_error
from tests.plants.two_robots import TwoRobots

DEFAULT = SnailBotParameters()
SHELL = ShellParameters()
LARGE = SnailBotParameters(
    wheel_radius=0.009, track=0.1, wheelbase=0.04, width=0.06, mass=0.25, clearance=0.014
)
LARGE_SHELL = ShellParameters(radius=0.12, friction=0.6)
SIZES = [(DEFAULT, SHELL), (LARGE, LARGE_SHELL)]
STEP = 1 / 300  # s, the inertial sensor's period

# --- Kinematics ---


@pytest.mark.parametrize(("robot", "shell"), SIZES)
def test_every_wheel_touches_the_shell(robot: SnailBotParameters, shell: ShellParameters) -> None:
    centre = [0.0, 0.0, -(shell.radius + robot.clearance)]
    centres = wheel_centres(robot, shell)
    distances = np.linalg.norm(centres - centre, axis=1)
    np.testing.assert_allclose(distances, shell.radius + robot.wheel_radius, atol=1e-12)
    ends = robot.wheelbase / 2
    np.testing.assert_allclose(centres[:, 0], 2 * [ends, 0.0, -ends], atol=1e-12)
    np.testing.assert_allclose(centres[:, 1], np.repeat([-0.5, 0.5], 3) * robot.track, atol=1e-12)


def test_known_wheel_speeds() -> None:
    # Straight on it is v / r, as on the flat. In place, by hand: the wheel at sin g = 36 / 81 rolls
    # on r cos g, and its contact is 75 sin g from the axis of the turn.
    np.testing.assert_allclose(wheel_speeds([0.03, 0.0], DEFAULT, SHELL), [5.0, 5.0])
    sine = 36 / 81
    expected = 0.075 * sine / (0.006 * math.sqrt(1 - sine**2))
    np.testing.assert_allclose(wheel_speeds([0.0, 1.0], DEFAULT, SHELL), [expected, -expected])
    # On a large shell it is what it is on the flat: half the track.
    plain = ShellParameters(radius=1e4)
    assert half_track(DEFAULT, plain) == pytest.approx(DEFAULT.track / 2)


@pytest.mark.parametrize(("robot", "shell"), SIZES)
def test_wheel_speeds_are_the_inverse(robot: SnailBotParameters, shell: ShellParameters) -> None:
    for command in np.random.default_rng(0).uniform(-1, 1, (10, 2)):
        speeds = wheel_speeds(command, robot, shell)
        np.testing.assert_allclose(body_velocity(speeds, robot, shell), command)


@pytest.mark.parametrize(("robot", "shell"), SIZES)
def test_no_wheel_slips_along(robot: SnailBotParameters, shell: ShellParameters) -> None:
    # Independent of the formulas: rigid rotation about the shell's centre, and each tread's
    # velocity where it touches. Along the wheel nothing is left of it; aside, in a turn, the
    # wheels at the ends slip and the middle ones do not.
    rig = Rig(robot=robot, shell=shell)
    M = servo_matrix(rig.plant, rig.model, robot, shell)
    assert not M[:6].any()
    p_CB = np.array([0.0, 0.0, shell.radius + robot.clearance])
    for v, omega in ((0.03, 0.0), (0.0, 0.5), (0.02, -0.4)):
        w = np.array([0.0, v / shell.radius, omega])
        speeds = M[6:] @ wheel_speeds([v, omega], robot, shell)
        for k, (centre, speed) in enumerate(
            zip(wheel_centres(robot, shell) + p_CB, speeds, strict=True)
        ):
            normal = centre / np.linalg.norm(centre)
            tread = np.cross(w, centre) + np.cross(
                w + speed * np.eye(3)[1], -robot.wheel_radius * normal
            )
            along = np.cross([0.0, 1.0, 0.0], normal)
            assert abs(tread @ along) < 1e-12
            assert abs(tread @ normal) < 1e-12
            assert (np.linalg.norm(tread) < 1e-12) == (k % 3 == 1 or omega == 0.0)


@pytest.mark.parametrize("field", list(vars(DEFAULT)))
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_nonsense_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}: must be greater than 0"):
        SnailBotParameters(**{field: value})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"wheelbase": 0.02}, r"wheelbase is 0.02: must be above two wheels' diameters = 0.024 m"),
        ({"width": 0.06}, r"width is 0.06: must be at most 0.054 m, between the rockers"),
        ({"mass_height": 0.03}, r"mass_height is 0.03: must be below the chassis' height"),
    ],
)
def test_parts_that_do_not_fit_are_refused(arguments: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SnailBotParameters(**arguments)


def test_a_shell_too_small_to_stand_on_is_refused() -> None:
    with pytest.raises(ValueError, match=r"radius is 0.04: must be at least 0.0481 m for a robot"):
        wheel_centres(DEFAULT, ShellParameters(radius=0.04))


# --- Multibody model ---


class Rig:
    """The robot on a shell, at rest there unless `motion` says how the shell moves."""

    def __init__(
        self,
        angles: tuple[float, float, float] = (0.0, 0.0, 0.0),
        *,
        robot: SnailBotParameters = DEFAULT,
        shell: ShellParameters = SHELL,
        time_step: float = STEP,
        motion: ShellMotionParameters | None = None,
        lift: float = 0.0,
        **magnets: float,
    ) -> None:
        builder = DiagramBuilder()
        config = MultibodyPlantConfig(
            time_step=time_step, discrete_contact_approximation="lagged",
            use_sampled_output_ports=False,
        )  # fmt: skip
        self.plant, _ = AddMultibodyPlant(config, builder)
        self.robot, self.shell = robot, shell
        add = add_shell if motion is None else add_moving_shell
        self.reference = add(self.plant, shell, "reference")
        self.model = add_snailbot(self.plant, robot, shell, "robot")
        self.plant.Finalize()
        self.adhesion = MagneticAdhesion.AddToBuilder(
            builder, self.plant, model=self.model, shell=self.reference,
            wheel_radius=robot.wheel_radius, shell_parameters=shell,
            parameters=MagnetParameters(**magnets),
        )  # fmt: skip
        self.state = BodyState.AddToBuilder(builder, self.plant, self.model)
        builder.ExportInput(self.plant.get_desired_state_input_port(self.model), "servos")
        if motion is not None:
            driver = builder.AddSystem(ShellMotion(parameters=motion))
            builder.Connect(
                driver.desired_state_output_port(),
                self.plant.get_desired_state_input_port(self.reference),
            )
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        self.plant_context = self.plant.GetMyMutableContextFromRoot(self.context)
        self.servos = servo_matrix(self.plant, self.model, robot, shell)
        X_RB = stance(np.radians(angles), robot, shell)
        self.plant.SetFreeBodyPose(
            self.plant_context,
            self.plant.GetBodyByName("base_link", self.model),
            X_RB @ RigidTransform([0.0, 0.0, lift]),
        )
        self.command(0.0, 0.0)

    def command(self, v: float, omega: float) -> None:
        speeds = wheel_speeds([v, omega], self.robot, self.shell)
        self.diagram.GetInputPort("servos").FixValue(self.context, self.servos @ speeds)

    def run(self, duration: float) -> Rig:
        self.simulator.AdvanceTo(self.context.get_time() + duration)
        return self

    def output(self, name: str) -> Any:
        for system in (self.adhesion, self.state):
            if system.HasOutputPort(name):
                return system.GetOutputPort(name).Eval(system.GetMyContextFromRoot(self.context))
        raise KeyError(name)

    def pose(self) -> RigidTransform:
        """Of base_link in the shell's frame."""
        X_WR = self.plant.GetBodyByName("shell", self.reference).EvalPoseInWorld(self.plant_context)
        return X_WR.inverse() @ self.output("pose")

    def normal(self) -> np.ndarray:
        p = self.pose().translation()
        return p / np.linalg.norm(p)

    def check_contact(self) -> None:
        """All wheels on the shell, and the robot upright on it."""
        gaps = self.output("gaps")
        assert gaps.max() < 0.0
        assert gaps.min() > -1.2e-4
        assert self.pose().rotation().matrix()[:, 2] @ self.normal() > math.cos(math.radians(1.0))
        assert self.output("detached") == 0.0


PLACES = [
    (0.0, 0.0, 0.0),
    (60.0, 0.0, 200.0),
    (0.0, 90.0, 0.0),
    (20.0, -90.0, 0.0),
    (130.0, -60.0, 40.0),
]


@pytest.mark.parametrize(("robot", "shell"), SIZES)
@pytest.mark.parametrize("angles", PLACES)
def test_it_is_put_on_the_shell_exactly(
    robot: SnailBotParameters, shell: ShellParameters, angles: tuple[float, float, float]
) -> None:
    rig = Rig(angles, robot=robot, shell=shell)
    gaps = rig.output("gaps")
    assert gaps.max() < -8e-6
    assert gaps.min() > -1.01e-5
    R = rig.pose().rotation().matrix()
    np.testing.assert_allclose(rotation_error(R, rotation(np.radians(angles))), 0.0, atol=1e-9)
    height = np.linalg.norm(rig.pose().translation()) - shell.radius
    assert height == pytest.approx(robot.clearance, abs=1.01e-5)


def test_its_masses_are_where_they_should_be() -> None:
    rig = Rig((0.0, 90.0, 0.0))
    models = [rig.model]
    p = DEFAULT
    mass = p.mass + 4 * p.arm_mass + 6 * p.wheel_mass
    assert rig.plant.CalcTotalMass(rig.plant_context, models) == pytest.approx(mass)
    com = rig.plant.CalcCenterOfMassPositionInWorld(rig.plant_context, models)
    # On the pole: symmetric left and right, and below the middle of the chassis.
    assert com[1] == pytest.approx(0.0, abs=1e-12)
    heights = wheel_centres(p, SHELL)[:, 2].sum() * p.wheel_mass + p.mass * p.mass_height
    assert com[2] == pytest.approx(0.085 + heights / mass, abs=1e-3)  # but for the arms


def test_a_differential_levels_the_chassis() -> None:
    # One rocker is pushed up by a foreign force on its rear wheel: the other goes down as much.
    rig = Rig((0.0, 90.0, 0.0)).run(0.2)
    names = ("right_rocker", "left_rocker")
    joints = [rig.plant.GetJointByName(name) for name in names]
    assert all(isinstance(joint, RevoluteJoint) for joint in joints)
    q = np.array([0.05, -0.05])
    for joint, angle in zip(joints, q, strict=True):
        joint.set_angle(rig.plant_context, angle)
    for _ in range(5):
        rig.run(0.02)
        right, left = (joint.get_angle(rig.plant_context) for joint in joints)
        assert right == pytest.approx(-left, abs=2e-4)
    assert abs(right) < 0.02  # the magnets pull them back


@pytest.mark.parametrize("angles", PLACES)
@pytest.mark.parametrize("time_step", [0.001, 0.002, STEP])
def test_at_rest_it_stays_where_it_is(angles: tuple[float, float, float], time_step: float) -> None:
    rig = Rig(angles, time_step=time_step).run(0.3)
    start = rig.pose()
    rig.run(0.3)
    creep = np.linalg.norm(rig.pose().translation() - start.translation()) / 0.3
    assert creep < 1e-4
    turn = rotation_error(rig.pose().rotation().matrix(), start.rotation().matrix()) / 0.3
    assert np.linalg.norm(turn) < 1e-3
    rig.check_contact()
    # It sank in by a few hundredths of a millimetre, and is where it was put.
    put = stance(np.radians(angles), DEFAULT, SHELL)
    assert np.linalg.norm(start.translation() - put.translation()) < 1e-4
    assert np.abs(rotation_error(start.rotation().matrix(), put.rotation().matrix())).max() < 1.5e-3


@pytest.mark.parametrize("angles", PLACES)
def test_an_inertial_sensor_on_it_feels_gravity(angles: tuple[float, float, float]) -> None:
    rig = Rig(angles).run(0.5)
    sample = ideal_sample(
        *(rig.output(n) for n in ("pose", "spatial_velocity", "spatial_acceleration")),
        np.array([0.01, 0.0, 0.005]),
    )
    up = rotation(np.radians(angles)).T @ [0.0, 0.0, GRAVITY]
    np.testing.assert_allclose(sample, [0, 0, 0, *up], atol=0.02)


@pytest.mark.parametrize(
    ("angles", "duration", "v"),
    [
        ((0.0, 0.0, 0.0), 7.85, 0.03),  # from the equator over the pole to the other side
        ((0.0, -60.0, 30.0), 3.0, 0.03),  # up from below, hanging at first
        ((180.0, 10.0, 0.0), 4.0, 0.03),  # down past the equator, head first
        ((90.0, 0.0, 0.0), 4.0, 0.03),  # along the equator
        ((0.0, 45.0, 0.0), 2.0, -0.03),  # backward
        ((0.0, 0.0, 0.0), 1.5, 0.1),
    ],
)
def test_it_drives_round_the_shell(
    angles: tuple[float, float, float], duration: float, v: float
) -> None:
    rig = Rig(angles)
    start = rig.pose().rotation().matrix()
    rig.command(v, 0.0)
    for _ in range(5):
        rig.run(duration / 5).check_contact()
    # A great circle, about the axis that was to its left.
    moved = rotation_error(rig.pose().rotation().matrix(), start)
    along, aside = moved @ start[:, 1], moved - (moved @ start[:, 1]) * start[:, 1]
    expected = v * duration / SHELL.radius
    if expected > np.pi - 0.05:
        along = abs(along)  # half a turn is one either way
    assert along == pytest.approx(expected, rel=0.03)
    assert np.linalg.norm(aside) < 0.02  # heading and track kept to a degree


def test_it_drives_a_larger_shell() -> None:
    rig = Rig((0.0, 0.0, 0.0), robot=LARGE, shell=LARGE_SHELL, force=6.0)
    rig.command(0.04, 0.0)
    rig.run(3.0)
    assert rig.output("gaps").max() < 0.0
    roll, pitch, yaw = angle_differences(rig.pose().rotation().matrix(), rotation(np.zeros(3)))
    assert pitch == pytest.approx(0.12 / 0.12, rel=0.03)
    assert max(abs(roll), abs(yaw)) < 0.01


@pytest.mark.parametrize("pitch", [90.0, 40.0, 0.0, -60.0])
@pytest.mark.parametrize("omega", [0.5, -0.5])
def test_it_turns_in_place(pitch: float, omega: float) -> None:
    rig = Rig((0.0, pitch, 0.0))
    start = rig.pose()
    rig.command(0.0, omega)
    for _ in range(4):
        rig.run(np.pi / 4).check_contact()
    R_start = start.rotation().matrix()
    moved = rotation_error(rig.pose().rotation().matrix(), R_start)
    # A quarter, less the creep of treads that scrub.
    assert np.degrees(moved @ R_start[:, 2]) == pytest.approx(math.copysign(90, omega), rel=0.05)
    # On a wall it gives way downhill while it does.
    assert np.linalg.norm(rig.pose().translation() - start.translation()) < 2.5e-3


def test_weak_magnets_let_it_fall() -> None:
    for force, falls in ((4.0, False), (1.0, False), (0.5, True)):
        rig = Rig(force=force)
        needs_more = rig.output("margin") < 1.0
        rig.run(0.5)
        assert (rig.output("detached") == 1.0) == falls == needs_more
        assert (rig.output("pose").translation()[2] < -0.05) == falls


def test_where_it_lets_go_upside_down() -> None:
    # Hanging, no friction is asked for: the least pull that holds is the weight's share. The
    # margin says so, and dynamics agree on both sides of it.
    unit = Rig((0.0, -90.0, 0.0), force=1.0).output("margin")[0]
    for share, falls in ((0.9, True), (1.1, False)):
        rig = Rig((0.0, -90.0, 0.0), force=share / unit)
        assert rig.output("margin") == pytest.approx(share)
        rig.run(0.5)
        assert (rig.output("detached") == 1.0) == falls


def test_on_a_slippery_shell_it_slides_down_and_hangs() -> None:
    # The magnets hold it all the same: from the equator it comes to swing about the lowest place.
    rig = Rig(shell=ShellParameters(friction=0.05), time_step=0.001)  # it gets fast
    assert rig.output("margin") < 1.0
    rig.run(0.3)
    assert rig.normal()[2] < -0.2
    assert rig.output("detached") == 0.0
    firm = Rig(shell=ShellParameters(friction=0.3))
    assert firm.output("margin") > 1.0
    assert abs(firm.run(0.3).normal()[2]) < 0.01


@pytest.mark.parametrize(
    ("lift", "lowest", "highest"), [(0.0, -0.1, 0.0), (0.005, -20.0, -8.0), (0.01, -90.0, -60.0)]
)
def test_why_it_has_to_be_put_down_exactly(lift: float, lowest: float, highest: float) -> None:
    # On the equator: what it falls before the magnets grip, in degrees of latitude.
    rig = Rig(lift=lift).run(0.5)
    assert lowest < math.degrees(math.asin(rig.normal()[2])) < highest
    assert rig.output("detached") == (lift == 0.01)


def test_no_wheel_jumps_when_it_is_put_down() -> None:
    # Without the hair's overlap of `stance` a wheel dips by a millimetre in the first steps.
    rig = Rig((0.0, 30.0, 0.0))
    for _ in range(20):
        rig.run(STEP)
        assert rig.output("gaps").min() > -6e-5
        assert rig.output("gaps").max() < 0.0


def test_it_rides_on_a_moving_shell() -> None:
    motion = ShellMotionParameters(
        translation=[0.1, -0.05, 0.05], translation_period=4.0,
        rotation=[1.0, 0.4, -0.5], rotation_period=5.0,
    )  # fmt: skip
    still, moving = Rig((30.0, 20.0, 50.0)), Rig((30.0, 20.0, 50.0), motion=motion)
    for rig in (still, moving):
        rig.command(0.03, 0.1)
        rig.run(2.0).check_contact()
    # Of the shell it does not know: on it, it drives where it does on one that stands.
    apart = rotation_error(moving.pose().rotation().matrix(), still.pose().rotation().matrix())
    assert np.linalg.norm(apart) < math.radians(0.5)
    # And the shell takes no notice of the robot.
    q, _ = motion.coordinates(2.0)
    X_WR = moving.plant.GetBodyByName("shell").EvalPoseInWorld(moving.plant_context)
    assert np.linalg.norm(X_WR.translation() - q[:3]) < 4e-4
    turn = X_WR.rotation() @ RollPitchYaw(q[:2:-1]).ToRotationMatrix().inverse()
    assert abs(turn.ToAngleAxis().angle()) < 2e-3


def test_the_motors_are_no_stronger_than_they_may_be() -> None:
    # Uphill from the equator six wheels of radius r need m g r in all (and a little for the
    # moment: the weight's centre goes round a wider circle than the treads).
    p = DEFAULT
    weight = GRAVITY * (p.mass + 4 * p.arm_mass + 6 * p.wheel_mass)
    needed = weight * p.wheel_radius * 0.09 / 0.075 / 6
    for share, climbs in ((0.7, False), (1.4, True)):
        rig = Rig(robot=SnailBotParameters(max_torque=share * needed))
        rig.command(0.03, 0.0)
        rig.run(1.0)
        assert (rig.normal()[2] > 0.2) == climbs
        assert (rig.normal()[2] < -0.02) == (not climbs)


# --- With a shell of its own and another robot on it ---


def test_a_carried_shell_is_over_the_chassis() -> None:
    X_BR = carried_shell_pose(LARGE, LARGE_SHELL)
    lowest = X_BR.translation()[2] - LARGE_SHELL.radius
    assert lowest == pytest.approx(LARGE.height + LARGE.mount)
    np.testing.assert_array_equal(X_BR.translation()[:2], 0.0)
    np.testing.assert_array_equal(X_BR.rotation().matrix(), np.eye(3))  # its pole is on top


@pytest.mark.parametrize(
    ("below", "angles"),
    [
        ((0, 90, 0), (0, 0, 0)),  # on top, with the other before it
        ((0, 90, 0), (0, 0, 180)),  # behind it
        ((0, 90, 0), (0, 0, 45)),
        ((0, 0, 0), (0, 90, 0)),  # sideways, nose up
        ((180, 0, 0), (0, 90, 0)),  # nose down
        ((75, 0, 0), (0, 90, 0)),
        ((0, -90, 0), (0, 90, 0)),  # hanging
    ],
)
def test_what_holds_a_carrier_is_what_its_margin_says(
    below: tuple[int, int, int], angles: tuple[int, int, int]
) -> None:
    # It tips over the pivots of its bogies. Just above 1 it may still fall: the load comes on it
    # at once.
    unit = TwoRobots(angles, below=below, forces=(1.0, 6.0)).output(0, "margin")[0]
    for share, falls in ((0.8, True), (1.5, False)):
        rig = TwoRobots(angles, below=below, forces=(share / unit, 6.0))
        assert rig.output(0, "margin") == pytest.approx(share)
        rig.run(0.6)
        assert (rig.output(0, "gaps").max() > 2e-3) == falls


@pytest.mark.parametrize(
    ("below", "v", "forces"),
    [
        ((0.0, 90.0, 0.0), 0.0, (7.0, 4.0)),  # it stands on the pole
        ((90.0, 0.0, 0.0), 0.01, (9.0, 4.0)),  # it drives along the equator, hanging sideways
    ],
)
def test_one_drives_on_the_shell_that_another_carries(
    below: tuple[float, float, float], v: float, forces: tuple[float, float]
) -> None:
    rig = TwoRobots((0.0, 0.0, 0.0), below=below, forces=forces)
    starts = [rig.pose(k).rotation().matrix() for k in (0, 1)]
    rig.command(0, v, 0.0)
    rig.command(1, 0.03, 0.0)
    for _ in range(10):  # from the equator over the pole to well below the other side's middle
        rig.run(0.55)
        for k in (0, 1):
            assert rig.output(k, "gaps").max() < 0.0
            assert rig.output(k, "gaps").min() > -2.5e-4
            assert rig.output(k, "margin") > 1.45
    for k, (speed, exact) in enumerate(((v, 0.05), (0.03, 0.03))):
        moved = rotation_error(rig.pose(k).rotation().matrix(), starts[k])
        along = moved @ starts[k][:, 1]
        aside = moved - along * starts[k][:, 1]
        assert along == pytest.approx(speed * 5.5 / SHELL.radius, rel=exact, abs=0.01)
        assert np.linalg.norm(aside) < math.radians(1.5)
