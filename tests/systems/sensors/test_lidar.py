from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    ClippingRange,
    Cylinder,
    DepthRange,
    DepthRenderCamera,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from systems.angles import spatial_pose
from systems.messages import Scan
from systems.raycasting import Solids
from systems.scans import scan_points
from systems.sensors.lidar import (
    Lidar,
    LidarParameters,
    incidence_cosine,
    measured_ranges,
    turn_of,
)
from systems.sensors.lidar_beams import Beams, cast_beams, poses_before

EXACT = LidarParameters(
    range_noise=0.0, range_noise_part=0.0, dropout_probability=0.0, mixed_share=0.0
)
DIVERGENCE = EXACT.beam_divergence
DEGREE = math.radians(1.0)

# A room of 5 m by 4 m, its inner corner at the origin, of walls 0.1 m thick.
LENGTH, WIDTH = 5.0, 4.0
ROOM: list[tuple[Shape, RigidTransform]] = [
    (Box(0.1, 6, 1), RigidTransform([-0.05, 2, 0.5])),
    (Box(0.1, 6, 1), RigidTransform([LENGTH + 0.05, 2, 0.5])),
    (Box(7, 0.1, 1), RigidTransform([2.5, -0.05, 0.5])),
    (Box(7, 0.1, 1), RigidTransform([2.5, WIDTH + 0.05, 0.5])),
]
GROUND = (Box(50.0, 50.0, 1.0), RigidTransform([0.0, 0.0, -0.5]))


def room_range(x: float, y: float, angle: float) -> float:
    """How far it is from a place in the room to its walls, by hand."""
    c, s = math.cos(angle), math.sin(angle)
    along_x = ((LENGTH - x) / c if c > 0 else -x / c) if c else math.inf
    along_y = ((WIDTH - y) / s if s > 0 else -y / s) if s else math.inf
    return min(along_x, along_y)


def solids(*things: tuple[Shape, RigidTransform]) -> Solids:
    return Solids([shape for shape, _ in things], [pose for _, pose in things])


def cast(
    world: Solids,
    pose: Any,
    *,
    parameters: LidarParameters = EXACT,
    mount: RigidTransform | None = None,
    twist: Any = (0, 0, 0, 0, 0, 0),
) -> Beams:
    turn = turn_of(parameters, end=1.0, frame_id="lidar")
    return cast_beams(
        turn,
        world,
        spatial_pose(np.array(pose, float)),
        RigidTransform([0.0, 0.0, 0.2]) if mount is None else mount,
        twist=np.array(twist, float),
        divergence=parameters.beam_divergence,
    )


# --- Angles and times ---


def test_a_turn_starts_backward_and_goes_round_to_the_left() -> None:
    turn = turn_of(EXACT, end=2.0, frame_id="l")
    assert len(turn) == 360
    np.testing.assert_allclose(turn.angles, np.radians(np.arange(-180, 180)), atol=1e-6)
    assert turn.time_increment * 360 == pytest.approx(1 / 5.5, rel=1e-6)
    assert turn.stamp + 359 * turn.time_increment == pytest.approx(2.0, abs=1e-9)
    assert (turn.range_min, turn.range_max) == pytest.approx((0.15, 12.0), rel=1e-6)


def test_a_faster_turn_of_more_rays() -> None:
    turn = turn_of(LidarParameters(rate=10.0, rays=720), end=2.0, frame_id="l")
    assert len(turn) == 720
    assert turn.angle_increment == pytest.approx(DEGREE / 2, rel=1e-6)
    assert turn.stamp == pytest.approx(2.0 - 0.1 * 719 / 720, abs=1e-8)


# --- Known scenes ---


