"""Hands a formation its moves one by one, whatever happens to its robots meanwhile."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, EventStatus, InputPort, LeafSystem, OutputPort, State

from systems.health import Counts
from systems.periods import period
from systems.planners.formation_astar import astar_move
from systems.planners.formation_course import FormationMove, Memory, Report, Rule, after
from systems.planners.formation_ground import FormationParameters
from systems.planners.formation_lattice import fit_lattice
from systems.planners.formation_moves import (
    closest_vertex_move,
)
from systems.planners.formation_obstacles import Obstacles
from systems.validation import require, require_positive

Array = NDArray[np.float64]

RULES: Mapping[str, Rule] = {"closest": closest_vertex_move, "astar": astar_move}


class FormationPlanner(LeafSystem):
    """Says which robot of a formation moves next, to which vertex, by which way.

    .. pydrake_system::

        name: FormationPlanner
        input_ports:
        - positions
        - failed
        - obstacles
        - destination
        - progress
        output_ports:
        - move
        - health

    Args:
        start: (n, 2) where the n >= 4 robots stand at first, m in map, at the vertices of triangles
            that share sides. All vertices to come are on the lattice that fits them best, so what
            a move misses its vertex by is not handed on to the next, if the estimate knows it.
        rule: `closest`, the paper's rule, or `astar`.
        parameters: room that robots need, and what counts as arrival.
        rate: how often the inputs are looked at, Hz.

    Ports:
        positions (input, vector of 2n): x, y of each robot in map, the estimate, m.
        failed (input, vector of n): 0 for a robot that is able, 1 for one that cannot move, but
            still marks its vertex if it stands at one, 2 for one that is no beacon either. Either
            is for good.
        obstacles (input, Obstacles): in map, known or sensed. What is handed on without a change
            is to be the same message. Robots that have failed, or stand beside the formation, count
            too and need not be among them.
        destination (input, vector of 2): x, y in map, m.
        progress (input, vector of 2): number of a move, and what became of it: 0 it is under way, 1
            the robot stands at its vertex, -1 it has given up. Of other moves than the present one
            nothing is taken note of.
        move (output, FormationMove): updated at `rate`, a new message only when there is something
            new to say.
        health (output, Health): looks at destinations or obstacles that could not be used, while
            the last ones count, and at positions of robots still able that were not finite
            (`bad_position`); moves that were said to be done, but where is the robot? (`unplaced`):
            its position is not finite, it is no beacon, and the next move does without it.

    A robot that cannot move serves as a beacon until it is left behind; then, or when it fails on
    the way or is no beacon either, it is an obstacle. What still hangs together is the formation,
    and those that were parted from it come back to it as movers.

    Source: [FORM] 3, see `systems.planners.formation_moves`, and for the multiple-leader-candidate
    structure its remark that any robot can lead when another fails.

    Raises:
        ValueError: fewer than four robots, a start that is no formation, or an unknown rule.
    """

    def __init__(
        self,
        *,
        start: ArrayLike,
        rule: str = "closest",
        parameters: FormationParameters | None = None,
        rate: float = 10.0,
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        places = np.asarray(start, float).reshape(-1, 2)
        require(len(places) >= 4, "start", places.tolist(), "places of at least four robots")
        require(rule in RULES, "rule", rule, " or ".join(RULES))
        self._parameters = parameters or FormationParameters()
        self._rule = RULES[rule]
        self._lattice, vertices = fit_lattice(places, self._parameters.side)
        n = len(places)
        self._positions_input = self.DeclareVectorInputPort("positions", 2 * n)
        self._failed_input = self.DeclareVectorInputPort("failed", n)
        self._obstacles_input = self.DeclareAbstractInputPort(
            "obstacles", AbstractValue.Make(Obstacles())
        )
        self._destination_input = self.DeclareVectorInputPort("destination", 2)
        self._progress_input = self.DeclareVectorInputPort("progress", 2)
        first = Memory(dict(enumerate(vertices)), FormationMove(frame_id="map"))
        self._memory = self.DeclareAbstractState(AbstractValue.Make(first))
        self.DeclarePeriodicUnrestrictedUpdateEvent(period(rate), 0.0, self._look)
        self._move_output = self.DeclareAbstractOutputPort(
            "move",
            lambda: AbstractValue.Make(FormationMove()),
            lambda context, output: output.set_value(
                context.get_abstract_state(self._memory).get_value().move
            ),
            {self.abstract_state_ticket(self._memory)},
        )
        self._counts = Counts(self, "bad_position", "bad_destination", "bad_obstacles", "unplaced")

    def positions_input_port(self) -> InputPort:
        """Returns the port of the estimated positions."""
        return self._positions_input

    def failed_input_port(self) -> InputPort:
        """Returns the port that says who has failed."""
        return self._failed_input

    def obstacles_input_port(self) -> InputPort:
        """Returns the port of the obstacles."""
        return self._obstacles_input

    def destination_input_port(self) -> InputPort:
        """Returns the port of the destination."""
        return self._destination_input

    def progress_input_port(self) -> InputPort:
        """Returns the port of what became of a move."""
        return self._progress_input

    def move_output_port(self) -> OutputPort:
        """Returns the port of the moves."""
        return self._move_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _look(self, context: Context, state: State) -> EventStatus:
        memory: Memory = context.get_abstract_state(self._memory).get_value()
        positions = self._positions_input.Eval(context).reshape(-1, 2).copy()
        failed = np.zeros(len(positions), np.int64)
        said = self._failed_input.Eval(context)
        if said.any():
            failed += np.clip(np.rint(np.nan_to_num(said)), 0, 2).astype(np.int64)
        obstacles: Obstacles = self._obstacles_input.Eval(context)
        destination = self._destination_input.Eval(context).copy()
        number, outcome = self._progress_input.Eval(context)
        bad_position = bool((~np.isfinite(positions).all(axis=1) & (failed == 0)).any())
        bad_destination = not np.isfinite(destination).all()
        bad_obstacles = not obstacles.sound
        if bad_obstacles:
            obstacles = memory.obstacles
        if bad_destination:
            destination = memory.destination
        discrete_state: Any = state.get_mutable_discrete_state()
        bad = {
            "bad_position": bad_position,
            "bad_destination": bad_destination,
            "bad_obstacles": bad_obstacles,
        }
        if not np.isfinite(destination).all():
            self._counts.add(context, discrete_state, **bad)
            return EventStatus.Succeeded()
        known = number == memory.move.number and np.isfinite(outcome)
        report = Report(
            time=context.get_time(),
            positions=positions,
            failed=failed,
            obstacles=obstacles,
            destination=destination,
            outcome=int(np.sign(outcome)) if known else 0,
        )
        following = after(memory, report, self._lattice, self._parameters, self._rule)
        unplaced = following.unplaced - memory.unplaced
        self._counts.add(context, discrete_state, **bad, unplaced=unplaced)
        if following is not memory:
            slot: Any = state.get_mutable_abstract_state(int(self._memory))
            slot.set_value(following)
        return EventStatus.Succeeded()
