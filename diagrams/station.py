"""The station: robots in their world as one Diagram with named ports, simulated or played back.

The ports are `{robot}.{device}.{signal}`: `robot.front_camera.detections`, `robot.imu.sample`,
`robot.drive.command`. They are the same whether the signals are simulated, come from a recording or
from a device: drivers are chosen by name in the scenario. Only a simulated station (or a recording
of one) adds ports under `truth.`; nothing on the robot's side reads those.
"""

from __future__ import annotations

import math
import re
import sys
import typing
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from pydrake.geometry import MakeRenderEngineVtk, RenderEngineVtkParams, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.systems.framework import Diagram, DiagramBuilder, InputPort, OutputPort, System

from diagrams.channels import Signal
from diagrams.schema import ScenarioError
from diagrams.tables import Choice, Table
from diagrams.world import World
from plants.lighting import daylight
from systems.io.ros_motion import FrameTransform, transforms_to_ros
from systems.markers.layout import MarkerMap
from systems.markers.projector import PlacedMarker
from systems.periods import align
from systems.sensors.faults import Fault, FaultInjector
from systems.validation import nearest, require

if typing.TYPE_CHECKING:
    from diagrams.shell_world import Shell
    from systems.io.bag import BagReader

BODIES = Table(
    "body",
    {
        "differential_drive": "diagrams.drivers.body:DifferentialDriveBody",
        "limo": "diagrams.drivers.limo_body:LimoBody",
        "snailbot": "diagrams.drivers.shell_body:SnailBotBody",
    },
    resources=frozenset({"shell"}),
    method="add_model",
)
DRIVES = Table(
    "drive",
    {
        "dc_motors": "diagrams.drivers.drive:DcMotorDrive",
        "wheel_servo": "diagrams.drivers.drive:WheelServo",
    },
    method="add",
)
SENSORS = Table(
    "sensor",
    {
        "bmi088": "diagrams.drivers.imu:Bmi088",
        "camera": "diagrams.drivers.camera:Camera",
        "imu": "diagrams.drivers.imu:InertialSensor",
        "lidar": "diagrams.drivers.lidar:Lidar",
        "mpu6050": "diagrams.drivers.imu:Mpu6050",
        "shell_camera": "diagrams.drivers.shell_camera:ShellCamera",
        "ultrasonic": "diagrams.drivers.ultrasonic:UltrasonicDriver",
        "wheel_encoders": "diagrams.drivers.encoders:Encoders",
    },
    method="add",
)

# Names of blocks, ports and topics of a robot that its devices must leave free.
_TAKEN = (
    "drive",
    "estimate",
    "odom",
    "servos",
    "state",
    "twin",
    "wheels",
    "wheel_angles",
    "wheel_rates",
)

RENDERER = "vtk"


@dataclass
class Start:
    """Where a robot starts.

    Attributes:
        x: m.
        y: m.
        heading_deg: 0 is along x, positive to the left.
    """

    x: float = 0.0
    y: float = 0.0
    heading_deg: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require(math.isfinite(value), name, value, "finite")

    def pose(self) -> np.ndarray:
        """Returns [x (m), y (m), theta (rad)]."""
        return np.array([self.x, self.y, math.radians(self.heading_deg)])


@dataclass(kw_only=True)
class Hardware:
    """What a robot is made of: its body, how it is driven, what it senses with.

    Attributes:
        body: model.
        drive: driver of the wheels.
        sensors: drivers by device name.
        faults: what goes wrong with the sensors on purpose.
    """

    body: Annotated[Choice, BODIES]
    drive: Annotated[Choice, DRIVES]
    sensors: dict[str, Annotated[Choice, SENSORS]] = field(default_factory=dict)
    faults: list[Fault] = field(default_factory=list)

    def __post_init__(self) -> None:
        for name in self.sensors:
            require(
                re.fullmatch("[a-z][a-z0-9_]*", name) is not None and name not in _TAKEN,
                "sensors",
                name,
                f"a name in lower case, as ROS takes them, other than {', '.join(_TAKEN)}",
            )