@pytest.mark.parametrize("x, y, yaw", [(1.3, 0.9, 0.0), (3.7, 2.2, 0.6), (0.5, 3.5, -2.0)])  # noqa: PT006
def test_a_known_room(x: float, y: float, yaw: float) -> None:
    mount = RigidTransform(RollPitchYaw(0.0, 0.0, 0.3), [0.1, -0.05, 0.2])
    beams = cast(solids(*ROOM, GROUND), (x, y, yaw), mount=mount)
    c, s = math.cos(yaw), math.sin(yaw)
    lidar = x + c * 0.1 + s * 0.05, y + s * 0.1 - c * 0.05
    angles = yaw + 0.3 + np.radians(np.arange(-180, 180))
    expected = [room_range(*lidar, angle) for angle in angles]
    np.testing.assert_allclose(beams.ranges[:, 1], expected, atol=2e-5)
    # The edges of the beams are half the divergence to the right and to the left.
    for edge, turn in ((0, -DIVERGENCE / 2), (2, DIVERGENCE / 2)):
        expected = [room_range(*lidar, angle + turn) for angle in angles]
        np.testing.assert_allclose(beams.ranges[:, edge], expected, atol=2e-5)


def test_a_cylinder_and_nothing_else() -> None:
    pole = (Cylinder(0.5, 1.0), RigidTransform([2.0, 0.0, 0.5]))
    ranges = cast(solids(pole, GROUND), (0, 0, 0)).ranges[:, 1]
    angles = np.radians(np.arange(-180, 180))
    # From the chord: 2 cos(a) - sqrt(0.25 - 4 sin(a)^2), seen within asin(1/4) = 14.5 degrees.
    seen = np.abs(angles) < math.asin(0.25)
    expected = 2 * np.cos(angles[seen]) - np.sqrt(0.25 - 4 * np.sin(angles[seen]) ** 2)
    np.testing.assert_allclose(ranges[seen], expected, atol=1e-6)
    assert seen.sum() == 29
    assert np.isinf(ranges[~seen]).all()


def test_a_low_step_is_overlooked_and_a_tilted_lidar_sees_the_floor() -> None:
    step = (Box(0.2, 2.0, 0.19), RigidTransform([1.0, 0.0, 0.095]))
    world = solids(step, GROUND)
    assert np.isinf(cast(world, (0, 0, 0)).ranges).all()
    # Nose down by 0.1 rad at 0.2 m: the floor ahead is 0.2 / sin(0.1) away; the step is met before.
    down = RigidTransform(RollPitchYaw(0.0, 0.1, 0.0), [0.0, 0.0, 0.2])
    ahead = cast(world, (0, 0, 0), mount=down).ranges[180, 1]
    assert ahead == pytest.approx(0.9 / math.cos(0.1), abs=1e-6)
    ahead = cast(solids(GROUND), (0, 0, 0), mount=down).ranges[180, 1]
    assert ahead == pytest.approx(0.2 / math.sin(0.1), abs=1e-6)


# --- Motion ---


def test_poses_before_are_those_of_many_small_steps() -> None:
    twist = np.array([0.3, -0.5, 1.2, 0.4, -0.2, 0.1])
    age, steps = 0.8, 20_000
    R, p = np.eye(3), np.zeros(3)
    small = RotationMatrix(RollPitchYaw(-twist[:3] * age / steps)).matrix()
    for _ in range(steps):
        p = p - R @ twist[3:] * age / steps
        R = R @ small
    found = poses_before(twist, np.array([0.0, age]))
    np.testing.assert_array_equal(found[0], np.eye(3, 4))
    np.testing.assert_allclose(found[1, :, :3], R, atol=1e-4)
    np.testing.assert_allclose(found[1, :, 3], p, atol=1e-4)


@pytest.mark.parametrize("omega", [0.0, 1e-13, 1e-7, 1e-3])
def test_poses_before_of_a_nearly_straight_way(omega: float) -> None:
    found = poses_before(np.array([0.0, 0.0, omega, 0.3, 0.0, 0.0]), np.array([0.2]))[0]
    # To second order: x = -v t, y = v omega t^2 / 2.
    np.testing.assert_allclose(found[:, 3], [-0.06, 0.3 * omega * 0.02, 0.0], atol=1e-9)
    assert found[1, 0] == pytest.approx(-0.2 * omega, abs=1e-10)


