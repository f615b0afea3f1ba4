"""What the filter in `shell_ekf` does with what it hears: remember, carry on, weigh, refuse.

No Drake: it works on arrays that belong to the caller, such as a block's discrete state. The model
is in `shell_model`, the gyro's memory in `rate_trail`, the numbers are in `shell_ekf_parameters`.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, packed
from systems.estimators.rate_trail import WIDTH, RateTrail, add_row, rows_for
from systems.estimators.shell_ekf_parameters import ShellEkfParameters
from systems.estimators.shell_model import (
    BIAS,
    DELAY,
    THETA,
    ShellModel,
    State,
    Turn,
)
from systems.flow.shell import ShellView
from systems.markers.layout import MarkerMap
from systems.messages import PoseEstimate, RotationIncrement
from systems.noise import sample_index
from systems.shell.angles import one_rotation, rotation_vector
from systems.small_matrices import eigen

Array = NDArray[np.float64]

REASONS = (
    "accepted", "gated", "unconfirmed", "ambiguous", "bad_marker_pose", "stale", "future",
    "restarted", "flow_accepted", "flow_gated", "bad_flow", "stale_flow", "bad_imu",
    "bad_reference",
)  # fmt: skip

_SAME_TIME = 1e-6  # s
_IDENTITY, _UNUSED = np.eye(3), np.zeros(0)
_WAIT = 0.1  # s; a marker pose so far ahead of the flow is carried back rather than waited for

# The memory: time of the state, stamps of the last increment and of the last marker pose; then the
# IMU's last sample and for how long it has not changed; then what the gyro is believed to tell now.
_TIME, _FLOW_STAMP, _MARKER_STAMP = 0, 1, 2
_SAMPLE, _UNCHANGED, _RATE = slice(3, 9), 9, slice(10, 13)


class Memory(NamedTuple):
    """What the filter remembers beside its state.

    Attributes:
        numbers: (13,) times, and what the IMU told.
        trail: (n * WIDTH,) rates of the recent past, see `rate_trail`.
        refused: (11,) the last refused pose: rotation, marker, time; NaN for none.
    """

    numbers: Array
    trail: Array
    refused: Array


@dataclass
class Now:
    """What one step works on.

    Attributes:
        t: s.
        state: of the last picture.
        memory: changed in place.
        counts: what became of the measurements, by `REASONS`.
        nis: of the marker pose that was compared, if one was.
    """

    t: float
    state: State
    memory: Memory
    counts: Counter[str] = field(default_factory=Counter)
    nis: float = math.nan


class ShellFusion:
    """Fuses gyro, flow and marker poses.

    Args:
        view: the camera as planned, and its place over the shell.
        marker_map: the markers as planned, in shell.
        height: of base_link's origin over the shell, m; it is held.
        parameters: noise and options.
        rate: of the IMU and of the filter, Hz.
    """

    def __init__(
        self,
        *,
        view: ShellView,
        marker_map: MarkerMap,
        height: float,
        parameters: ShellEkfParameters,
        rate: float,
    ) -> None:
        self.parameters = p = parameters
        self.model = ShellModel(view=view, height=height, noise=p.process_noise())
        self.rate = rate
        self._age = 1 / rate if p.imu_age is None else p.imu_age
        places = np.array([marker.X_WM.translation() for marker in marker_map])
        self._directions = places / np.linalg.norm(places, axis=1, keepdims=True)
        self._floor = np.diag(
            np.repeat([p.marker_rotation_noise**2, p.marker_position_noise**2], 3)
        )

    def new_memory(self) -> Memory:
        """Returns the memory of a filter that has heard nothing yet."""
        numbers = np.zeros(13)
        numbers[: _SAMPLE.stop] = np.nan
        rows = rows_for(2 * self.parameters.horizon + _WAIT, self.rate)
        return Memory(numbers, np.full(rows * WIDTH, np.nan), np.full(11, np.nan))

    # --- Every sample of the IMU ---

    def listen(
        self, t: float, memory: Memory, sample: Array | None, reference: Array | None
    ) -> list[str]:
        """Remembers the rates of this moment.

        Args:
            t: s.
            memory: changed in place.
            sample: (6,) of the IMU; None if it is not used.
            reference: (6,) velocity of the reference; None if it is not known to move.

        Returns:
            What was wrong with them.
        """
        p = self.parameters
        bad_imu, bad_reference = _listen(
            memory.numbers, memory.trail.reshape(-1, WIDTH), t, sample_index(t, self.rate),
            self.rate, _UNUSED if sample is None else packed(sample),
            _UNUSED if reference is None else packed(reference),
            float(p.gyro_range), float(p.imu_silence),
        )  # fmt: skip
        return ["bad_reference"] * bad_reference + ["bad_imu"] * bad_imu

    def _trail(self, memory: Memory) -> RateTrail:
        return RateTrail(memory.trail.reshape(-1, WIDTH), rate=self.rate, age=self._age)

    # --- Every picture ---

    def has_news(
        self, t: float, memory: Memory, increment: RotationIncrement, told: PoseEstimate
    ) -> bool:
        """Whether `take` would change anything."""
        return (
            _is_new(increment, memory.numbers[_FLOW_STAMP])
            or _is_new(told, memory.numbers[_MARKER_STAMP])
            or self._is_overdue(t, memory)
        )

    def take(self, now: Now, increment: RotationIncrement, told: PoseEstimate) -> None:
        """Takes what is new of an increment and a marker pose; long without both, goes on.

        Args:
            now: changed.
            increment: of the body over the shell, in base_link.
            told: `X_RB` by markers.
        """
        numbers = now.memory.numbers
        if _is_new(increment, numbers[_FLOW_STAMP]):
            numbers[_FLOW_STAMP] = increment.stamp
            self._take_increment(increment, now)
        if _is_new(told, numbers[_MARKER_STAMP]):
            numbers[_MARKER_STAMP] = told.stamp
            self._take_marker_pose(told, now)
        if self._is_overdue(now.t, now.memory):
            self._advance(now, now.t - 0.8 * self.parameters.horizon)

    def _is_overdue(self, t: float, memory: Memory) -> bool:
        return bool(t - memory.numbers[_TIME] > self.parameters.horizon)

    def _turn(self, now: Now, start: float, end: float) -> Turn:
        delay = float(now.state.x[DELAY])
        newest = sample_index(now.t, self.rate)
        return self._trail(now.memory).between(start - delay, end - delay, newest)

    def _advance(self, now: Now, stamp: float, turn: Turn | None = None) -> Array:
        """Carries the state to the time of a picture; returns what the flow is to see of it."""
        numbers, refused = now.memory.numbers, now.memory.refused
        if turn is None:
            turn = self._turn(now, float(numbers[_TIME]), stamp)
        now.state, u, seen = self.model.predict(now.state, turn)
        if not math.isnan(refused[0]):
            refused[:9] = (refused[:9].reshape(3, 3) @ one_rotation(u)).ravel()
        numbers[_TIME] = stamp
        return seen

    def _take_increment(self, increment: RotationIncrement, now: Now) -> None:
        p, memory = self.parameters, now.memory.numbers
        dt = increment.stamp - increment.previous_stamp
        sound = dt > 0 and increment.stamp <= now.t + _SAME_TIME
        sound &= bool(np.isfinite(increment.rotation).all())
        if not (sound and _is_covariance(increment.covariance)):
            now.counts["bad_flow"] += 1
            return
        if increment.previous_stamp < memory[_TIME] - _SAME_TIME:
            now.counts["stale_flow"] += 1
            return
        if increment.previous_stamp > memory[_TIME] + _SAME_TIME:
            self._advance(now, increment.previous_stamp)
        R_before = now.state.R
        turn = self._turn(now, float(memory[_TIME]), increment.stamp)
        seen = self._advance(now, increment.stamp, turn._replace(way=increment.rotation))
        slack = p.flow_floor**2 + p.flow_noise**2 * float(increment.rotation @ increment.rotation)
        # Where the rate changes, what is not known of the delay is mostly noise (`delay_slack`).
        bend = turn.rate_after - turn.rate_before
        slack += p.delay_slack**2 * float(bend @ bend) * float(now.state.P[DELAY, DELAY])
        update = self.model.update_flow(
            now.state, seen, increment.rotation,
            increment.covariance + slack * _IDENTITY, p.flow_gate,
        )  # fmt: skip
        now.counts["flow_accepted" if update.accepted else "flow_gated"] += 1
        if update.accepted:
            now.state = update.state
            # What a silent gyro would tell: how the body went last.
            memory[_RATE] = rotation_vector(R_before.T @ now.state.R) / dt + now.state.x[BIAS]

    def _take_marker_pose(self, told: PoseEstimate, now: Now) -> None:
        p, memory = self.parameters, now.memory.numbers
        R, place = told.pose.rotation().matrix(), told.pose.translation()
        sound = bool(np.isfinite(R).all() and np.isfinite(place).all() and place.any())
        if not (sound and _is_covariance(told.covariance)):
            now.counts["bad_marker_pose"] += 1
        elif told.stamp > now.t + _SAME_TIME:
            now.counts["future"] += 1
        elif told.stamp < memory[_TIME] - p.horizon:
            now.counts["stale"] += 1
        elif told.ambiguous:
            now.counts["ambiguous"] += 1
        else:
            if told.stamp > memory[_TIME] + (_WAIT if "flow" in p.sensors else 0.0):
                self._advance(now, told.stamp)
            turn = self._turn(now, told.stamp, float(memory[_TIME]))
            R_now = R @ one_rotation(self.model.turned(now.state, turn))
            moved = np.zeros((6, 6))
            moved[:3, :3] = moved[3:, 3:] = R_now @ R.T
            place = moved[:3, :3] @ place
            noise = moved @ told.covariance @ moved.T + self._floor
            noise[3:, 3:] += p.height_noise**2 * np.outer(place, place) / (place @ place)
            self._weigh(now, R_now, place, noise)

    def _weigh(self, now: Now, R: Array, place: Array, noise: Array) -> None:
        """Takes a marker pose of the state's time, starts from it, or refuses it."""
        p, model = self.parameters, self.model
        marker = int(np.argmax(self._directions @ place))
        unknown = float(np.diag(now.state.P)[THETA].max()) > p.start_beyond**2
        state = now.state
        if unknown and not self._agrees_with_refused(now, R):
            now.counts["unconfirmed"] += 1
            now.memory.refused[:] = [*R.ravel(), marker, now.memory.numbers[_TIME]]
            return
        if unknown:
            state = model.start(state, R, marker, p.initial_deviation**2)
        update = model.update_marker(state, marker, R, place, noise, p.marker_gate)
        now.nis = update.nis
        another = now.memory.refused[9] != marker
        if not update.accepted and another and self._agrees_with_refused(now, R):
            now.counts["restarted"] += 1
            fresh = State(R, np.zeros_like(state.x), p.initial_covariance(len(self._directions)))
            state = model.start(fresh, R, marker, p.initial_deviation**2)
            update = model.update_marker(state, marker, R, place, noise, p.marker_gate)
        now.counts["accepted" if update.accepted else "gated"] += 1
        if update.accepted:
            now.state = update.state
            now.memory.refused[:] = np.nan
        elif another:
            now.memory.refused[:] = [*R.ravel(), marker, now.memory.numbers[_TIME]]

    def _agrees_with_refused(self, now: Now, R: Array) -> bool:
        before = now.memory.refused[:9].reshape(3, 3)
        if math.isnan(now.memory.refused[9]):
            return False
        angle = np.linalg.norm(rotation_vector(R @ before.T))
        return bool(angle < self.parameters.recovery_angle)

    # --- Now ---

    def pose(self, t: float, state: State, memory: Memory) -> tuple[Array, Array]:
        """Returns the pose now: the state's, carried on by the gyro.

        Args:
            t: s.
            state: of the last picture, with or without the markers.
            memory: as it is.

        Returns:
            (3, 3) `R_RB`; (3,) `p_RB`, m.
        """
        turn = self._turn_ahead(t, state, memory)
        if turn is None:
            return state.R, self.model.position(state)
        return self.model.pose_after(state, turn)

    def covariance(self, t: float, state: State, memory: Memory) -> Array:
        """Returns the covariance (6, 6) of the pose now: rotation, then position.

        Args:
            t: s.
            state: of the last picture, without the markers.
            memory: as it is.
        """
        turn = self._turn_ahead(t, state, memory)
        if turn is not None:
            state, _, _ = self.model.predict(state, turn)
        return self.model.pose_covariance(state)

    def _turn_ahead(self, t: float, state: State, memory: Memory) -> Turn | None:
        start = float(memory.numbers[_TIME])
        if math.isnan(start):
            return None
        turn = self._trail(memory).between(start - float(state.x[DELAY]), t)
        turn.rate_after[:] = 0.0  # only the beginning of this interval is uncertain
        return turn


