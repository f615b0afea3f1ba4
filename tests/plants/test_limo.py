from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from plants.arena import ArenaParameters, add_arena
from plants.body_state import BodyState
from plants.differential_drive import KinematicDifferentialDrive
from plants.limo import LimoParameters, add_limo, hull
from plants.wheels import joint_matrices, servo_matrix, wheel_speeds
from systems.estimators.wheel_odometry import effective_track, moved
from systems.markers.family import family
from systems.markers.layout import MarkerMap

Array = NDArray[np.float64]

LIMO = LimoParameters()
LONG = LimoParameters(wheelbase=0.26, length=0.4)
SLIPPERY = LimoParameters(friction=0.2)
ROBOTS = [LIMO, LONG, SLIPPERY, LimoParameters(mass=8.0, centre_height=0.15)]
names = pytest.mark.parametrize("robot", ROBOTS, ids=["limo", "long", "slippery", "heavy"])


class Rig:
    """A LIMO on flat ground."""

    def __init__(self, robot: LimoParameters, time_step: float = 0.005) -> None:
        builder = DiagramBuilder()
        config = MultibodyPlantConfig(
            time_step=time_step, discrete_contact_approximation="lagged",
            use_sampled_output_ports=False,
        )  # fmt: skip
        self.plant, _ = AddMultibodyPlant(config, builder)
        add_arena(self.plant, ArenaParameters(), MarkerMap(family("36h11"), 0.1))
        self.model = add_limo(self.plant, robot, "limo")
        self.plant.Finalize()
        self.state = BodyState.AddToBuilder(builder, self.plant, self.model)
        builder.ExportInput(self.plant.get_desired_state_input_port(self.model), "servos")
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        self.servos = servo_matrix(self.plant, self.model)
        self.to_angles, self.to_rates = joint_matrices(self.plant, self.model)
        self.robot = robot
        self.command(0.0, 0.0)

    def command(self, v: float, omega: float) -> None:
        speeds = np.array(wheel_speeds([v, omega], self.robot))
        self.diagram.GetInputPort("servos").FixValue(self.context, self.servos @ speeds)

    def output(self, name: str) -> Any:
        return self.state.GetOutputPort(name).Eval(self.state.GetMyContextFromRoot(self.context))

    def wheels(self, matrix: Array) -> Array:
        port = self.plant.get_state_output_port(self.model)
        return matrix @ port.Eval(self.plant.GetMyContextFromRoot(self.context))

    def body_twist(self) -> Array:
        """Angular velocity, then velocity, in the body's axes."""
        R_BW = self.output("pose").rotation().matrix().T
        V = self.output("spatial_velocity")
        return np.concatenate([R_BW @ V[:3], R_BW @ V[3:]])


def test_it_is_as_large_and_heavy_as_the_data_sheet_has_it() -> None:
    rig = Rig(LIMO)
    own = rig.plant.GetMyContextFromRoot(rig.context)
    assert rig.plant.CalcTotalMass(own, [rig.model]) == pytest.approx(4.2)
    assert hull(LIMO) == pytest.approx([0.161, 0.161, 0.11])
    for end, x in (("front", 0.1), ("rear", -0.1)):
        for side, y in (("right", -0.086), ("left", 0.086)):
            body = rig.plant.GetBodyByName(f"{end}_{side}_wheel")
            place = rig.plant.EvalBodyPoseInWorld(own, body).translation()
            np.testing.assert_allclose(place, [x, y, 0.045], atol=1e-12)
    centre = rig.plant.CalcCenterOfMassPositionInWorld(own, [rig.model])
    wheels = 4 * LIMO.wheel_mass
    expected = (wheels * 0.045 + (4.2 - wheels) * LIMO.centre_height) / 4.2
    np.testing.assert_allclose(centre, [0.0, 0.0, expected], atol=1e-12)


@names
def test_at_rest_it_stays_at_rest_and_upright(robot: LimoParameters) -> None:
    rig = Rig(robot)
    rig.simulator.AdvanceTo(2.0)
    X_WB = rig.output("pose")
    assert np.abs(X_WB.translation()).max() < 1e-4
    assert np.abs(X_WB.rotation().matrix() - np.eye(3)).max() < 1e-4
    assert np.abs(rig.output("spatial_velocity")).max() < 1e-5


@names
def test_straight_on_it_rolls_without_slip(robot: LimoParameters) -> None:
    rig = Rig(robot)
    for k in range(1, 41):  # 0.8 m/s^2: at once, the tyres would spin
        rig.command(0.01 * k, 0.0)
        rig.simulator.AdvanceTo(0.0125 * k)
    rig.simulator.AdvanceTo(1.0)
    start, angles = rig.output("planar_pose").copy(), rig.wheels(rig.to_angles)
    rig.simulator.AdvanceTo(4.0)
    x, y, theta = rig.output("planar_pose")
    rolled = robot.wheel_radius * (rig.wheels(rig.to_angles) - angles)
    np.testing.assert_allclose(rolled, x - start[0], rtol=1e-3)
    assert x - start[0] == pytest.approx(1.2, rel=2e-3)
    assert abs(y) < 1e-3
    assert abs(theta) < 1e-3


