"""Random arenas: a walled room with obstacles and markers, a start, and waypoints within reach.

What is drawn is looked at on a fine grid: a cell is free when nothing stands within half of the
passage that the robot is to have, and the start and all waypoints lie in one connected region of
free cells. So there is a way of that width for every leg. A room that has none is drawn again; the
seed says which random numbers come next, so one seed always ends with the same arena. All lengths
are whole millimetres and all angles tenths of a degree, as a person would write them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from plants.arena import ArenaParameters
from plants.obstacles import BoxObstacle, CylinderObstacle, Wall
from plants.planar_shapes import PlanarShapes
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap
from systems.noise import generator, stream_key
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

_CELL = 0.02  # m
_DRAWS = 200  # rooms, until the parameters are given up
_TRIES = 50  # places for one obstacle, until the room is given up
_GAP = 0.1  # m, at least, between two obstacles, or an obstacle and a wall
_THICKNESS = 0.05  # m, of the walls
_BEFORE = 0.006  # m from what carries a marker to the marker, whose board is 3.5 mm thick
_VIEW = 0.2  # m, free ground before a marker: nearer to something it would be hidden


@dataclass
class RandomArenaParameters:
    """What kind of room is drawn.

    Attributes:
        size: [along x, along y] of the room between its walls, about the origin, m.
        obstacles: number of boxes and cylinders.
        cylinder_share: part of the obstacles that are cylinders.
        box_side: [least, greatest] length and width of a box, m.
        radius: [least, greatest] radius of a cylinder, m.
        height: of walls and obstacles, m.
        waypoints: number of waypoints.
        leg: least straight distance from the start, or a waypoint, to the next, m.
        passage: width of the way that there is for every leg, m.
        family: of the markers, on the walls and on the boxes' faces.
        marker_size: side of the black squares, m.
        marker_spacing: distance of markers along a wall, about, m.
        marker_height: of the markers' centres, m.
    """

    size: list[float] = field(default_factory=lambda: [6.0, 5.0])
    obstacles: int = 10
    cylinder_share: float = 0.4
    box_side: list[float] = field(default_factory=lambda: [0.25, 0.7])
    radius: list[float] = field(default_factory=lambda: [0.08, 0.25])
    height: float = 0.5
    waypoints: int = 3
    leg: float = 2.0
    passage: float = 0.6
    family: str = "DICT_4X4_100"
    marker_size: float = 0.15
    marker_spacing: float = 0.8
    marker_height: float = 0.25

    def __post_init__(self) -> None:
        for name in ("size", "box_side", "radius"):
            value = getattr(self, name)
            fits = len(value) == 2 and all(math.isfinite(v) and v > 0 for v in value)
            require(fits, name, value, "two numbers greater than 0")
        for name in ("box_side", "radius"):
            low, high = getattr(self, name)
            require(low <= high, name, [low, high], "[least, greatest]")
        require(self.obstacles >= 0, "obstacles", self.obstacles, "0 or greater")
        require(0 <= self.cylinder_share <= 1, "cylinder_share", self.cylinder_share, "0 to 1")
        require(self.waypoints >= 1, "waypoints", self.waypoints, "1 or greater")
        require_non_negative(leg=self.leg)
        require_positive(
            passage=self.passage, marker_size=self.marker_size, marker_spacing=self.marker_spacing
        )
        half = self.board() / 2
        low, high = half, self.height - half
        require(
            low <= self.marker_height <= high,
            "marker_height",
            self.marker_height,
            f"from {low:.3g} to {high:.3g} m, for the whole board to be on the wall",
        )

    def board(self) -> float:
        """Returns the side of a marker's board, with its white rim, m."""
        cells = family(self.family).cells
        return self.marker_size * (cells + 2) / cells


@dataclass(frozen=True)
class RandomArena:
    """A room that was drawn.

    Attributes:
        arena: walls and obstacles.
        markers: the markers on them.
        start: (3,) where a robot starts: [x (m), y (m), theta (rad)].
        waypoints: (n, 2) m.
    """

    arena: ArenaParameters
    markers: MarkerMap
    start: Array
    waypoints: Array


def random_arena(seed: int, parameters: RandomArenaParameters | None = None) -> RandomArena:
    """Draws a room whose every leg has a way of at least `passage`.

    Args:
        seed: any integer.
        parameters: what kind of room.

    Raises:
        ValueError: there is no such room among many, or the family has too few markers for it.
    """
    p = parameters or RandomArenaParameters()
    key = stream_key(seed, "random arena")
    for draw in range(_DRAWS):
        random = generator(key, draw)
        arena = _draw_arena(random, p)
        if arena is None:
            continue
        stops = _draw_stops(random, arena, p)
        if stops is None:
            continue
        heading = math.radians(float(random.integers(-180, 180)))
        return RandomArena(arena, _markers(arena, p), np.array([*stops[0], heading]), stops[1:])
    raise ValueError(
        f"random arena: none of {_DRAWS} rooms of {p.size} m with {p.obstacles} obstacles has "
        f"{p.waypoints} legs of {p.leg} m with a passage of {p.passage} m: ask for less"
    )


