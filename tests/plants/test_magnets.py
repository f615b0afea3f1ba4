from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import DiagramBuilder
from scipy.optimize import linprog

from plants.adhesion_margin import Suspension, adhesion_margin
from plants.magnets import MagneticAdhesion, MagnetParameters, magnet_force
from plants.shell import ShellParameters, add_shell, pose_on_shell
from plants.snailbot import SnailBotParameters, add_snailbot, wheel_centres
from tests.plants.two_robots import TwoRobots

RADIUS = 0.075
COM = np.array([0.0, 0.0, 0.09])  # 15 mm above the pole
PULLS = np.full(6, 4.0)
WEIGHT = 2.4  # N


def stations(*, ahead: float = 0.17, across: float = 0.45) -> np.ndarray:
    """Six contacts about the pole, by direction cosines; (6, 3) m."""
    xy = np.array([[x, y] for y in (-across, across) for x in (ahead, 0.0, -ahead)])
    return RADIUS * np.column_stack([xy, np.sqrt(1 - (xy * xy).sum(axis=1))])


CONTACTS = stations()

# --- Force ---


def test_known_forces() -> None:
    magnets = MagnetParameters(force=4.0, gap=0.002)
    gaps = np.array([-1e-4, 0.0, 0.002, 0.006, 0.018])
    np.testing.assert_allclose(magnet_force(gaps, magnets), [4.0, 4.0, 1.0, 0.25, 0.04])
    assert magnet_force(0.002, magnets) == pytest.approx(1.0)


def test_work_to_pull_a_magnet_off() -> None:
    # The integral of F0 / (1 + g / g0)^2 from 0 to infinity is F0 g0.
    gaps = np.geomspace(1e-7, 100.0, 200_001)
    work = np.trapezoid(magnet_force(gaps, MagnetParameters(force=3.0, gap=0.0015)), gaps)
    assert work == pytest.approx(3.0 * 0.0015, rel=1e-3)


@pytest.mark.parametrize(
    ("field", "value"), [("force", -1.0), ("force", math.nan), ("gap", 0.0), ("detached_gap", 0.0)]
)
def test_nonsense_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}: must be"):
        MagnetParameters(**{field: value})


# --- Margin ---


def margin(direction: Any, *, friction: float = 0.8, com: np.ndarray = COM, **other: Any) -> float:
    weight = WEIGHT * np.asarray(direction, float) / np.linalg.norm(direction)
    arguments = {"contacts": CONTACTS, "pulls": PULLS, **other}
    return adhesion_margin(**arguments, weight=weight, centre_of_mass=com, friction=friction)


def test_on_top_it_needs_no_adhesion() -> None:
    assert margin([0, 0, -1]) == math.inf


def test_hanging_the_magnets_carry_the_weight() -> None:
    # The pulls' components along the vertical, over the weight; friction has no part in it.
    assert margin([0, 0, 1]) == pytest.approx(4.0 * CONTACTS[:, 2].sum() / RADIUS / WEIGHT)
    assert margin([0, 0, 1], friction=0.0) == margin([0, 0, 1])


def test_without_friction_no_magnet_holds_it_on_a_slope() -> None:
    assert margin([1, 0, 0], friction=0.0) == 0.0
    assert margin([0.01, 0, -1], friction=0.0) == 0.0


def test_tipping_backward_by_hand() -> None:
    # Four wheels, in rows ahead and behind, 15 degrees and more from the plane between them. With
    # plenty of friction and a high centre of mass it tips about the rear row. Its moments: of the
    # weight, by how much higher it acts; of the two front pulls, by their distance from the row, of
    # which the part at right angles to it counts. Contacts at R (+-a, +-b, c).
    a, b = 0.25, 0.3
    c = math.sqrt(1 - a * a - b * b)
    contacts = RADIUS * np.array([[x, y, c] for y in (-b, b) for x in (a, -a)])
    com = np.array([0.0, 0.0, 0.15])
    found = margin([-1, 0, 0], friction=5.0, com=com, contacts=contacts, pulls=PULLS[:4])
    # A front pull F (-a, ., -c) acts 2 a R ahead of the row: its moment about y is 2 a c R F.
    holding = 2 * 4.0 * 2 * a * c * RADIUS
    assert found == pytest.approx(holding / (WEIGHT * (0.15 - c * RADIUS)))


