from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from plants.shell import (
    ShellMotion,
    ShellMotionParameters,
    ShellParameters,
    add_moving_shell,
    add_shell,
    pose_on_shell,
)

CONFIG = MultibodyPlantConfig(time_step=0.002, discrete_contact_approximation="lagged")
X_WS = RigidTransform(RollPitchYaw(0.3, -0.2, 1.0), [0.5, -0.3, 0.8])
LIVELY = ShellMotionParameters(
    translation=[0.1, -0.05, 0.03],
    translation_period=4.0,
    rotation=[1.5, 0.4, -0.6],
    rotation_period=6.0,
)

# --- Places ---


@pytest.mark.parametrize(
    ("angles", "place", "forward"),
    [
        ([0, 0, 0], [2, 0, 0], [0, 0, 1]),  # on the equator, to the pole
        ([90, 0, 0], [2, 0, 0], [0, -1, 0]),  # turned left: to the west
        ([0, 0, 90], [0, 2, 0], [0, 0, 1]),
        ([0, 90, 0], [0, 0, 2], [-1, 0, 0]),  # over the pole, away from yaw 0
        ([180, -90, 0], [0, 0, -2], [-1, 0, 0]),
    ],
)
def test_known_places(angles: list[float], place: list[float], forward: list[float]) -> None:
    X_RB = pose_on_shell(np.radians(angles), 2.0)
    np.testing.assert_allclose(X_RB.translation(), place, atol=1e-12)
    R = X_RB.rotation().matrix()
    np.testing.assert_allclose(R[:, 0], forward, atol=1e-12)
    np.testing.assert_allclose(R[:, 2], np.array(place) / 2, atol=1e-12)  # outward


@pytest.mark.parametrize("field", ["radius", "mass", "friction"])
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_nonsense_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}: must be"):
        ShellParameters(**{field: value})


# --- At rest ---


def test_it_stands_where_it_is_put_or_on_what_carries_it() -> None:
    plant, _ = AddMultibodyPlant(CONFIG, DiagramBuilder())
    ground = add_shell(plant, ShellParameters(), "ground", X_PR=X_WS)
    carrier = plant.AddRigidBody(
        "carrier", plant.AddModelInstance("robot"), SpatialInertia.SolidSphereWithMass(1.0, 0.1)
    )
    X_PR = RigidTransform([0.0, 0.0, 0.1])
    carried = add_shell(plant, ShellParameters(mass=0.5), "carried", carrier.body_frame(), X_PR)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    X_WC = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [1.0, 2.0, 3.0])
    plant.SetFreeBodyPose(context, carrier, X_WC)
    for model, expected in ((ground, X_WS), (carried, X_WC @ X_PR)):
        body = plant.GetBodyByName("shell", model)
        assert body.EvalPoseInWorld(context).IsNearlyEqualTo(expected, 1e-12)
    assert plant.CalcTotalMass(context, [carried]) == pytest.approx(0.5)


@pytest.mark.parametrize("add", [add_shell, add_moving_shell])
def test_without_its_plain_looks_one_can_still_stand_on_it(add: Any) -> None:
    for plain in (True, False):
        plant, _ = AddMultibodyPlant(CONFIG, DiagramBuilder())
        model = add(plant, ShellParameters(), "shell", plain=plain)
        body = plant.GetBodyByName("shell", model)
        assert len(plant.GetVisualGeometriesForBody(body)) == plain
        assert len(plant.GetCollisionGeometriesForBody(body)) == 1


# --- Moved ---


def test_known_motion() -> None:
    # Half a swing of 0.2 m in 4 s: there after 2 s, half way after 1 s at 0.1 pi / 2 m/s.
    motion = ShellMotionParameters(
        translation=[0.2, 0.0, 0.0], translation_period=4.0, rotation=[0.0, 0.0, 1.0]
    )
    for t, place, speed in ((0, 0, 0), (1, 0.1, 0.1 * np.pi / 2), (2, 0.2, 0), (4, 0, 0)):
        q, rates = motion.coordinates(t)
        np.testing.assert_allclose(q[:3], [place, 0, 0], atol=1e-12)
        np.testing.assert_allclose(rates[:3], [speed, 0, 0], atol=1e-12)
    q, rates = motion.coordinates(15.0)  # half of the default period of 30 s
    np.testing.assert_allclose([q[5], rates[5]], [1.0, 0.0], atol=1e-12)


def test_velocity_is_how_the_pose_changes() -> None:
    motion = ShellMotion(parameters=LIVELY, X_WS=X_WS)
    context = motion.CreateDefaultContext()

    def at(t: float) -> tuple[RigidTransform, np.ndarray]:
        context.SetTime(t)
        velocity = motion.spatial_velocity_output_port().Eval(context)
        X_WR = motion.pose_output_port().Eval(context)
        return RigidTransform(X_WR.GetAsMatrix4()), velocity.copy()

    assert at(0.0)[0].IsNearlyEqualTo(X_WS, 1e-12)
    h = 1e-4
    for t in (0.7, 2.9, 5.3):
        before, (_, V), after = at(t - h)[0], at(t), at(t + h)[0]
        rate = (after.rotation().matrix() - before.rotation().matrix()) / (2 * h)
        spin = rate @ before.rotation().matrix().T  # [w]x
        np.testing.assert_allclose(V[:3], [spin[2, 1], spin[0, 2], spin[1, 0]], atol=1e-3)
        step = after.translation() - before.translation()
        np.testing.assert_allclose(V[3:], step / (2 * h), atol=1e-6)


def test_it_goes_where_it_is_told() -> None:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(CONFIG, builder)
    model = add_moving_shell(plant, ShellParameters(), "reference", X_WS)
    plant.Finalize()
    motion = builder.AddSystem(ShellMotion(parameters=LIVELY, X_WS=X_WS))
    builder.Connect(motion.desired_state_output_port(), plant.get_desired_state_input_port(model))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    body = plant.GetBodyByName("shell", model)
    for t in (0.5, 1.5, 3.0, 4.5):
        simulator.AdvanceTo(t)
        own = plant.GetMyContextFromRoot(simulator.get_context())
        sent = motion.GetMyContextFromRoot(simulator.get_context())
        X_WR, expected = body.EvalPoseInWorld(own), motion.pose_output_port().Eval(sent)
        assert np.linalg.norm(X_WR.translation() - expected.translation()) < 3e-4
        turn = (X_WR.rotation() @ expected.rotation().inverse()).ToAngleAxis().angle()
        assert abs(turn) < 2e-3
        V = body.EvalSpatialVelocityInWorld(own).get_coeffs()
        expected_V = motion.spatial_velocity_output_port().Eval(sent)
        np.testing.assert_allclose(V, expected_V, atol=5e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"translation": [0.0, 1.0]}, r"translation is \[0.0, 1.0\]: must be three finite numbers"),
        ({"rotation": [0.0, math.nan, 0.0]}, "rotation is .*: must be three finite numbers"),
        ({"rotation": [0.0, 1.6, 0.0]}, r"rotation\[1\] is 1.6: must be within"),
        ({"translation_period": 0.0}, "translation_period is 0.0: must be greater than 0"),
        ({"rotation_period": -1.0}, "rotation_period is -1.0: must be greater than 0"),
    ],
)
def test_motion_that_makes_no_sense_is_refused(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ShellMotionParameters(**arguments)
