"""Driving by hand from the browser: sliders, keys and a gamepad of Meshcat."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem, OutputPort

from systems.periods import period
from systems.validation import require, require_positive

Array = NDArray[np.float64]

SPEED = "speed [m/s]: W faster, S slower"
TURN = "turn [rad/s]: A left, D right"
STRAIGHT = "straight on: X"
STOP = "stop: space"
DONE = "done: Y"

_Y_BUTTON = 3  # of the W3C's standard gamepad: the upper one of four, Y on Xbox controllers
_STICK = (0, 1)  # axes of the left stick: to the right, toward oneself


@dataclass
class MeshcatDriverParameters:
    """Limits and steps.

    Attributes:
        rate: how often the browser is asked, Hz.
        max_speed: at the end of the slider and of the stick, m/s.
        max_turn_rate: rad/s.
        speed_step: of a key, m/s.
        turn_step: of a key, rad/s.
        dead_zone: of the stick, which never rests quite in the middle; part of its way.
    """

    rate: float = 20.0
    max_speed: float = 0.6
    max_turn_rate: float = 1.5
    speed_step: float = 0.05
    turn_step: float = 0.1
    dead_zone: float = 0.12

    def __post_init__(self) -> None:
        require_positive(**{name: v for name, v in vars(self).items() if name != "dead_zone"})
        require(0 <= self.dead_zone < 1, "dead_zone", self.dead_zone, "0 or more, below 1")


def stick_command(axes: list[float], parameters: MeshcatDriverParameters) -> Array | None:
    """Returns the command [v (m/s), omega (rad/s)] of a gamepad's left stick; None at rest.

    Args:
        axes: of the gamepad, -1 to 1; a stick's grow to the right and toward oneself.
        parameters: limits.
    """
    if len(axes) <= max(_STICK):
        return None
    p = parameters
    right, back = (
        0.0
        if abs(axes[k]) < p.dead_zone
        else math.copysign((min(abs(axes[k]), 1.0) - p.dead_zone) / (1 - p.dead_zone), axes[k])
        for k in _STICK
    )
    if right == 0 and back == 0:
        return None
    return np.array([-back * p.max_speed, -right * p.max_turn_rate])


class MeshcatDriver(LeafSystem):
    """Gives what a person in the browser commands, and when the person is done.

    .. pydrake_system::

        name: MeshcatDriver
        output_ports:
        - command
        - finished

    Args:
        meshcat: where the controls are.
        parameters: limits and steps.

    Ports:
        command (output, vector of 2): [v (m/s), omega (rad/s)]: of the gamepad's left stick while
            it is moved, else of the sliders, which keys move too (W, S; A, D; X; space).
        finished (output, vector of 1): how often the key Y, its button in the browser or the
            gamepad's Y was pressed. The first ends the teaching; what comes next is up to whoever
            looks at it.

    The browser is outside of the Context: a periodic event samples it, so that all others see one
    value until the next.
    """

    def __init__(
        self, *, meshcat: Meshcat, parameters: MeshcatDriverParameters | None = None
    ) -> None:
        super().__init__()
        p = parameters or MeshcatDriverParameters()
        self._meshcat, self._parameters = meshcat, p
        for name in (SPEED, TURN):
            meshcat.DeleteSlider(name, strict=False)
        for name in (STRAIGHT, STOP, DONE):
            meshcat.DeleteButton(name, strict=False)
        meshcat.AddSlider(SPEED, -p.max_speed, p.max_speed, p.speed_step, 0.0, "KeyS", "KeyW")
        meshcat.AddSlider(TURN, -p.max_turn_rate, p.max_turn_rate, p.turn_step, 0.0, "KeyD", "KeyA")
        meshcat.AddButton(STRAIGHT, "KeyX")
        meshcat.AddButton(STOP, "Space")
        meshcat.AddButton(DONE, "KeyY")
        self._command = self.DeclareDiscreteState(2)
        self._finished = self.DeclareDiscreteState(1)
        # Clicks of `straight on`, `stop` and `done` that were heard; whether the pad's Y is down.
        self._heard = self.DeclareDiscreteState(4)
        self.DeclarePeriodicDiscreteUpdateEvent(period(p.rate), 0.0, self._listen)
        self._command_output = self.DeclareStateOutputPort("command", self._command)
        self._finished_output = self.DeclareStateOutputPort("finished", self._finished)

    def command_output_port(self) -> OutputPort:
        """Returns the port of the command."""
        return self._command_output

    def finished_output_port(self) -> OutputPort:
        """Returns the port of how often the person was done."""
        return self._finished_output

    def _listen(self, context: Context, discrete_state: DiscreteValues) -> None:
        meshcat = self._meshcat
        straight, stop, done, was_down = context.get_discrete_state(self._heard).get_value()
        clicks = [meshcat.GetButtonClicks(name) for name in (STRAIGHT, STOP, DONE)]
        if clicks[0] > straight or clicks[1] > stop:
            meshcat.SetSliderValue(TURN, 0.0)
        if clicks[1] > stop:
            meshcat.SetSliderValue(SPEED, 0.0)
        command = np.array([meshcat.GetSliderValue(SPEED), meshcat.GetSliderValue(TURN)])
        pad, down = meshcat.GetGamepad(), False
        if pad.index is not None:
            buttons = list(pad.button_values)
            down = len(buttons) > _Y_BUTTON and buttons[_Y_BUTTON] > 0.5
            stick = stick_command(list(pad.axes), self._parameters)
            command = command if stick is None else stick
        presses = clicks[2] - done + (down and not was_down)
        discrete_state.set_value(self._command, command)
        discrete_state.set_value(self._heard, [*clicks, down])
        if presses > 0:
            finished = context.get_discrete_state(self._finished)[0]
            discrete_state.set_value(self._finished, [finished + presses])