def test_it_is_in_proportion_and_knows_no_axes() -> None:
    rng = np.random.default_rng(0)
    for direction in rng.normal(size=(20, 3)):
        reference = margin(direction)
        assert margin(direction, pulls=PULLS / 3) == pytest.approx(reference / 3)
        R = RollPitchYaw(*rng.uniform(-1.4, 1.4, 3)).ToRotationMatrix().matrix()
        turned = margin(R @ direction, contacts=CONTACTS @ R.T, com=R @ COM)
        assert turned == pytest.approx(reference)
        order = rng.permutation(6)
        assert margin(direction, contacts=CONTACTS[order]) == pytest.approx(reference)


def least_adhesion(
    direction: np.ndarray,
    friction: float,
    com: np.ndarray,
    contacts: np.ndarray = CONTACTS,
    pivots: tuple[np.ndarray, np.ndarray] | None = None,
) -> float:
    """The smallest scale of the pulls with which normal and friction forces hold the robot.

    With `pivots`, (2, 3) of the bogies and of the rockers, about y, right and left: of front and
    middle wheel no moment about their bogie's is left, and of a side's three about the rockers'
    the same on both.
    """
    weight = WEIGHT * direction / np.linalg.norm(direction)

    def wrench(k: int, f: np.ndarray) -> np.ndarray:
        found = [*f, *np.cross(contacts[k], f)]
        if pivots is not None:
            bogies, rockers = pivots
            side = k // 3
            about = [np.cross(contacts[k] - p[side], f)[1] for p in (bogies, rockers)]
            found += [about[0] * (side == s and k % 3 < 2) for s in (0, 1)]
            found.append(about[1] * (1 if side else -1))
        return np.array(found)

    n = contacts / np.linalg.norm(contacts, axis=1, keepdims=True)
    columns = [np.sum([wrench(k, -PULLS[k] * normal) for k, normal in enumerate(n)], axis=0)]
    for k, normal in enumerate(n):
        t = np.cross(normal, [0.3, 0.9, 0.1])
        t /= np.linalg.norm(t)
        u = np.cross(normal, t)
        for angle in np.arange(32) * np.pi / 16:
            f = normal + friction * (np.cos(angle) * t + np.sin(angle) * u)
            columns.append(wrench(k, f))
    sought = np.zeros(len(columns[0]))
    sought[:6] = -np.concatenate([weight, np.cross(com, weight)])
    scale = np.where(np.arange(len(sought)) < 3, 1, 20)  # moments are in fractions of N m
    cost = np.eye(1, len(columns))[0]
    found = linprog(
        cost, A_eq=np.array(columns).T * scale[:, None], b_eq=sought * scale, bounds=(0, None)
    )
    assert found.status == 0
    return float(found.x[0])


@pytest.mark.parametrize(("friction", "height"), [(0.4, 0.09), (0.8, 0.09), (0.8, 0.11)])
def test_it_is_what_statics_allow(friction: float, height: float) -> None:
    com = np.array([0.0, 0.0, height])
    ratios = []
    for direction in np.random.default_rng(1).normal(size=(40, 3)):
        exact = least_adhesion(direction, friction, com)
        if exact > 0.1:  # where it matters: less than ten times what is needed
            ratios.append(margin(direction, friction=friction, com=com) * exact)
    assert len(ratios) > 20
    # Never on the wrong side but by the cone's corners (32 of them: 0.5 %), and near.
    assert min(ratios) > 0.994
    assert max(ratios) < 1.3
    assert np.median(ratios) < 1.1


# --- Margin of a robot on rockers ---


def on_rockers(contacts: np.ndarray, bogies: np.ndarray, rockers: np.ndarray) -> Suspension:
    """Wheels right front, middle, rear, left ...; pivots (2, 3), right and left, about y."""
    supports = np.array([bogies[0], contacts[2], bogies[1], contacts[5]])
    bearing = np.zeros((4, 6))
    for row, wheels in enumerate(([0, 1], [2], [3, 4], [5])):
        bearing[row, wheels] = 1
    arms = supports - np.repeat(rockers, 2, axis=0)
    sway = np.cross([0.0, 1.0, 0.0], arms) * np.array([1, 1, -1, -1])[:, None]
    return Suspension(supports, bearing, sway)


