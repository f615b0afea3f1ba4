"""Which cameras of a formation take pictures: those that are needed and have something to see."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.messages import Detections
from systems.periods import period
from systems.validation import require, require_non_negative, require_positive


class FormationCameras(LeafSystem):
    """Switches the cameras of a formation: one whose picture shows no marker rests for a while.

    On its way to the others a robot has all of them before it, and none behind; at the end of its
    way it is the other way round. What shows nobody now will not show anybody at once: so half the
    pictures need not be taken, whatever the robot is at.

    .. pydrake_system::

        name: FormationCameras
        input_ports:
        - looking
        - robot{k}_{camera}
        output_ports:
        - robot{k}_{camera}_active

    Args:
        robots: how many, N.
        cameras: names of the cameras that each of them has.
        rest: how long a camera rests, s; 0 for not at all.
        rate: Hz; at least that of the pictures.

    Ports:
        looking (input, vector of N): 1 for each robot whose cameras are needed.
        robot{k}_{camera} (input, Detections): what camera `camera` of robot k, from 0, shows.
        robot{k}_{camera}_active (output, vector of 1): 1 while that camera is to take pictures,
            else 0.

    Raises:
        ValueError: no robots or cameras, a rest below 0, or a rate out of range.
    """

    def __init__(
        self,
        *,
        robots: int,
        cameras: Sequence[str] = ("front_camera", "rear_camera"),
        rest: float = 0.5,
        rate: float = 20.0,
    ) -> None:
        super().__init__()
        require(robots >= 1, "robots", robots, "1 or more")
        require(len(cameras) >= 1, "cameras", list(cameras), "names of one or more")
        require_non_negative(rest=rest)
        require_positive(rate=rate)
        self._rest = rest
        self._names = list(cameras)
        names = [f"robot{k}_{camera}" for k in range(robots) for camera in cameras]
        nothing = AbstractValue.Make(Detections())
        self._looking_input = self.DeclareVectorInputPort("looking", robots)
        self._detections_inputs = [self.DeclareAbstractInputPort(name, nothing) for name in names]
        # Of each camera: stamp of the last picture that was looked at, and when it is rested, s.
        self._stamps = self.DeclareDiscreteState(np.full(len(names), -math.inf))
        self._rested = self.DeclareDiscreteState(np.full(len(names), -math.inf))
        self._active = self.DeclareDiscreteState(np.ones(len(names)))
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._update)
        self._active_outputs = [
            self.DeclareVectorOutputPort(
                f"{name}_active",
                1,
                lambda context, output, k=k: self._calc_active(context, output, k),
                {self.discrete_state_ticket(self._active), self._looking_input.ticket()},
            )
            for k, name in enumerate(names)
        ]

    def looking_input_port(self) -> InputPort:
        """Returns the port of whose cameras are needed."""
        return self._looking_input

    def detections_input_port(self, robot: int, camera: str) -> InputPort:
        """Returns the port of what one camera of one robot shows."""
        return self._detections_inputs[self._index(robot, camera)]

    def active_output_port(self, robot: int, camera: str) -> OutputPort:
        """Returns the port of whether one camera of one robot takes pictures."""
        return self._active_outputs[self._index(robot, camera)]

    def _index(self, robot: int, camera: str) -> int:
        return robot * len(self._names) + self._names.index(camera)

    def _calc_active(self, context: Context, output: Any, k: int) -> None:
        looking = self._looking_input.Eval(context)[k // len(self._names)]
        awake = context.get_discrete_state(self._active)[k]
        output.SetFromVector([float(looking > 0 and awake > 0)])

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        stamps = context.get_discrete_state(self._stamps).get_value()
        rested = context.get_discrete_state(self._rested).get_value()
        every = [port.Eval(context) for port in self._detections_inputs]
        new = [k for k, before in enumerate(stamps.tolist()) if every[k].stamp > before]
        if new:
            stamps, rested = stamps.copy(), rested.copy()
            for k in new:
                seen: Detections = every[k]
                stamps[k] = seen.stamp
                rested[k] = -math.inf if len(seen) else seen.stamp + self._rest
            discrete_state.set_value(self._stamps, stamps)
            discrete_state.set_value(self._rested, rested)
        awake = context.get_time() >= rested - 1e-9
        discrete_state.set_value(self._active, awake.astype(float))