@dataclass(kw_only=True)
class RobotParameters(Hardware):
    """One robot, and where it starts.

    Attributes:
        start: pose at the start; of other worlds than an arena, what has a `pose()` there.
    """

    start: Start = field(default_factory=Start)

    def require_sensor(self, key: str, name: str | None, method: str) -> None:
        """Refuses a scenario's key that names none of the sensors that fit.

        Args:
            key: of the scenario, for the message.
            name: what it says; None, for no sensor, is never refused.
            method: what the drivers of sensors that fit have.

        Raises:
            ValueError: naming the key and the sensors that fit.
        """
        if name is None:
            return
        fit = [own for own, sensor in self.sensors.items() if hasattr(sensor.target, method)]
        have = ", ".join(fit) or "none"
        require(name in fit, key, name, f"one of the robot's sensors that fit: {have}")


@dataclass
class Robot:
    """A robot while its station is built.

    Attributes:
        name: prefix of its ports.
        body: its body's driver.
        start: where its `Start` says.
        drive: the driver of its wheels.
        on: name of whose shell it stands on, of a robot on a shell.
        sensors: its devices by name.
        model: its model instance in the plant.
        frame_id: geometry frame of what its sensors are fixed to: base_link, or what rocks on it.
        state: block with the outputs pose, planar_pose, spatial_velocity, spatial_acceleration.
        wheel_speeds: input port that takes [right, left] (rad/s): how the wheels are to turn.
        wheel_rates: output port of [right, left] (rad/s): how they turn.
        wheel_angles: output port of [right, left] (rad); see the body's `wheel_angles`.
        twin: its kinematic twin, when there is one.
    """

    name: str
    body: Any
    start: np.ndarray
    drive: Any = None
    on: str = ""
    sensors: dict[str, Choice] = field(default_factory=dict)
    model: Any = None
    frame_id: Any = None
    state: Any = None
    wheel_speeds: Any = None
    wheel_rates: Any = None
    wheel_angles: Any = None
    twin: Any = None


