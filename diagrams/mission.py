"""What all missions share: wiring by port names, logs, recording, and what a run asks for."""

from __future__ import annotations

import contextlib
from abc import abstractmethod
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams, Role
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    InputPort,
    OutputPort,
    System,
)
from pydrake.systems.primitives import LogVectorOutput, VectorLogSink

from diagrams.channels import Signal
from diagrams.scenario import Scenario
from diagrams.schema import ScenarioError
from diagrams.station import RobotParameters, Station
from diagrams.world import World
from systems.io.bag import BagReader, BagWriter
from systems.io.recorder import Recorder
from systems.periods import period
from systems.validation import nearest

Array = NDArray[np.float64]

LOG_RATE = 50.0  # Hz
_REPEAT = 1.0  # s; a robot that stands has little to say, and its command changes rarely
FRAME_RATE = 20.0  # Hz, of what Meshcat shows and the replay keeps


class Wiring:
    """A station and the blocks around it, connected by names like `estimator.pose`.

    Args:
        scenario: seed, sight, recording, ...
        world: what stands around the robots.
        robots: by name.
        meshcat: where it is shown, if anywhere.
        frame_rate: at which Meshcat's bodies are moved, Hz; the replay glides in between.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        world: World,
        robots: dict[str, RobotParameters],
        meshcat: Meshcat | None,
        frame_rate: float = FRAME_RATE,
    ) -> None:
        self.builder = DiagramBuilder()
        self._scenario = scenario
        player = BagReader(Path(scenario.recording)) if scenario.recording else None
        self.station: Station = self.builder.AddSystem(
            Station(
                world=world,
                robots=robots,
                seed=scenario.seed,
                sight=scenario.sight,
                time_step=scenario.time_step,
                dynamics=scenario.dynamics,
                player=player,
            )
        )
        self._blocks: dict[str, System] = {}
        self._signals = list(self.station.signals)
        self._sources: dict[str, str] = {}  # of signals that are not the station's
        self._logs: dict[str, VectorLogSink] = {}
        self._watched: dict[str, OutputPort] = {}  # to look one up by name takes a millisecond
        if meshcat is not None:
            parameters = MeshcatVisualizerParams(
                publish_period=period(frame_rate), role=Role.kIllustration, prefix="scene"
            )
            visualizer = MeshcatVisualizer(meshcat, parameters)
            visualizer.set_name("meshcat")
            self.builder.AddSystem(visualizer)
            _look_at(meshcat, world)
            self.builder.Connect(
                self.output("scene.query_object"), visualizer.query_object_input_port()
            )

    def add(self, system: System, name: str) -> Any:
        """Adds a block under a name and returns it."""
        system.set_name(name)
        self._blocks[name] = self.builder.AddSystem(system)
        return system

    def output(self, name: str) -> OutputPort:
        """Returns the output port `{block}.{port}`, or the station's of that name."""
        return self._port(name, "Output")

    def input(self, name: str) -> InputPort:
        """Returns the input port `{block}.{port}`, or the station's of that name."""
        return self._port(name, "Input")

    def has_output(self, name: str) -> bool:
        """Whether there is such an output port."""
        if name in self._watched or self.station.HasOutputPort(name):
            return True
        block, _, port = name.partition(".")
        return block in self._blocks and self._blocks[block].HasOutputPort(port)

    def has_input(self, name: str) -> bool:
        """Whether the station has such an input port."""
        return bool(self.station.HasInputPort(name))

    def has_block(self, name: str) -> bool:
        """Whether a block was added under that name."""
        return name in self._blocks

    def block(self, name: str) -> System:
        """Returns the block that was added under that name."""
        return self._blocks[name]

    def value(self, name: str, context: Context) -> Any:
        """Returns what an output port says, once the diagram is built.

        Args:
            name: as `output` takes it.
            context: of the whole diagram.
        """
        if name not in self._watched:
            self._watched[name] = self.output(name)
        port = self._watched[name]
        return port.Eval(port.get_system().GetMyContextFromRoot(context))

    def connect(self, source: str, target: str) -> None:
        """Connects two ports by name.

        Raises:
            ScenarioError: there is no such port, or they carry different things.
        """
        output, port = self.output(source), self.input(target)
        try:
            self.builder.Connect(output, port)
        except RuntimeError as error:
            raise ScenarioError(f"{source} does not fit {target}: {error}") from error

    def connect_if_wanted(self, source: str, target: str) -> None:
        """Connects two ports if the target block, a user's perhaps, has that input at all."""
        block, _, port = target.partition(".")
        if self._blocks[block].HasInputPort(port):
            self.connect(source, target)

    def log(self, name: str, rate: float = LOG_RATE) -> None:
        """Logs a vector output at `rate` (Hz)."""
        self._logs[name] = LogVectorOutput(self.output(name), self.builder, period(rate))
        self._logs[name].set_name(f"log of {name}")

    def record(self, source: str, signal: Signal) -> None:
        """Puts another output into the recording, as `signal`."""
        self._signals.append(signal)
        self._sources[signal.port] = source

    def add_recorder(self, out: Path | None, *, rate: float | None = None) -> Recorder | None:
        """Adds the recorder of all signals, if the scenario wants a recording.

        A vector that does not change is recorded once a second.

        The recording of an earlier run in the same folder is replaced.

        Args:
            out: folder of the run; None records nothing.
            rate: at which the recorder looks at what is played back, Hz, see `Signal.channel`, and
                at most at all else; by default that of the fastest signal.

        Raises:
            ValueError: the folder cannot be written, or holds the recording that is played.
        """
        wanted = self._scenario.record
        if out is None:
            return None
        played = self._scenario.recording
        if played and Path(played).is_relative_to((out / "bag").resolve()):
            raise ScenarioError(f"--out {out}: holds the recording that is played")
        for name in ("bag_0.mcap", "metadata.yaml"):
            (out / "bag" / name).unlink(missing_ok=True)
        if not wanted.bag:
            with contextlib.suppress(OSError):  # not there, or something else is in it
                (out / "bag").rmdir()
            return None
        signals = [s for s in self._signals if wanted.images or not s.port.endswith(".image")]
        looks = max(signal.rate for signal in signals) if rate is None else rate
        signals = [replace(signal, rate=min(signal.rate, looks)) for signal in signals]
        recorder = self.add(
            Recorder(
                channels=[signal.channel(looks, _REPEAT) for signal in signals],
                writer=BagWriter(out / "bag"),
                static=self.station.static_messages,
            ),
            "recorder",
        )
        for signal in signals:
            self.builder.Connect(
                self.output(self._sources.get(signal.port, signal.port)),
                recorder.GetInputPort(signal.port),
            )
        return recorder

    def build(self, name: str) -> tuple[Diagram, dict[str, VectorLogSink]]:
        """Returns the finished diagram and its logs."""
        diagram = self.builder.Build()
        diagram.set_name(name)
        return diagram, self._logs

    def _port(self, name: str, kind: str) -> Any:
        if getattr(self.station, f"Has{kind}Port")(name):
            return getattr(self.station, f"Get{kind}Port")(name)
        block, _, port = name.partition(".")
        owner = self._blocks.get(block, self.station)
        if block in self._blocks:
            names = _port_names(owner, kind)
            if port in names:
                return getattr(owner, f"Get{kind}Port")(port)
            raise ScenarioError(
                f"{block} ({type(owner).__name__}): has no {kind.lower()} port {port!r}; "
                f"{nearest(port, names)}"
            )
        raise ScenarioError(
            f"the station has no {kind.lower()} port {name!r}; "
            f"{nearest(name, _port_names(self.station, kind))}"
        )


