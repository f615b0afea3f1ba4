"""Every block of the house, held to what its docstring says of it.

A new block needs an entry in `CASES`: a function that builds it and gives each input port a value,
and another value that makes a difference.
"""

from __future__ import annotations

import copy
import dataclasses
import importlib
import inspect
import pkgutil
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.geometry import (
    FramePoseVector,
    MakeRenderEngineVtk,
    Meshcat,
    MeshcatParams,
    QueryObject,
    RenderEngineVtkParams,
    Role,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, ExternallyAppliedSpatialForce
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    LeafSystem,
    PortDataType,
)
from ruamel.yaml import YAML

import diagrams
import plants
import systems
from diagrams.drivers.body import DifferentialDriveBody
from diagrams.formation_viewer import FormationViewer
from diagrams.frames_viewer import FramesViewer
from diagrams.shell_viewer import ShellViewer
from diagrams.surroundings_viewer import SurroundingsViewer
from diagrams.viewer import EstimateViewer
from plants.boards import add_board
from plants.body_state import BodyState, TwinPositions, TwinState
from plants.clearance import ClearanceMonitor
from plants.differential_drive import (
    DifferentialDriveParameters,
    KinematicDifferentialDrive,
    add_differential_drive,
    wheel_speeds,
)
from plants.magnets import MagneticAdhesion
from plants.motors import DcMotors, MotorModel, MotorParameters
from plants.moving import MovingCylinder, MovingObstacles
from plants.planar_shapes import PlanarShapes
from plants.relative_pose import FramePose, RelativePose
from plants.rocking import RockingBody
from plants.rocking_motion import RockingParameters
from plants.shell import ShellMotion, ShellParameters, add_shell
from plants.shell_rover import ShellRover
from plants.snailbot import SnailBotParameters, add_snailbot, stance
from systems.angles import spatial_pose
from systems.avoiders.dwa import DwaAvoider
from systems.avoiders.sector import SectorAvoider
from systems.avoiders.vfh_plus import VfhPlus
from systems.cameras import PinholeCamera
from systems.controllers.collision_monitor import CollisionMonitor
from systems.controllers.formation_cameras import FormationCameras
from systems.controllers.kanayama import Kanayama
from systems.controllers.mpc import Mpc
from systems.controllers.path_tracking import TrackingState
from systems.controllers.pure_pursuit import PurePursuit
from systems.controllers.replay_supervisor import ReplaySupervisor
from systems.controllers.scripted_driver import ScriptedDriver
from systems.controllers.search import SearchWhenLost
from systems.controllers.shell_route import Leg, ShellRoute
from systems.controllers.step_task import StepTask
from systems.controllers.triangle_algorithm1 import TriangleAlgorithm1
from systems.controllers.triangle_resection import TriangleResection
from systems.controllers.tvlqr import Tvlqr
from systems.controllers.unicycle import Unicycle
from systems.controllers.waypoints import WaypointController
from systems.controllers.wheel_drive import WheelDrive
from systems.controllers.wheel_pwm import WheelPwm
from systems.estimators.formation_filter import FormationFilter
from systems.estimators.gyro_yaw import GyroYaw
from systems.estimators.madgwick import Madgwick
from systems.estimators.planar_ekf import PlanarEkf
from systems.estimators.planar_kalman import PlanarKalmanFilter
from systems.estimators.pose_chain import PoseChain
from systems.estimators.reference_motion import CarriedShellMotion, KnownShellMotion
from systems.estimators.shell_ekf import ShellEkf
from systems.estimators.shell_rule import ShellRule
from systems.estimators.wheel_odometry import WheelOdometry
from systems.estimators.wheel_speeds import WheelSpeeds
from systems.flow.lucas_kanade import PointTracker
from systems.flow.mean_flow import MeanFlow
from systems.flow.projector import FlowProjector
from systems.flow.shell import ShellView
from systems.flow.sphere_flow import SphereFlow, SphereFlowEstimator
from systems.formation.building import Algorithm1Parameters
from systems.image_effects import ImageEffects
from systems.io.bag import BagWriter
from systems.io.meshcat_driver import MeshcatDriver
from systems.io.playback import Entry, MessagePlayback, VectorPlayback
from systems.io.recorder import Channel, Recorder
from systems.mapping.tag_frames import TagFrame, TagFrames, observe
from systems.markers.detector import Detector, MarkerDetector
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap
from systems.markers.localizer import Localizer, LocalizerParameters, MapLocalizer
from systems.markers.markers_seen import MarkersSeen
from systems.markers.projector import MarkerProjector, placed_markers
from systems.messages import (
    AvoiderState,
    CameraImage,
    Detections,
    Health,
    Message,
    OccupancyGrid,
    PointMatches,
    PoseEstimate,
    RotationIncrement,
    Scan,
)
from systems.messages import (
    Path as PlannedPath,
)
from systems.planners.astar import AStarPlanner
from systems.planners.failure import Failure
from systems.planners.formation_course import FormationMove
from systems.planners.formation_lattice import strip
from systems.planners.formation_obstacles import Obstacles
from systems.planners.formation_planner import FormationPlanner
from systems.planners.formation_turns import FormationTurns
from systems.planners.occupancy import OccupancyMapper
from systems.planners.progress import ProgressMonitor
from systems.planners.route import Route
from systems.planners.route_clearance import RouteClearance
from systems.planners.sonar_obstacles import SonarObstacles
from systems.planners.waypoint_sequencer import WaypointSequencer
from systems.pose_vector import PoseFromVector, PoseToVector
from systems.sensors.drawn_camera import DrawnCamera
from systems.sensors.faults import Fault, FaultInjector
from systems.sensors.imu import Imu
from systems.sensors.imu_parameters import ImuParameters
from systems.sensors.lidar import Lidar, LidarParameters
from systems.sensors.missed_passages import MissedPassages
from systems.sensors.pose_outliers import PoseOutliers
from systems.sensors.rendered_camera import RenderedCamera
from systems.sensors.ultrasonic import UltrasonicParameters, UltrasonicRing
from systems.sensors.wheel_encoders import WheelEncoders
from systems.shell.marker_pose import ShellMarkerPose, shell_localizer