@pytest.mark.parametrize("v, omega", [(0.3, 0.0), (0.0, 2.0), (0.4, -1.5), (-0.3, 1.0)])  # noqa: PT006
def test_a_turn_on_the_move(v: float, omega: float) -> None:
    # The robot ends its arc at (2, 1.5) with heading 0.4, the lidar is 0.1 m before its middle.
    x, y, theta = 2.0, 1.5, 0.4
    mount = RigidTransform(RollPitchYaw(0, 0, 0.2), [0.1, 0.0, 0.2])
    beams = cast(solids(*ROOM), (x, y, theta), mount=mount, twist=(0, 0, omega, v, 0, 0))
    dt = 1 / (5.5 * 360)
    expected = []
    for i in range(360):
        age = (359 - i) * dt
        then = theta - omega * age
        if omega:
            px = x - v / omega * (math.sin(theta) - math.sin(then))
            py = y + v / omega * (math.cos(theta) - math.cos(then))
        else:
            px, py = x - v * age * math.cos(theta), y - v * age * math.sin(theta)
        lx, ly = px + 0.1 * math.cos(then), py + 0.1 * math.sin(then)
        expected.append(room_range(lx, ly, then + 0.2 + math.radians(i - 180)))
    np.testing.assert_allclose(beams.ranges[:, 1], expected, atol=3e-6)
    # The motion shows, and the twist straightens it: all points lie on the walls.
    at_rest = cast(solids(*ROOM), (x, y, theta), mount=mount).ranges[:, 1]
    assert np.abs(at_rest - expected).max() > 0.02
    scan = replace(turn_of(EXACT, end=1.0, frame_id=""), ranges=beams.ranges[:, 1])
    lidar_pose = np.array([0.1, 0.0, 0.2])
    straight = scan_points(scan, lidar_pose, twist=np.array([v, omega]))
    bent = scan_points(scan, lidar_pose)
    assert off_the_walls(straight, x, y, theta).max() < 1e-5
    assert off_the_walls(bent, x, y, theta).max() > 0.02


def off_the_walls(points: np.ndarray, x: float, y: float, theta: float) -> np.ndarray:
    """How far points in the body's frame are from the nearest wall of the room, m."""
    R = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
    px, py = R @ points.T + np.array([[x], [y]])
    assert len(points) == 360
    return np.abs([px, px - LENGTH, py, py - WIDTH]).min(axis=0)


# --- Limits, noise, failures ---


def measure(beams: Beams, seed: int = 0, **changes: Any) -> np.ndarray:
    random = np.random.default_rng(seed)
    return measured_ranges(beams, replace(EXACT, **changes), random)


def facing(distance: float, n: int = 360) -> Beams:
    """Beams that fall square on one surface."""
    return Beams(np.full((n, 3), distance), np.zeros((n, 3), np.intp))


def test_the_limits_of_range() -> None:
    assert np.isnan(measure(facing(0.149))).all()
    np.testing.assert_allclose(measure(facing(0.151)), 0.151, rtol=1e-7)
    np.testing.assert_allclose(measure(facing(11.99)), 11.99, rtol=1e-7)
    nothing = Beams(np.full((360, 3), math.inf), np.full((360, 3), -1))
    assert np.isinf(measure(nothing, dropout_probability=1.0, range_noise=1.0)).all()
    # Nothing is said beyond what it measures, noise or not.
    noisy = measure(facing(11.99), range_noise=0.1)
    assert np.isinf(noisy).any()
    assert noisy[np.isfinite(noisy)].max() <= 12.0


@pytest.mark.parametrize("distance, expected", [(0.3, 0.00112), (3.0, 0.00991), (10.0, 0.0330)])  # noqa: PT006
def test_the_noise_has_a_constant_part_and_one_that_grows(distance: float, expected: float) -> None:
    # sqrt(0.0005^2 + (0.0033 d)^2), of 40000 rays: known to 0.35 %.
    noise = LidarParameters()
    error = (
        measure(
            facing(distance, 40_000),
            range_noise=noise.range_noise,
            range_noise_part=noise.range_noise_part,
        )
        - distance
    )
    assert error.std() == pytest.approx(expected, rel=0.015)
    assert abs(error.mean()) < 4 * expected / 200
    # The datasheet's resolution, 1 % of the distance, is kept by nearly all rays.
    assert distance < 1 or (np.abs(error) < 0.01 * distance).mean() > 0.995


def test_the_rate_of_dropouts() -> None:
    ranges = measure(facing(2.0, 40_000), dropout_probability=0.03)
    assert np.isnan(ranges).mean() == pytest.approx(0.03, abs=0.003)
    assert np.isnan(measure(facing(2.0), dropout_probability=1.0)).all()
    assert np.isfinite(measure(facing(2.0), dropout_probability=0.0)).all()


