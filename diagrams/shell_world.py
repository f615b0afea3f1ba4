"""The world of robots that climb robots: a shell that stands or moves, and those on backs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import FrameId
from pydrake.math import RigidTransform
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.primitives import Adder, ConstantValueSource

from diagrams.schema import File, ScenarioError, file_path
from diagrams.world import World
from plants.relative_pose import FramePose
from plants.shell import (
    BODY,
    ShellMotion,
    ShellMotionParameters,
    ShellParameters,
    add_moving_shell,
    add_shell,
)
from plants.shell_surface import add_shell_surface
from systems.drawing import shells as drawing
from systems.markers.layout import MarkerMap, load_map
from systems.shell.layout import check_on_shell, misplaced, shell_markers
from systems.validation import require_non_negative

if TYPE_CHECKING:
    from diagrams.station import Robot, StationBuilder

REFERENCE = "reference"  # name of the shell that carries all others


@dataclass(frozen=True, eq=False)
class Shell:
    """A shell of a station.

    Attributes:
        name: of who has it.
        model: its instance in the plant.
        frame_id: geometry frame of its frame R.
        X_WR: where it is at the start.
        markers: on it, as they are, in R.
    """

    name: str
    model: ModelInstanceIndex
    frame_id: FrameId
    X_WR: RigidTransform
    markers: MarkerMap


@dataclass
class ShellWorldParameters(World):
    """The reference robot, and what all shells are like.

    Attributes:
        shell: radius, mass and friction.
        markers: a marker map's file (bundled, or beside the scenario), in the shell's frame: what
            the robots believe. Left out, the paper's 25 on a shell of this radius.
        placement_tolerance_deg: the seed shifts and turns each marker on the sphere by up to so
            much about each of three axes (see `systems.shell.layout.misplaced`).
        motion: how the reference robot moves; left out, it stands.
        looks: the steel, its holes, the print.
    """

    shell: ShellParameters = field(default_factory=ShellParameters)
    markers: Annotated[str, File("maps")] | None = None
    placement_tolerance_deg: float = 0.0
    motion: ShellMotionParameters | None = None
    looks: drawing.ShellParameters = field(default_factory=drawing.ShellParameters)

    def __post_init__(self) -> None:
        require_non_negative(placement_tolerance_deg=self.placement_tolerance_deg)
        # What is no map names its file itself.
        where = "the paper's markers: " if self.markers is None else ""
        try:
            markers = self.marker_map()
            where = f"marker map {self.markers}: "
            check_on_shell(markers, self.shell.radius)
        except ScenarioError:
            raise
        except ValueError as error:
            raise ValueError(f"{where}{error}") from error

    def resources(self) -> dict[str, Any]:
        """Returns the shell, which a body is made for."""
        return {"shell": self.shell}

    def marker_map(self) -> MarkerMap:
        """Returns the markers of a shell as the robots believe them to be, in its frame."""
        if self.markers is None:
            return shell_markers(radius=self.shell.radius)
        return load_map(file_path(self.markers, "maps"))

    def true_markers(self, seed: int) -> MarkerMap:
        """Returns the markers of a shell as they are; each seed has its own."""
        bound = math.radians(self.placement_tolerance_deg)
        return misplaced(self.marker_map(), bound=bound, seed=seed)

    def view(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns a place beside the reference robot's shell and above, and its middle."""
        r = self.shell.radius
        return r * np.array([2.2, -1.9, 2.0]), np.zeros(3)

    def add_models(self, station: StationBuilder) -> None:
        """Adds the reference robot."""
        plant = station.plant
        add = add_moving_shell if self.motion is not None and station.simulated else add_shell
        model = add(plant, self.shell, REFERENCE, plain=False)
        self.finish_shell(station, REFERENCE, model, RigidTransform(), station.true_markers)

    def finish_shell(
        self,
        station: StationBuilder,
        name: str,
        model: ModelInstanceIndex,
        X_WR: RigidTransform,
        markers: MarkerMap,
    ) -> None:
        """Gives a shell its looks, and makes it known by the name of who has it.

        Args:
            station: its plant is not finalized yet.
            name: of the robot that has it.
            model: its instance in the plant, without looks.
            X_WR: where it is at the start.
            markers: on it, as they are.
        """
        body = station.plant.GetBodyByName(BODY, model)
        add_shell_surface(
            station.plant,
            body,
            radius=self.shell.radius,
            markers=markers,
            parameters=self.looks,
            rendered=station.sight == "rendered",
        )
        frame_id = station.plant.GetBodyFrameIdOrThrow(body.index())
        station.shells[name] = Shell(name, model, frame_id, X_WR, markers)

    def add_blocks(self, station: StationBuilder, robots: list[Robot]) -> None:
        """Moves the reference robot, and lets the magnets pull.

        The motion is known: of a recording it is as it was.
        """
        del robots
        if station.simulated:
            self._add_magnets(station)
        still = ConstantValueSource(AbstractValue.Make(RigidTransform()))
        pose = station.add(
            still if self.motion is None else ShellMotion(parameters=self.motion),
            f"{REFERENCE}.motion",
        )
        if self.motion is not None:
            for name in ("pose", "spatial_velocity"):
                station.export_output(pose.GetOutputPort(name), f"{REFERENCE}.{name}")
        if not station.simulated:  # the plant is a model only: somebody has to say where it is
            shown = station.add(
                FramePose(frame_id=station.shells[REFERENCE].frame_id), f"{REFERENCE}.frame"
            )
            port = "y0" if self.motion is None else "pose"
            station.connect(pose.GetOutputPort(port), shown.pose_input_port())
            station.connect(
                shown.frame_pose_output_port(),
                station.scene_graph.get_source_pose_port(station.plant.get_source_id()),
            )
        elif self.motion is not None:
            model = station.shells[REFERENCE].model
            station.connect(
                pose.GetOutputPort("desired_state"),
                station.plant.get_desired_state_input_port(model),
            )

    def _add_magnets(self, station: StationBuilder) -> None:
        forces = station.plant.get_applied_generalized_force_input_port()
        if len(station.pulls) == 1:
            station.connect(station.pulls[0], forces)
            return
        total = station.add(Adder(len(station.pulls), station.plant.num_velocities()), "magnets")
        for k, pull in enumerate(station.pulls):
            station.connect(pull, total.get_input_port(k))
        station.connect(total.get_output_port(), forces)
