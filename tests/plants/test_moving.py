from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydrake.geometry import Box, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from plants.moving import MovingCylinder, MovingObstacles, add_moving_cylinders, starting_points

BENT = MovingCylinder(  # 3 m, then 4 m: 3.5 s there, 1 s of rest, 3.5 s back, 1 s of rest
    radius=0.1, path=[[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]], speed=2.0, pause=1.0
)
STRAIGHT = MovingCylinder(radius=0.15, path=[[1.0, -1.0], [1.0, 1.0]], speed=0.25, height=0.4)


@pytest.mark.parametrize(
    ("t", "position", "velocity"),
    [
        (0.0, [0.0, 0.0], [2.0, 0.0]),
        (1.0, [2.0, 0.0], [2.0, 0.0]),
        (2.0, [3.0, 1.0], [0.0, 2.0]),
        (3.75, [3.0, 4.0], [0.0, 0.0]),
        (4.5, [3.0, 4.0], [0.0, -2.0]),
        (5.5, [3.0, 2.0], [0.0, -2.0]),
        (7.0, [2.0, 0.0], [-2.0, 0.0]),
        (8.5, [0.0, 0.0], [0.0, 0.0]),
        (9.0, [0.0, 0.0], [2.0, 0.0]),
        (9001.0, [2.0, 0.0], [2.0, 0.0]),
    ],
)
def test_where_it_is_and_how_fast(t: float, position: list[float], velocity: list[float]) -> None:
    p, v = BENT.motion(t)
    np.testing.assert_allclose(p, position, atol=1e-9)
    np.testing.assert_allclose(v, velocity, atol=1e-9)


def test_it_moves_as_fast_as_it_says_and_never_jumps() -> None:
    h = 1e-4
    times = np.arange(0.0, 20.0, 0.0173)
    for t in times:
        p, v = BENT.motion(t)
        q, _ = BENT.motion(t + h)
        assert np.linalg.norm(q - p) <= 2.0 * h * (1 + 1e-9)
        later = BENT.motion(t + h)[1]
        if np.array_equal(v, later):  # no turn in between
            np.testing.assert_allclose((q - p) / h, v, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"radius": 0.0}, "radius is 0.0: must be greater than 0"),
        ({"height": -1.0}, "height is -1.0: must be greater than 0"),
        ({"speed": 0.0}, "speed is 0.0: must be greater than 0"),
        ({"pause": -0.1}, "pause is -0.1: must be 0 or greater"),
        ({"courtesy": -0.1}, "courtesy is -0.1: must be 0 or greater"),
        ({"path": [[0.0, 0.0]]}, r"path is \[\[0.0, 0.0\]\]: must be at least two points"),
        ({"path": [[0.0, 0.0], [1.0]]}, r"path\[1\] is \[1.0\]: must be \[x, y\] in metres"),
        ({"path": [[0.0, 0.0], [1.0, math.nan]]}, r"path\[1\] is .*: must be \[x, y\] in metres"),
        ({"path": [[1.0, 0.0], [1.0, 0.0]]}, r"path\[1\] is \[1.0, 0.0\]: must be another point"),
    ],
)
def test_nonsense_is_refused(change: dict[str, Any], message: str) -> None:
    good: dict[str, Any] = {"radius": 0.1, "path": [[0.0, 0.0], [1.0, 0.0]], "speed": 0.2}
    with pytest.raises(ValueError, match=message):
        MovingCylinder(**(good | change))
    with pytest.raises(ValueError, match=r"cylinders is .*: must be at least one"):
        MovingObstacles(cylinders=[])


def test_the_swept_ground_holds_it_at_all_times_and_nothing_that_it_never_reaches() -> None:
    points = np.random.default_rng(0).uniform([-1, -1], [4, 5], (200, 2))
    swept = BENT.swept().distances_from(points).min(axis=0)
    places = np.array([BENT.motion(t)[0] for t in np.arange(0.0, 3.5, 0.001)])
    nearest = np.linalg.norm(points[:, None] - places, axis=2).min(axis=1) - BENT.radius
    np.testing.assert_allclose(np.maximum(swept, 0), np.maximum(nearest, 0), atol=2e-3)


SLOW = MovingCylinder(radius=0.1, path=[[3.0, 0.0], [3.5, 0.0], [3.5, 0.5]], speed=0.25, pause=0.5)


def simulated(*, ball: float = 0.0) -> Any:
    """Two cylinders in a plant, and a ball of that mass (kg) at (1, 0) on smooth ground, if any."""
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(time_step=0.01, discrete_contact_approximation="lagged")
    plant, _ = AddMultibodyPlant(config, builder)
    cylinders = [SLOW, STRAIGHT]
    model = add_moving_cylinders(plant, cylinders, CoulombFriction(1.0, 1.0))
    smooth = CoulombFriction(0.0, 0.0)
    ground = Box(40.0, 40.0, 1.0)
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform([0.0, 0.0, -0.5]), ground, "ground", smooth
    )
    if ball:
        inertia = SpatialInertia.SolidSphereWithMass(ball, 0.1)
        body = plant.AddRigidBody("ball", plant.AddModelInstance("ball"), inertia)
        plant.RegisterCollisionGeometry(body, RigidTransform(), Sphere(0.1), "ball", smooth)
        plant.SetDefaultFloatingBaseBodyPose(body, RigidTransform([1.0, 0.0, 0.1]))
    plant.Finalize()
    motion = builder.AddSystem(MovingObstacles(cylinders=cylinders))
    builder.Connect(motion.desired_state_output_port(), plant.get_desired_state_input_port(model))
    simulator = Simulator(builder.Build())
    simulator.Initialize()
    own = plant.GetMyContextFromRoot(simulator.get_context())

    def place(name: str) -> Any:
        return plant.EvalBodyPoseInWorld(own, plant.GetBodyByName(name)).translation()[:2]

    return simulator, place