@names
def test_turning_in_place_its_tyres_slip_as_friction_has_it(robot: LimoParameters) -> None:
    """What the moment of four equal friction forces says by hand: b = W + L^2 / W."""
    differences, turns = [], []
    for omega in (0.5, -1.5, 3.0):
        rig = Rig(robot)
        rig.command(0.0, omega)
        rig.simulator.AdvanceTo(0.5)
        start, angles = rig.output("planar_pose")[2], rig.wheels(rig.to_angles)
        turned, last = 0.0, start
        for k in range(40):
            rig.simulator.AdvanceTo(0.5 + 0.05 * (k + 1))
            heading = rig.output("planar_pose")[2]
            turned += math.remainder(heading - last, 2 * math.pi)
            last = heading
        right, left = rig.wheels(rig.to_angles) - angles
        differences.append(right - left)
        turns.append(turned)
        assert np.abs(rig.output("planar_pose")[:2]).max() < 1e-3  # in place
    calibrated = effective_track(differences, turns, robot.wheel_radius)
    by_hand = robot.track + robot.wheelbase**2 / robot.track
    assert calibrated == pytest.approx(by_hand, rel=2e-3)
    assert robot.base == pytest.approx(by_hand)
    # Nothing like the track, which would be right without slip.
    assert calibrated > 1.8 * robot.track


@pytest.mark.parametrize("command", [[0.3, 0.3], [0.5, -0.5], [0.3, 1.0]])
def test_on_arcs_its_odometry_follows_it(command: list[float]) -> None:
    rig = Rig(LIMO)
    rig.command(*command)
    rig.simulator.AdvanceTo(1.0)
    truth, pose, angles = [], rig.output("planar_pose").copy(), rig.wheels(rig.to_angles)
    track_only = pose.copy()
    for k in range(150):
        rig.simulator.AdvanceTo(1.0 + 0.02 * (k + 1))
        now = rig.wheels(rig.to_angles)
        right, left = LIMO.wheel_radius * (now - angles)
        angles = now
        pose = moved(pose, (right + left) / 2, (right - left) / LIMO.base)
        track_only = moved(track_only, (right + left) / 2, (right - left) / LIMO.track)
        truth.append(rig.output("planar_pose").copy())
    way = 3.0 * command[0]
    error = np.hypot(*(pose - truth[-1])[:2])
    # Centrifugal force pushes it outward and the nose inward: 3 % at 0.3 m/s^2.
    assert error < (0.01 if abs(command[0] * command[1]) < 0.1 else 0.04) * way
    assert abs(math.remainder(pose[2] - truth[-1][2], 2 * math.pi)) < 0.01 * 3 * abs(command[1])
    # Odometry that knows nothing of the slip turns more than twice as much.
    assert np.hypot(*(track_only - truth[-1])[:2]) > 5 * error


def test_its_twin_is_the_kinematics_without_centrifugal_force() -> None:
    rig, command = Rig(LIMO), [0.3, 0.4]
    rig.command(*command)
    rig.simulator.AdvanceTo(1.0)
    twin = KinematicDifferentialDrive(parameters=LIMO)
    simulator = Simulator(twin)
    context = simulator.get_mutable_context()
    twin.wheel_speeds_input_port().FixValue(context, wheel_speeds(command, LIMO))
    context.SetContinuousState(rig.output("planar_pose"))
    simulator.AdvanceTo(2.0)
    rig.simulator.AdvanceTo(3.0)
    pose, expected = rig.output("planar_pose"), twin.pose_output_port().Eval(context)
    np.testing.assert_allclose(pose[:2], expected[:2], atol=0.02 * 0.6)
    assert abs(pose[2] - expected[2]) < 0.02 * 0.8


def test_in_a_curve_it_drifts_outward_the_more_the_less_it_grips() -> None:
    aside = []
    for robot in (LIMO, SLIPPERY):
        rig = Rig(robot)
        rig.command(0.4, 0.8)
        rig.simulator.AdvanceTo(2.0)
        aside.append(rig.body_twist()[4])
    assert aside[1] < 1.5 * aside[0] < 0  # to the right of a curve to the left


def test_the_time_step_hardly_matters() -> None:
    ends = []
    for step in (0.01, 0.005, 0.002):
        rig = Rig(LIMO, step)
        rig.command(0.3, 0.3)
        rig.simulator.AdvanceTo(4.0)
        ends.append(rig.output("planar_pose").copy())
    np.testing.assert_allclose(ends[0], ends[2], atol=0.01)
    np.testing.assert_allclose(ends[1], ends[2], atol=0.005)


def test_its_motors_are_no_stronger_than_they_may_be() -> None:
    weak = LimoParameters(max_torque=0.02)
    rig = Rig(weak)
    rig.command(1.0, 0.0)
    rig.simulator.AdvanceTo(0.2)
    before = rig.body_twist()[3]
    rig.simulator.AdvanceTo(0.7)
    limit = 4 * 0.02 / 0.045 / 4.2
    assert 0.8 * limit < (rig.body_twist()[3] - before) / 0.5 < limit
    # Nor strong enough to turn it in place against the friction of all tyres.
    rig.command(0.0, 2.0)
    rig.simulator.AdvanceTo(4.0)
    assert abs(rig.body_twist()[2]) < 0.02


@pytest.mark.parametrize("field", [name for name in vars(LIMO) if name != "effective_track"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_nonsense_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}: must be greater than 0"):
        LimoParameters(**{field: value})


def test_parts_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match=r"wheel_mass is 1\.2: must be less than a quarter"):
        LimoParameters(wheel_mass=1.2)
    with pytest.raises(ValueError, match=r"wheel_width is 0\.2: must be less than the track"):
        LimoParameters(wheel_width=0.2)
    with pytest.raises(ValueError, match=r"clearance is 0\.3: must be below"):
        LimoParameters(clearance=0.3)
    with pytest.raises(ValueError, match=r"centre_height is 0\.5: must be from"):
        LimoParameters(centre_height=0.5)
    with pytest.raises(ValueError, match=r"effective_track is -0\.1"):
        LimoParameters(effective_track=-0.1)
    assert LimoParameters(effective_track=0.42).base == 0.42
