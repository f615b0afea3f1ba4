"""Geared DC motors behind an L298 bridge: current and torque of a duty cycle and a wheel's speed.

All speeds and torques are the wheel's, behind the gear. Currents are means over a period of the
pulse width modulation, and follow the voltage at once: the winding's time constant is a fraction of
a millisecond, the robot's is tens of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.framework import Context, InputPort, LeafSystem, OutputPort

from systems.compiled import compiled, packed
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

PWM_LEVELS = 255  # of 8 bits: a command goes from -255 to 255


@dataclass
class MotorParameters:
    """Two geared motors, their bridge and their battery: the figures of data sheets.

    Sources. Gear ratio, torque and current: sellers' sheets of the yellow "TT" motor, 1:48, at 6 V
    (SunFounder 3in1 kit: no load 150 mA, stall torque 0.8 kgf cm; Adafruit 3777: no load 160 mA,
    stalled 1.5 A). They give 200-250 turns a minute at 6 V and 90 at 3 V; [NAV] says about 90 at
    6-12 V, and its figure is ours. Bridge: ST L298 data sheet, typical V_CEsat of both transistors
    of the path together 1.35 + 1.2 V at 1 A and 2.0 + 1.7 V at 2 A: a straight line through both.
    The rotor's inertia is estimated: a cylinder of 6 g and 6 mm radius.

    Attributes:
        rated_voltage: at the motor's terminals, of the four figures that follow, V.
        no_load_speed: rad/s; 9.425 is 90 turns a minute.
        no_load_current: A. What it makes in torque is the gear's friction.
        stall_torque: N m; 0.8 kgf cm.
        stall_current: A.
        gear_ratio: turns of the rotor to one of the wheel.
        rotor_inertia: of the rotor itself, kg m^2.
        battery_voltage: V; two lithium cells.
        bridge_voltage: what the bridge takes at a current near none, V.
        bridge_resistance: what it takes beyond that, by current, Ohm.
        chopped: which pins of the L298 get the pulses. `enable` (as Arduino sketches do it:
            `analogWrite(ENA, ...)`): between pulses the bridge is off, the current dies out through
            the diodes and the motor coasts; nothing brakes at duty 0 but the gear's friction.
            `inputs`, with enable high: between pulses the motor is shorted, so that its speed is
            in proportion to the duty cycle and it brakes.
        right_gain: speed of the right motor at the same duty cycle, over the nominal one.
        left_gain: likewise of the left one.
    """

    rated_voltage: float = 6.0
    no_load_speed: float = 9.425
    no_load_current: float = 0.15
    stall_torque: float = 0.0785
    stall_current: float = 1.5
    gear_ratio: float = 48.0
    rotor_inertia: float = 1e-7
    battery_voltage: float = 7.4
    bridge_voltage: float = 1.4
    bridge_resistance: float = 1.15
    chopped: Literal["enable", "inputs"] = "enable"
    right_gain: float = 0.98
    left_gain: float = 1.01

    def __post_init__(self) -> None:
        numbers = {k: v for k, v in vars(self).items() if k != "chopped"}
        bridge = {k: numbers.pop(k) for k in ("bridge_voltage", "bridge_resistance")}
        require_non_negative(rotor_inertia=numbers.pop("rotor_inertia"), **bridge)
        require_positive(**numbers)
        require(
            self.chopped in ("enable", "inputs"), "chopped", self.chopped, "'enable' or 'inputs'"
        )
        require(
            self.stall_current > self.no_load_current,
            "stall_current",
            self.stall_current,
            f"greater than the no_load_current of {self.no_load_current:.3g} A",
        )
        model = MotorModel(self)
        least = self.bridge_voltage + self.no_load_current * model.resistance
        require(
            self.battery_voltage > least,
            "battery_voltage",
            self.battery_voltage,
            f"greater than {least:.3g} V, below which the wheels do not turn",
        )


class MotorModel:
    """The straight lines of a DC motor behind a bridge; functions of arrays, element by element.

    At its rated voltage without the bridge: torque at the wheel falls from `stall_torque` at rest
    to zero at `no_load_speed`, current from `stall_current` to `no_load_current`. So
    I = (U - k_e w) / R and torque = k_t I, less the friction k_t `no_load_current`. That k_t is
    less than k_e is the gear's loss; we take the same share of it whichever drives the other, which
    understates how hard a motor brakes that is reversed at speed.

    Args:
        parameters: the figures.
        gain: speed at the same duty cycle, over the nominal one; a number or one for each wheel.

    Attributes:
        back_emf: k_e, V s/rad of the wheel.
        torque_constant: k_t, N m/A at the wheel.
        resistance: R of the winding, and of the bridge, Ohm.
        friction: Coulomb friction of the gear at the wheel, N m.
        damping: steepest slope of torque by speed, N m s/rad.
        inertia: of the rotor as the wheel feels it, kg m^2.
        max_speed: of the slower wheel without load at full duty, rad/s.
        figures: (4,) battery's and bridge's voltage (V), resistance (Ohm), 1 if chopped at the
            enable pins: what `_currents` takes.
    """

    def __init__(self, parameters: MotorParameters, gain: ArrayLike = 1.0) -> None:
        p = parameters
        self.parameters = p
        winding = p.rated_voltage / p.stall_current
        no_load_emf = p.rated_voltage - winding * p.no_load_current
        self.back_emf = no_load_emf / p.no_load_speed / np.asarray(gain, float)
        self.torque_constant = p.stall_torque / (p.stall_current - p.no_load_current)
        self.resistance = winding + p.bridge_resistance
        self.friction = self.torque_constant * p.no_load_current
        self.damping = float(np.max(self.torque_constant * self.back_emf / self.resistance))
        self.inertia = p.rotor_inertia * p.gear_ratio**2
        self._voltage_lost = p.no_load_current * self.resistance
        at_enable = float(p.chopped == "enable")
        self.figures = np.array([p.battery_voltage, p.bridge_voltage, self.resistance, at_enable])
        self.max_speed = float(np.min(self.steady_speed(1.0)))

    def current(self, duty: ArrayLike, speed: ArrayLike) -> Array:
        """Returns the mean current, A, positive when it drives the wheel forward.

        Chopped at the enable pins, current flows only during the pulse, and only the way that the
        bridge points: I = D (U - U_0 - k_e w) / R, never below zero. That is for pulses longer than
        the winding's time constant, and a back-EMF below the battery's voltage. Chopped at the
        inputs, it flows on through transistor and diode: I = (D U - k_e w -+ U_0) / R, and none
        while the difference is less than U_0.

        Args:
            duty: -1 to 1; beyond that it counts as that.
            speed: of the wheel, rad/s.
        """
        d, w, k_e = np.broadcast_arrays(
            np.asarray(duty, float), np.asarray(speed, float), self.back_emf
        )
        currents = np.empty(d.size)
        duties, speeds, constants = (values.flatten() for values in (d, w, k_e))
        _currents(duties, speeds, constants, self.figures, currents)
        return currents.reshape(d.shape)

    def torque(self, duty: ArrayLike, speed: ArrayLike) -> Array:
        """Returns the torque at the wheel before the gear's friction, N m (see `current`)."""
        return self.torque_constant * self.current(duty, speed)

    def steady_speed(self, duty: ArrayLike) -> Array:
        """Returns the speed at which friction takes all the torque, rad/s; 0 in the dead band.

        Args:
            duty: -1 to 1.
        """
        p = self.parameters
        d = np.abs(np.asarray(duty, float))
        with np.errstate(divide="ignore"):
            if p.chopped == "enable":
                emf = p.battery_voltage - p.bridge_voltage - self._voltage_lost / d
            else:
                emf = d * p.battery_voltage - p.bridge_voltage - self._voltage_lost
        return np.asarray(np.sign(duty) * np.maximum(emf, 0.0) / self.back_emf)

    def duty(self, speed: ArrayLike) -> Array:
        """Returns the duty cycle that keeps up a speed without load, -1 to 1; 0 for speed 0.

        The inverse of `steady_speed`: it makes up for the bridge's drop and steps over the dead
        band.

        Args:
            speed: of the wheel, rad/s.
        """
        p = self.parameters
        emf = np.asarray(self.back_emf * np.asarray(speed, float))
        duties = []
        for e in emf.ravel().tolist():  # of two wheels, mostly: too few for NumPy to be quick
            if p.chopped == "enable":
                left = max(p.battery_voltage - p.bridge_voltage - abs(e), self._voltage_lost)
                size = self._voltage_lost / left
            else:
                size = (abs(e) + p.bridge_voltage + self._voltage_lost) / p.battery_voltage
            duties.append(math.copysign(min(size, 1.0), e) if e else 0.0)
        return np.array(duties).reshape(emf.shape)