def test_in_the_plant_they_follow_their_paths_from_the_first_moment() -> None:
    simulator, place = simulated()
    np.testing.assert_allclose(starting_points([BENT, STRAIGHT]), [0, 0, 1, -1])
    for t in np.arange(0.0, 9.0, 0.1):
        simulator.AdvanceTo(t)
        for k, cylinder in enumerate((SLOW, STRAIGHT)):
            np.testing.assert_allclose(place(f"moving_{k}"), cylinder.motion(t)[0], atol=0.02)


def test_what_is_in_its_way_is_pushed_along() -> None:
    simulator, place = simulated(ball=1.0)
    simulator.AdvanceTo(2.9)
    np.testing.assert_allclose(place("ball"), [1.0, 0.0], atol=1e-3)
    simulator.AdvanceTo(7.9)
    # The cylinder is at y = 0.975 and not held up; the ball touches it or has run ahead.
    np.testing.assert_allclose(place("moving_1"), STRAIGHT.motion(7.9)[0], atol=0.02)
    assert place("ball")[1] >= place("moving_1")[1] + 0.15 + 0.1 - 0.002


def test_it_is_held_up_by_what_it_cannot_push_and_catches_up_later() -> None:
    # 50 N move 500 kg by 0.45 m in 3 s, and the cylinder comes to the ball after 3 s.
    simulator, place = simulated(ball=500.0)
    simulator.AdvanceTo(6.0)
    assert STRAIGHT.motion(6.0)[0][1] == pytest.approx(0.5)
    held = place("moving_1")[1]
    assert -0.2 < held < 0.25
    assert place("ball")[1] - held == pytest.approx(0.25, abs=0.005)  # it did not go into the ball
    simulator.AdvanceTo(14.5)  # on its way back
    np.testing.assert_allclose(place("moving_1"), STRAIGHT.motion(14.5)[0], atol=0.02)


def test_the_ports_say_the_same() -> None:
    motion = MovingObstacles(cylinders=[BENT, STRAIGHT])
    context = motion.CreateDefaultContext()
    context.SetTime(2.0)
    positions = motion.positions_output_port().Eval(context)
    desired = motion.desired_state_output_port().Eval(context)
    np.testing.assert_allclose(positions, [3.0, 1.0, 1.0, -0.5])
    np.testing.assert_allclose(desired[:4], positions - [0.0, 0.0, 1.0, -1.0])
    np.testing.assert_allclose(desired[4:], [0.0, 2.0, 0.0, 0.25])


POLITE = MovingCylinder(radius=0.1, path=[[0.0, 0.0], [2.0, 0.0]], speed=0.5, courtesy=0.3)


def places(cylinder: MovingCylinder, robot: Any, times: np.ndarray) -> np.ndarray:
    """x of a cylinder and its wanted speed at those times, with one robot at `robot(t)` (x, y)."""
    builder = DiagramBuilder()
    motion = builder.AddSystem(MovingObstacles(cylinders=[cylinder], robots=1))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = motion.GetMyContextFromRoot(simulator.get_mutable_context())
    found = []
    for t in times:
        motion.robots_input_port().FixValue(context, [*robot(t), 0.0])
        simulator.AdvanceTo(t)
        x = motion.positions_output_port().Eval(context)[0]
        found.append([x, motion.desired_state_output_port().Eval(context)[2]])
    return np.array(found)


def test_it_waits_for_a_robot_ahead_and_goes_on_when_it_has_gone() -> None:
    times = np.arange(0.02, 6.0, 0.02)
    x, v = places(POLITE, lambda t: (1.0, 0.1) if t < 3.0 else (1.0, 3.0), times).T
    # Where the robot's middle is 0.3 m from its surface.
    stop = 1.0 - np.sqrt(0.4**2 - 0.1**2)
    waiting = (times > stop / 0.5 + 0.05) & (times < 3.0)
    np.testing.assert_allclose(x[waiting], stop, atol=0.5 * 0.04)
    assert np.ptp(x[waiting]) == 0
    assert (v[waiting] == 0).all()
    after = (times > 3.05) & (times < 5.5)  # before it turns back
    np.testing.assert_allclose(x[after], x[waiting][0] + 0.5 * (times[after] - 3.0), atol=0.03)
    assert (np.abs(np.diff(x)) <= 0.5 * 0.02 + 1e-9).all()  # it never jumps


@pytest.mark.parametrize("robot", [(1.0, 0.41), (-0.15, 0.0)])
def test_it_does_not_wait_for_what_it_passes_or_leaves_behind(robot: tuple[float, float]) -> None:
    times = np.arange(0.02, 3.0, 0.02)
    x, _ = places(POLITE, lambda _: robot, times).T
    np.testing.assert_allclose(x, 0.5 * times, atol=1e-9)


def test_without_courtesy_it_looks_for_nobody() -> None:
    times = np.arange(0.02, 3.0, 0.02)
    x, _ = places(replace(POLITE, courtesy=0.0), lambda _: (1.0, 0.0), times).T
    np.testing.assert_allclose(x, 0.5 * times, atol=1e-9)
