"""Counting what a block drops: discrete state and a `health` output, the same in every block."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem, OutputPort

from systems.messages import Health


class Counts:
    """Counts by reason, kept in a block's discrete state and sent on its `health` port.

    Args:
        system: the block; call this in its constructor.
        reasons: snake_case words.
    """

    def __init__(self, system: LeafSystem, *reasons: str) -> None:
        self._reasons = reasons
        self._state = system.DeclareDiscreteState(len(reasons))
        self.output_port: OutputPort = system.DeclareAbstractOutputPort(
            "health",
            lambda: AbstractValue.Make(Health()),
            self._calc_health,
            {system.discrete_state_ticket(self._state)},
        )

    def add(self, context: Context, discrete_state: DiscreteValues, **more: int | bool) -> None:
        """Adds to the counts, in a discrete update.

        Args:
            context: the block's context.
            discrete_state: what the update writes to.
            more: reason to number; reasons left out stay as they are.
        """
        if not any(more.values()):
            return
        counts = context.get_discrete_state(self._state).get_value().copy()
        for reason, number in more.items():
            counts[self._reasons.index(reason)] += number
        discrete_state.set_value(self._state, counts)

    def _calc_health(self, context: Context, output: Any) -> None:
        counts = context.get_discrete_state(self._state).get_value().astype(np.int64)
        output.set_value(Health(dict(zip(self._reasons, map(int, counts), strict=True))))