# --- One of each, with inputs ---


@dataclass
class Case:
    """A block and what its inputs are fixed to: by port, a value and another one."""

    system: LeafSystem
    inputs: dict[str, tuple[Any, Any]] = field(default_factory=dict)
    close: Callable[[], Any] = lambda: None
    nan_outputs: tuple[str, ...] = ()  # which may hold NaN while there is nothing to say


TAG = family("DICT_4X4_50")
CAMERA = PinholeCamera.from_focal_length(160, 120, 140.0)
VIEW = ShellView(camera=CAMERA)  # over a shell, in no relation to the world
# A camera in the world's origin that looks along x, and a marker 0.6 m before it.
X_WC = RigidTransform(RollPitchYaw(-np.pi / 2, 0.0, -np.pi / 2), np.zeros(3))
MAP = MarkerMap(TAG, 0.2, {7: Marker(7, spatial_pose(np.array([0.6, 0.0, np.pi - 0.5])), 0.2)})
CORNERS = CAMERA.project(X_WC.inverse().multiply(MAP.corners(np.array([7]))[0].T).T)


def scene(y: float) -> QueryObject:
    """What SceneGraph says of the marker, moved aside by y."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    X_WM = RigidTransform([0.0, y, 0.0]) @ MAP.markers[7].X_WM
    add_board(plant, plant.world_body(), X_WM, family=TAG, marker_id=7, size=0.2)
    plant.Finalize()
    parameters = RenderEngineVtkParams(backend="EGL")
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(parameters))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    SCENES.append((diagram, context))  # the query object looks into them
    return scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))


def relative_pose(_: Path) -> Case:
    """A free body as the world sees it, in two places."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    body = plant.AddRigidBody("body", SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.1, 0.1))
    plant.Finalize()
    diagram = builder.Build()
    queries = []
    for X_WB in POSES:
        context = diagram.CreateDefaultContext()
        plant.SetFreeBodyPose(plant.GetMyMutableContextFromRoot(context), body, X_WB)
        SCENES.append((diagram, context))
        own = scene_graph.GetMyContextFromRoot(context)
        queries.append(scene_graph.get_query_output_port().Eval(own))
    child = plant.GetBodyFrameIdOrThrow(body.index())
    system = RelativePose(parent=scene_graph.world_frame_id(), child=child)
    return Case(system, {"query_object": (queries[0], queries[1])})


SCENES: list[Any] = []
WORLD = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.01)[1].world_frame_id()


def detections(stamp: float, shift: float = 0.0) -> Detections:
    return Detections(
        stamp=stamp,
        family=TAG.name,
        ids=np.array([7]),
        corners=CORNERS[None] + shift,
        hamming=np.array([0]),
        decision_margin=np.array([50.0]),
    )


def image(stamp: float) -> CameraImage:
    cells = np.kron(TAG.cell_image(7, margin=2), np.ones((12, 12), np.uint8))
    return CameraImage(stamp=stamp, data=cells)


def marker_pose(x: float) -> PoseEstimate:
    pose = RigidTransform([x, 0.0, 0.0])
    return PoseEstimate(stamp=x, pose=pose, covariance=np.eye(6) * 1e-4, markers=1)


def twin_positions(_: Path) -> Case:
    plant = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.01)[0]
    for name in ("blue", "red"):
        add_differential_drive(plant, DifferentialDriveParameters(), name)
    plant.Finalize()
    poses = (np.array([1.0, 2.0, 0.3]), np.array([1.0, 2.0, 0.4]))
    system = TwinPositions(plant=plant, models=["blue", "red"])
    return Case(system, {"blue": poses, "red": poses})


def magnetic_adhesion(_: Path) -> Case:
    plant = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.01)[0]
    shell = add_shell(plant, ShellParameters(), "shell")
    model = add_snailbot(plant, SnailBotParameters(), ShellParameters(), "robot")
    plant.Finalize()
    context = plant.CreateDefaultContext()
    X_RB = stance(np.zeros(3), SnailBotParameters(), ShellParameters())
    states = []
    for height in (0.0, 0.02):  # on the shell, off it
        X_WB = X_RB @ RigidTransform([0.0, 0.0, height])
        plant.SetFreeBodyPose(context, plant.GetBodyByName("base_link", model), X_WB)
        states.append(plant.get_state_output_port().Eval(context).copy())
    system = MagneticAdhesion(
        plant=plant,
        model=model,
        shell=shell,
        wheel_radius=SnailBotParameters().wheel_radius,
        shell_parameters=ShellParameters(),
    )
    return Case(system, {"state": (states[0], states[1])})


def recorder(folder: Path) -> Case:
    channels = [
        Channel("sample", "/imu", "sensor_msgs/msg/Imu", 6, 100.0),
        Channel("found", "/tags", "apriltag_msgs/msg/AprilTagDetectionArray", Detections(), 10.0),
    ]
    system = Recorder(channels=channels, writer=BagWriter(folder / "bag"))
    found = (detections(0.0), detections(0.1))
    return Case(system, {"sample": (np.zeros(6), np.ones(6)), "found": found}, system.close)


def viewer(_: Path) -> Case:
    system = EstimateViewer(
        meshcat=Meshcat(MeshcatParams(host="localhost")),
        ghost=DifferentialDriveBody().ghost(),
        waypoints=np.zeros((1, 2)),
        radius=0.3,
        rate=10.0,
    )
    poses = (np.zeros(3), np.ones(3))
    covariances = (0.01 * np.eye(3).ravel(), 0.02 * np.eye(3).ravel())
    return Case(system, {"pose": poses, "covariance": covariances, "truth": poses})