@dataclass
class StationBuilder:
    """What drivers build with.

    Attributes:
        world: what stands around the robots.
        marker_map: the markers as the robots believe them to be.
        true_markers: the markers as they are.
        seed: of all noise.
        sight: `rendered`, `drawn` or `projected`.
        time_step: of the multibody plant, s.
        dynamics: `multibody` or `kinematic`.
        player: the recording that is played back, or None when the station is simulated.
        faults: by the name of the port, what is still to go wrong with it.
        plant: the model of world and robots, finalized when sensors are added.
        scene_graph: its geometry.
        signals: the ports that go into a recording.
        static_messages: topic to (message type, message), written once into a recording.
        mountings: optical frame to (robot, `X_BC`), for /tf_static.
        end_time: time of the last message that is played, s.
        outputs: exported so far, by name.
        carried_markers: on robots, by the robot's name.
        shells: that robots stand on, by the name of who has it.
        pulls: what the magnets of each robot on a shell do: generalized forces for the plant.
        robots: by name.
    """

    world: World
    marker_map: MarkerMap
    true_markers: MarkerMap
    seed: int = 0
    sight: str = "rendered"
    time_step: float = 0.005
    dynamics: str = "multibody"
    player: BagReader | None = None
    faults: dict[str, list[Fault]] = field(default_factory=dict)
    builder: DiagramBuilder = field(default_factory=DiagramBuilder)
    signals: list[Signal] = field(default_factory=list)
    static_messages: dict[str, tuple[str, Any]] = field(default_factory=dict)
    mountings: dict[str, tuple[str, RigidTransform]] = field(default_factory=dict)
    end_time: float = 0.0
    outputs: dict[str, OutputPort] = field(default_factory=dict)
    carried_markers: dict[str, list[PlacedMarker]] = field(default_factory=dict)
    shells: dict[str, Shell] = field(default_factory=dict)
    pulls: list[OutputPort] = field(default_factory=list)
    robots: dict[str, Robot] = field(default_factory=dict)
    plant: MultibodyPlant = field(init=False)
    scene_graph: SceneGraph = field(init=False)

    def __post_init__(self) -> None:
        config = MultibodyPlantConfig(
            time_step=align(self.time_step),
            discrete_contact_approximation="lagged",
            # Sampled ports make each step an unrestricted update, which copies all abstract state.
            use_sampled_output_ports=False,
        )
        if self.dynamics == "multibody":
            self.plant, self.scene_graph = AddMultibodyPlant(config, self.builder)
        else:
            self.scene_graph = self.builder.AddSystem(SceneGraph())
            self.plant = MultibodyPlant(config.time_step)
            self.plant.RegisterAsSourceForSceneGraph(self.scene_graph)
        self.plant.set_name("plant")
        self.scene_graph.set_name("scene_graph")
        self.world.add_models(self)

    @property
    def simulated(self) -> bool:
        """Whether the signals are made here, not played back."""
        return self.player is None

    def add(self, system: System, name: str) -> Any:
        """Adds a block under a name and returns it."""
        system.set_name(name)
        return self.builder.AddSystem(system)

    def connect(self, output: OutputPort, target: InputPort) -> None:
        """Connects two blocks of the station."""
        self.builder.Connect(output, target)

    def export_input(self, port: InputPort, name: str) -> None:
        """Makes a port of a block an input port of the station."""
        self.builder.ExportInput(port, name)

    def export_output(self, port: OutputPort, name: str, signal: Signal | None = None) -> None:
        """Makes a port of a block an output port of the station, recorded if it is a signal."""
        if signal is not None:
            port = self.spoiled(port, signal)
            self.signals.append(signal)
        self.outputs[name] = port
        self.builder.ExportOutput(port, name)

    def spoiled(self, port: OutputPort, signal: Signal) -> OutputPort:
        """Returns the port with the faults that the scenario has for it, or the port itself.

        For what looks at a signal before it is exported; to export it then adds them no more.

        Raises:
            ScenarioError: a kind of fault that such a signal cannot have.
        """
        faults = self.faults.pop(signal.port, [])
        if not faults:
            return port
        try:
            injector = FaultInjector(
                model=signal.model,
                faults=faults,
                rate=signal.rate,
                seed=self.seed,
                name=f"{signal.port}.faults",
            )
        except ValueError as error:
            raise ScenarioError(f"faults of {signal.port}: {error}") from error
        self.add(injector, f"{signal.port}.faults")
        self.connect(port, injector.input_port())
        return injector.output_port()

    def play(self, signal: Signal, optional: bool = False) -> Any:
        """Adds what plays a signal from the recording, and returns its output port.

        Args:
            signal: what is played.
            optional: return None when the recording lacks the topic.

        Raises:
            ScenarioError: the recording lacks the topic.
        """
        assert self.player is not None
        if optional and signal.topic not in self.player.topics():
            return None
        player, last = signal.player(self.player)
        self.end_time = max(self.end_time, last)
        return self.add(player, f"{signal.port}.player").value_output_port()

    def need_renderer(self) -> None:
        """Adds the renderer, once, when a camera needs it.

        Raises:
            ScenarioError: this machine cannot render.
        """
        if self.scene_graph.HasRenderer(RENDERER):
            return
        # Without a display Linux renders through EGL; Drake's default serves the other platforms.
        backend = {"backend": "EGL"} if sys.platform == "linux" else {}
        parameters = RenderEngineVtkParams(lights=daylight(), **backend)
        try:
            self.scene_graph.AddRenderer(RENDERER, MakeRenderEngineVtk(parameters))
        except RuntimeError as error:
            raise ScenarioError(
                f"sight is 'rendered': the renderer does not start ({error}); install the system "
                "packages libegl1 and libgl1-mesa-dri, or use sight=projected"
            ) from error