@pytest.mark.parametrize("yaw", [0.0, 0.2])
def test_incidence_is_found_on_a_plane(yaw: float) -> None:
    wall = (Box(0.1, 100.0, 1.0), RigidTransform([2.05, 0.0, 0.5]))
    beams = cast(solids(wall), (0, 0, yaw))
    cosine = incidence_cosine(beams.ranges, DIVERGENCE)
    angles = yaw + np.radians(np.arange(-180, 180))
    hit = np.isfinite(beams.ranges).all(axis=1)
    assert hit.sum() > 150
    np.testing.assert_allclose(cosine[hit], np.cos(angles[hit]), atol=1e-5)
    assert np.isnan(cosine[~hit]).all()


@pytest.mark.parametrize("reflectivity", [1.0, 0.25, 0.04])
def test_grazing_and_dark_surfaces_send_too_little_light_back(reflectivity: float) -> None:
    # A long wall 2 m ahead: d = 2 / cos(a) comes back while d^2 <= 144 rho cos(a).
    wall = (Box(0.1, 100.0, 1.0), RigidTransform([2.05, 0.0, 0.5]))
    beams = cast(solids(wall), (0, 0, 0))
    ranges = measure(beams, reflectivity=reflectivity)
    angles = np.radians(np.arange(-180, 180))
    limit = math.acos((4 / (144 * reflectivity)) ** (1 / 3))
    met = np.isfinite(beams.ranges[:, 1])
    seen = np.abs(angles) < limit
    np.testing.assert_array_equal(np.isfinite(ranges), seen)
    assert np.isnan(ranges[met & ~seen]).all()
    assert (met & ~seen).sum() > 0
    assert np.isinf(ranges[~met]).all()


POST = (Box(0.4, 0.4, 1.0), RigidTransform([2.0, 0.0, 0.5]))
WALL = (Box(0.1, 20.0, 1.0), RigidTransform([4.05, 0.0, 0.5]))
# Its face is from y = -0.2 to 0.2 at x = 1.8: a beam of a degree covers the edge at 6.34 degrees.
WIDE = replace(EXACT, beam_divergence=DEGREE, mixed_share=1.0)


def test_points_are_mixed_over_edges_only() -> None:
    beams = cast(solids(POST, WALL), (0, 0, 0), parameters=WIDE)
    edges = np.degrees(math.atan2(0.2, 1.8)) * np.array([-1, 1])
    angles = np.arange(-180, 180)
    over = np.abs(angles[:, None] - edges).min(axis=1) < 0.5
    assert over.sum() == 2
    middle = beams.ranges[:, 1]
    seen: list[np.ndarray] = []
    for seed in range(300):
        ranges = measured_ranges(beams, WIDE, np.random.default_rng(seed))
        same = np.isclose(ranges, middle, rtol=1e-6) | np.isnan(ranges) | np.isinf(middle)
        assert not (same[over]).all()
        assert same[~over].all()
        seen.append(ranges[over])
    between = np.array(seen)
    near, far = 1.8 / np.cos(np.radians(6.84)), 4.0 / np.cos(np.radians(6.84))
    assert (between > 1.8).all()
    assert (between < far).all()
    # Evenly in the inverse range: mean and variance of a uniform number.
    low, high = 1 / far, 1 / near
    assert np.mean(1 / between) == pytest.approx((low + high) / 2, rel=0.03)
    assert np.std(1 / between) == pytest.approx((high - low) / math.sqrt(12), rel=0.1)


def test_a_share_of_the_beams_over_an_edge_is_mixed() -> None:
    beams = cast(solids(POST, WALL), (0, 0, 0), parameters=WIDE)
    many = Beams(np.repeat(beams.ranges, 200, axis=0), np.repeat(beams.solids, 200, axis=0))

    def mixed(share: float) -> int:
        parameters = replace(WIDE, mixed_share=share)
        ranges = measured_ranges(many, parameters, np.random.default_rng(1))
        at_its_middle = np.isclose(ranges, many.ranges[:, 1], rtol=1e-6)
        return int((np.isfinite(ranges) & ~at_its_middle).sum())

    assert mixed(0.0) == 0
    assert mixed(0.3) == pytest.approx(0.3 * 400, abs=30)
    assert mixed(1.0) == pytest.approx(400, abs=4)


