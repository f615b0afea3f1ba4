"""What a scenario says of the world around the robots: what a world is, and the arena."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from diagrams.schema import File, ScenarioError, file_path
from diagrams.surroundings import add_clearance, add_motion, let_wait, show_twins
from plants.arena import ArenaParameters, add_arena
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap, load_map
from systems.validation import require, require_non_negative, require_positive

if TYPE_CHECKING:
    from diagrams.station import Robot, StationBuilder


class World(ABC):
    """What stands around the robots: a station is built in it."""

    @abstractmethod
    def marker_map(self) -> MarkerMap:
        """Returns the markers as the robots believe them to be."""

    @abstractmethod
    def true_markers(self, seed: int) -> MarkerMap:
        """Returns the markers as they are.

        Args:
            seed: of the scenario.
        """

    @abstractmethod
    def view(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns where Meshcat's camera is and what it looks at, (3,) m each."""

    @abstractmethod
    def add_models(self, station: StationBuilder) -> None:
        """Adds what stands around to the plant, before any robot."""

    @abstractmethod
    def add_blocks(self, station: StationBuilder, robots: list[Robot]) -> None:
        """Adds what moves in the world, and the truth about robots in it.

        Args:
            station: its plant is finalized, its robots have their devices.
            robots: all of them.
        """

    def resources(self) -> dict[str, Any]:
        """Returns what the bodies of robots take from the world, by the argument's name."""
        return {}


@dataclass
class TagPlacement:
    """One marker of a scenario's own list.

    Attributes:
        id: in the family.
        position: [x, y, z] of its centre, m.
        facing_deg: direction that the printed face looks to, in the ground plane; 0 is along x.
        size: side of the black square, m; 0 takes the list's.
    """

    id: int
    position: list[float]
    facing_deg: float
    size: float = 0.0

    def __post_init__(self) -> None:
        require(
            len(self.position) == 3 and bool(np.isfinite(self.position).all()),
            "position",
            self.position,
            "[x, y, z] in metres",
        )
        require(math.isfinite(self.facing_deg), "facing_deg", self.facing_deg, "finite")
        require_non_negative(size=self.size)


@dataclass
class TagList:
    """Upright markers written in the scenario itself, instead of a marker map's file.

    Attributes:
        family: of all markers.
        size: side of the black square, m.
        tags: where they are.
    """

    family: str
    size: float
    tags: list[TagPlacement]

    def __post_init__(self) -> None:
        require_positive(size=self.size)
        self.to_map()

    def to_map(self) -> MarkerMap:
        """Returns the marker map.

        Raises:
            ValueError: unknown family, an id twice or outside the family.
        """
        kind = family(self.family)
        markers: dict[int, Marker] = {}
        for tag in self.tags:
            kind.check_id(tag.id)
            require(tag.id not in markers, "id", tag.id, "given once")
            R = RollPitchYaw(0.0, 0.0, math.radians(tag.facing_deg))
            markers[tag.id] = Marker(tag.id, RigidTransform(R, tag.position), tag.size or self.size)
        return MarkerMap(kind, self.size, markers)


@dataclass
class MovedMarker:
    """A marker that hangs elsewhere than the map says.

    Attributes:
        id: of the marker.
        by: [x, y, z] from where the map has it, m.
    """

    id: int
    by: list[float]

    def __post_init__(self) -> None:
        require(
            len(self.by) == 3 and bool(np.isfinite(self.by).all()), "by", self.by, "three numbers"
        )


@dataclass
class WorldParameters(World):
    """An arena: a flat ground with obstacles and upright markers.

    In a scenario it may come from the seed instead: see `diagrams.random_world`.

    Attributes:
        markers: a marker map's file (bundled, or beside the scenario), or the markers themselves:
            what the robots believe.
        arena: ground and obstacles.
        moved_markers: where the markers are not where the robots believe them to be.
    """

    markers: Annotated[str, File("maps")] | TagList
    arena: ArenaParameters = field(default_factory=ArenaParameters)
    moved_markers: list[MovedMarker] = field(default_factory=list)

    def marker_map(self) -> MarkerMap:
        """Returns the marker map that the robots have."""
        if isinstance(self.markers, TagList):
            return self.markers.to_map()
        return load_map(file_path(self.markers, "maps"))

    def true_markers(self, seed: int = 0) -> MarkerMap:
        """Returns the markers where they are.

        Raises:
            ScenarioError: a marker that was moved is not in the map.
        """
        del seed
        believed = self.marker_map()
        markers = dict(believed.markers)
        for moved in self.moved_markers:
            if moved.id not in markers:
                known = ", ".join(map(str, markers))
                raise ScenarioError(f"moved_markers: {moved.id} is not in the map; known: {known}")
            marker = markers[moved.id]
            shift = RigidTransform([float(d) for d in moved.by])
            markers[moved.id] = replace(marker, X_WM=shift @ marker.X_WM)
        return replace(believed, markers=markers)

    def view(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns a place to the south of walls or markers and above, and their middle."""
        ends = np.array([e for wall in self.arena.walls for e in (wall.start, wall.end)])
        if len(ends) == 0:  # in the open the markers say where it is
            ends = np.array([tag.X_WM.translation()[:2] for tag in self.marker_map()])
        if len(ends) < 2:
            ends = np.array([[-1.0, -1.0], [1.0, 1.0]])
        middle, extent = (ends.max(axis=0) + ends.min(axis=0)) / 2, np.ptp(ends, axis=0).max()
        eye = np.array([middle[0], middle[1] - 0.55 * extent, 0.75 * extent])
        return eye, np.array([*middle, 0.0])

    def add_models(self, station: StationBuilder) -> None:
        """Adds ground, obstacles and marker boards."""
        add_arena(station.plant, self.arena, station.true_markers)

    def add_blocks(self, station: StationBuilder, robots: list[Robot]) -> None:
        """Adds moving obstacles, the truth about clearance and contacts, and kinematic twins."""
        moving = add_motion(station, self.arena, len(robots) if station.simulated else 0)
        for robot in robots:
            add_clearance(station, self.arena, robot, moving)
        if station.simulated:
            let_wait(station, self.arena, robots)
        if station.dynamics == "kinematic" and station.plant.num_positions() > 0:
            show_twins(station, self.arena, robots if station.simulated else [])