@compiled("UniTuple(b1, 2)(f8[::1], f8[:,::1], f8, i8, f8, f8[::1], f8[::1], f8, f8)")
def _listen(
    numbers: Array,
    trail: Array,
    t: float,
    k: int,
    rate: float,
    sample: Array,
    reference: Array,
    gyro_range: float,
    silence: float,
) -> tuple[bool, bool]:
    """Remembers the rates of sample k, see `ShellFusion.listen`.

    Returns:
        Whether the sample and the reference's velocity were wrong; what is not used is of size 0.
    """
    if math.isnan(numbers[_TIME]):
        numbers[_TIME] = t
    turning, bad_reference = np.zeros(3), False
    if len(reference):
        for i in range(3):
            bad_reference = bad_reference or not math.isfinite(reference[i])
        if not bad_reference:
            turning[:] = reference[:3]
    lost, told = True, numbers[_SAMPLE]
    if len(sample):
        unchanged, within = True, True
        for i in range(6):
            unchanged = unchanged and sample[i] == told[i]
            within = within and (i >= 3 or abs(sample[i]) <= gyro_range)
            told[i] = sample[i]
        numbers[_UNCHANGED] = numbers[_UNCHANGED] + 1.0 / rate if unchanged else 0.0
        lost = not within or numbers[_UNCHANGED] >= silence
        if not lost:
            numbers[_RATE] = sample[:3]
    add_row(trail, k, numbers[_RATE], turning, lost, rate)
    return lost and len(sample) > 0, bad_reference


def _is_new(message: RotationIncrement | PoseEstimate, last_stamp: float) -> bool:
    return bool(message.valid and message.stamp != last_stamp)


def _is_covariance(P: Array) -> bool:
    """Whether a matrix is finite, symmetric and not negative, and not all zeros."""
    return _has_sound_eigenvalues(np.array(P, order="C"))


@compiled("b1(f8[:,::1])")
def _has_sound_eigenvalues(P: Array) -> bool:
    """The same of a matrix that may be spoilt."""
    n, largest, askew = len(P), 0.0, 0.0
    for i in range(n):
        for j in range(n):
            if not math.isfinite(P[i, j]):
                return False
            largest = max(largest, abs(P[i, j]))
        for j in range(i):
            askew = max(askew, abs(P[i, j] - P[j, i]))
            P[i, j] = P[j, i] = (P[i, j] + P[j, i]) / 2
    if largest == 0.0:
        return False
    values, vectors = np.empty(n), np.empty((n, n))
    eigen(P, values, vectors)
    return values.min() >= -1e-9 * values.max() and askew <= 1e-6 * values.max()