def test_before_nothing_an_edge_is_sharp() -> None:
    beams = cast(solids(POST), (0, 0, 0), parameters=WIDE)
    ranges = measured_ranges(beams, WIDE, np.random.default_rng(1))
    seen = np.abs(np.arange(-180, 180)) <= 6
    np.testing.assert_array_equal(np.isfinite(ranges), seen)


def test_one_parameter_changes_only_what_it_is_about() -> None:
    beams = cast(solids(*ROOM), (2.0, 1.0, 0.3))
    noisy = measure(beams, range_noise=0.01)
    holed = measure(beams, range_noise=0.01, dropout_probability=0.3)
    left = np.isfinite(holed)
    assert 200 < left.sum() < 300
    np.testing.assert_array_equal(holed[left], noisy[left])


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"rate": 5.4}, "rate"),
        ({"rate": 10.1}, "rate"),
        ({"rate": math.nan}, "rate"),
        ({"rays": 3}, "rays"),
        ({"rays": 801, "rate": 10.0}, "rays"),
        ({"range_min": 0.0}, "range_min"),
        ({"range_min": 12.0}, "range_min"),
        ({"range_max": math.inf}, "range_max"),
        ({"range_noise": -1e-3}, "range_noise"),
        ({"range_noise_part": math.nan}, "range_noise_part"),
        ({"dropout_probability": 1.1}, "dropout_probability"),
        ({"mixed_share": -0.1}, "mixed_share"),
        ({"reflectivity": 0.0}, "reflectivity"),
        ({"reflectivity": 1.2}, "reflectivity"),
        ({"beam_divergence": 0.0}, "beam_divergence"),
        ({"beam_divergence": 0.02}, "beam_divergence"),
    ],
)
def test_wrong_parameters_are_refused(changes: dict[str, Any], field: str) -> None:
    with pytest.raises(ValueError, match=rf"^{field} is .*: must be "):
        LidarParameters(**changes)


# --- The block ---

X_WP = RigidTransform(RollPitchYaw(0.0, 0.0, 0.5), [1.5, 1.2, 0.0])
X_PL = RigidTransform(RollPitchYaw(0.0, 0.0, -0.3), [0.05, 0.02, 0.25])


@dataclass
class Scene:
    """A lidar on a body in a world, its velocity fixed at will."""

    diagram: Diagram
    lidar: Lidar
    context: Context
    simulator: Simulator
    query: Any

    def at(self, t: float) -> Scan:
        self.simulator.AdvanceTo(t)
        own = self.lidar.GetMyContextFromRoot(self.context)
        return self.lidar.scan_output_port().Eval(own)