class Station(Diagram):
    """Robots and world; see the module's docstring for the ports.

    Attributes:
        signals: the ports that go into a recording.
        static_messages: topic to (message type, message), written once into a recording.
        marker_map: the markers as the robots believe them to be.
        plant: the model of world and robots.
        scene_graph: its geometry.
        robots: by name.
        seed: of all noise.
        simulated: whether the signals are made here, not played back.
        shells: that robots stand on, by the name of who has it.
        end_time: when a recording ends, s; infinite for a simulated station.
    """

    def __init__(
        self,
        *,
        world: World,
        robots: dict[str, RobotParameters],
        seed: int = 0,
        sight: str = "rendered",
        time_step: float = 0.005,
        dynamics: str = "multibody",
        player: BagReader | None = None,
    ) -> None:
        """Builds the station.

        Args:
            world: what stands around the robots.
            robots: by name.
            seed: of all noise.
            sight: `rendered`, `drawn` or `projected`.
            time_step: of the multibody plant, s.
            dynamics: `multibody`, or `kinematic` for the robots' kinematic twins.
            player: a recording to play back instead of simulating.

        Raises:
            ValueError: a file, marker or value is refused; one line.
        """
        super().__init__()
        station = StationBuilder(
            world=world,
            marker_map=world.marker_map(),
            true_markers=world.true_markers(seed),
            seed=seed,
            sight=sight,
            time_step=time_step,
            dynamics=dynamics if player is None else "kinematic",
            player=player,
            faults=_faults_by_port(robots),
        )
        bodies = {
            name: Robot(
                name,
                parameters.body.build(**world.resources()),
                parameters.start.pose(),
                parameters.drive.build(),
                getattr(parameters.start, "on", ""),
                parameters.sensors,
            )
            for name, parameters in robots.items()
        }
        station.robots = bodies
        if station.simulated:
            for robot in bodies.values():
                robot.body.add_model(station, robot)
        station.plant.Finalize()
        for name, robot in bodies.items():
            if station.simulated:
                robot.body.add_state(station, robot)
            else:
                robot.body.play_state(station, robot)
            robot.drive.add(station, robot)
            for device, sensor in robots[name].sensors.items():
                sensor.build().add(station, robot, device)
        world.add_blocks(station, list(bodies.values()))
        for port in station.faults:
            known = [signal.port for signal in station.signals]
            raise ScenarioError(f"faults: there is no signal {port}; {nearest(port, known)}")
        station.builder.ExportOutput(
            station.scene_graph.get_query_output_port(), "scene.query_object"
        )
        self.signals = station.signals
        self.static_messages = station.static_messages | _static_transforms(station.mountings)
        self.marker_map = station.marker_map
        self.plant = station.plant
        self.scene_graph = station.scene_graph
        self.robots = bodies
        self.seed = seed
        self.simulated = station.simulated
        self.shells = station.shells
        self.end_time = math.inf if station.simulated else station.end_time
        station.builder.BuildInto(self)
        self.set_name("station")


def _faults_by_port(robots: dict[str, RobotParameters]) -> dict[str, list[Fault]]:
    faults: dict[str, list[Fault]] = {}
    for name, robot in robots.items():
        for fault in robot.faults:
            faults.setdefault(f"{name}.{fault.signal}", []).append(fault)
    return faults


def _static_transforms(
    mountings: dict[str, tuple[str, RigidTransform]],
) -> dict[str, tuple[str, Any]]:
    """Returns the /tf_static message of the cameras' mountings."""
    if not mountings:
        return {}
    transforms = [
        FrameTransform(0.0, f"{robot}/base_link", frame, X_BC)
        for frame, (robot, X_BC) in mountings.items()
    ]
    return {"/tf_static": ("tf2_msgs/msg/TFMessage", transforms_to_ros(transforms))}