@pytest.mark.parametrize(
    ("x", "y"), [(0.1, 0.0), (0.1, 0.02), (0.1, -0.05), (-0.1, 0.03), (0.0, 0.15), (0.2, 0.2)]
)
def test_a_load_aslant_by_hand(x: float, y: float) -> None:
    # On the flat, with a load at x, y from the middle axle's middle. The normal forces of rear
    # wheels and bogies' pivots, apart from the pulls, F and 2 F, follow from their sum, from the
    # moments about both axes, and from the rockers, whose moments are the same on both sides. The
    # one that comes nearest to nothing decides.
    a, b, h, large = 0.013, 0.0065, 0.036, 1e4
    A = np.array([[1, 1, 1, 1], [b, -a, b, -a], [-h, -h, h, h], [b, -a, -b, a]])
    by_weight = np.linalg.solve(A, WEIGHT * np.array([1, x, y, 0]))
    expected = (np.array([8, 4, 8, 4]) / -by_weight)[by_weight < 0].min()
    plane = np.array([[x, y, large] for y in (-h, h) for x in (a, 0.0, -a)])
    contacts = plane * large / np.linalg.norm(plane, axis=1, keepdims=True)
    bogies = np.array([[b, y, large + 0.002] for y in (-h, h)])
    rockers = np.array([[0.0, y, large + 0.01] for y in (-h, h)])
    found = margin(
        [0, 0, -1], friction=1e6, com=np.array([x, y, large + 0.05]), contacts=contacts,
        suspension=on_rockers(contacts, bogies, rockers),
    )  # fmt: skip
    assert found == pytest.approx(expected, rel=1e-3)


def test_on_rockers_it_is_what_statics_allow() -> None:
    # With a load on its back, so that tipping decides. Taken for rigid, it would be said to hold
    # half as much again as it does, and at times five times as much.
    robot = SnailBotParameters()
    up = np.array([0.0, 0.0, 1.0])
    contacts = wheel_centres(robot, ShellParameters()) + (RADIUS + robot.clearance) * up
    bogies = (contacts[[0, 3]] + contacts[[1, 4]]) / 2 + robot.bogie_pivot * up
    rockers = contacts[[1, 4]] + robot.rocker_pivot * up
    contacts *= RADIUS / np.linalg.norm(contacts, axis=1, keepdims=True)
    suspension = on_rockers(contacts, bogies, rockers)
    rng = np.random.default_rng(2)
    ratios: list[float] = []
    rigid: list[float] = []
    for direction in rng.normal(size=(60, 3)):
        com = np.array([*rng.normal(size=2) * 0.03, 0.16])
        exact = least_adhesion(direction, 0.8, com, contacts, (bogies, rockers))
        if exact > 0.1:
            for found, model in ((ratios, suspension), (rigid, None)):
                held = margin(direction, com=com, contacts=contacts, suspension=model)
                found.append(held * exact)
    assert len(ratios) > 30
    assert min(ratios) > 0.8
    assert max(ratios) < 1.4
    assert 0.9 < np.median(ratios) < 1.0
    assert np.median(rigid) > 1.3
    assert max(rigid) > 4.0


# --- Block ---


class Rig:
    """A SnailBot and a shell whose poses are set, without dynamics."""

    def __init__(self, **magnets: float) -> None:
        builder = DiagramBuilder()
        self.plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.002), builder)
        self.X_WR = RigidTransform(RollPitchYaw(0.4, 0.2, -0.7), [0.3, 0.2, 1.0])
        robot, shell = SnailBotParameters(), ShellParameters()
        reference = add_shell(self.plant, shell, "reference", X_PR=self.X_WR)
        self.model = add_snailbot(self.plant, robot, shell, "robot")
        self.plant.Finalize()
        self.adhesion = MagneticAdhesion.AddToBuilder(
            builder, self.plant, model=self.model, shell=reference,
            wheel_radius=robot.wheel_radius, shell_parameters=shell,
            parameters=MagnetParameters(**magnets),
        )  # fmt: skip
        self.diagram = builder.Build()
        self.context = self.diagram.CreateDefaultContext()
        self.plant_context = self.plant.GetMyMutableContextFromRoot(self.context)

    def put(self, angles: list[float], above: float = 0.0) -> None:
        X_RB = pose_on_shell(np.radians(angles), 0.085 + above)
        base = self.plant.GetBodyByName("base_link", self.model)
        self.plant.SetFreeBodyPose(self.plant_context, base, self.X_WR @ X_RB)

    def output(self, name: str) -> Any:
        return self.adhesion.GetOutputPort(name).Eval(
            self.adhesion.GetMyContextFromRoot(self.context)
        )


def generalized(plant: Any, context: Any, pulls: list[tuple[Any, np.ndarray]]) -> np.ndarray:
    """What forces on the origins of bodies do to the joints, by Drake's Jacobians."""
    world, total = plant.world_frame(), np.zeros(plant.num_velocities())
    for body, force in pulls:
        J = plant.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, body.body_frame(), np.zeros(3), world, world
        )
        total += J.T @ force
    return total