def build(
    *things: tuple[Shape, RigidTransform],
    velocity: Any = (0, 0, 0, 0, 0, 0),
    furnish: Callable[[Any], None] = lambda plant: None,  # noqa: ARG005
    transparent: bool = True,
    renderer: bool = False,
    **arguments: Any,
) -> Scene:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.1)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
    body = plant.AddRigidBody("body", SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.1, 0.1))
    plant.SetDefaultFloatingBaseBodyPose(body, X_WP)
    friction = CoulombFriction(1.0, 1.0)
    # The mast stands beside the lidar, in the scan plane.
    mast = RigidTransform([-0.1, 0.0, 0.2])
    plant.RegisterCollisionGeometry(body, mast, Cylinder(0.02, 0.4), "mast", friction)
    plant.RegisterCollisionGeometry(body, RigidTransform(), Sphere(0.1), "body", friction)
    for k, (shape, pose) in enumerate(things):
        plant.RegisterCollisionGeometry(plant.world_body(), pose, shape, f"{k}", friction)
        if renderer:
            grey = np.array([0.5, 0.5, 0.5, 1.0])
            plant.RegisterVisualGeometry(plant.world_body(), pose, shape, f"{k}", grey)
    furnish(plant)
    plant.Finalize()
    frame = plant.GetBodyFrameIdOrThrow(body.index())
    if renderer:
        engine = MakeRenderEngineVtk(RenderEngineVtkParams(backend="EGL"))
        scene_graph.AddRenderer("vtk", engine)
    lidar = builder.AddSystem(
        Lidar(
            **{
                "parent_frame": frame,
                "X_PL": X_PL,
                "parameters": EXACT,
                "transparent_frames": [frame] if transparent else [],
            }
            | arguments
        )
    )
    builder.Connect(scene_graph.get_query_output_port(), lidar.query_object_input_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    own = lidar.GetMyMutableContextFromRoot(context)
    lidar.spatial_velocity_input_port().FixValue(own, np.array(velocity, float))
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    return Scene(diagram, lidar, context, simulator, query)


PERIOD = 1 / 5.5


def test_a_scan_arrives_when_its_turn_is_done_and_the_latency_over() -> None:
    scene = build(*ROOM, latency=0.03, frame_id="robot/lidar")
    for t in (0.0, 0.05, PERIOD + 0.029):
        before = scene.at(t)
        assert math.isnan(before.stamp)
        assert len(before) == 0
        assert before.frame_id == "robot/lidar"
    first = scene.at(PERIOD + 0.031)
    # The first ray of the first turn was a step after the start.
    assert first.stamp == pytest.approx(PERIOD / 360, abs=1e-8)
    assert first.stamp == round(first.stamp * 1e9) / 1e9
    assert first.frame_id == "robot/lidar"
    assert scene.at(2 * PERIOD + 0.029) is first
    second = scene.at(2 * PERIOD + 0.031)
    assert second.stamp - first.stamp == pytest.approx(PERIOD, abs=2e-9)
    # Turns follow each other without a gap.
    assert second.stamp - (first.stamp + 359 * first.time_increment) == pytest.approx(
        first.time_increment, abs=2e-8
    )


def test_the_block_scans_the_known_room_through_its_own_robot() -> None:
    scan = build(*ROOM, GROUND).at(0.2)
    X_WL = X_WP @ X_PL
    x, y, _ = X_WL.translation()
    expected = [room_range(x, y, 0.2 + math.radians(i - 180)) for i in range(360)]
    np.testing.assert_allclose(scan.ranges, expected, atol=3e-6)
    # Not so when the robot is no glass: the mast, 0.15 m behind, hides the wall (too near: NaN).
    opaque = build(*ROOM, GROUND, transparent=False).at(0.2)
    hidden = ~np.isclose(opaque.ranges, expected, atol=3e-6)
    assert 10 < hidden.sum() < 25
    assert not (opaque.ranges[hidden] > 0.2).any()


def test_it_sees_what_robots_bump_into_not_what_is_drawn() -> None:
    def curtain(plant: Any) -> None:
        X = RigidTransform([3.0, 2.0, 0.5])
        colour = np.array([1.0, 0.0, 0.0, 1.0])
        plant.RegisterVisualGeometry(plant.world_body(), X, Box(0.1, 3, 1), "curtain", colour)

    with_curtain = build(*ROOM, furnish=curtain).at(0.2)
    np.testing.assert_array_equal(with_curtain.ranges, build(*ROOM).at(0.2).ranges)


@pytest.mark.parametrize("v, omega", [(0.3, 0.8), (-0.2, -1.5)])  # noqa: PT006
def test_the_block_takes_the_bodys_velocity_in_the_world(v: float, omega: float) -> None:
    heading = 0.5  # of X_WP
    velocity = [0, 0, omega, v * math.cos(heading), v * math.sin(heading), 0]
    scan = build(*ROOM, velocity=velocity).at(0.2)
    points = scan_points(scan, np.array([0.05, 0.02, -0.3]), twist=np.array([v, omega]))
    assert off_the_walls(points, 1.5, 1.2, 0.5).max() < 1e-5
    bent = scan_points(scan, np.array([0.05, 0.02, -0.3]))
    assert off_the_walls(bent, 1.5, 1.2, 0.5).max() > 0.02


def test_noise_is_of_the_sample_and_of_the_seed() -> None:
    def scans(**arguments: Any) -> list[np.ndarray]:
        scene = build(*ROOM, parameters=LidarParameters(), **arguments)
        return [scene.at(t).ranges for t in (0.2, 0.4)]

    first, second = scans(seed=1)
    again = scans(seed=1)
    np.testing.assert_array_equal(again[0], first)
    np.testing.assert_array_equal(again[1], second)
    for other in (second, scans(seed=2)[0], scans(seed=1, name="rear")[0]):
        assert (other != first).mean() > 0.9


def test_it_says_nothing_finer_than_a_recording_keeps() -> None:
    scan = build(*ROOM, parameters=LidarParameters()).at(0.2)
    numbers = [scan.angle_min, scan.angle_increment, scan.time_increment, scan.range_max]
    for value in (scan.ranges, np.array([*numbers, scan.range_min])):
        np.testing.assert_array_equal(value.astype(np.float32).astype(float), value)


@pytest.mark.parametrize(("field", "value"), [("latency", -1.0), ("seed", -1)])
def test_nonsense_is_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"{field} is .*: must be "):
        build(*ROOM, **{field: value})


