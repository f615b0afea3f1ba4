"""The sector method of [NAV] 4.4: the free sector nearest to the goal, half a metre at a time.

[NAV]: Hussein, Lazkani, Saad, Yehia, "Real-time robot navigation with QR-based localization and
lidar obstacle mapping".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap
from systems.avoiders.base import Avoider, AvoiderParameters, Choice, View
from systems.avoiders.surroundings import in_frame
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]


@dataclass
class SectorParameters(AvoiderParameters):
    """Radii, widening and step of the sector method. The defaults are as printed.

    Attributes:
        sectors: how many the circle has; 72 of 5 degrees.
        block_radius: an obstacle this near blocks its sector, m.
        widening: and the sectors up to this angle to either side, rad. Printed as +-50 degrees,
            explained as 25 to either side.
        search_radius: a sector may be chosen unless something blocks it within this distance, m.
        step: how far it drives before it looks again, m.
        arrived: a step ends this near to its end, m. Ours: a controller whose speed is in
            proportion to the distance would take seconds for the last centimetres.
        step_timeout: and after this time, s. Ours.
        turn_first: how far beside the heading a step may start; beyond, the robot turns in place
            first, rad. Ours, for "drive that way": the printed controller would swing out by a
            turning radius.
    """

    sectors: int = 72
    block_radius: float = 1.0
    widening: float = math.radians(25)
    search_radius: float = 0.5
    step: float = 0.5
    arrived: float = 0.1
    step_timeout: float = 5.0
    turn_first: float = math.radians(45)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.sectors >= 4, "sectors", self.sectors, "4 or more")
        require_positive(
            block_radius=self.block_radius,
            search_radius=self.search_radius,
            step=self.step,
            step_timeout=self.step_timeout,
            turn_first=self.turn_first,
        )
        require_non_negative(widening=self.widening, arrived=self.arrived)
        require(self.widening < math.pi, "widening", self.widening, "below pi (rad)")
        require(self.arrived < self.step, "arrived", self.arrived, f"below {self.step} m, the step")
        require(
            self.search_radius <= self.block_radius,
            "search_radius",
            self.search_radius,
            f"at most the block_radius of {self.block_radius} m",
        )


def sector_of(bearing: Array | float, sectors: int) -> NDArray[np.intp]:
    """Returns the sector of a bearing (rad): sector 0 is centred on the heading, 1 left of it."""
    width = 2 * math.pi / sectors
    index: NDArray[np.intp] = np.floor(np.asarray(bearing) / width + 0.5).astype(np.intp) % sectors
    return index


def blocking_distances(points: Array, parameters: SectorParameters) -> Array:
    """Returns how far the nearest obstacle is that blocks each sector: (sectors,) m.

    Args:
        points: (k, 2) m, in the body's frame.
        parameters: number of sectors, block radius, widening.

    Returns:
        Distances from the body's origin; inf of a sector that nothing blocks.
    """
    n = parameters.sectors
    nearest = np.full(n, math.inf)
    distances = np.hypot(points[:, 0], points[:, 1])
    blocks = distances <= parameters.block_radius
    bearings = np.arctan2(points[blocks, 1], points[blocks, 0])
    np.minimum.at(nearest, sector_of(bearings, n), distances[blocks])
    reach = min(round(parameters.widening * n / (2 * math.pi)), n // 2)
    neighbours = (np.arange(n)[:, None] + np.arange(-reach, reach + 1)) % n
    widened: Array = nearest[neighbours].min(axis=1)
    return widened


def choose_sector(distances: Array, bearing: float, search_radius: float) -> int | None:
    """Returns the sector nearest to the bearing of the goal that may be chosen, None if none.

    Of two that are equally near the left one, so that a robot before a pole does not hesitate.

    Args:
        distances: (n,) m, from `blocking_distances`.
        bearing: of the goal in the body's frame, rad.
        search_radius: see `SectorParameters`.
    """
    n = len(distances)
    free = np.flatnonzero(distances > search_radius)
    if len(free) == 0:
        return None
    away = wrap(free * (2 * math.pi / n) - bearing)
    return int(free[np.argmin(np.abs(away) - 1e-9 * (away > 0))])


def choose(view: View, memory: Array, parameters: SectorParameters, radius: float) -> Choice:
    """Chooses by the sector method.

    Args:
        view: what stands around.
        memory: (5,) end of the step under way (m, in map), when it began (s), and the goal then;
            NaN when there is none.
        parameters: radii, widening, step.
        radius: of the robot, m; what stands farther behind the goal than this does not matter.
    """
    p = parameters
    away = np.hypot(view.points[:, 0], view.points[:, 1])
    distances = blocking_distances(view.points[away <= view.distance + radius], p)
    free = distances > p.search_radius
    angles = wrap(np.arange(p.sectors) * (2 * math.pi / p.sectors))
    density = np.clip(1 - distances / p.block_radius, 0, 1)

    def result(bearing: float | None, end: Array | None, memory: Array, clear: bool) -> Choice:
        if bearing is not None and abs(bearing) > p.turn_first and not clear:
            end = None
        return Choice(bearing, angles, density, free, clear, end, memory)

    nothing = np.full(5, math.nan)
    goal_sector = int(sector_of(view.bearing, p.sectors))
    if math.isinf(distances[goal_sector]):
        return result(view.bearing, view.goal, nothing, True)
    ahead, aside = in_frame(view.pose, memory[None, :2])[0]
    under_way = (
        math.hypot(ahead, aside) > p.arrived
        and view.now - memory[2] < p.step_timeout
        and math.hypot(*(view.goal - memory[3:])) <= p.step
        and free[sector_of(math.atan2(aside, ahead), p.sectors)]
    )
    if under_way:
        return result(math.atan2(aside, ahead), memory[:2], memory, False)
    sector = choose_sector(distances, view.bearing, p.search_radius)
    if sector is None:
        return result(None, None, nothing, False)
    bearing = view.bearing if sector == goal_sector else float(angles[sector])
    end = view.ahead(bearing, min(p.step, view.distance))
    return result(bearing, end, np.array([*end, view.now, *view.goal]), False)


class SectorAvoider(Avoider):
    """Drives in steps toward the free sector that is nearest to the goal.

    .. pydrake_system::

        name: SectorAvoider
        input_ports:
        - pose
        - goal
        - scan
        - command
        output_ports:
        - goal
        - state
        - health

    Args:
        parameters: radii, widening, step.
        rate: how often it looks, Hz.
        lidar_pose: (3,) [x (m), y (m), yaw (rad)] of the lidar in base_link.
        hull: [front, rear, half_width] of the robot about base_link, m.

    Ports:
        pose (input, vector of 3): [x (m), y (m), theta (rad)] of base_link in map, the estimate.
        goal (input, vector of 2): [x, y] (m) in map, where to go.
        scan (input, Scan): of the lidar.
        command (input, vector of 2): [v (m/s), omega (rad/s)] as last sent to the wheels; one that
            is not finite counts as standing.
        goal (output, vector of 2): [x, y] (m) in map, where to steer to: the goal itself while its
            sector is free, else the end of the step; a millimetre beside the robot to turn in
            place; the robot's own place to stop. Chosen at `rate`; the latter two follow the pose.
        state (output, AvoiderState): the sectors, at `rate`; density is 1 for an obstacle at the
            robot's origin, falling to 0 at the block radius.
        health (output, Health): updates without a scan, with a stale or a garbled one, with a pose
            or a goal that is not finite (all of them stop the robot), with a command that is not.

    Source: [NAV] 4.4. What the text leaves open is read so: the sectors are the lidar's, fixed to
    the robot; a sector that something blocks between the search radius and the block radius may be
    chosen; the goal's own sector, if chosen, is driven along the line to the goal; what stands
    behind the goal blocks nothing. A step ends at its end, and early when a later scan shows its
    sector blocked within the search radius, when the goal has moved by more than a step, or when
    the goal's own sector has become free.

    Raises:
        ValueError: rate, lidar_pose or hull out of range.
    """

    def __init__(
        self,
        *,
        parameters: SectorParameters | None = None,
        rate: float = 10.0,
        lidar_pose: Sequence[float] | Array = (0.0, 0.0, 0.0),
        hull: Sequence[float] | Array = (0.11, 0.11, 0.0975),
    ) -> None:
        self._parameters = parameters or SectorParameters()
        super().__init__(
            parameters=self._parameters,
            rate=rate,
            lidar_pose=lidar_pose,
            hull=hull,
            sectors=self._parameters.sectors,
            memory=np.full(5, math.nan),
        )

    def _choose(self, view: View, memory: Array) -> Choice:
        return choose(view, memory, self._parameters, self._hull.radius)
