"""An occupancy grid from lidar scans: what is free and what is not, in log-odds.

Moravec and Elfes, "High resolution maps from wide angle sonar", ICRA 1985; the log-odds form with
clamping is that of Hornung et al., "OctoMap: an efficient probabilistic 3D mapping framework based
on octrees", Autonomous Robots 34, 2013.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, EventStatus, InputPort, LeafSystem, OutputPort, State

from systems.compiled import compiled, in_rows, packed
from systems.health import Counts
from systems.messages import OccupancyGrid, Scan
from systems.periods import period
from systems.pose_trail import empty_trail, poses_at, ray_poses, remember
from systems.scans import scan_fault
from systems.validation import require, require_positive

Array = NDArray[np.float64]

REASONS = ("stale_scan", "garbled_scan", "bad_pose", "lost", "too_fast", "out_of_bounds")


@dataclass
class OccupancyParameters:
    """How the grid is built. The log-odds and their bounds are OctoMap's.

    Attributes:
        resolution: side of a cell, m.
        extent: [x_min, y_min, x_max, y_max] of the first grid, m; it grows as needed.
        growth: by how much it grows at least, m.
        max_side: longest side that it may grow to, m; scans that lead farther are dropped.
        hit: added to a cell in which a ray ended; ln(0.7 / 0.3).
        miss: added to a cell that a ray passed through; ln(0.4 / 0.6).
        least: lower bound of a cell; p = 0.12.
        most: upper bound; p = 0.97. The nearer the bounds, the sooner what has moved is forgotten.
        max_range: rays are followed no farther than this, m.
        max_free_range: rays that hit nothing are followed no farther than this, m; many a lidar
            reports a surface that is too dark or too tilted in the same way.
        max_speed: scans during which the estimate moved faster are skipped, m/s; it has jumped.
        max_turn_rate: likewise of its heading, rad/s; fast turns smear a scan, too.
        max_position_std: scans are skipped while the position's standard deviation exceeds this
            along its worst axis, m.
        max_heading_std: likewise of the heading, rad.
        max_scan_age: scans whose first ray is older are skipped, s.
    """

    resolution: float = 0.05
    extent: list[float] = field(default_factory=lambda: [-3.0, -3.0, 3.0, 3.0])
    growth: float = 1.0
    max_side: float = 60.0
    hit: float = 0.85
    miss: float = -0.4
    least: float = -2.0
    most: float = 3.5
    max_range: float = 6.0
    max_free_range: float = 3.0
    max_speed: float = 1.0
    max_turn_rate: float = 1.0
    max_position_std: float = 0.15
    max_heading_std: float = 0.1
    max_scan_age: float = 0.6

    def __post_init__(self) -> None:
        require_positive(
            resolution=self.resolution,
            growth=self.growth,
            max_side=self.max_side,
            hit=self.hit,
            most=self.most,
            max_range=self.max_range,
            max_free_range=self.max_free_range,
            max_speed=self.max_speed,
            max_turn_rate=self.max_turn_rate,
            max_position_std=self.max_position_std,
            max_heading_std=self.max_heading_std,
            max_scan_age=self.max_scan_age,
        )
        for name in ("miss", "least"):
            value = getattr(self, name)
            require(math.isfinite(value) and value < 0, name, value, "less than 0")
        e = self.extent
        sound = len(e) == 4 and bool(np.isfinite(e).all()) and e[0] < e[2] and e[1] < e[3]
        sound = sound and max(e[2] - e[0], e[3] - e[1]) <= self.max_side
        require(
            sound, "extent", e, f"[x_min, y_min, x_max, y_max] of at most {self.max_side:g} m (m)"
        )


def empty_grid(parameters: OccupancyParameters, frame_id: str = "map") -> OccupancyGrid:
    """Returns the first grid: nothing is known, and its stamp is NaN."""
    x_min, y_min, x_max, y_max = parameters.extent
    rows = math.ceil((y_max - y_min) / parameters.resolution - 1e-9)
    columns = math.ceil((x_max - x_min) / parameters.resolution - 1e-9)
    return OccupancyGrid(
        frame_id=frame_id,
        resolution=parameters.resolution,
        origin=np.array([x_min, y_min]),
        log_odds=np.zeros((rows, columns), np.float32),
    )


def cells_of(points: Array, grid: OccupancyGrid) -> NDArray[np.intp]:
    """Returns the cells (row, column) that hold points (..., 2) m; those may lie outside."""
    cells = np.floor((points - grid.origin) / grid.resolution).astype(np.intp)
    return cells[..., ::-1]


def grown(grid: OccupancyGrid, points: Array, *, growth: float, max_side: float) -> OccupancyGrid:
    """Returns a grid that holds the points (n, 2) m: the same one, or a larger one.

    Args:
        grid: the grid.
        points: finite, m.
        growth: by how much a side that must be moved is moved at least, m.
        max_side: m.

    Raises:
        ValueError: a side would have to be longer than max_side.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    least, most = (low - grid.origin) / grid.resolution, (high - grid.origin) / grid.resolution
    rows, columns = grid.log_odds.shape
    if min(least.tolist()) >= 0 and most[0] < columns and most[1] < rows:
        return grid
    shape = np.array((rows, columns))
    cells = np.maximum(most[::-1], shape) - np.minimum(least[::-1], 0)
    if cells.max() > max_side / grid.resolution:
        raise ValueError(f"the grid would be longer than {max_side} m")
    before = np.maximum(-np.floor(least[::-1]).astype(int), 0)
    after = np.maximum(np.floor(most[::-1]).astype(int) + 1 - shape, 0)
    block = math.ceil(growth / grid.resolution)
    before, after = -(-before // block) * block, -(-after // block) * block
    return OccupancyGrid(
        stamp=grid.stamp,
        frame_id=grid.frame_id,
        resolution=grid.resolution,
        origin=grid.origin - before[::-1] * grid.resolution,
        log_odds=np.pad(grid.log_odds, np.stack([before, after], axis=-1)),
    )


def with_scan(
    grid: OccupancyGrid, scan: Scan, rays: Array, parameters: OccupancyParameters
) -> OccupancyGrid:
    """Returns the grid after a scan.

    Along each ray the cells are free, up to half a cell before what it hit; a ray that hit nothing
    is free as far as it is followed; one that failed says nothing. Each cell changes at most once:
    a cell that any ray hit is not made free by another.

    Args:
        grid: before.
        scan: n rays.
        rays: (n, 3) where each began and its direction, in the grid's frame.
        parameters: log-odds and reach.

    Raises:
        ValueError: the grid would have to be larger than allowed.
    """
    p = parameters
    reach = min(p.max_range, scan.range_max)
    limits = np.array((scan.range_min, scan.range_max, reach, min(p.max_free_range, reach)))
    ways, box = np.empty((len(scan), 6)), np.empty((2, 2))
    ways = ways[: _follow(packed(scan.ranges), in_rows(rays, 3), limits, ways, box)]
    if len(ways) == 0:
        return grid
    grid = grown(grid, box, growth=p.growth, max_side=p.max_side)
    log_odds = np.array(grid.log_odds, np.float32, order="C")
    frame = np.array((*grid.origin.tolist(), grid.resolution))
    _mark(ways, frame, np.array((p.miss, p.hit, p.least, p.most)), log_odds)
    return OccupancyGrid(
        stamp=scan.stamp,
        frame_id=grid.frame_id,
        resolution=grid.resolution,
        origin=grid.origin,
        log_odds=log_odds,
    )


@compiled("i8(f8[::1], f8[:,::1], f8[::1], f8[:,::1], f8[:,::1])")
def _follow(ranges: Array, rays: Array, limits: Array, ways: Array, box: Array) -> int:
    """Writes how far each ray that says something is followed; returns how many those are.

    Args:
        ranges: (n,) m.
        rays: (n, 3), see `with_scan`.
        limits: range_min, range_max, how far rays are followed, and those that hit nothing, m.
        ways: (n, 6) [x (m), y (m), cos, sin, length (m), whether it hit something at its end].
        box: (2, 2) the least and the largest x, y of all ways, m.
    """
    n = 0
    box[0], box[1] = math.inf, -math.inf
    for k in range(len(ranges)):
        nothing = ranges[k] == math.inf
        usable = ranges[k] >= limits[0] and (nothing or ranges[k] <= limits[1])
        x, y, direction = rays[k, 0], rays[k, 1], rays[k, 2]
        if not usable or not math.isfinite(x + y + direction):
            continue
        c, s = math.cos(direction), math.sin(direction)
        length = min(ranges[k], limits[3] if nothing else limits[2])
        ways[n, 0], ways[n, 1], ways[n, 2], ways[n, 3], ways[n, 4] = x, y, c, s, length
        ways[n, 5] = 0.0 if nothing or ranges[k] > limits[2] else 1.0
        end_x, end_y = x + length * c, y + length * s
        box[0, 0], box[0, 1] = min(box[0, 0], x, end_x), min(box[0, 1], y, end_y)
        box[1, 0], box[1, 1] = max(box[1, 0], x, end_x), max(box[1, 1], y, end_y)
        n += 1
    return n


@compiled("void(f8[:,::1], f8[::1], f8[::1], f4[:,::1])")
def _mark(ways: Array, frame: Array, limits: Array, log_odds: NDArray[np.float32]) -> None:
    """Changes the log-odds by what the rays say.

    Args:
        ways: see `_follow`.
        frame: x, y of the grid's corner and side of a cell, m.
        limits: miss, hit, least, most.
        log_odds: changed.
    """
    miss, hit, least, most = limits[0], limits[1], limits[2], limits[3]
    side = frame[2]
    seen: NDArray[np.int8] = np.zeros(log_odds.shape, np.int8)  # 1 free, 2 hit
    rows, columns = log_odds.shape
    for k in range(len(ways)):
        x, y = (ways[k, 0] - frame[0]) / side, (ways[k, 1] - frame[1]) / side
        free = (ways[k, 4] - ways[k, 5] * side / 2) / side  # up to half a cell before what it hit
        for n in range(int(max(free, 0.0) * 2)):  # looked at every half a cell
            seen[int(y + n / 2 * ways[k, 3]), int(x + n / 2 * ways[k, 2])] = 1
    for k in range(len(ways)):
        if ways[k, 5] > 0:
            x, y = ways[k, 0] + ways[k, 4] * ways[k, 2], ways[k, 1] + ways[k, 4] * ways[k, 3]
            seen[math.floor((y - frame[1]) / side), math.floor((x - frame[0]) / side)] = 2
    for row in range(rows):
        for column in range(columns):
            if seen[row, column]:
                changed = log_odds[row, column] + (miss if seen[row, column] == 1 else hit)
                log_odds[row, column] = min(max(changed, least), most)


def moved_too_fast(
    trail: Array, start: float, end: float, *, max_speed: float, max_turn_rate: float
) -> bool:
    """Returns whether the robot moved faster than allowed, or jumped, between two times (s).

    Args:
        trail: of the robot, see `systems.pose_trail`.
        start: s.
        end: s.
        max_speed: m/s.
        max_turn_rate: rad/s.
    """
    times = trail[np.isfinite(trail).all(axis=1), 0]
    meanwhile = (times[:-1] <= end) & (times[1:] >= start)
    moved = np.diff(poses_at(trail, times), axis=0)[meanwhile]
    dt = np.diff(times)[meanwhile]
    fast = np.hypot(moved[:, 0], moved[:, 1]) > max_speed * dt + 1e-9
    fast |= np.abs(moved[:, 2]) > max_turn_rate * dt + 1e-9
    return bool(fast.any())


class OccupancyMapper(LeafSystem):
    """Maps what the lidar sees from the estimated pose.

    .. pydrake_system::

        name: OccupancyMapper
        input_ports:
        - scan
        - pose
        - covariance
        output_ports:
        - grid
        - health

    Args:
        lidar_pose: (3,) [x (m), y (m), yaw (rad)] of the lidar in base_link.
        parameters: how the grid is built.
        rate: how often the pose is kept and a new scan is looked for, Hz.

    Ports:
        scan (input, Scan): from the lidar; used once for each stamp.
        pose (input, vector of 3): [x (m), y (m), theta (rad)] of base_link in map, the estimate;
            one that is not finite is not kept.
        covariance (input, vector of 9): (3, 3) of the estimate, row by row. While it is too large,
            or not finite, scans are skipped.
        grid (output, OccupancyGrid): in map; without a stamp, and unknown all over, until the first
            scan.
        health (output, Health): scans that were stale, garbled, or led beyond the largest grid;
            that were skipped while the estimate was lost, or moved or jumped too fast, or did not
            reach back to the first ray; and poses that were not finite.

    Each ray is placed by where the estimate was when it was measured, so a scan made on the move is
    straight.

    Raises:
        ValueError: lidar_pose or rate out of range.
    """

    def __init__(
        self,
        *,
        lidar_pose: Sequence[float],
        parameters: OccupancyParameters | None = None,
        rate: float = 20.0,
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        sound = len(lidar_pose) == 3 and bool(np.isfinite(lidar_pose).all())
        require(sound, "lidar_pose", lidar_pose, "[x (m), y (m), yaw (rad)]")
        self._parameters = parameters or OccupancyParameters()
        self._lidar_pose = np.array(lidar_pose, float)
        self._scan_input = self.DeclareAbstractInputPort("scan", AbstractValue.Make(Scan()))
        self._pose_input = self.DeclareVectorInputPort("pose", 3)
        self._covariance_input = self.DeclareVectorInputPort("covariance", 9)
        trail = empty_trail(duration=self._parameters.max_scan_age, rate=rate)
        self._trail = self.DeclareDiscreteState(trail.ravel())
        self._last_stamp = self.DeclareDiscreteState([math.nan])
        nothing = AbstractValue.Make(empty_grid(self._parameters))
        self._grid = self.DeclareAbstractState(nothing)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period(rate), 0.0, self._look)
        self._grid_output = self.DeclareStateOutputPort("grid", self._grid)
        self._counts = Counts(self, *REASONS)

    def scan_input_port(self) -> InputPort:
        """Returns the port of the scans."""
        return self._scan_input

    def pose_input_port(self) -> InputPort:
        """Returns the port of the estimated pose."""
        return self._pose_input

    def covariance_input_port(self) -> InputPort:
        """Returns the port of the estimate's covariance."""
        return self._covariance_input

    def grid_output_port(self) -> OutputPort:
        """Returns the port of the grid."""
        return self._grid_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _look(self, context: Context, state: State) -> EventStatus:
        discrete_state: Any = state.get_mutable_discrete_state()
        trail = discrete_state.get_mutable_value(self._trail).reshape(-1, 4)
        pose = self._pose_input.Eval(context)
        bad_pose = not all(map(math.isfinite, pose.tolist()))
        if not bad_pose:
            trail[:] = remember(trail, context.get_time(), pose)
        counts = {"bad_pose": int(bad_pose)}
        scan = self._scan_input.Eval(context)
        last_stamp = context.get_discrete_state(self._last_stamp)[0]
        if not math.isnan(scan.stamp) and scan.stamp != last_stamp:
            discrete_state.set_value(self._last_stamp, [scan.stamp])
            grid = context.get_abstract_state(self._grid).get_value()
            verdict, grid = self._take(grid, scan, trail, context)
            if verdict == "taken":
                state.get_mutable_abstract_state(int(self._grid)).set_value(grid)
            elif verdict in REASONS:
                counts[verdict] = counts.get(verdict, 0) + 1
        self._counts.add(context, discrete_state, **counts)
        return EventStatus.Succeeded()

    def _take(
        self, grid: OccupancyGrid, scan: Scan, trail: Array, context: Context
    ) -> tuple[str, OccupancyGrid]:
        """Returns what became of a scan, and the grid after it."""
        p, now = self._parameters, context.get_time()
        fault = scan_fault(scan, now, p.max_scan_age)
        if fault is not None:
            return fault, grid
        if self._is_lost(self._covariance_input.Eval(context)):
            return "lost", grid
        end = scan.stamp + scan.time_increment * (len(scan) - 1)
        known = trail[np.isfinite(trail[:, 0]), 0]
        # The estimate must reach over the scan: from before its first ray, up to its last.
        if len(known) == 0 or known[0] > scan.stamp + 1e-6 or known[-1] < end - 1e-6:
            return "bad_pose", grid
        if moved_too_fast(
            trail, scan.stamp, end, max_speed=p.max_speed, max_turn_rate=p.max_turn_rate
        ):
            return "too_fast", grid
        try:
            return "taken", with_scan(grid, scan, ray_poses(scan, self._lidar_pose, trail), p)
        except ValueError:
            return "out_of_bounds", grid

    def _is_lost(self, covariance: Array) -> bool:
        xx, xy, _, _, yy, _, _, _, tt = elements = covariance.tolist()
        if not all(map(math.isfinite, elements)) or min(xx, yy, tt) < 0:
            return True
        position = (xx + yy) / 2 + math.hypot((xx - yy) / 2, xy)  # along its worst axis
        p = self._parameters
        return bool(position > p.max_position_std**2 or tt > p.max_heading_std**2)
