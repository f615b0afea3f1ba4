from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.systems.framework import DiagramBuilder
from scipy.optimize import linprog

from plants.magnets import MagneticAdhesion, MagnetParameters, adhesion_margin, magnet_force
from plants.shell import ShellParameters, add_shell, pose_on_shell
from plants.snailbot import SnailBotParameters, add_snailbot

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


def least_adhesion(direction: np.ndarray, friction: float, com: np.ndarray) -> float:
    """The smallest scale of the pulls with which normal and friction forces hold the robot."""
    weight = WEIGHT * direction / np.linalg.norm(direction)
    n = CONTACTS / RADIUS
    columns = [np.concatenate([-(PULLS[:, None] * n).sum(axis=0), np.zeros(3)])]
    for p, normal in zip(CONTACTS, n, strict=True):
        t = np.cross(normal, [0.3, 0.9, 0.1])
        t /= np.linalg.norm(t)
        u = np.cross(normal, t)
        for angle in np.arange(32) * np.pi / 16:
            f = normal + friction * (np.cos(angle) * t + np.sin(angle) * u)
            columns.append(np.concatenate([f, np.cross(p, f)]))
    sought = -np.concatenate([weight, np.cross(com, weight)])
    scale = np.array([1, 1, 1, 20, 20, 20])  # moments are in fractions of N m
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


def test_the_magnets_pull_to_the_centre_and_the_shell_is_pulled_back() -> None:
    rig = Rig(force=2.0)
    rig.put([30, 40, 50])
    *pulls, reaction = rig.output("forces")
    assert len(pulls) == 6
    names = {rig.plant.get_body(force.body_index).name() for force in pulls}
    sides = ("right", "left")
    ends = ("front", "middle", "rear")
    assert names == {f"{side}_{end}_wheel" for side in sides for end in ends}
    for force in pulls:
        wheel = rig.plant.get_body(force.body_index).EvalPoseInWorld(rig.plant_context)
        inward = rig.X_WR.translation() - wheel.translation()
        np.testing.assert_allclose(
            force.F_Bq_W.translational(), 2.0 * inward / np.linalg.norm(inward), atol=1e-9
        )
    assert rig.plant.get_body(reaction.body_index).name() == "shell"
    total = np.sum([force.F_Bq_W.get_coeffs() for force in [*pulls, reaction]], axis=0)
    np.testing.assert_allclose(total, 0.0, atol=1e-12)
    assert all(np.array_equal(force.p_BoBq_B, np.zeros(3)) for force in [*pulls, reaction])


def test_lifted_off_it_is_detached() -> None:
    rig = Rig(detached_gap=0.004)
    rig.put([0, 20, 70])
    np.testing.assert_allclose(rig.output("gaps"), 0.0, atol=1e-12)
    assert rig.output("detached") == 0.0
    near = sum(np.linalg.norm(f.F_Bq_W.translational()) for f in rig.output("forces")[:6])
    rig.put([0, 20, 70], above=0.003)
    assert rig.output("gaps").min() > 0.002
    assert rig.output("detached") == 0.0
    rig.put([0, 20, 70], above=0.01)
    assert rig.output("detached") == 1.0
    far = sum(np.linalg.norm(f.F_Bq_W.translational()) for f in rig.output("forces")[:6])
    assert far < near / 50
    # Tilted, with one side on the shell, it is not.
    X_RB = pose_on_shell(np.radians([0, 20, 70]), 0.085)
    p_BWheel = np.array([0.0, 0.036, -0.01])
    tilt = RigidTransform(RollPitchYaw(-0.3, 0, 0), p_BWheel) @ RigidTransform(-p_BWheel)
    base = rig.plant.GetBodyByName("base_link", rig.model)
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
    expected = adhesion_margin(
        np.array(contacts), PULLS,
        np.array([0, 0, -9.81 * rig.plant.CalcTotalMass(context, [rig.model])]),
        rig.plant.CalcCenterOfMassPositionInWorld(context, [rig.model]) - p_WR, 0.8,
    )  # fmt: skip
    assert rig.output("margin") == pytest.approx(expected)


def test_a_model_without_wheels_is_refused() -> None:
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.002), DiagramBuilder())
    shell = add_shell(plant, ShellParameters(), "reference")
    plant.Finalize()
    with pytest.raises(ValueError, match="wheels is 0: must be at least three"):
        MagneticAdhesion(
            plant=plant, model=shell, shell=shell, wheel_radius=0.006,
            shell_parameters=ShellParameters(),
        )  # fmt: skip
