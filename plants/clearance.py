"""The truth about touching: how far a robot is from its surroundings, and how often it touched.

Robot and obstacles are seen from above, which is exact for upright obstacles that are as high as
the robot. Drake's contact results would not serve: a kinematic twin has none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from plants.planar_shapes import PlanarShapes
from systems.periods import period
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]


def touches(distances: Array, touching: Array, tolerance: float, release: float) -> Array:
    """Returns which obstacles are touched.

    Args:
        distances: (n,) from the robot to each obstacle, m.
        touching: (n,) whether each was touched when it was looked at last.
        tolerance: distance up to which a touch begins, m.
        release: distance from which it is over, m.

    Returns:
        (n,) bool.
    """
    return np.asarray(np.where(touching, distances < release, distances <= tolerance))


class ClearanceMonitor(LeafSystem):
    """Measures a robot's clearance and counts what it touches.

    .. pydrake_system::

        name: ClearanceMonitor
        input_ports:
        - pose
        - moving
        output_ports:
        - distances
        - clearance
        - contacts

    Args:
        footprint: what of the robot can touch, in the frame of its base_link.
        standing: what stands still, in the world.
        moving_radii: (m,) of the moving cylinders, m.
        tolerance: distance up to which a touch begins, m.
        release: distance from which it is over, m; at least the tolerance.
        rate: how often it looks for touches, Hz.

    Ports:
        pose (input, vector of 3): [x (m), y (m), theta (rad)] of base_link in the world.
        moving (input, vector of 2 for each moving cylinder): [x, y, ...] of their axes in the
            world, m. Of size 0, and best left unconnected, when nothing moves.
        distances (output, vector of one for each obstacle): from the footprint to each, m; those
            that stand still first. Negative when they overlap, by the shortest push that parts
            them.
        clearance (output, vector of 1): the least distance, m; inf when there is no obstacle.
        contacts (output, vector of 1): touches so far, counted at `rate`. A touch begins within
            the tolerance; the same obstacle counts again after it was `release` away.
    """

    def __init__(
        self,
        *,
        footprint: PlanarShapes,
        standing: PlanarShapes,
        moving_radii: Sequence[float] = (),
        tolerance: float = 0.001,
        release: float = 0.01,
        rate: float = 50.0,
    ) -> None:
        super().__init__()
        require(len(footprint) > 0, "footprint", footprint, "of at least one shape")
        require_non_negative(tolerance=tolerance)
        require(release >= tolerance, "release", release, f"at least the tolerance, {tolerance} m")
        require_positive(rate=rate)
        n = len(moving_radii)
        self._footprint = footprint
        cylinders = PlanarShapes(
            centres=np.zeros((n, 2)),
            headings=np.zeros(n),
            sizes=np.zeros((n, 2)),
            radii=moving_radii,
        )
        self._obstacles = PlanarShapes.joined([standing, cylinders])
        self._standing_centres = standing.centres
        self._moving = n > 0
        self._tolerance = tolerance
        self._release = release
        count = len(standing) + n
        # [number of touches, whether each obstacle is touched]
        self._state = self.DeclareDiscreteState(1 + count)
        self._pose_input = self.DeclareVectorInputPort("pose", 3)
        self._moving_input = self.DeclareVectorInputPort("moving", 2 * n)
        places = {self._pose_input.ticket()} | ({self._moving_input.ticket()} if n else set())
        self._distances_output = self.DeclareVectorOutputPort(
            "distances", count, self._calc_distances, places
        )
        self._clearance_output = self.DeclareVectorOutputPort(
            "clearance", 1, self._calc_clearance, places
        )
        self._contacts_output = self.DeclareVectorOutputPort(
            "contacts", 1, self._calc_contacts, {self.discrete_state_ticket(self._state)}
        )
        if count > 0:
            self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._look)

    def pose_input_port(self) -> InputPort:
        """Returns the port of the robot's pose."""
        return self._pose_input

    def moving_input_port(self) -> InputPort:
        """Returns the port of the moving cylinders' positions."""
        return self._moving_input

    def distances_output_port(self) -> OutputPort:
        """Returns the port of the distances."""
        return self._distances_output

    def clearance_output_port(self) -> OutputPort:
        """Returns the port of the clearance."""
        return self._clearance_output

    def contacts_output_port(self) -> OutputPort:
        """Returns the port of the number of touches."""
        return self._contacts_output

    def _calc_distances(self, context: Context, output: Any) -> None:
        if output.size() == 0:
            return
        obstacles = self._obstacles
        if self._moving:
            moving = self._moving_input.Eval(context).reshape(-1, 2)
            obstacles = obstacles.at(np.concatenate([self._standing_centres, moving]))
        pose = self._pose_input.Eval(context)
        output.SetFromVector(self._footprint.clearances(obstacles, pose))

    def _calc_clearance(self, context: Context, output: Any) -> None:
        distances = self._distances_output.Eval(context)
        output.SetFromVector([distances.min() if len(distances) else np.inf])

    def _calc_contacts(self, context: Context, output: Any) -> None:
        output.SetFromVector(context.get_discrete_state(self._state).get_value()[:1])

    def _look(self, context: Context, discrete_state: DiscreteValues) -> None:
        count, *touching = context.get_discrete_state(self._state).get_value().tolist()
        if not any(touching) and self._clearance_output.Eval(context)[0] > self._tolerance:
            return
        before = np.array(touching, bool)
        distances = self._distances_output.Eval(context)
        now = touches(distances, before, self._tolerance, self._release)
        new = np.count_nonzero(now & ~before)
        discrete_state.set_value(self._state, np.concatenate([[count + new], now]))
