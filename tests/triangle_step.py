"""One step of a formation driven by a block: the true robot, and markers projected for it.

The beacons carry markers on four sides; what is found is `systems.markers.projector`'s to say. The
robot is kinematic, with wheels that err by a scale.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator

from systems.angles import spatial_pose
from systems.cameras import PinholeCamera
from systems.controllers.formation_step import FormationStep
from systems.controllers.step_task import Status, StepTask
from systems.formation.bearing_filter import moved
from systems.formation.triangles import arrival_heading, components, next_vertex
from systems.markers.family import family
from systems.markers.projector import ProjectorParameters, project_markers
from systems.messages import Detections, whole_nanoseconds

Array = NDArray[np.float64]
Tamper = Callable[[float, bool, Detections], Detections]

CAMERA = PinholeCamera.from_focal_length(640, 480, 485.0)
TAG = family("tag36h11")
# The paper's start ([FORM] 5), robots 0 to 3.
STARTS = np.array([[0.75, 0.0, 0.0], [0.0, 1.30, 0.0], [2.25, 0.0, 0.0], [1.5, 1.30, 0.0]])
_HEIGHT = 0.2
# Optical frame in the robot's: z along +x, or along -x.
_FRONT = RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
_REAR = RotationMatrix(np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]]))


@dataclass
class World:
    """Where everything is, and how well it is seen.

    Attributes:
        mover: number of the robot that moves; the others stand.
        order: numbers of beacons 1, 2, 3.
        points: (n, 2) centre points of a way that is longer than entry and exit, m.
        poses: (N, 3) true poses at the start.
        marker_size: m.
        corner_noise: px.
        centre_bias: px, of both cameras.
        latency: s.
        wheel_scale: of distance and of angle.
        dead: from when to when the motors stand still, s.
        tamper: changes the detections of a picture: time, whether from the rear camera, detections.
    """

    mover: int = 1
    order: tuple[int, int, int] = (2, 3, 0)
    points: Array = field(default_factory=lambda: np.zeros((0, 2)))
    poses: Array = field(default_factory=STARTS.copy)
    marker_size: float = 0.10
    corner_noise: float = 0.5
    centre_bias: float = 0.0
    latency: float = 0.2
    wheel_scale: tuple[float, float] = (1.0, 1.0)
    dead: tuple[float, float] = (0.0, 0.0)
    tamper: Tamper = lambda _, __, detections: detections

    def task(self, number: int = 1) -> StepTask:
        """Returns the step from here to the next vertex, all that is believed being true."""
        poses = self.poses[list(self.order)]
        target = next_vertex(poses[:, :2])
        beacons, start = np.array(self.order), self.poses[self.mover, :2]
        others = np.setdiff1d(np.arange(len(self.poses)), [self.mover, *self.order])
        return StepTask(
            number, beacons, poses, target, start, self.points, others, self.poses[others]
        )

    def mirrored(self) -> World:
        """Returns the same world seen in a mirror along the x axis."""
        mirrored = World(**vars(self))
        mirrored.poses = self.poses * [1.0, -1.0, -1.0]
        mirrored.points = self.points * [1.0, -1.0]
        return mirrored


@dataclass
class Run:
    """How a step went.

    Attributes:
        seconds: that it took.
        statuses: in the order in which they first came.
        since: when they first came, s.
        along: longitudinal error at the end, m.
        aside: lateral error, m.
        health: counts.
        path: (n, 3) true poses.
    """

    seconds: float
    statuses: list[Status]
    since: dict[Status, float]
    along: float
    aside: float
    health: dict[str, int]
    path: Array


def picture(world: World, pose: Array, rear: bool, t: float, index: int, seed: int) -> Detections:
    """Returns what a camera of the moving robot finds of the others' markers."""
    ids, frames = [], []
    for robot in range(len(world.poses)):
        if robot == world.mover:
            continue
        for side in range(4):
            turn = RigidTransform(RotationMatrix.MakeZRotation(side * math.pi / 2), np.zeros(3))
            out = RigidTransform([0.15, 0.0, 0.0])
            ids.append(4 * robot + side)
            frames.append((spatial_pose(world.poses[robot], _HEIGHT) @ turn @ out).GetAsMatrix34())
    R = _REAR if rear else _FRONT
    found, corners = project_markers(
        camera=CAMERA,
        X_WC=spatial_pose(pose, _HEIGHT) @ RigidTransform(R, np.zeros(3)),
        X_WM=np.array(frames),
        sizes=np.full(len(ids), world.marker_size),
        cells=TAG.cells,
        parameters=ProjectorParameters(pixel_noise=world.corner_noise, max_incidence=1.3),
        random=np.random.default_rng([seed, index, int(rear)]),
    )
    corners = corners + np.array([world.centre_bias, 0.0])
    return Detections(
        stamp=t,
        family=TAG.name,
        ids=np.array(ids)[found],
        corners=corners,
        hamming=np.zeros(len(found), np.int64),
        decision_margin=np.full(len(found), np.nan),
    )


def run_step(
    system: FormationStep, world: World, *, limit: float = 150.0, seed: int = 0, task: Any = None
) -> Run:
    """Drives a step to its end, or for `limit` seconds, at 20 Hz with pictures at 20 Hz."""
    task = task or world.task()
    dt, delay = 0.05, round(world.latency / 0.05)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    ports = (system.front_detections_input_port(), system.rear_detections_input_port())
    system.task_input_port().FixValue(context, AbstractValue.Make(task))
    pose, path, under_way = world.poses[world.mover].copy(), [], []
    since: dict[Status, float] = {}
    for step in range(round(limit / dt)):
        t = whole_nanoseconds(step * dt)
        under_way.append(
            [
                world.tamper(t, rear, picture(world, pose, rear, t, step, seed))
                for rear in (False, True)
            ]
        )
        late = under_way.pop(0) if len(under_way) > delay else (Detections(), Detections())
        for port, detections in zip(ports, late, strict=True):
            port.FixValue(context, detections)
        # The controller's update at t is done at the beginning of this step.
        simulator.AdvanceTo(t + dt / 2)
        command = system.command_output_port().Eval(context)
        status = Status(int(system.status_output_port().Eval(context)[1]))
        since.setdefault(status, t)
        path.append(pose)
        if status == Status.DONE:
            break
        dead = world.dead[0] <= t < world.dead[1]
        pose = moved(pose, command * world.wheel_scale * dt * (not dead))
    heading = arrival_heading(task.target, task.poses[2, :2])
    along, aside = components(pose[:2] - task.target, heading)
    health = dict(system.health_output_port().Eval(context).counts)
    return Run(t, list(since), since, float(along), float(aside), health, np.array(path))
