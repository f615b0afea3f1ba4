"""What Meshcat shows of how the robot sees its surroundings: scan, sectors, path, occupancy grid.

The replay keeps transforms and properties, not changes of shape. So everything is drawn with pools
of small objects that are moved; what is not needed is hidden.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import Box, Cylinder, Meshcat, Rgba, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import Context, InputPort, LeafSystem

from systems.angles import spatial_pose, wrap
from systems.messages import AvoiderState, OccupancyGrid, Path, Scan
from systems.periods import period
from systems.scans import hits, scan_points

Array = NDArray[np.float64]

_ROOT = "view"
_POINTS = 90  # of a scan
_SCAN_HEIGHT = 0.13  # m
_DOTS, _DOT_STEP = 80, 0.12  # of the planned path, and m between two
_RING = 0.30  # m, radius of the circle of sectors
_CELL = 0.10  # m, side of a drawn cell of the grid
_OCCUPIED = math.log(0.7 / 0.3)  # log-odds from which a cell is drawn
_GRID_PERIOD = 1.0  # s between two looks at the grid
_AWAY = RigidTransform([0.0, 0.0, -10.0])


class _Pool:
    """Equal objects, each shown or not, each with a place; only what changes is sent.

    The replay lets an object glide from one place to the next, however long it stood. With `jumps`
    it is held where it was up to the frame before it moves.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        name: str,
        count: int,
        shape: Shape,
        colour: Rgba,
        *,
        frame: float,
        jumps: bool = False,
    ) -> None:
        self._meshcat = meshcat
        self._jumps = jumps
        self._frame = frame  # s between two pictures
        self._names = [f"{_ROOT}/{name}/{k}" for k in range(count)]
        self._places = np.full((count, 4), np.nan)  # x, y, z (m), yaw (rad)
        self._poses = [_AWAY] * count
        self._set_at = np.zeros(count)
        self._visible = np.zeros(count, bool)
        for path in self._names:
            meshcat.SetObject(path, shape, colour)
            meshcat.SetProperty(path, "visible", False, 0.0)

    def __len__(self) -> int:
        return len(self._names)

    def show(self, places: Array, t: float) -> None:
        """Puts each object at its place and hides those that have none.

        Args:
            places: (n, 4) [x (m), y (m), z (m), yaw (rad)] of the first n objects, in the frame
                of the pool; NaN for one that is not to be seen.
            t: time of the simulation, s.
        """
        t = (round(t / self._frame) + 0.25) * self._frame  # frames are counted down from t
        places = places[: len(self)]
        wanted = np.zeros(len(self), bool)
        wanted[: len(places)] = np.isfinite(places[:, 0])
        moved = np.nonzero((self._places[: len(places)] != places).any(axis=1))[0]
        for k in moved[wanted[moved]]:
            *xyz, yaw = places[k]
            if self._jumps and self._visible[k] and t - self._set_at[k] > 1.5 * self._frame:
                self._meshcat.SetTransform(self._names[k], self._poses[k], t - self._frame)
            pose = RigidTransform(RollPitchYaw(0.0, 0.0, yaw), xyz)
            self._meshcat.SetTransform(self._names[k], pose, t)
            self._places[k], self._poses[k], self._set_at[k] = places[k], pose, t
        for k in np.nonzero(wanted != self._visible)[0]:
            if not wanted[k]:  # lest it glides to where it is seen next
                self._meshcat.SetTransform(self._names[k], self._poses[k], t)
            self._meshcat.SetProperty(self._names[k], "visible", bool(wanted[k]), t)
        self._visible = wanted


def along(points: Array, step: float) -> Array:
    """Returns points every `step` (m) along a polyline (n, 2), from its start: (k, 2)."""
    if len(points) < 2:
        return points
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(lengths)])
    wanted = np.arange(0.0, distance[-1], step)
    return np.stack([np.interp(wanted, distance, points[:, k]) for k in range(2)], axis=1)


