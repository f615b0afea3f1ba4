"""A robot that fails, on purpose."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.systems.framework import Context, LeafSystem, OutputPort

from systems.validation import require, require_non_negative


class Failure(LeafSystem):
    """Says which robots have failed: one from some time on, or none.

    .. pydrake_system::

        name: Failure
        output_ports:
        - failed

    Args:
        robots: how many there are, n.
        robot: which one fails, from 0; None for none.
        at: when, s.
        beacon: whether it still is one.

    Ports:
        failed (output, vector of n): 1 for a robot that cannot move any more, 2 for one that is no
            beacon either, else 0.

    Raises:
        ValueError: there is no such robot, or a time before 0.
    """

    def __init__(
        self, *, robots: int, robot: int | None = None, at: float = 0.0, beacon: bool = True
    ) -> None:
        super().__init__()
        require_non_negative(at=at)
        known = robot is None or 0 <= robot < robots
        require(known, "robot", robot, f"0 to {robots - 1}")
        self._robot = robot
        self._at = at
        self._kind = 1.0 if beacon else 2.0
        self._failed_output = self.DeclareVectorOutputPort(
            "failed", robots, self._calc_failed, {self.time_ticket()}
        )

    def failed_output_port(self) -> OutputPort:
        """Returns the port of who has failed."""
        return self._failed_output

    def _calc_failed(self, context: Context, output: Any) -> None:
        failed = np.zeros(output.size())
        if self._robot is not None and context.get_time() >= self._at:
            failed[self._robot] = self._kind
        output.SetFromVector(failed)