def pulls_between(
    plant: Any, context: Any, model: Any, shell: Any, force: float
) -> list[tuple[Any, np.ndarray]]:
    """The six wheels' pulls to the shell's centre, where they touch it, and their reaction."""
    pulls, reaction = [], np.zeros(3)
    centre = shell.EvalPoseInWorld(context).translation()
    for body in map(plant.get_body, plant.GetBodyIndices(model)):
        if body.name().endswith("_wheel"):
            inward = centre - body.EvalPoseInWorld(context).translation()
            pulls.append((body, force * inward / np.linalg.norm(inward)))
            reaction -= pulls[-1][1]
    assert len(pulls) == 6
    return [*pulls, (shell, reaction)]


def test_the_magnets_pull_to_the_centre_and_the_shell_is_pulled_back() -> None:
    rig = Rig(force=2.0)
    rig.put([30, 40, 50])
    joints = ["right_rocker", "left_rocker", "right_bogie", "left_bogie", "left_rear_wheel"]
    for name, angle in zip(joints, [0.05, -0.05, 0.1, -0.02, 1.3], strict=True):
        joint = rig.plant.GetJointByName(name, rig.model)
        joint.set_angle(rig.plant_context, angle)
    # Only turned within the robot, its wheels are up to a millimetre off the shell.
    shell = rig.plant.GetBodyByName("shell")
    expected = []
    for (body, force), gap in zip(
        pulls_between(rig.plant, rig.plant_context, rig.model, shell, 1.0),
        [*rig.output("gaps"), 0.0],
        strict=True,
    ):
        expected.append((body, force * magnet_force(gap, MagnetParameters(force=2.0))))
    assert np.ptp(rig.output("gaps")) > 5e-4
    told = rig.output("generalized_forces")
    np.testing.assert_allclose(
        told, generalized(rig.plant, rig.plant_context, expected[:6]), atol=1e-12
    )  # the shell stands: its reaction moves nothing
    assert np.abs(told).max() > 1.0


def test_lifted_off_it_is_detached() -> None:
    rig = Rig(detached_gap=0.004)
    rig.put([0, 20, 70])
    np.testing.assert_allclose(rig.output("gaps"), 0.0, atol=1e-12)
    assert rig.output("detached") == 0.0
    base = rig.plant.GetBodyByName("base_link", rig.model)
    start = base.floating_velocities_start_in_v()
    on_base = slice(start + 3, start + 6)
    near = np.linalg.norm(rig.output("generalized_forces")[on_base])
    rig.put([0, 20, 70], above=0.003)
    assert rig.output("gaps").min() > 0.002
    assert rig.output("detached") == 0.0
    rig.put([0, 20, 70], above=0.01)
    assert rig.output("detached") == 1.0
    far = np.linalg.norm(rig.output("generalized_forces")[on_base])
    assert 0 < far < near / 50
    # Tilted, with one side on the shell, it is not.
    X_RB = pose_on_shell(np.radians([0, 20, 70]), 0.085)
    p_BWheel = np.array([0.0, 0.036, -0.01])
    tilt = RigidTransform(RollPitchYaw(-0.3, 0, 0), p_BWheel) @ RigidTransform(-p_BWheel)
    rig.plant.SetFreeBodyPose(rig.plant_context, base, rig.X_WR @ X_RB @ tilt)
    assert rig.output("gaps").max() > 0.01
    assert rig.output("detached") == 0.0


def test_the_margin_is_that_of_the_robot_as_it_stands() -> None:
    rig = Rig()
    rig.put([35, 10, 120])
    context = rig.plant_context
    p_WR = rig.X_WR.translation()
    contacts = []
    for index in rig.plant.GetBodyIndices(rig.model):
        body = rig.plant.get_body(index)
        if "wheel" in body.name():
            offset = body.EvalPoseInWorld(context).translation() - p_WR
            contacts.append(offset * RADIUS / np.linalg.norm(offset))
    weight = np.array([0, 0, -9.81 * rig.plant.CalcTotalMass(context, [rig.model])])
    com = rig.plant.CalcCenterOfMassPositionInWorld(context, [rig.model]) - p_WR
    X_WB = rig.plant.GetBodyByName("base_link", rig.model).EvalPoseInWorld(context)
    R = X_WB.rotation().matrix()

    def in_base(*names: str) -> np.ndarray:
        bodies = [rig.plant.GetBodyByName(name, rig.model) for name in names]
        return np.array([body.EvalPoseInWorld(context).translation() - p_WR for body in bodies]) @ R

    # In the axes of the robot, which make no difference, so that its y is the rockers' axis.
    touching = np.array(contacts) @ R
    order = np.lexsort([-touching[:, 0], touching[:, 1] > 0])  # right front, middle, rear, left ...
    suspension = on_rockers(
        touching[order],
        in_base("right_bogie", "left_bogie"),
        in_base("right_rocker", "left_rocker"),
    )
    expected = adhesion_margin(
        touching[order], PULLS, weight @ R, com @ R, 0.8, suspension=suspension
    )
    assert rig.output("margin") == pytest.approx(expected)
    # As if nothing gave way it would be more.
    assert adhesion_margin(np.array(contacts), PULLS, weight, com, 0.8) > 1.2 * expected