def occupied_cells(grid: OccupancyGrid, cell: float) -> NDArray[np.int64]:
    """Returns the drawn cells, of side `cell` (m), that hold an occupied one: (k, 2) int64.

    Cell (i, j) reaches from (i, j) to (i + 1, j + 1) times `cell`, in the grid's frame.
    """
    rows, columns = np.nonzero(grid.log_odds > _OCCUPIED)
    if len(rows) == 0:
        return np.zeros((0, 2), np.int64)
    middles = grid.origin + grid.resolution * (np.stack([columns, rows], axis=1) + 0.5)
    return np.unique(np.floor(middles / cell).astype(np.int64), axis=0)


class SurroundingsViewer(LeafSystem):
    """Shows scan points, sectors and chosen direction, the planned path and the occupancy grid.

    .. pydrake_system::

        name: SurroundingsViewer
        input_ports:
        - pose
        - scan
        - state
        - path
        - grid

    Args:
        meshcat: where.
        lidar_pose: (3,) [x (m), y (m), yaw (rad)] of the lidar in the body.
        rate: pictures a second, Hz.

    Ports:
        pose (input, vector of 3): [x (m), y (m), theta (rad)] in map, the estimate; scan points
            are drawn from it, as the robot believes them to be.
        scan (input, Scan): black balls.
        state (input, AvoiderState): a ring of red blocks, one for each sector that may not be
            chosen, and a green pointer in the chosen direction. May be left unconnected.
        path (input, Path): blue discs. May be left unconnected.
        grid (input, OccupancyGrid): dark tiles where it is occupied. May be left unconnected.

    A sink: it draws in publish events and influences nothing.
    """

    def __init__(self, *, meshcat: Meshcat, lidar_pose: Array, rate: float) -> None:
        super().__init__()
        self._meshcat = meshcat
        self._lidar_pose = np.array(lidar_pose, float)
        self._pose_input = self.DeclareVectorInputPort("pose", 3)
        inputs = {"scan": Scan(), "state": AvoiderState(), "path": Path(), "grid": OccupancyGrid()}
        self._inputs = {
            name: self.DeclareAbstractInputPort(name, AbstractValue.Make(model))
            for name, model in inputs.items()
        }
        self._frame = 1.0 / rate
        self._scan = self._pool("scan", _POINTS, Sphere(0.012), Rgba(0.05, 0.05, 0.05, 1.0))
        disc = Cylinder(0.018, 0.004)
        self._path = self._pool("planned path", _DOTS, disc, Rgba(0.1, 0.3, 0.9, 1.0), jumps=True)
        self._sectors: _Pool | None = None
        # What the browser holds, not the diagram: the stamps of what was drawn, the tiles.
        self._drawn = dict.fromkeys(inputs, math.nan)
        self._tiles: dict[tuple[int, int], bool] = {}
        self._draw_pointer()
        self.DeclarePeriodicPublishEvent(period(rate), 0.0, self._draw)

    def pose_input_port(self) -> InputPort:
        """Returns the port of the estimated pose."""
        return self._pose_input

    def scan_input_port(self) -> InputPort:
        """Returns the port of the lidar's scans."""
        return self._inputs["scan"]

    def state_input_port(self) -> InputPort:
        """Returns the port of what the avoider sees."""
        return self._inputs["state"]

    def path_input_port(self) -> InputPort:
        """Returns the port of the planned path."""
        return self._inputs["path"]

    def grid_input_port(self) -> InputPort:
        """Returns the port of the occupancy grid."""
        return self._inputs["grid"]

    def _pool(
        self, name: str, count: int, shape: Shape, colour: Rgba, jumps: bool = False
    ) -> _Pool:
        return _Pool(self._meshcat, name, count, shape, colour, frame=self._frame, jumps=jumps)

    def _draw_pointer(self) -> None:
        name = f"{_ROOT}/direction/pointer"
        self._meshcat.SetObject(name, Cylinder(0.008, 0.2), Rgba(0.1, 0.6, 0.2, 1.0))
        turned = RollPitchYaw(0.0, math.pi / 2, 0.0)
        self._meshcat.SetTransform(name, RigidTransform(turned, [_RING + 0.1, 0.0, _SCAN_HEIGHT]))
        self._meshcat.SetTransform(f"{_ROOT}/direction", _AWAY)

    def _new(self, name: str, context: Context, period: float = 0.0) -> object | None:
        """Returns the message on a port if it is another one than that drawn last."""
        port = self._inputs[name]
        if not port.HasValue(context):
            return None
        message = port.Eval(context)
        stamp, drawn = message.stamp, self._drawn[name]
        if math.isnan(stamp) or stamp < drawn + period or stamp == drawn:
            return None
        self._drawn[name] = stamp
        return message

    def _draw(self, context: Context) -> None:
        t = context.get_time()
        pose = self._pose_input.Eval(context)
        if not np.isfinite(pose).all():
            return
        if isinstance(scan := self._new("scan", context), Scan):
            self._draw_scan(scan, pose, t)
        if self._inputs["state"].HasValue(context):
            self._draw_state(self._inputs["state"].Eval(context), pose, t)
        if isinstance(path := self._new("path", context), Path):
            dots = along(path.points, _DOT_STEP)
            self._path.show(np.c_[dots, np.tile([0.006, 0.0], (len(dots), 1))], t)
        if isinstance(grid := self._new("grid", context, _GRID_PERIOD), OccupancyGrid):
            self._draw_grid(grid, t)

    def _draw_scan(self, scan: Scan, pose: Array, t: float) -> None:
        every = max(1, math.ceil(len(scan.ranges) / _POINTS))
        places = np.full((len(scan.ranges), 4), np.nan)
        seen = hits(scan)
        x, y = scan_points(scan, self._lidar_pose).T
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        places[seen, 0] = pose[0] + cos * x - sin * y
        places[seen, 1] = pose[1] + sin * x + cos * y
        places[:, 2:] = _SCAN_HEIGHT, 0.0
        self._scan.show(places[::every], t)

    def _draw_state(self, state: AvoiderState, pose: Array, t: float) -> None:
        visible = math.isfinite(state.direction)
        pointer = spatial_pose(np.array([*pose[:2], state.direction])) if visible else _AWAY
        self._meshcat.SetTransform(f"{_ROOT}/direction", pointer, t)
        angles = state.angles
        if len(angles) == 0:
            return
        if self._sectors is None:
            width = 2 * math.pi * _RING / len(angles)
            block = Box(0.02, 0.8 * width, 0.01)
            colour = Rgba(0.85, 0.15, 0.1, 0.9)
            self._sectors = self._pool("sectors", len(angles), block, colour)
        # The sectors turn with the robot: the ring is moved, not each of its blocks.
        ring = spatial_pose(np.array([*pose[:2], angles[0]]), _SCAN_HEIGHT)
        self._meshcat.SetTransform(f"{_ROOT}/sectors", ring, t)
        turned = np.round(wrap(angles - angles[0]), 6)
        places = np.stack(
            [_RING * np.cos(turned), _RING * np.sin(turned), 0 * turned, turned], axis=1
        )
        places[state.free] = np.nan
        self._sectors.show(places, t)

    def _draw_grid(self, grid: OccupancyGrid, t: float) -> None:
        occupied = {(int(i), int(j)) for i, j in occupied_cells(grid, _CELL)}
        for cell in occupied - self._tiles.keys():
            name = f"{_ROOT}/grid/{cell[0]}_{cell[1]}"
            self._meshcat.SetObject(name, Box(_CELL, _CELL, 0.004), Rgba(0.2, 0.15, 0.3, 0.6))
            middle = [(cell[0] + 0.5) * _CELL, (cell[1] + 0.5) * _CELL, 0.004]
            self._meshcat.SetTransform(name, RigidTransform(middle))
            if t > 0:
                self._meshcat.SetProperty(name, "visible", False, 0.0)
            self._tiles[cell] = False
        for cell, shown in self._tiles.items():
            if shown != (cell in occupied):
                self._tiles[cell] = not shown
                name = f"{_ROOT}/grid/{cell[0]}_{cell[1]}"
                self._meshcat.SetProperty(name, "visible", not shown, t)
