"""How far a route is free of what a lidar sees."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.controllers.path_tracking import TrackingState
from systems.health import Counts
from systems.messages import Scan
from systems.periods import period
from systems.planners.route import Route
from systems.scans import SCAN_FAULTS, scan_fault, scan_points
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

_STEP = 0.03  # m, between the looks at the route


@dataclass
class ClearanceParameters:
    """What counts as standing on the route.

    Attributes:
        half_width: of the robot, m.
        front: from base_link to the robot's front, m.
        margin: room to either side, m.
        look: how far ahead of the front to look, m.
        max_scan_age: how long after its first ray a scan may be used, s.
    """

    half_width: float = 0.11
    front: float = 0.16
    margin: float = 0.05
    look: float = 2.0
    max_scan_age: float = 0.6

    def __post_init__(self) -> None:
        require_positive(half_width=self.half_width, look=self.look, max_scan_age=self.max_scan_age)
        require_non_negative(front=self.front, margin=self.margin)


def free_distance(
    route: Route, run: float, points: Array, parameters: ClearanceParameters
) -> float:
    """Returns how far the front can go along a route before something stands in the way, m.

    Args:
        route: the route.
        run: way along it to the robot's place, m.
        points: (k, 2) what stands around, in the route's frame, m.
        parameters: width and reach.

    Returns:
        From the front; 0 if it is there already, infinite if nothing stands within reach.
    """
    p = parameters
    ahead = np.arange(0.0, p.front + p.look, _STEP)
    if not route.closed:
        ahead = ahead[ahead <= max(route.length - run, 0.0) + p.front]
    if len(points) == 0 or len(ahead) == 0:
        return math.inf
    poses = route.poses_at(route.time_at(run + ahead))
    beyond = 0.0 if route.closed else np.maximum(run + ahead - route.length, 0.0)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    dx = points[:, 0] - (poses[:, 0] + beyond * c)[:, None]
    dy = points[:, 1] - (poses[:, 1] + beyond * s)[:, None]
    # A point stands on the stretch whose side it lies beside, no farther off than half the width.
    beside = np.abs(c[:, None] * dx + s[:, None] * dy) <= _STEP
    near = np.abs(c[:, None] * dy - s[:, None] * dx) <= p.half_width + p.margin
    hit = (beside & near).any(axis=1) & (ahead >= p.front - _STEP)
    if not hit.any():
        return math.inf
    return float(max(ahead[np.argmax(hit)] - p.front, 0.0))


class RouteClearance(LeafSystem):
    """Looks along the route in a lidar's scan for what stands on it.

    .. pydrake_system::

        name: RouteClearance
        input_ports:
        - pose
        - scan
        - tracking
        output_ports:
        - free_distance
        - health

    Args:
        route: that is followed.
        lidar_pose: (3,) [x (m), y (m), yaw (rad)] of the lidar in base_link.
        parameters: width of the robot and reach.
        rate: Hz.

    Ports:
        pose (input, vector of 3): [x (m), y (m), theta (rad)] of base_link in map, the estimate.
        scan (input, Scan): in the lidar's frame.
        tracking (input, TrackingState): where along the route the robot is.
        free_distance (output, vector of 1): from the robot's front along the route to the first
            thing that stands on it, m, at `rate`; infinite if there is none within reach, and NaN
            while there is no scan fit for use, no place on the route, or no finite pose.
        health (output, Health): scans that were missing, stale or garbled; poses not finite.
    """

    def __init__(
        self,
        *,
        route: Route,
        lidar_pose: Sequence[float] = (0.0, 0.0, 0.0),
        parameters: ClearanceParameters | None = None,
        rate: float = 20.0,
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        sound = len(lidar_pose) == 3 and bool(np.isfinite(lidar_pose).all())
        require(sound, "lidar_pose", lidar_pose, "[x (m), y (m), yaw (rad)]")
        self._route = route
        self._lidar_pose = np.array(lidar_pose, float)
        self._parameters = parameters or ClearanceParameters()
        self._pose_input = self.DeclareVectorInputPort("pose", 3)
        self._scan_input = self.DeclareAbstractInputPort("scan", AbstractValue.Make(Scan()))
        self._tracking_input = self.DeclareAbstractInputPort(
            "tracking", AbstractValue.Make(TrackingState())
        )
        self._free = self.DeclareDiscreteState([math.nan])
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._look)
        self._free_output = self.DeclareStateOutputPort("free_distance", self._free)
        self._counts = Counts(self, *SCAN_FAULTS, "bad_pose")

    def pose_input_port(self) -> InputPort:
        """Returns the port of the estimated pose."""
        return self._pose_input

    def scan_input_port(self) -> InputPort:
        """Returns the port of the scans."""
        return self._scan_input

    def tracking_input_port(self) -> InputPort:
        """Returns the port of the tracker's state."""
        return self._tracking_input

    def free_distance_output_port(self) -> OutputPort:
        """Returns the port of the free way ahead."""
        return self._free_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _look(self, context: Context, discrete_state: DiscreteValues) -> None:
        scan: Scan = self._scan_input.Eval(context)
        pose = self._pose_input.Eval(context)
        tracking: TrackingState = self._tracking_input.Eval(context)
        fault = scan_fault(scan, context.get_time(), self._parameters.max_scan_age)
        bad_pose = not np.isfinite(pose).all()
        self._counts.add(
            context, discrete_state, bad_pose=bad_pose, **({fault: 1} if fault else {})
        )
        free = math.nan
        if not (fault or bad_pose or math.isnan(tracking.run)):
            c, s = math.cos(pose[2]), math.sin(pose[2])
            points = scan_points(scan, self._lidar_pose) @ np.array([[c, s], [-s, c]]) + pose[:2]
            free = free_distance(self._route, tracking.run, points, self._parameters)
        discrete_state.set_value(self._free, [free])