# --- Against Drake's renderer ---

PIXELS = 2000
INTRINSICS = CameraInfo(PIXELS, 5, PIXELS / 2, PIXELS / 2, PIXELS / 2, 2.5)


def depth_scan(scene: Scene, X_WL: RigidTransform, angles: np.ndarray) -> np.ndarray:
    """Ranges at those angles by four depth images of 90 degrees; NaN at edges.

    The inverse depth of a plane is linear in the pixel, so it is interpolated between the two
    pixels about the ray: exactly, unless an edge lies between them.
    """
    core = RenderCameraCore("vtk", INTRINSICS, ClippingRange(0.05, 50.0), RigidTransform())
    camera = DepthRenderCamera(core, DepthRange(0.1, 40.0))
    world = scene.query.inspector().world_frame_id()
    optical = RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
    ranges = np.full(len(angles), np.nan)
    for quarter in range(4):
        yaw = quarter * math.pi / 2
        R_LC = RotationMatrix.MakeZRotation(yaw) @ optical
        image = scene.query.RenderDepthImage(
            camera, world, X_WL @ RigidTransform(R_LC, np.zeros(3))
        )
        inverse = 1 / image.data[2, :, 0].astype(float)
        to_left = np.remainder(angles - yaw + math.pi, 2 * math.pi) - math.pi
        mine = np.flatnonzero(np.abs(to_left) <= math.pi / 4)
        # By Drake's intrinsics the middle of pixel i is at i + 0.5.
        u = PIXELS / 2 * (1 - np.tan(to_left[mine])) - 0.5
        first = np.clip(np.floor(u).astype(int), 0, PIXELS - 2)
        a, b = inverse[first], inverse[first + 1]
        Z = 1 / (a + (u - first) * (b - a))
        Z[np.abs(1 / a - 1 / b) > 0.02] = np.nan
        ranges[mine] = Z / np.cos(to_left[mine])
    return ranges


def crowd(n: int, seed: int) -> list[tuple[Shape, RigidTransform]]:
    """Boxes and cylinders in the room, none within 0.5 m of the lidar."""
    rng = np.random.default_rng(seed)
    found: list[tuple[Shape, RigidTransform]] = []
    while len(found) < n:
        x, y = rng.uniform(0.2, 4.8), rng.uniform(0.2, 3.8)
        if math.hypot(x - 1.5, y - 1.2) > 0.5:
            box = Box(*rng.uniform(0.02, 0.2, 2), 1.0)
            shape = Cylinder(rng.uniform(0.02, 0.1), 1.0) if len(found) % 2 else box
            turn = RollPitchYaw(0.0, 0.0, rng.uniform(-3, 3))
            found.append((shape, RigidTransform(turn, [x, y, 0.5])))
    return found


@pytest.mark.parametrize("n", [0, 12, 100])
def test_the_scan_agrees_with_drakes_depth_images(n: int) -> None:
    scene = build(*ROOM, *crowd(n, seed=n), GROUND, renderer=True)
    scan = scene.at(0.2)
    rendered = depth_scan(scene, X_WP @ X_PL, scan.angles)
    away_from_edges = np.isfinite(rendered)
    assert away_from_edges.mean() > 0.85
    difference = np.abs(scan.ranges - rendered)[away_from_edges]
    assert difference.max() < 0.01
    assert np.median(difference) < 0.001
