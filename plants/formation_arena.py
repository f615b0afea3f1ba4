"""Random cluttered arenas that a formation of four can cross, and known obstacles from any arena.

First a hidden way is drawn: a walk of triangles through random stops, so that it winds. Then
obstacles are dropped wherever they leave it free, with the room that the robots need and the lines
of sight between them. So there is a way by construction, and no planner has a say in it. All
lengths are whole millimetres and all angles tenths of a degree, as a person would write them.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from plants.arena import ArenaParameters
from plants.obstacles import BoxObstacle, CylinderObstacle, Wall
from plants.planar_shapes import PlanarShapes
from systems.noise import generator, stream_key
from systems.planners.formation_ground import FormationParameters
from systems.planners.formation_lattice import (
    Triangle,
    TriangleLattice,
    Vertex,
    mirrored,
    sides_of,
)
from systems.planners.formation_obstacles import Obstacles
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

_DRAWS = 100  # ways, until the parameters are given up
_TRIES = 20  # places for one obstacle, until it is left out
_THICKNESS = 0.05  # m, of the walls


@dataclass
class FormationArenaParameters:
    """What kind of arena is drawn.

    Attributes:
        size: [along x, along y] of the room between its walls, about the origin, m.
        obstacles: number of boxes and cylinders at most; one that finds no place is left out.
        cylinder_share: part of the obstacles that are cylinders.
        box_side: [least, greatest] length and width of a box, m.
        radius: [least, greatest] radius of a cylinder, m.
        height: of walls and obstacles, m; above the cameras they hide what is behind them.
        stops: number of places that the hidden way passes before the destination.
        distance: least straight distance from the formation's start to the destination, m.
        slack: how much wider the hidden way is than the robots need, on either side, m: for those
            that do not know the obstacles, but only hear about where they are.
    """

    size: list[float] = field(default_factory=lambda: [18.0, 14.0])
    obstacles: int = 60
    cylinder_share: float = 0.4
    box_side: list[float] = field(default_factory=lambda: [0.4, 1.6])
    radius: list[float] = field(default_factory=lambda: [0.15, 0.4])
    height: float = 0.5
    stops: int = 2
    distance: float = 8.0
    slack: float = 0.0

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
        require(self.stops >= 0, "stops", self.stops, "0 or greater")
        require_positive(height=self.height, distance=self.distance)
        require_non_negative(slack=self.slack)


@dataclass(frozen=True)
class FormationArena:
    """An arena that was drawn.

    Attributes:
        arena: walls and obstacles.
        start: (4, 2) m, where the robots stand.
        destination: (2,) m.
        way: (n, 3, 2) m, the triangles of the hidden way; the robots start at the corners of the
            first two, and the last has a corner at the destination.
    """

    arena: ArenaParameters
    start: Array
    destination: Array
    way: Array


def formation_arena(
    seed: int,
    parameters: FormationArenaParameters | None = None,
    *,
    formation: FormationParameters | None = None,
) -> FormationArena:
    """Draws an arena that a formation of four robots can cross.

    Args:
        seed: any integer.
        parameters: what kind of arena.
        formation: the triangles' side and the room that the robots need.

    Raises:
        ValueError: the room is too small for such a way.
    """
    p, f = parameters or FormationArenaParameters(), formation or FormationParameters()
    key = stream_key(seed, "formation arena")
    for draw in range(_DRAWS):
        random = generator(key, draw)
        heading = round(float(random.uniform(-180, 180)), 1)
        origin = tuple(round(float(v), 3) for v in random.uniform(-f.side / 2, f.side / 2, 2))
        lattice = TriangleLattice((origin[0], origin[1]), math.radians(heading), f.side)
        way = _draw_way(random, lattice, p, f)
        if way is not None:
            arena = _draw_arena(random, _kept_free(way, lattice, f, p.slack), p)
            first = [*sorted(way[0]), *(way[1] - way[0])]
            places = np.array([lattice.positions(np.array(sorted(t))) for t in way])
            (last,) = way[-1] - way[-2]
            start = lattice.positions(np.array(first))
            return FormationArena(arena, start, lattice.positions(np.array(last)), places)
    raise ValueError(
        f"formation arena: a room of {p.size} m has no way over {p.distance} m for triangles of "
        f"{f.side} m: ask for less"
    )


def known_obstacles(arena: ArenaParameters, stamp: float = 0.0) -> Obstacles:
    """Returns what stands still in an arena, as a formation's planner takes it.

    Args:
        arena: the arena.
        stamp: when this is known, s.
    """
    circles = [[*cylinder.position, cylinder.radius] for cylinder in arena.cylinders]
    polygons = [box.footprint().corners()[0] for box in (*arena.walls, *arena.boxes)]
    return Obstacles(
        stamp=stamp,
        frame_id="map",
        circles=np.array(circles, float).reshape(-1, 3),
        polygons=np.array(polygons, float).reshape(-1, 4, 2),
    )


def _draw_way(
    random: np.random.Generator,
    lattice: TriangleLattice,
    p: FormationArenaParameters,
    f: FormationParameters,
) -> list[Triangle] | None:
    """Draws the walk of triangles; None when it is too short or meets itself badly."""
    half = np.array(p.size) / 2 - f.room - f.beyond - p.slack
    reach = int(np.hypot(*half) / f.side * 2) + 2
    span = np.arange(-reach, reach + 1)
    grid = np.stack(np.meshgrid(span, span, indexing="ij"), axis=-1).reshape(-1, 2)
    inside = (np.abs(lattice.positions(grid)) <= half).all(axis=1)
    vertices = {(int(i), int(j)) for i, j in grid[inside]}
    if len(vertices) < 4:
        return None
    names = sorted(vertices)
    way: list[Triangle] = []
    for _ in range(p.stops + 1):
        goal = names[random.integers(len(names))]
        if not way:
            first = _any_triangle(names[random.integers(len(names))], vertices)
            if first is None:
                return None
            way = [first]
        leg = _shortest_way(way, goal, vertices)
        if leg is None:
            return None
        way += leg
    if len(way) < 3:
        return None
    (last,) = way[-1] - way[-2]
    start = lattice.positions(np.array([*(way[0] | way[1])])).mean(axis=0)
    far = float(np.hypot(*(lattice.positions(np.array(last)) - start)))
    return way if far >= p.distance else None


def _any_triangle(vertex: Vertex, vertices: set[Vertex]) -> Triangle | None:
    i, j = vertex
    triangle = frozenset({(i, j), (i + 1, j), (i, j + 1)})
    return triangle if triangle <= vertices else None


def _shortest_way(
    way: list[Triangle], goal: Vertex, vertices: set[Vertex]
) -> list[Triangle] | None:
    """Returns the triangles after the last one up to one with that corner, never straight back."""
    before: Triangle = way[-2] if len(way) > 1 else frozenset()
    first = (before, way[-1])
    parents: dict[tuple[Triangle, Triangle], tuple[Triangle, Triangle] | None] = {first: None}
    queue = deque([first])
    while queue:
        state = queue.popleft()
        if goal in state[1]:
            leg: list[Triangle] = []
            step: tuple[Triangle, Triangle] | None = state
            while step is not None and step != first:
                leg.append(step[1])
                step = parents[step]
            return leg[::-1]
        for p, q, r in sides_of(state[1]):
            new = mirrored(r, p, q)
            following = (state[1], frozenset({p, q, new}))
            if new in vertices and following[1] != state[0] and following not in parents:
                parents[following] = state
                queue.append(following)
    return None


def _kept_free(
    way: list[Triangle], lattice: TriangleLattice, f: FormationParameters, slack: float
) -> PlanarShapes:
    """Returns the ground that the robots need on the way, and the lines along which they look."""
    lines: set[tuple[tuple[float, float], tuple[float, float], float]] = set()
    for a, b in pairwise(way):
        p, q = sorted(a & b)
        middle = _half(p, q)
        lines |= {(end, middle, f.room) for end in sorted(a - b)}
        lines |= {(_past(middle, end, f), middle, f.room) for end in sorted(b - a)}
        lines |= {(x, y, f.sight_margin) for x in sorted(a | b) for y in sorted(a | b) if x < y}
    for a, b, c in zip(way, way[1:], way[2:], strict=False):
        (p, q), (r, s) = sorted(a & b), sorted(b & c)
        lines.add((_half(p, q), _half(r, s), f.room))
    ordered = sorted(lines)
    line_ends = lattice.positions(np.array([[a, b] for a, b, _ in ordered]))
    along = line_ends[:, 1] - line_ends[:, 0]
    lengths = np.hypot(*along.T)
    return PlanarShapes(
        centres=line_ends.mean(axis=1),
        headings=np.arctan2(along[:, 1], along[:, 0]),
        sizes=np.stack([lengths, np.zeros_like(lengths)], axis=1),
        radii=[width + slack for _, _, width in ordered],
    )


def _past(
    middle: tuple[float, float], vertex: Vertex, f: FormationParameters
) -> tuple[float, float]:
    """Returns how far the robot goes that settles on a vertex, on the lattice."""
    share = f.beyond / (math.sqrt(0.75) * f.side)
    return (
        vertex[0] + share * (vertex[0] - middle[0]),
        vertex[1] + share * (vertex[1] - middle[1]),
    )


def _half(p: Vertex, q: Vertex) -> tuple[float, float]:
    return (p[0] + q[0]) / 2, (p[1] + q[1]) / 2


def _draw_arena(
    random: np.random.Generator, free: PlanarShapes, p: FormationArenaParameters
) -> ArenaParameters:
    x, y = (round((side + _THICKNESS) / 2, 3) for side in p.size)
    corners = [[-x, -y], [x, -y], [x, y], [-x, y]]
    walls = [
        Wall(corners[k], corners[(k + 1) % 4], thickness=_THICKNESS, height=p.height)
        for k in range(4)
    ]
    arena = ArenaParameters(walls=walls, ground=round(max(p.size) + 1.0, 3))
    for _ in range(p.obstacles):
        cylinder = random.random() < p.cylinder_share
        for _ in range(_TRIES):
            obstacle = _draw_obstacle(random, p, cylinder=cylinder)
            # A millimetre more than is needed, as the place is rounded.
            if obstacle.footprint().distances(free).min() >= 1e-3:
                (arena.cylinders if cylinder else arena.boxes).append(obstacle)  # type: ignore[arg-type]
                break
    return arena


def _draw_obstacle(
    random: np.random.Generator, p: FormationArenaParameters, *, cylinder: bool
) -> CylinderObstacle | BoxObstacle:
    position = [round(float(random.uniform(-side / 2, side / 2)), 3) for side in p.size]
    if cylinder:
        radius = round(float(random.uniform(p.radius[0], p.radius[1])), 3)
        return CylinderObstacle(position, radius, p.height)
    size = [round(float(side), 3) for side in random.uniform(p.box_side[0], p.box_side[1], 2)]
    return BoxObstacle(position, [*size, p.height], round(float(random.uniform(-90, 90)), 1))