@compiled("void(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1])")
def _currents(duty: Array, speed: Array, back_emf: Array, figures: Array, currents: Array) -> None:
    battery, bridge, resistance, at_enable = figures
    for k in range(len(duty)):
        d, emf = min(max(duty[k], -1.0), 1.0), back_emf[k] * speed[k]
        if at_enable:
            against = emf if d > 0 else -emf
            voltage = d * max(battery - bridge - against, 0.0)
        else:
            over = d * battery - emf
            voltage = math.copysign(max(abs(over) - bridge, 0.0), over)
        currents[k] = voltage / resistance


class DcMotors(LeafSystem):
    """The two motors of a differential drive behind an L298.

    .. pydrake_system::

        name: DcMotors
        input_ports:
        - pwm
        - wheel_speeds
        output_ports:
        - torque
        - current
        - servo_speeds
        - steady_speeds

    Args:
        parameters: of motors, bridge, battery.

    Ports:
        pwm (input, vector of 2): [right, left], -255 to 255.
        wheel_speeds (input, vector of 2): [right, left] (rad/s) as the wheels turn.
        torque (output, vector of 2): [right, left] (N m) at the wheels, before friction.
        current (output, vector of 2): [right, left] (A), means over a pulse.
        servo_speeds (output, vector of 2): [right, left] (rad/s): the set-points with which the
            actuators of `add_differential_drive(..., motor=...)` make that torque.
        steady_speeds (output, vector of 2): [right, left] (rad/s) that wheels without load and
            without inertia turn at: for the kinematic twin. Depends on pwm only.

    A motor is a speed servo: its torque falls with speed. Drake's discrete solver takes the torque
    d (w_servo - w) of a servo at the end of the step, so no motor is too stiff for a time step.
    With w_servo = w + torque(w) / d, w at the beginning of the step, the torque is the motor's own
    to the first order in the time step h, and exactly when the speed is steady, stalled for
    example. A motor whose torque falls more slowly (at a small duty cycle) speeds up as if its
    inertia were more by up to d h: 8 % of the default robot's at 10 ms.
    """

    def __init__(self, *, parameters: MotorParameters | None = None) -> None:
        super().__init__()
        p = parameters or MotorParameters()
        self._model = MotorModel(p, [p.right_gain, p.left_gain])
        # The servo's gain is that of the nominal motor, for both.
        self._by_current = self._model.torque_constant / MotorModel(p).damping
        self._pwm_input = self.DeclareVectorInputPort("pwm", 2)
        self._speeds_input = self.DeclareVectorInputPort("wheel_speeds", 2)
        both = {self._pwm_input.ticket(), self._speeds_input.ticket()}
        self._torque_output = self.DeclareVectorOutputPort("torque", 2, self._calc_torque, both)
        self._current_output = self.DeclareVectorOutputPort("current", 2, self._calc_current, both)
        self._servo_speeds_output = self.DeclareVectorOutputPort(
            "servo_speeds", 2, self._calc_servo_speeds, both
        )
        self._steady_speeds_output = self.DeclareVectorOutputPort(
            "steady_speeds", 2, self._calc_steady_speeds, {self._pwm_input.ticket()}
        )

    def pwm_input_port(self) -> InputPort:
        """Returns the port of the duty cycles."""
        return self._pwm_input

    def wheel_speeds_input_port(self) -> InputPort:
        """Returns the port of the speeds at which the wheels turn."""
        return self._speeds_input

    def torque_output_port(self) -> OutputPort:
        """Returns the port of the torques."""
        return self._torque_output

    def current_output_port(self) -> OutputPort:
        """Returns the port of the currents."""
        return self._current_output

    def servo_speeds_output_port(self) -> OutputPort:
        """Returns the port of the actuators' set-points."""
        return self._servo_speeds_output

    def steady_speeds_output_port(self) -> OutputPort:
        """Returns the port of the speeds without load."""
        return self._steady_speeds_output

    def _duty(self, context: Context) -> Array:
        duty: Array = self._pwm_input.Eval(context) / PWM_LEVELS
        return duty

    def _current(self, context: Context, speeds: Array) -> Array:
        current = np.empty(2)
        model = self._model
        _currents(self._duty(context), packed(speeds), model.back_emf, model.figures, current)
        return current

    def _calc_torque(self, context: Context, output: Any) -> None:
        current = self._current(context, self._speeds_input.Eval(context))
        output.SetFromVector(self._model.torque_constant * current)

    def _calc_current(self, context: Context, output: Any) -> None:
        output.SetFromVector(self._current(context, self._speeds_input.Eval(context)))

    def _calc_servo_speeds(self, context: Context, output: Any) -> None:
        speeds = self._speeds_input.Eval(context)
        output.SetFromVector(speeds + self._by_current * self._current(context, speeds))

    def _calc_steady_speeds(self, context: Context, output: Any) -> None:
        duty = np.clip(self._duty(context), -1.0, 1.0)
        output.SetFromVector(self._model.steady_speed(duty))
