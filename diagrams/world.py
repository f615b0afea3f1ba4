"""What a scenario says of the world around the robots: markers and obstacles."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from diagrams.schema import File, ScenarioError, file_path
from plants.arena import ArenaParameters
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap, load_map
from systems.validation import require, require_non_negative, require_positive


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
class WorldParameters:
    """What stands around the robots.

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

    def true_markers(self) -> MarkerMap:
        """Returns the markers where they are.

        Raises:
            ScenarioError: a marker that was moved is not in the map.
        """
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