def shell_viewer(_: Path) -> Case:
    system = ShellViewer(
        meshcat=Meshcat(MeshcatParams(host="localhost")),
        body=SnailBotParameters(),
        shell=ShellParameters(),
        rate=10.0,
    )
    poses = tuple(RigidTransform([0.0, y, 0.085]) for y in (0.0, 0.01))
    covariances = (1e-4 * np.eye(6).ravel(), 2e-4 * np.eye(6).ravel())
    inputs = {"pose": poses, "covariance": covariances, "reference_pose": poses, "truth": poses}
    return Case(system, inputs)


def surroundings_viewer(_: Path) -> Case:
    system = SurroundingsViewer(
        meshcat=Meshcat(MeshcatParams(host="localhost")), lidar_pose=np.zeros(3), rate=10.0
    )
    scans = [Scan(stamp=float(k), ranges=np.full(360, 1.0 + k)) for k in range(2)]
    states = [
        AvoiderState(
            stamp=float(k),
            status="avoiding",
            angles=np.radians(np.arange(-180.0, 180.0, 5.0)),
            density=np.zeros(72),
            free=np.arange(72) % 3 > k,
            direction=0.5,
        )
        for k in range(2)
    ]
    paths = [PlannedPath(stamp=float(k), points=np.array([[0.0, 0.0], [1.0, k]])) for k in range(2)]
    grids = [
        OccupancyGrid(stamp=float(k), log_odds=np.full((4, 5), 2.0 * k, np.float32))
        for k in range(2)
    ]
    inputs = {"scan": scans, "state": states, "path": paths, "grid": grids}
    return Case(
        system,
        {"pose": (np.zeros(3), np.ones(3))} | {k: tuple(v) for k, v in inputs.items()},
    )


def tag_frame(stamp: float, shift: float = 0.0) -> TagFrame:
    return observe(detections(stamp, shift), camera=CAMERA, markers=MAP, anchor=7, pixel_noise=0.3)


def frames_viewer(_: Path) -> Case:
    system = FramesViewer(
        meshcat=Meshcat(MeshcatParams(host="localhost")),
        markers=MAP,
        X_BC=X_WC,
        anchor=7,
        rate=10.0,
    )
    frames = (tag_frame(0.0), tag_frame(0.1, 1.0))
    return Case(system, {"frame": frames, "pose": vector(0.0, 0.1, 0.2)})


def vector(*first: float) -> tuple[np.ndarray, np.ndarray]:
    """The numbers, and larger ones."""
    return np.array(first), np.array(first) * 1.1 + 0.05


def turn(stamp: float, distance: float) -> Scan:
    """A turn of a lidar in the middle of a round room."""
    return Scan(stamp=stamp, range_min=0.15, range_max=12.0, ranges=np.full(360, distance))


def grid_with_a_wall() -> OccupancyGrid:
    cells = np.full((40, 40), -2.0, np.float32)
    cells[:30, 20] = 3.5
    return OccupancyGrid(stamp=0.0, log_odds=cells)


def avoider(kind: type) -> Case:
    """One without a scan: it stands, so that its local goal follows the pose."""
    inputs = {"pose": vector(0.1, 0.2, 0.3), "goal": vector(1.0, 2.0)}
    scans = (Scan(), Scan(stamp=0.1, ranges=np.ones(360)))
    return Case(kind(), {**inputs, "scan": scans, "command": vector(0.2, 0.1)})


def matches(stamp: float, distance: float) -> PointMatches:
    """A shell that passes by under the camera of `VIEW`."""
    y, x = np.mgrid[10:110:20, 10:150:20].astype(float)
    before = np.stack([x.ravel(), y.ravel()], axis=1)
    after = VIEW.turned(before, np.array([0.0, distance / VIEW.radius, 0.0]))
    return PointMatches(stamp, stamp - 0.02, "camera", before, after)


SQUARE = PlanarShapes(centres=[[0.0, 0.0]], headings=[0.0], sizes=[[0.2, 0.2]], radii=[0.0])
QUERIES = (scene(0.0), scene(0.05))
POSES = (RigidTransform(), RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [1.0, 2.0, 3.0]))
ESTIMATES = (marker_pose(0.5), marker_pose(0.51))


def formation_step(kind: type) -> Case:
    """A step between the beacons 0, 1 and 2, and another one."""
    system = kind(front_camera=CAMERA, rear_camera=CAMERA, **FORMATION_OPTIONS.get(kind, {}))
    poses = np.array([[2.25, 0, 0], [1.5, 1.3, 0], [0.75, 0, 0]])
    tasks = tuple(
        StepTask(number, np.arange(3), poses, np.array([3.0, 1.3]), np.array([0, 1.3]))
        for number in (1, 2)
    )
    seen = (detections(0.0), detections(0.1))
    inputs = {"front_detections": seen, "rear_detections": seen}
    return Case(system, {**inputs, "task": tasks})


# The narrow camera of these tests holds 80 px aside.
FORMATION_OPTIONS = {TriangleAlgorithm1: {"parameters": Algorithm1Parameters(dt=70.0)}}


def straight_route() -> Route:
    t = 0.1 * np.arange(20)
    one, none = np.ones(20), np.zeros(20)
    return Route(t, 0.3 * t, none, none, 0.3 * one, none)


def tracker(kind: type) -> Case:
    system = kind(route=straight_route())
    covariances = (1e-4 * np.eye(3).ravel(), 1e6 * np.eye(3).ravel())
    return Case(
        system,
        {"pose": vector(0.1, 0.02, 0.1), "covariance": covariances, "sent": vector(0.2, 0.1)},
    )


