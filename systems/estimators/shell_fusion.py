"""What the filter in `shell_ekf` does with what it hears: remember, carry on, weigh, refuse.

No Drake: it works on arrays that belong to the caller, such as a block's discrete state. The model
is in `shell_model`, the gyro's memory in `rate_trail`, the numbers are in `shell_ekf_parameters`.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, packed
from systems.estimators.rate_trail import RateTrail
from systems.estimators.shell_ekf_parameters import ShellEkfParameters
from systems.estimators.shell_memory import (
    FLOW_STAMP,
    MARKER_STAMP,
    NEWEST,
    RATE,
    REFUSED,
    REFUSED_MARKER,
    REFUSED_R,
    TIME,
    covariance_now,
    fresh_memory,
    listen,
    pose_now,
    trail_of,
)
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


@dataclass
class Now:
    """What one step works on.

    Attributes:
        t: s.
        state: of the last picture.
        memory: (m,) see `ShellFusion.new_memory`; changed in place.
        counts: what became of the measurements, by `REASONS`.
        nis: of the marker pose that was compared, if one was.
    """

    t: float
    state: State
    memory: Array
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
        self._listening = np.array([rate, p.gyro_range, p.imu_silence])
        self._ahead = np.array([rate, self._age, self.model.reach, p.rock_time])

    def new_memory(self) -> Array:
        """Returns the memory of a filter that has heard nothing yet, one vector."""
        return fresh_memory(2 * self.parameters.horizon + _WAIT, self.rate)

    # --- Every sample of the IMU ---

    def listen(
        self, t: float, memory: Array, sample: Array | None, reference: Array | None
    ) -> tuple[bool, bool]:
        """Remembers the rates of this moment.

        Args:
            t: s.
            memory: changed in place.
            sample: (6,) of the IMU; None if it is not used.
            reference: (6,) velocity of the reference; None if it is not known to move.

        Returns:
            Whether each of them was wrong.
        """
        return listen(
            t, memory, _UNUSED if sample is None else packed(sample),
            _UNUSED if reference is None else packed(reference), self._listening,
        )  # fmt: skip

    def _trail(self, memory: Array) -> RateTrail:
        return RateTrail(trail_of(memory), rate=self.rate, age=self._age)

    # --- Every picture ---

    def has_news(
        self, t: float, memory: Array, increment: RotationIncrement, told: PoseEstimate
    ) -> bool:
        """Whether `take` would change anything."""
        return (
            _is_new(increment, memory[FLOW_STAMP])
            or _is_new(told, memory[MARKER_STAMP])
            or self._is_overdue(t, memory)
        )

    def take(self, now: Now, increment: RotationIncrement, told: PoseEstimate) -> None:
        """Takes what is new of an increment and a marker pose; long without both, goes on.

        Args:
            now: changed.
            increment: of the body over the shell, in base_link.
            told: `X_RB` by markers.
        """
        memory = now.memory
        if _is_new(increment, memory[FLOW_STAMP]):
            memory[FLOW_STAMP] = increment.stamp
            self._take_increment(increment, now)
        if _is_new(told, memory[MARKER_STAMP]):
            memory[MARKER_STAMP] = told.stamp
            self._take_marker_pose(told, now)
        if self._is_overdue(now.t, now.memory):
            self._advance(now, now.t - 0.8 * self.parameters.horizon)

    def _is_overdue(self, t: float, memory: Array) -> bool:
        return bool(t - memory[TIME] > self.parameters.horizon)

    def _turn(self, now: Now, start: float, end: float) -> Turn:
        delay = float(now.state.x[DELAY])
        newest = int(now.memory[NEWEST])
        return self._trail(now.memory).between(start - delay, end - delay, newest)

    def _advance(self, now: Now, stamp: float, turn: Turn | None = None) -> Array:
        """Carries the state to the time of a picture; returns what the flow is to see of it."""
        memory = now.memory
        if turn is None:
            turn = self._turn(now, float(memory[TIME]), stamp)
        now.state, u, seen = self.model.predict(now.state, turn)
        if not math.isnan(memory[REFUSED_MARKER]):
            refused = memory[REFUSED_R].reshape(3, 3)
            refused[:] = refused @ one_rotation(u)
        memory[TIME] = stamp
        return seen

    def _take_increment(self, increment: RotationIncrement, now: Now) -> None:
        p, memory = self.parameters, now.memory
        way = packed(increment.rotation)
        dt = increment.stamp - increment.previous_stamp
        sound = dt > 0 and increment.stamp <= now.t + _SAME_TIME
        if not (sound and _is_sound(way, increment.covariance)):
            now.counts["bad_flow"] += 1
            return
        if increment.previous_stamp < memory[TIME] - _SAME_TIME:
            now.counts["stale_flow"] += 1
            return
        if increment.previous_stamp > memory[TIME] + _SAME_TIME:
            self._advance(now, increment.previous_stamp)
        R_before = now.state.R
        turn = self._turn(now, float(memory[TIME]), increment.stamp)
        seen = self._advance(now, increment.stamp, turn._replace(way=way))
        # Where the rate changes, what is not known of the delay is mostly noise (`delay_slack`).
        bend = math.dist(turn.rate_before, turn.rate_after)
        slack = p.flow_floor**2 + p.flow_noise**2 * float(way @ way)
        slack += (p.delay_slack * bend) ** 2 * float(now.state.P[DELAY, DELAY])
        update = self.model.update_flow(
            now.state, seen, way, increment.covariance + slack * _IDENTITY, p.flow_gate
        )
        now.counts["flow_accepted" if update.accepted else "flow_gated"] += 1
        if update.accepted:
            now.state = update.state
            # What a silent gyro would tell: how the body went last.
            memory[RATE] = rotation_vector(R_before.T @ now.state.R) / dt + now.state.x[BIAS]

    def _take_marker_pose(self, told: PoseEstimate, now: Now) -> None:
        p, memory = self.parameters, now.memory
        R, place = told.pose.rotation().matrix(), told.pose.translation()
        sound = place.any() and _is_sound(np.append(R, place), told.covariance)
        if not sound:
            now.counts["bad_marker_pose"] += 1
        elif told.stamp > now.t + _SAME_TIME:
            now.counts["future"] += 1
        elif told.stamp < memory[TIME] - p.horizon:
            now.counts["stale"] += 1
        elif told.ambiguous:
            now.counts["ambiguous"] += 1
        else:
            if told.stamp > memory[TIME] + (_WAIT if "flow" in p.sensors else 0.0):
                self._advance(now, told.stamp)
            turn = self._turn(now, told.stamp, float(memory[TIME]))
            noise = (told.covariance, self._floor, p.height_noise**2)
            self._weigh(now, *self.model.marker_pose_now(now.state, turn, R, place, noise))

    def _weigh(self, now: Now, R: Array, place: Array, noise: Array) -> None:
        """Takes a marker pose of the state's time, starts from it, or refuses it."""
        p, model = self.parameters, self.model
        marker = int(np.argmax(self._directions @ place))
        unknown = float(np.diag(now.state.P)[THETA].max()) > p.start_beyond**2
        state = now.state
        if unknown and not self._agrees_with_refused(now, R):
            now.counts["unconfirmed"] += 1
            now.memory[REFUSED] = [*R.ravel(), marker, now.memory[TIME]]
            return
        if unknown:
            state = model.start(state, R, marker, p.initial_deviation**2)
        update = model.update_marker(state, marker, R, place, noise, p.marker_gate)
        now.nis = update.nis
        another = now.memory[REFUSED_MARKER] != marker
        if not update.accepted and another and self._agrees_with_refused(now, R):
            now.counts["restarted"] += 1
            fresh = State(R, np.zeros_like(state.x), p.initial_covariance(len(self._directions)))
            state = model.start(fresh, R, marker, p.initial_deviation**2)
            update = model.update_marker(state, marker, R, place, noise, p.marker_gate)
        now.counts["accepted" if update.accepted else "gated"] += 1
        if update.accepted:
            now.state = update.state
            now.memory[REFUSED] = np.nan
        elif another:
            now.memory[REFUSED] = [*R.ravel(), marker, now.memory[TIME]]

    def _agrees_with_refused(self, now: Now, R: Array) -> bool:
        before = now.memory[REFUSED_R].reshape(3, 3)
        if math.isnan(now.memory[REFUSED_MARKER]):
            return False
        angle = np.linalg.norm(rotation_vector(R @ before.T))
        return bool(angle < self.parameters.recovery_angle)

    # --- Now ---

    def pose(self, t: float, R: Array, x: Array, memory: Array) -> Array:
        """Returns the pose now: the state's, carried on by the gyro.

        Args:
            t: s.
            R: (3, 3) of the last picture.
            x: (n,), with or without the markers.
            memory: as it is.

        Returns:
            (3, 4) `R_RB` and `p_RB`, m.
        """
        X_RB = np.empty((3, 4))
        pose_now(t, packed(memory), packed(R), packed(x), self._ahead, X_RB)
        return X_RB

    def covariance(self, t: float, R: Array, x: Array, lower: Array, memory: Array) -> Array:
        """Returns the covariance (6, 6) of the pose now: rotation, then position.

        Args:
            t: s.
            R: (3, 3) of the last picture.
            x: (n,), with or without the markers.
            lower: the lower half of P, row by row, see `small_matrices.fold`.
            memory: as it is.
        """
        P = np.empty((6, 6))
        covariance_now(
            t, packed(memory), packed(R), packed(x), packed(lower), self._ahead,
            self.model.variances, self.model.rock_step, P,
        )  # fmt: skip
        return P


def _is_new(message: RotationIncrement | PoseEstimate, last_stamp: float) -> bool:
    return bool(message.valid and message.stamp != last_stamp)


def _is_sound(values: Array, P: Array) -> bool:
    """Whether values are finite, and a matrix is finite, symmetric, not negative and not zero."""
    return _are_sound(values, np.array(P, order="C"))


@compiled("b1(f8[::1], f8[:,::1])")
def _are_sound(values: Array, P: Array) -> bool:
    """The same, with a matrix that may be spoilt."""
    for value in values:
        if not math.isfinite(value):
            return False
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