def _look_at(meshcat: Meshcat, world: World) -> None:
    """Points Meshcat's camera at the world, without axes and grid."""
    meshcat.SetCameraPose(*world.view())
    for name in ("/Grid", "/Axes"):
        meshcat.SetProperty(name, "visible", False)


def _port_names(system: System, kind: str) -> list[str]:
    if kind == "Input":
        return [system.get_input_port(i).get_name() for i in range(system.num_input_ports())]
    return [system.get_output_port(i).get_name() for i in range(system.num_output_ports())]


class Mission:
    """A wired diagram and what a run needs to know of it.

    Attributes:
        diagram: the whole.
        station: its station.
        recorder: what writes the recording, if anything does.
        logs: vector logs by the name of the port.
        aligned: whether its blocks were made within `systems.periods.aligned`.
    """

    diagram: Diagram
    station: Station
    recorder: Recorder | None
    logs: dict[str, VectorLogSink]
    aligned: bool = False

    @abstractmethod
    def outcome(self, context: Context) -> str | None:
        """Returns the word for how the run ended, None while it goes on.

        Args:
            context: of the diagram.
        """

    def unfinished(self, context: Context, word: str) -> str:
        """Returns the word for a run whose time was up; `word` unless the mission knows better.

        Args:
            context: of the diagram.
            word: `timeout`, or `played` at the end of a recording.
        """
        del context
        return word

    @abstractmethod
    def succeeded(self, outcome: str) -> bool:
        """Whether that outcome means that the mission was fulfilled."""

    @abstractmethod
    def metrics(self, context: Context) -> dict[str, Any]:
        """Returns the metrics of the report: plain numbers, None where there is nothing to say."""

    @abstractmethod
    def write(self, context: Context, out: Path) -> None:
        """Writes the mission's own results (figures, trajectories) into the run's folder."""

    def log(self, name: str, context: Context) -> tuple[Array, Array]:
        """Returns the times (n,) and values (n, k) of a logged port."""
        log = self.logs[name].FindLog(context)
        return log.sample_times(), log.data().T

    def health(self, context: Context) -> dict[str, dict[str, int]]:
        """Returns what each block dropped, by block, from every output port called health."""
        found: dict[str, dict[str, int]] = {}
        for system in _leaves(self.diagram):
            if "health" in _port_names(system, "Output"):
                port = system.GetOutputPort("health")
                counts = port.Eval(system.GetMyContextFromRoot(context)).counts
                if counts:
                    found[system.get_name()] = dict(counts)
        return found


def _leaves(diagram: Diagram) -> list[System]:
    leaves: list[System] = []
    for system in diagram.GetSystems():
        leaves += _leaves(system) if isinstance(system, Diagram) else [system]
    return leaves