CASES: dict[type, Callable[[Path], Case]] = {
    AStarPlanner: lambda _: Case(
        AStarPlanner(),
        {
            "pose": vector(0.1, 0.2, 0.3),
            "goal": vector(2.0, 1.0),
            "grid": (OccupancyGrid(), grid_with_a_wall()),
        },
    ),
    BodyState: lambda _: Case(
        BodyState(num_positions=7, num_velocities=6),
        {
            "state": vector(0.9, 0.1, 0.2, 0.3, *range(9)),
            "generalized_acceleration": vector(*[1] * 6),
        },
    ),
    CollisionMonitor: lambda _: Case(
        CollisionMonitor(hull=[0.11, 0.11, 0.093], lidar_pose=[0.0, 0.0, 0.0]),
        {
            "command": vector(0.2, 0.1),
            "scan": (turn(0.0, 1.0), turn(0.1, 0.3)),
            "sent": vector(0.1, 0.1),
        },
    ),
    DcMotors: lambda _: Case(
        DcMotors(), {"pwm": vector(120.0, 90.0), "wheel_speeds": vector(3.0, -2.0)}
    ),
    CarriedShellMotion: lambda _: Case(
        CarriedShellMotion(),
        {"imu": vector(0.1, 0.2, 0.3, 0.0, 0.0, 9.81), "calibration": vector(*[0.01] * 18)},
    ),
    ClearanceMonitor: lambda _: Case(
        ClearanceMonitor(
            footprint=SQUARE, standing=SQUARE.moved([3.0, 0.0, 0.5]), moving_radii=[0.2]
        ),
        {"pose": vector(1.0, 0.5, 0.3), "moving": vector(1.0, 1.5)},
    ),
    Detector: lambda _: Case(
        Detector(detector=MarkerDetector(family=TAG), rate=20.0),
        {"image": (image(1.0), image(2.0))},
    ),
    DrawnCamera: lambda _: Case(
        DrawnCamera(
            camera=CAMERA,
            parent_frame=WORLD,
            X_PC=X_WC,
            rate=15.0,
            markers=placed_markers(MAP, WORLD),
            family=TAG,
            effects=ImageEffects(exposure_samples=2, read_noise=1.0),
        ),
        {
            "query_object": QUERIES,
            "spatial_velocity": vector(0, 0, 1, 0, 0, 0),
            "active": vector(1.0),
        },
    ),
    DwaAvoider: lambda _: avoider(DwaAvoider),
    EstimateViewer: viewer,
    Failure: lambda _: Case(Failure(robots=4, robot=1, at=0.1), {}),
    FormationCameras: lambda _: Case(
        FormationCameras(robots=1, cameras=["front_camera"]),
        {"looking": vector(0.0), "robot0_front_camera": (detections(0.0), detections(0.01, 3.0))},
    ),
    FormationTurns: lambda _: Case(
        FormationTurns(start_poses=[[0.75, 0, 0], [0, 1.3, 0], [2.25, 0, 0], [1.5, 1.3, 0]]),
        {
            "move": (FormationMove(), FormationMove(stamp=0.0, status="moving", number=1)),
            "poses": vector(*range(12)),
            "covariance": vector(*(1e-4 * np.eye(12)).ravel()),
            "failed": vector(0.0, 0.0, 0.0, 0.0),
            **{f"status_{k}": vector(0.0, 0.0, 0.0) for k in range(4)},
        },
    ),
    FormationViewer: lambda _: Case(
        FormationViewer(
            meshcat=Meshcat(MeshcatParams(host="localhost")),
            robots=4,
            destination=np.zeros(2),
            rate=10.0,
        ),
        {
            "move": (FormationMove(), FormationMove(stamp=0.0, status="reached", number=1)),
            "moving": vector(0.0, 1.0, 0.0, 0.0),
            "record": vector(*np.zeros(10)),
            "positions": vector(*range(8)),
            "poses": vector(*range(12)),
            "covariance": vector(*(1e-4 * np.eye(12).ravel())),
        }
        | {f"truth_{k}": vector(0.0, float(k), 0.1) for k in range(4)},
    ),
    FormationFilter: lambda _: Case(
        FormationFilter(start_poses=[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], camera=CAMERA),
        {"moving": vector(0.0, 0.0)}
        | {
            f"robot{k}_{name}": (detections(0.0), detections(0.01, 3.0))
            for k in range(2)
            for name in ("front_camera", "rear_camera")
        },
        nan_outputs=("nis",),
    ),
    FlowProjector: lambda _: Case(
        FlowProjector(camera=CAMERA), {"pose": (VIEW.X_SC, VIEW.X_SC @ POSES[1])}
    ),
    FormationPlanner: lambda _: Case(
        FormationPlanner(start=strip(4, 1.5)),
        {
            "positions": vector(*strip(4, 1.5).ravel()),
            "failed": vector(0.0, 0.0, 0.0, 0.0),
            "obstacles": (Obstacles(), Obstacles(stamp=0.0)),
            "destination": vector(9.0, 4.0),
            "progress": vector(0.0, 0.0),
        },
    ),
    FramesViewer: frames_viewer,
    GyroYaw: lambda _: Case(GyroYaw(num_samples=3), {"imu": vector(0.0, 0.0, 0.1, 0.0, 0.0, 9.81)}),
    Imu: lambda _: Case(
        Imu(parameters=ImuParameters(gyro_noise_density=0.01), p_BS=np.array([0.1, 0.0, 0.0])),
        {
            "pose": POSES,
            "spatial_velocity": vector(0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
            "spatial_acceleration": vector(0.6, 0.5, 0.4, 0.3, 0.2, 0.1),
        },
    ),
    KnownShellMotion: lambda _: Case(
        KnownShellMotion(),
        {"pose": POSES, "spatial_velocity": vector(0.1, 0.2, 0.3, 0.4, 0.5, 0.6)},
    ),
    Kanayama: lambda _: tracker(Kanayama),
    KinematicDifferentialDrive: lambda _: Case(
        KinematicDifferentialDrive(), {"wheel_speeds": vector(3.0, 5.0)}
    ),
    Lidar: lambda _: Case(
        Lidar(
            parent_frame=WORLD,
            X_PL=RigidTransform(),
            parameters=LidarParameters(rate=10.0, dropout_probability=0.0),
            role=Role.kPerception,  # of the markers' boards
        ),
        {
            "query_object": QUERIES,
            "spatial_velocity": vector(0, 0, 1, 0, 0, 0),
        },
    ),
    Localizer: lambda _: Case(
        Localizer(
            localizer=MapLocalizer(
                marker_map=MAP,
                camera=CAMERA,
                X_BC=X_WC,
                parameters=LocalizerParameters(max_reprojection=50.0),  # there is an alternative
            ),
            rate=20.0,
        ),
        {"detections": (detections(1.0), detections(2.0, shift=0.5))},
    ),
    Madgwick: lambda _: Case(Madgwick(), {"imu": vector(0.1, 0.2, 0.3, 1.0, 2.0, 9.81)}),
    MagneticAdhesion: magnetic_adhesion,
    MarkerProjector: lambda _: Case(
        MarkerProjector(
            camera=CAMERA,
            parent_frame=WORLD,
            X_PC=X_WC,
            markers=placed_markers(MAP, WORLD),
            family=TAG,
        ),
        {"query_object": QUERIES, "active": vector(1.0)},
    ),
    MeshcatDriver: lambda _: Case(MeshcatDriver(meshcat=Meshcat(MeshcatParams(host="localhost")))),
    MessagePlayback: lambda _: Case(
        MessagePlayback(
            entries=[Entry(round(1e8 * k), 0.1 * k, detections(0.1 * k)) for k in range(5)],
            nothing=Detections(),
        )
    ),
    OccupancyMapper: lambda _: Case(
        OccupancyMapper(lidar_pose=[0.0, 0.0, 0.0]),
        {
            "scan": (turn(0.0, 1.0), turn(0.1, 2.0)),
            "pose": vector(0.1, 0.2, 0.3),
            "covariance": vector(*(1e-4 * np.eye(3).ravel())),
        },
    ),
    MeanFlow: lambda _: Case(
        MeanFlow(view=VIEW),
        {
            "matches": (matches(1.0, 1e-4), matches(2.0, 2e-4)),
            "imu": vector(0.1, 0.2, 0.3, 0.0, 0.0, 9.81),
        },
    ),
    Mpc: lambda _: tracker(Mpc),
    MovingObstacles: lambda _: Case(
        MovingObstacles(
            cylinders=[MovingCylinder(radius=0.1, path=[[0, 0], [1, 0]], speed=0.3, courtesy=0.5)],
            robots=1,
        ),
        {"robots": vector(0.5, 0.1, 0.0)},
    ),
    PlanarEkf: lambda _: Case(
        PlanarEkf(),
        {
            "command": vector(0.3, 0.1),
            "imu": vector(0.0, 0.0, 0.1, 0.0, 0.0, 9.81),
            "marker_pose": (marker_pose(0.0), marker_pose(0.1)),
            "marker_alternative": ESTIMATES,
            "wheel_speeds": vector(9.0, 10.0),
        },
        nan_outputs=("nis",),
    ),
    PlanarKalmanFilter: lambda _: Case(
        PlanarKalmanFilter(),
        {
            "command": vector(0.3, 0.1),
            "imu": vector(0.0, 0.0, 0.1, 0.0, 0.0, 9.81),
            "marker_pose": ESTIMATES,
            "marker_alternative": ESTIMATES,
        },
        nan_outputs=("nis",),
    ),
    PointTracker: lambda _: Case(
        PointTracker(view=VIEW),
        {
            "image": (image(0.0), image(0.1)),
            "imu": vector(0.1, 0.2, 0.3, 0.0, 0.0, 9.81),
            "increment": (RotationIncrement(), RotationIncrement(0.0, -0.1, "", np.ones(3))),
        },
    ),
    MissedPassages: lambda _: Case(
        MissedPassages(probability=0.5), {"detections": (detections(0.0), detections(0.01, 3.0))}
    ),
    PoseOutliers: lambda _: Case(PoseOutliers(probability=0.5, angle=0.1), {"pose": ESTIMATES}),
    PoseFromVector: lambda _: Case(
        PoseFromVector(), {"vector": vector(1.0, 0.1, 0.2, 0.3, 1.0, 2.0, 3.0)}
    ),
    PoseToVector: lambda _: Case(PoseToVector(), {"pose": POSES}),
    RelativePose: relative_pose,
    FramePose: lambda _: Case(FramePose(frame_id=WORLD), {"pose": POSES}),
    MarkersSeen: lambda _: Case(
        MarkersSeen(marker_map=MAP, rate=60.0),
        {"detections": (detections(0.0), detections(0.5, 3.0))},
    ),
    PoseChain: lambda _: Case(
        PoseChain(mounts=[RigidTransform([0.0, 0.0, 0.1])]),
        {
            "pose_1": POSES,
            "covariance_1": vector(*(1e-4 * np.eye(6).ravel())),
            "pose_2": POSES,
            "covariance_2": vector(*(1e-4 * np.eye(6).ravel())),
        },
    ),
    ProgressMonitor: lambda _: Case(
        ProgressMonitor(),
        {
            "pose": vector(0.1, 0.2, 0.3),
            "goal": vector(2.0, 1.0),
            "path": (PlannedPath(), PlannedPath(stamp=0.0, points=np.eye(2))),
        },
    ),
    FaultInjector: lambda _: Case(
        FaultInjector(
            model=3, faults=[Fault("imu.sample", "nan", 9.0)], rate=10.0, seed=0, name="faults"
        ),
        {"input": vector(1.0, 2.0, 3.0)},
    ),
    Recorder: recorder,
    RockingBody: lambda _: Case(
        RockingBody(parameters=RockingParameters(bound=0.1), frame_id=WORLD),
        {
            "state": vector(0.8, 0.1, -0.2, 0.3, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
            "generalized_acceleration": vector(0.6, 0.5, 0.4, 0.3, 0.2, 0.1),
        },
    ),
    RenderedCamera: lambda _: Case(
        RenderedCamera(
            camera=CAMERA,
            parent_frame=WORLD,
            X_PC=X_WC,
            renderer="vtk",
            rate=15.0,
            effects=ImageEffects(exposure_samples=2, read_noise=1.0),
        ),
        {
            "query_object": QUERIES,
            "spatial_velocity": vector(0, 0, 1, 0, 0, 0),
            "active": vector(1.0),
        },
    ),
    ScriptedDriver: lambda _: Case(
        ScriptedDriver(route=[[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]]),
        {"pose": vector(0.1, 0.05, 0.0)},
    ),
    SearchWhenLost: lambda _: Case(
        SearchWhenLost(),
        {"command": vector(0.2, 0.1), "covariance": vector(*(0.01 * np.eye(3).ravel()))},
    ),
    SectorAvoider: lambda _: avoider(SectorAvoider),
    SonarObstacles: lambda _: Case(
        SonarObstacles(robots=2),
        {
            "poses": vector(0.0, 0.0, 0.0, 1.5, 0.0, 1.0),
            "covariance": vector(*(1e-6 * np.eye(6)).ravel()),
            "moving": vector(0.0, 0.0),
            **{
                f"scan_{k}": (
                    Scan(stamp=0.0, range_max=2.6, ranges=np.full(24, 1.0 + k)),
                    Scan(stamp=0.0, range_max=2.6, ranges=np.full(24, 2.0 + k)),
                )
                for k in range(2)
            },
        },
    ),
    SphereFlow: lambda _: Case(
        SphereFlow(estimator=SphereFlowEstimator(view=VIEW)),
        {"matches": (matches(1.0, 1e-4), matches(2.0, 2e-4))},
    ),
    ReplaySupervisor: lambda _: Case(
        ReplaySupervisor(),
        {
            "command": vector(0.3, 0.1),
            "covariance": (1e-6 * np.eye(3).ravel(), 1e-2 * np.eye(3).ravel()),
            "estimator_health": (Health({"accepted": 1}), Health({"accepted": 2, "restarted": 1})),
            "tracking": (TrackingState(distance=0.0), TrackingState(distance=1.0)),
            "free_distance": vector(0.3),
        },
    ),
    RouteClearance: lambda _: Case(
        RouteClearance(route=straight_route()),
        {
            "pose": vector(0.0, 0.0, 0.0),
            "scan": (turn(0.1, 0.4), turn(0.1, 0.3)),
            "tracking": (TrackingState(run=0.0), TrackingState(run=0.2)),
        },
        nan_outputs=("free_distance",),
    ),
    ShellEkf: lambda _: Case(
        ShellEkf(view=VIEW, marker_map=MAP),
        {
            "marker_pose": ESTIMATES,
            "increment": (RotationIncrement(), RotationIncrement(0.0, -0.1, "", np.ones(3))),
            "imu": vector(0.1, 0.2, 0.3, 0.0, 0.0, 9.81),
            "reference_velocity": vector(0.0, 0.0, 0.1, 0.0, 0.0, 0.0),
        },
        nan_outputs=("nis",),
    ),
    ShellMarkerPose: lambda _: Case(
        ShellMarkerPose(
            localizer=shell_localizer(
                marker_map=MAP,
                camera=CAMERA,
                X_BC=X_WC,
                parameters=LocalizerParameters(max_reprojection=50.0),  # there is an alternative
            ),
            rate=20.0,
        ),
        {"detections": (detections(1.0), detections(2.0, shift=0.5))},
    ),
    ShellRoute: lambda _: Case(
        ShellRoute(legs=[Leg(0.0, np.pi / 2, np.pi, 1.0)], radius=0.075), {"pose": POSES}
    ),
    ShellMotion: lambda _: Case(ShellMotion()),
    ShellRover: lambda _: Case(ShellRover(radius=0.075), {"command": vector(0.03, 0.1)}),
    ShellRule: lambda _: Case(
        ShellRule(radius=0.075),
        {
            "marker_pose": ESTIMATES,
            "flow": vector(0.03, 0.01),
            "orientation": vector(1.0, 0.0, 0.0, 0.0),
            "imu": vector(0.1, 0.2, 0.3, 0.0, 0.0, 9.81),
        },
    ),
    ShellViewer: shell_viewer,
    SurroundingsViewer: surroundings_viewer,
    TriangleAlgorithm1: lambda _: formation_step(TriangleAlgorithm1),
    TriangleResection: lambda _: formation_step(TriangleResection),
    TagFrames: lambda _: Case(
        TagFrames(camera=CAMERA, markers=MAP, anchor=7, rate=20.0),
        {"detections": (detections(1.0), Detections(stamp=2.0, family=TAG.name))},
    ),
    TwinPositions: twin_positions,
    TwinState: lambda _: Case(
        TwinState(), {"twin_pose": vector(1.0, 2.0, 0.3), "twin_velocity": vector(0.3, 0.5)}
    ),
    VectorPlayback: lambda _: Case(
        VectorPlayback(
            entries=[Entry(round(1e8 * k), 0.1 * k, np.full(3, k)) for k in range(5)], size=3
        )
    ),
    PurePursuit: lambda _: tracker(PurePursuit),
    Tvlqr: lambda _: tracker(Tvlqr),
    Unicycle: lambda _: Case(Unicycle(), {"command": vector(0.3, 0.2)}),
    VfhPlus: lambda _: avoider(VfhPlus),
    WaypointController: lambda _: Case(
        WaypointController(), {"pose": vector(0.0, 0.0, 0.3), "goal": vector(0.1, 0.1)}
    ),
    WaypointSequencer: lambda _: Case(
        WaypointSequencer(waypoints=np.array([[0.0, 0.0], [1.0, 0.0]])),
        {"pose": vector(0.1, 0.0, 0.0)},
    ),
    WheelDrive: lambda _: Case(
        WheelDrive(to_wheel_speeds=lambda c: wheel_speeds(c, DifferentialDriveParameters())),
        {"command": vector(0.3, 0.2)},
    ),
    WheelOdometry: lambda _: Case(
        WheelOdometry(ticks_per_turn=80.0, wheel_radius=0.045, track=0.4),
        {"ticks": vector(100.0, 120.0)},
    ),
    WheelSpeeds: lambda _: Case(WheelSpeeds(ticks_per_turn=80.0), {"ticks": vector(100.0, 120.0)}),
    UltrasonicRing: lambda _: Case(
        UltrasonicRing(
            parent_frame=WORLD,
            X_PU=RigidTransform(),
            parameters=UltrasonicParameters(dropout_probability=0.0),
            role=Role.kPerception,  # of the markers' boards
        ),
        {"query_object": QUERIES},
    ),
    WheelEncoders: lambda _: Case(WheelEncoders(), {"wheel_angles": vector(7.0, -3.0)}),
    WheelPwm: lambda _: Case(
        WheelPwm(to_duty=MotorModel(MotorParameters()).duty), {"wheel_speeds": vector(3.0, 2.0)}
    ),
}

# --- What there is to be tested ---


def all_systems() -> list[type]:
    """Every concrete LeafSystem of ours; of a scalar-generic one, that for floats."""
    for package in (systems, plants, diagrams):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)

    def below(kind: type) -> Iterator[type]:
        for child in kind.__subclasses__():
            yield child
            yield from below(child)

    ours = {kind for kind in below(LeafSystem) if kind.__module__.split(".")[0] in HOUSE}
    return sorted((kind for kind in ours if not is_abstract(kind)), key=name_of)


HOUSE = ("systems", "plants", "diagrams")


def is_abstract(kind: type) -> bool:
    members = (getattr(kind, name, None) for name in dir(kind))
    return any(getattr(member, "__isabstractmethod__", False) for member in members)


def name_of(kind: type) -> str:
    """The class' name, without the scalar type that Drake adds to a template's."""
    return re.split(r"_\N{MATHEMATICAL BOLD SCRIPT CAPITAL T}", kind.__name__)[0]


SYSTEMS = all_systems()


@pytest.fixture
def case(kind: type, tmp_path: Path) -> Iterator[Case]:
    case = CASES[kind](tmp_path)
    yield case
    case.close()


every_system = pytest.mark.parametrize("kind", [s for s in SYSTEMS if s in CASES], ids=name_of)


def test_every_system_has_a_case() -> None:
    missing = [f"{kind.__module__}.{name_of(kind)}" for kind in SYSTEMS if kind not in CASES]
    assert not missing, (
        f"no case for {', '.join(missing)}: add to CASES of {Path(__file__).name} a function that "
        "returns Case(system, {input port: (value, another value)})"
    )
    gone = [name_of(kind) for kind in CASES if kind not in SYSTEMS]
    assert not gone, f"CASES has {', '.join(gone)}, which no package of {HOUSE} defines"


# --- Docstrings ---


def sections(kind: type) -> dict[str, str]:
    """The docstring's sections by heading: the drawn block, Args, Ports, ..."""
    text = inspect.cleandoc(kind.__doc__ or "")
    parts = re.split(r"^(\.\. pydrake_system::|[A-Z]\w+:)$", text, flags=re.MULTILINE)
    return {
        heading.strip(".: "): re.split(r"^\S", body, maxsplit=1, flags=re.MULTILINE)[0]
        for heading, body in zip(parts[1::2], parts[2::2], strict=True)
    }


def entries(section: str) -> list[str]:
    """What the entries of a section begin with: "name", or "name (kind)"."""
    lines = inspect.cleandoc("\n" + section).splitlines()
    return [line.split(":")[0] for line in lines if line and not line.startswith(" ")]


def described_ports(kind: type) -> dict[tuple[str, str], str]:
    """Direction and name of each port that the docstring describes, and what it says it carries."""
    found = {}
    for entry in entries(sections(kind).get("Ports", "")):
        match = re.fullmatch(r"(\S+) \((input|output), (.+)\)", entry)
        assert match, f"Ports: {entry!r} is not 'name (input or output, type)'"
        found[match[2], match[1]] = match[3]
    return found


def stands_for(documented: list[str], names: list[str]) -> bool:
    """Whether the drawn ports are these; what is no name, such as `{model}`, is any number."""
    plain = [entry if re.fullmatch(r"\w+", entry) else "*" for entry in documented]
    pattern = "".join(r"(\w+ )+" if entry == "*" else f"{entry} " for entry in plain)
    pattern = re.sub(r"(\(\\w\+ \)\+)+", r"(\\w+ )+", pattern)
    return re.fullmatch(pattern, "".join(f"{name} " for name in names)) is not None


def ports(system: LeafSystem) -> dict[str, list[Any]]:
    return {
        "input": [system.get_input_port(i) for i in range(system.num_input_ports())],
        "output": [system.get_output_port(i) for i in range(system.num_output_ports())],
    }


@every_system
def test_the_drawn_block_has_the_declared_ports(kind: type, case: Case) -> None:
    block = sections(kind).get("pydrake_system")
    assert block, "the docstring lacks `.. pydrake_system::`"
    drawn = YAML(typ="safe", pure=True).load(inspect.cleandoc(block))
    assert drawn.pop("name") == name_of(kind)
    for direction, declared in ports(case.system).items():
        names = [port.get_name() for port in declared]
        documented = drawn.pop(f"{direction}_ports", [])
        assert stands_for(documented, names), f"{direction}_ports: {documented}, in fact {names}"
    assert not drawn


@every_system
def test_every_port_is_described(kind: type, case: Case) -> None:
    described = described_ports(kind)
    for direction, declared in ports(case.system).items():
        names = [port.get_name() for port in declared]
        documented = [name for key, name in described if key == direction]
        assert stands_for(documented, names), f"Ports: {direction}s {documented}, in fact {names}"
        for port in declared:
            said = described.get((direction, port.get_name()), "")
            if match := re.fullmatch(r"vector of (\d+)", said):
                assert port.get_data_type() == PortDataType.kVectorValued
                assert port.size() == int(match[1]), f"{port.get_name()}: vector of {port.size()}"
            elif direction == "input" and re.fullmatch(r"\w+", said):
                assert said == type(case.inputs[port.get_name()][0]).__name__


@every_system
def test_every_argument_is_described(kind: type) -> None:
    construct = getattr(kind, "_construct", kind.__init__)  # of a template, the former
    parameters = list(inspect.signature(construct).parameters.values())[1:]
    assert all(p.kind is p.KEYWORD_ONLY for p in parameters), "arguments are to be keyword-only"
    names = [p.name for p in parameters if p.name != "converter"]
    assert entries(sections(kind).get("Args", "")) == names


# --- Behaviour ---


def fix(case: Case, context: Context, *changed: str) -> None:
    """Fixes the inputs; of the changed ports to the other value."""
    for name, (value, other) in case.inputs.items():
        case.system.GetInputPort(name).FixValue(context, other if name in changed else value)


def simulate(case: Case, duration: float = 0.25) -> Context:
    simulator = Simulator(case.system)
    fix(case, simulator.get_mutable_context())
    simulator.AdvanceTo(duration)
    return simulator.get_context()


def same(a: Any, b: Any) -> bool:
    if isinstance(a, RigidTransform):
        return a.IsExactlyEqualTo(b)
    if isinstance(a, FramePoseVector):
        return {*a.ids()} == {*b.ids()} and all(same(a.value(f), b.value(f)) for f in a.ids())
    if isinstance(a, list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, ExternallyAppliedSpatialForce):
        return all(
            same(np.asarray(f(a)), np.asarray(f(b)))
            for f in (lambda x: int(x.body_index), lambda x: x.F_Bq_W.get_coeffs())
        )
    if isinstance(a, Message):
        return type(a) is type(b) and all(
            same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a)
        )
    if isinstance(a, np.ndarray | float):
        return np.array_equal(a, b, equal_nan=True)
    return a == b