def free_regions(
    arena: ArenaParameters, size: list[float], passage: float
) -> tuple[Array, Array, NDArray[np.int32]]:
    """Returns where the middle of a passage can be, in connected regions.

    Every point of the straight lines between free neighbours, in x or y, is at least half a passage
    from all that stands still.

    Args:
        arena: the arena.
        size: of the room about the origin, m.
        passage: m.

    Returns:
        x (n,) and y (m,) of the grid's cells, m, and (m, n) the number of each cell's region; 0
        where it is not free.
    """
    cells = [int(side / 2 / _CELL) for side in size]
    x, y = (np.arange(-n, n + 1) * np.float64(_CELL) for n in cells)
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    distance = arena.footprints().distances_from(points).min(axis=0)
    free = (distance >= passage / 2 + _CELL / 2).reshape(len(y), len(x))
    _, regions = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
    return x, y, np.asarray(regions, np.int32)


def _draw_arena(random: np.random.Generator, p: RandomArenaParameters) -> ArenaParameters | None:
    """Draws obstacles into the room; None when there was no place for one of them."""
    arena = ArenaParameters(walls=_walls(p), ground=round(max(p.size) + 1.0, 3))
    covered = arena.footprints()
    cylinders = round(p.cylinder_share * p.obstacles)
    for k in range(p.obstacles):
        for _ in range(_TRIES):
            obstacle = _draw_obstacle(random, p, cylinder=k < cylinders)
            place = obstacle.footprint()
            if place.distances(covered).min() >= _GAP:
                break
        else:
            return None
        (arena.cylinders if k < cylinders else arena.boxes).append(obstacle)  # type: ignore[arg-type]
        covered = PlanarShapes.joined([covered, place])
    return arena


def _draw_obstacle(
    random: np.random.Generator, p: RandomArenaParameters, *, cylinder: bool
) -> CylinderObstacle | BoxObstacle:
    position = [_rounded(random.uniform(-side / 2, side / 2)) for side in p.size]
    if cylinder:
        return CylinderObstacle(
            position, _rounded(random.uniform(p.radius[0], p.radius[1])), p.height
        )
    size = [_rounded(side) for side in random.uniform(p.box_side[0], p.box_side[1], 2)]
    return BoxObstacle(position, [*size, p.height], round(float(random.uniform(-90, 90)), 1))


def _walls(p: RandomArenaParameters) -> list[Wall]:
    """Returns four walls around the room, counterclockwise, closed at the corners."""
    x, y = (_rounded((side + _THICKNESS) / 2) for side in p.size)
    corners = [[-x, -y], [x, -y], [x, y], [-x, y]]
    return [
        Wall(corners[k], corners[(k + 1) % 4], thickness=_THICKNESS, height=p.height)
        for k in range(4)
    ]


def _draw_stops(
    random: np.random.Generator, arena: ArenaParameters, p: RandomArenaParameters
) -> Array | None:
    """Draws the start and the waypoints, (1 + n, 2) m; None when they do not find room."""
    x, y, regions = free_regions(arena, p.size, p.passage)
    if regions.max() == 0:
        return None
    largest = 1 + np.argmax(np.bincount(regions.ravel())[1:])
    rows, columns = np.nonzero(regions == largest)
    places = np.column_stack([x[columns], y[rows]]).round(3)
    stops: list[Array] = []
    choice = places
    for _ in range(1 + p.waypoints):
        if stops:
            choice = places[np.linalg.norm(places - stops[-1], axis=1) >= p.leg]
        if len(choice) == 0:
            return None
        stops.append(choice[random.integers(len(choice))])
    return np.array(stops)


def _markers(arena: ArenaParameters, p: RandomArenaParameters) -> MarkerMap:
    """Puts markers along the walls and on the boxes' faces, where something can look at them."""
    covered = arena.footprints()
    poses = []
    for wall in arena.walls:
        inside = wall.length - 2 * _THICKNESS
        count = max(1, math.floor(inside / p.marker_spacing))
        along = (np.arange(count) + 0.5) / count * inside - inside / 2
        poses += [_face(wall.centre, wall.heading, t, _THICKNESS / 2) for t in along]
    for box in arena.boxes:
        length, width, _ = box.size
        for turn in range(4):
            broad, deep = (length, width) if turn % 2 == 0 else (width, length)
            if broad >= p.board():
                poses.append(_face(box.centre, box.heading + turn * math.pi / 2, 0.0, deep / 2))
    markers: dict[int, Marker] = {}
    kind = family(p.family)
    for x, y, facing in poses:
        view = np.array([[x + _VIEW * math.cos(facing), y + _VIEW * math.sin(facing)]])
        # What carries the marker is `_VIEW` away; whatever is nearer stands in the way.
        if covered.distances_from(view).min() < _VIEW - _BEFORE:
            continue
        place = RigidTransform(RollPitchYaw(0.0, 0.0, facing), [x, y, p.marker_height])
        markers[len(markers)] = Marker(len(markers), place, p.marker_size)
    if len(markers) > kind.count:
        raise ValueError(
            f"random arena: {len(markers)} markers, and {kind.name} has {kind.count}: take another "
            "family or a larger marker_spacing"
        )
    return MarkerMap(kind, p.marker_size, markers)


def _face(centre: Array, heading: float, along: float, deep: float) -> tuple[float, float, float]:
    """Returns x, y (m) and facing (rad) of a marker on the left side of what has this heading."""
    left = deep + _BEFORE
    x = centre[0] + along * math.cos(heading) - left * math.sin(heading)
    y = centre[1] + along * math.sin(heading) + left * math.cos(heading)
    facing = math.remainder(heading + math.pi / 2, 2 * math.pi)
    return _rounded(x), _rounded(y), facing


def _rounded(length: float) -> float:
    return round(float(length), 3)