def test_a_model_without_wheels_is_refused() -> None:
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.002), DiagramBuilder())
    shell = add_shell(plant, ShellParameters(), "reference")
    plant.Finalize()
    with pytest.raises(ValueError, match="wheels is 0: must be at least three"):
        MagneticAdhesion(
            plant=plant, model=shell, shell=shell, wheel_radius=0.006,
            shell_parameters=ShellParameters(),
        )  # fmt: skip


def test_what_it_carries_weighs_on_it() -> None:
    margins = {}
    for carried in (True, False):
        rig = TwoRobots([0.0, 0.0, 60.0], below=(20, 70, 30), load=carried)
        margins[carried] = [rig.output(k, "margin")[0] for k in (0, 1)]
    # On the one below it weighs, not on the one above, which hangs on its own magnets.
    assert margins[True][0] < margins[False][0] / 5
    assert margins[True][1] == margins[False][1]
    # And it weighs as one heavier robot would, with its centre of mass where Drake says.
    rig = TwoRobots([0.0, 0.0, 60.0], below=(20, 70, 30))
    everything = [*rig.robots, rig.shells[1]]
    total = rig.plant.CalcTotalMass(rig.plant_context, everything)
    block = rig.adhesions[0]
    R, p = block._weighed.poses(rig.plant.get_state_output_port().Eval(rig.plant_context))
    own = slice(-len(block._masses), None)
    com = block._masses @ (p[own] + (R[own] @ block._centres_of_mass[..., None])[..., 0]) / total
    expected = rig.plant.CalcCenterOfMassPositionInWorld(rig.plant_context, everything)
    np.testing.assert_allclose(com, expected, atol=1e-9)
    assert total == pytest.approx(2 * 0.242 + 0.28)


def test_where_the_other_stands_makes_a_difference() -> None:
    # Behind, the far rear wheels' axle is nearer to the load than the bogies' pivots are in front:
    # it takes less to tip forward.
    margins = {}
    for yaw in (0.0, 90.0, 180.0):
        rig = TwoRobots([0.0, 0.0, yaw])
        margins[yaw] = rig.output(0, "margin")[0]
    assert margins[0.0] < margins[180.0] < margins[90.0]


@pytest.mark.parametrize("wrong", ["itself", "its shell", "one twice"])
def test_what_it_cannot_carry_is_refused(wrong: str) -> None:
    rig = TwoRobots([0.0, 0.0, 0.0])
    load = {
        "itself": [rig.robots[0]],
        "its shell": [rig.shells[0]],
        "one twice": [rig.robots[1], rig.robots[1]],
    }[wrong]
    with pytest.raises(ValueError, match=r"carried is \['\w+'.*\]: must be neither the robot"):
        MagneticAdhesion(
            plant=rig.plant, model=rig.robots[0], shell=rig.shells[0], wheel_radius=0.006,
            shell_parameters=ShellParameters(), carried=load,
        )  # fmt: skip


def test_the_forces_of_all_robots_reach_the_plant() -> None:
    rig = TwoRobots([0.0, 0.0, 0.0], forces=(2.0, 3.0))
    port = rig.plant.get_applied_generalized_force_input_port()
    expected = np.zeros(rig.plant.num_velocities())
    for k, force in enumerate((2.0, 3.0)):
        shell = rig.plant.GetBodyByName("shell", rig.shells[k])
        pulls = pulls_between(rig.plant, rig.plant_context, rig.robots[k], shell, force)
        expected += generalized(rig.plant, rig.plant_context, pulls)
    np.testing.assert_allclose(port.Eval(rig.plant_context), expected, atol=1e-9)
    # The lower one is pulled at from above too: by the reaction on the shell that it carries.
    lower = rig.plant.GetBodyByName("base_link", rig.robots[0]).floating_velocities_start_in_v()
    alone = rig.output(0, "generalized_forces")[lower + 3 : lower + 6]
    assert np.linalg.norm(expected[lower + 3 : lower + 6] - alone) > 1.0