def copied(value: Any) -> Any:
    """A copy: what Eval returns is the cache's own, which changes with the inputs."""
    if not isinstance(value, FramePoseVector):  # which Python cannot copy
        return copy.deepcopy(value)
    poses = FramePoseVector()
    for frame in value.ids():
        poses.set_value(frame, value.value(frame))
    return poses


def outputs(system: LeafSystem, context: Context) -> dict[str, Any]:
    return {port.get_name(): copied(port.Eval(context)) for port in ports(system)["output"]}


def said_of(described: dict[tuple[str, str], str], output: str) -> str:
    """What the docstring says of an output port, perhaps as one of many, such as `task_{k}`."""
    for (kind, name), said in described.items():
        pattern = re.sub(r"{\w+}", r"\\w+", name)
        if kind == "output" and re.fullmatch(pattern, output):
            return said
    raise AssertionError(f"{output} is not described")


@every_system
def test_it_steps_and_sends_what_it_says(kind: type, case: Case) -> None:
    described = described_ports(kind)
    for name, value in outputs(case.system, simulate(case)).items():
        said = said_of(described, name)
        if isinstance(value, np.ndarray):
            vector = said.startswith("vector of ") or said == "of the type of `model`"
            assert vector, f"{name} is a vector, said to be {said}"
            assert np.isfinite(value).all() or name in case.nan_outputs
        else:
            assert said in (type(value).__name__, "of the type of `nothing`")


@every_system
def test_two_simulations_do_not_know_of_each_other(case: Case) -> None:
    # State that is kept on the block instead of the Context would show.
    first = outputs(case.system, simulate(case))
    simulate(case, duration=0.1)
    again = outputs(case.system, simulate(case))
    for name, value in first.items():
        assert same(value, again[name]), f"{name} differs in a second simulation"


@every_system
def test_direct_feedthrough_is_what_drake_says(case: Case) -> None:
    context = simulate(case).Clone()
    context.DisableCaching()  # else an undeclared dependence would not show
    before = outputs(case.system, context)
    inputs, declared = ports(case.system).values()
    said = {
        (given.get_name(), sent.get_name())
        for given in inputs
        for sent in declared
        if case.system.HasDirectFeedthrough(given.get_index(), sent.get_index())
    }
    assert list(case.inputs) == [given.get_name() for given in inputs]
    found = set()
    for changed in case.inputs:
        fix(case, context, changed)
        after = outputs(case.system, context)
        found |= {(changed, name) for name in before if not same(before[name], after[name])}
    assert found <= said, f"changes an output at once, undeclared: {found - said}"
    assert said <= found, f"declared, but changes nothing: {said - found}"
