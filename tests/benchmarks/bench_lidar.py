"""The lidar: how fast a turn is cast among many obstacles, and how near to Drake's renderer."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    ClippingRange,
    Cylinder,
    DepthRange,
    DepthRenderCamera,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from systems.raycasting import solids_from_inspector
from systems.sensors.lidar import Lidar, LidarParameters, turn_of
from systems.sensors.lidar_beams import cast_beams
from tests.benchmarks.table import Row, show

Array = NDArray[np.float64]

SIDE = 10.0  # of the arena, m
HEIGHT = 0.15  # of the scan plane, m
OBSTACLES = 100
# One pixel a ray in the middle of a picture of 90 degrees.
FAST, FINE = 115, 4000
TWIST = np.array([0.0, 0.0, 1.0, 0.3, 0.0, 0.0])
EXACT = LidarParameters(
    range_noise=0.0, range_noise_part=0.0, dropout_probability=0.0, mixed_share=0.0
)


def rows() -> Iterator[Row]:
    """Yields the measurements."""
    world = World()
    turn = turn_of(EXACT, end=1.0, frame_id="")
    solids = solids_from_inspector(world.inspector).pose(world.query)
    flat = np.column_stack([np.cos(turn.angles), np.sin(turn.angles), np.zeros(360)])
    origin = np.array([0.0, 0.0, HEIGHT])
    way = origin + np.linspace(-0.05, 0.0, 360)[:, None] * [1.0, 0.0, 0.0]

    def beams() -> None:
        cast_beams(turn, solids, RigidTransform(), X_PL, twist=TWIST, divergence=0.005)

    still, moving, all_beams, sample = interleaved(
        lambda: solids.first_hit(origin, flat, 12.0),
        lambda: solids.first_hit(way, flat, 12.0),
        beams,
        world.sample,
    )
    (depth,) = interleaved(lambda: world.depth_images(FAST), repeats=30)
    peers = f"four depth images of {FAST} px: {depth * 1e3:.2f} ms"
    what = f"360 rays, {len(solids)} solids"
    yield Row(f"{what}: cast at rest", f"{still * 1e3:.2f} ms", "<= 0.5 ms", still <= 5e-4, peers)
    yield Row(f"{what}: cast, moving", f"{moving * 1e3:.2f} ms", "<= 0.5 ms", moving <= 5e-4)
    yield Row(f"{what}: cast with both edges of the beams, moving", f"{all_beams * 1e3:.2f} ms")
    yield Row(f"{what}: whole scan of the block", f"{sample * 1e3:.2f} ms")

    ranges = solids.first_hit(origin, flat, 12.0)
    rendered = ranges_from_depth(world.depth_images(FINE), turn.angles)
    away = np.isfinite(rendered) & np.isfinite(ranges)
    worst = float(np.abs(ranges - rendered)[away].max())
    yield Row(
        f"against the depth images, largest difference of {away.sum()} rays away from edges",
        f"{1e3 * worst:.1f} mm", "<= 10 mm", worst <= 0.01,
    )  # fmt: skip


X_PL = RigidTransform([0.0, 0.0, HEIGHT])
R_FORWARD = RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))


class World:
    """An arena with boxes and cylinders, a lidar in its middle."""

    def __init__(self) -> None:
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
        engine = MakeRenderEngineVtk(RenderEngineVtkParams(backend="EGL"))
        scene_graph.AddRenderer("vtk", engine)
        grey, friction = np.array([0.6, 0.6, 0.6, 1.0]), CoulombFriction(1.0, 1.0)
        for k, (shape, pose) in enumerate(_things()):
            plant.RegisterVisualGeometry(plant.world_body(), pose, shape, f"{k}", grey)
            plant.RegisterCollisionGeometry(plant.world_body(), pose, shape, f"{k}", friction)
        plant.Finalize()
        self.lidar = builder.AddSystem(Lidar(parent_frame=scene_graph.world_frame_id(), X_PL=X_PL))
        builder.Connect(scene_graph.get_query_output_port(), self.lidar.query_object_input_port())
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        own = scene_graph.GetMyContextFromRoot(self._context)
        self.query = scene_graph.get_query_output_port().Eval(own)
        self.inspector = scene_graph.model_inspector()
        self._world = scene_graph.world_frame_id()
        self._own = self.lidar.GetMyMutableContextFromRoot(self._context)
        velocity = [0, 0, TWIST[2], TWIST[3], 0, 0]
        self.lidar.spatial_velocity_input_port().FixValue(self._own, velocity)

    def sample(self) -> Array:
        """Returns the ranges of one scan of the block."""
        return self.lidar._measure(self._own, 1.0, 0).ranges

    def depth_images(self, pixels: int) -> list[Array]:
        """Returns a row of depths (m) to the front, to the left, behind and to the right."""
        info = CameraInfo(pixels, 3, pixels / 2, pixels / 2, pixels / 2, 1.5)
        core = RenderCameraCore("vtk", info, ClippingRange(0.05, 30.0), RigidTransform())
        camera = DepthRenderCamera(core, DepthRange(0.1, 25.0))
        found = []
        for quarter in range(4):
            R = RotationMatrix.MakeZRotation(quarter * math.pi / 2) @ R_FORWARD
            X_WC = X_PL @ RigidTransform(R, np.zeros(3))
            found.append(self.query.RenderDepthImage(camera, self._world, X_WC).data[1, :, 0])
        return found


def _things() -> Iterator[tuple[Box | Cylinder, RigidTransform]]:
    rng = np.random.default_rng(0)
    yield Box(50.0, 50.0, 1.0), RigidTransform([0.0, 0.0, -0.5])
    for yaw in np.arange(4) * np.pi / 2:
        side = RigidTransform(RollPitchYaw(0, 0, yaw), np.zeros(3))
        yield Box(0.1, SIDE, 0.6), side @ RigidTransform([SIDE / 2, 0.0, 0.3])
    placed = 0
    while placed < OBSTACLES:
        x, y = rng.uniform(-SIDE / 2, SIDE / 2, 2)
        if math.hypot(x, y) < 0.6:
            continue
        shape = Box(*rng.uniform(0.1, 0.5, 2), 0.6) if placed % 2 else None
        pose = RigidTransform(RollPitchYaw(0, 0, rng.uniform(-3, 3)), [x, y, 0.3])
        yield shape or Cylinder(rng.uniform(0.05, 0.25), 0.6), pose
        placed += 1


def ranges_from_depth(rows: list[Array], angles: Array) -> Array:
    """Returns ranges (m) at angles (rad); NaN between pixels of different surfaces."""
    pixels = len(rows[0])
    ranges = np.full(len(angles), np.nan)
    for quarter, row in enumerate(rows):
        off = np.remainder(angles - quarter * math.pi / 2 + math.pi, 2 * math.pi) - math.pi
        mine = np.flatnonzero(np.abs(off) <= math.pi / 4)
        # Drake's pixels have their middles at halves. The inverse depth of a plane is linear.
        u = pixels / 2 * (1 - np.tan(off[mine])) - 0.5
        left = np.clip(np.floor(u).astype(int), 0, pixels - 2)
        a, b = 1 / row[left].astype(float), 1 / row[left + 1].astype(float)
        depth = 1 / (a + (u - left) * (b - a))
        depth[np.abs(1 / a - 1 / b) > 0.02] = np.nan
        ranges[mine] = depth / np.cos(off[mine])
    return ranges


def interleaved(*functions: Callable[[], object], repeats: int = 200) -> list[float]:
    """Returns the shortest time of each, s, tried in turn."""
    best = [np.inf] * len(functions)
    for _ in range(repeats):
        for k, function in enumerate(functions):
            started = time.perf_counter()
            function()
            best[k] = min(best[k], time.perf_counter() - started)
    return best


if __name__ == "__main__":
    show("Lidar", rows())
