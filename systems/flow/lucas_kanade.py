"""Sparse Lucas-Kanade: corners of one picture found again in the next, with a predicted start."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    Context,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
    State,
)

from systems.flow.shell import ShellView
from systems.health import Counts
from systems.markers.detector import is_picture
from systems.messages import CameraImage, PointMatches, RotationIncrement
from systems.periods import period
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

_HISTORY = 0.25  # s of the gyro that are remembered: a picture may arrive that late
_EARLY = 1e-9  # s; why, `systems.sensors.sampled` tells
_MOVED = 3.0  # px, predicted: then not even the noise of two pictures is the same


@dataclass
class LucasKanadeParameters:
    """What is tracked, and what counts as found again.

    Attributes:
        max_points: at most so many corners.
        quality: least response of a corner, as a part of the best one's.
        min_distance: between corners, px.
        decimate: corners are looked for in the picture reduced by this, 1 or greater, in which
            noise makes fewer of them; they are followed in the whole one. On noisy pictures of
            steel 2 takes an eighth of the time.
        window: side of the square that is compared, px, odd.
        levels: of the pyramid above the picture itself, without a prediction.
        predicted_levels: the same with one, for half the time. On steel with a hole every 96 px,
            one level makes up for a prediction that is 40 px wrong.
        max_error: mean difference of the two squares above which a point is dropped, grey levels.
            On pictures of steel with a noise of 1.5 grey levels, points found again have 2.2 to
            3.2; points that slipped to the next hole, 3 to 40.
        max_interval: pictures further apart are not compared, s.
    """

    max_points: int = 500
    quality: float = 0.01
    min_distance: float = 7.0
    decimate: float = 2.0
    window: int = 21
    levels: int = 3
    predicted_levels: int = 1
    max_error: float = 10.0
    max_interval: float = 0.1

    def __post_init__(self) -> None:
        require(self.max_points >= 1, "max_points", self.max_points, "1 or greater")
        require(0 < self.quality < 1, "quality", self.quality, "between 0 and 1")
        require_non_negative(min_distance=self.min_distance)
        sound = math.isfinite(self.decimate) and self.decimate >= 1
        require(sound, "decimate", self.decimate, "1 or greater")
        odd = self.window >= 5 and self.window % 2 == 1
        require(odd, "window", self.window, "odd, 5 or greater (px)")
        for name in ("levels", "predicted_levels"):
            require(0 <= getattr(self, name) <= 8, name, getattr(self, name), "0 to 8")
        require_positive(max_error=self.max_error, max_interval=self.max_interval)


def corners(image: Grey, parameters: LucasKanadeParameters) -> Array:
    """Returns points (n, 2) px that can be found again, surest first (Shi and Tomasi)."""
    p, size = parameters, np.array(image.shape[::-1])
    reduced = np.maximum(np.rint(size / p.decimate), 1).astype(int)
    if p.decimate > 1:
        image = cv2.resize(image, reduced.tolist(), interpolation=cv2.INTER_AREA)
    found = cv2.goodFeaturesToTrack(image, p.max_points, p.quality, p.min_distance / p.decimate)
    if found is None:
        return np.zeros((0, 2))
    # From pixels' centres to their corners, where the picture begins, and back.
    return (found.reshape(-1, 2).astype(float) + 0.5) * (size / reduced) - 0.5


def track(
    previous: Grey,
    current: Grey,
    points: Array,
    parameters: LucasKanadeParameters,
    predicted: Array | None = None,
) -> tuple[Array, NDArray[np.bool_]]:
    """Looks for points of one picture in another.

    Args:
        previous: uint8 (height, width).
        current: of the same size.
        points: (n, 2) px, in `previous`.
        parameters: window, pyramid and the error test.
        predicted: (n, 2) px, where they are looked for first; NaN for where they were. Left out:
            all where they were.

    Returns:
        (n, 2) px in `current`, and (n,) whether they pass the test of status (the tracker converged
        in the picture) and of error (it looks the same there).
    """
    if len(points) == 0:
        return np.zeros((0, 2)), np.zeros(0, bool)
    start, flags, levels = None, 0, parameters.levels
    if predicted is not None:
        levels = parameters.predicted_levels
        start = _as_opencv(np.where(np.isfinite(predicted), predicted, points))
        flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    found, status, error = cv2.calcOpticalFlowPyrLK(
        previous,
        current,
        _as_opencv(points),
        start,
        winSize=(parameters.window, parameters.window),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01),
        flags=flags,
    )
    found = found[:, 0].astype(float)
    good = (status.ravel() == 1) & (error.ravel() <= parameters.max_error)
    return found, good


def _as_opencv(points: Array) -> NDArray[np.float32]:
    return np.ascontiguousarray(points[:, None], np.float32)


def remembered(history: Array, t: float, rate: Array) -> Array:
    """Returns a gyro's history with one more sample.

    Args:
        history: (n, 4) times (s) and integrals of the rate (rad), the latest last; NaN before the
            first.
        t: of the sample, s, later than all.
        rate: (3,) rad/s; held since the last sample.
    """
    last = history[-1]
    angle = last[1:] + rate * (t - last[0]) if math.isfinite(last[0]) else np.zeros(3)
    return np.concatenate([history[1:], [[t, *angle]]])


def turned_between(history: Array, start: float, end: float) -> Array | None:
    """Returns the integral (3,) rad of a gyro's rate from `start` to `end` (s).

    What the history does not cover counts as its mean rate in the rest; None when it covers less
    than half.
    """
    known = history[np.isfinite(history[:, 0])]
    if len(known) == 0:
        return None
    first, last = max(start, known[0, 0]), min(end, known[-1, 0])
    if last - first < 0.5 * (end - start):
        return None
    angles = np.array([np.interp([first, last], known[:, 0], known[:, k]) for k in (1, 2, 3)])
    mean: Array = (angles[:, 1] - angles[:, 0]) / (last - first)
    return mean * (end - start)


def sound(image: CameraImage, view: ShellView) -> bool:
    """Whether it is a picture of the camera's size that was taken at some time."""
    size = (view.camera.height, view.camera.width)
    return math.isfinite(image.stamp) and is_picture(image.data) and image.data.shape[:2] == size


def grey(image: CameraImage) -> Grey:
    """Returns the picture in grey, (height, width)."""
    if image.data.ndim == 3:
        return np.asarray(cv2.cvtColor(image.data, cv2.COLOR_RGB2GRAY), np.uint8)
    return np.ascontiguousarray(image.data)


class PointTracker(LeafSystem):
    """Finds points of each picture again in the next.

    .. pydrake_system::

        name: PointTracker
        input_ports:
        - image
        - imu
        - increment
        output_ports:
        - matches
        - health

    Args:
        view: the camera and its place over the shell, for the prediction.
        parameters: what is tracked.
        rate: of the camera, Hz.
        processing_time: from the camera's sample times, multiples of its period, to the matches, s,
            less than a period. It must exceed the camera's latency, else a picture waits for the
            next turn.
        imu_rate: of the gyro, Hz.

    Ports:
        image (input, CameraImage): grey or RGB. One without pixels or of another size than the
            camera's is dropped and counted.
        imu (input, vector of 6): [gyro (rad/s), accel (m/s^2)] in B; need not be connected. A
            sample that is not finite is dropped and counted.
        increment (input, RotationIncrement): the last one that was found, for the prediction when
            the gyro says nothing; need not be connected.
        matches (output, PointMatches): of the last two good pictures, at `rate`; none and the stamp
            NaN before the second.
        health (output, Health): `bad_image`, `bad_imu`; `gap`, pictures too far apart, or out of
            order; `frozen`, a picture that is the last one bit by bit while the gyro turns;
            `no_points`, two pictures without a match. What is counted of these sends no matches.

    The tracker looks for each point where the rotation since the last picture carries it. On steel
    with a hole every 2 mm, plain tracking takes the next hole for the last one above half the
    pattern a picture, and shows another, perfectly consistent motion. The gyro feels the reference
    robot's motion too: the prediction may be wrong by nearly half the pattern.

    Source: Zhang and Lam, "Relative Localization System Design for SnailBot", algorithm 2: up to
    500 corners of quality 0.01 at distance 7, pyramidal Lucas-Kanade, tests of status and error
    (printed there with the letters exchanged: a point is good when its status is set and its error
    small). We differ in the predicted start, and hand on the matches instead of their mean (see
    `systems.flow.mean_flow`). Shi and Tomasi, "Good features to track", CVPR 1994; Bouguet,
    "Pyramidal implementation of the Lucas Kanade feature tracker", Intel 2000.

    Raises:
        ValueError: a rate or the processing time out of range.
    """

    def __init__(
        self,
        *,
        view: ShellView,
        parameters: LucasKanadeParameters | None = None,
        rate: float = 60.0,
        processing_time: float = 0.005,
        imu_rate: float = 300.0,
    ) -> None:
        super().__init__()
        require_positive(rate=rate, imu_rate=imu_rate)
        possible = 0 <= processing_time < 1 / rate
        require(possible, "processing_time", processing_time, f"0 to less than {1 / rate:g} (s)")
        self._view = view
        self._parameters = parameters or LucasKanadeParameters()
        self._image_input = self.DeclareAbstractInputPort(
            "image", AbstractValue.Make(CameraImage())
        )
        self._imu_input = self.DeclareVectorInputPort("imu", 6)
        self._increment_input = self.DeclareAbstractInputPort(
            "increment", AbstractValue.Make(RotationIncrement())
        )
        self._length = max(2, math.ceil(_HISTORY * imu_rate))
        self._history = self.DeclareDiscreteState(np.full(self._length * 4, np.nan))
        self._seen = self.DeclareDiscreteState([math.nan])  # stamp of the last picture, good or bad
        self._last = self.DeclareAbstractState(AbstractValue.Make(CameraImage()))
        self._matches = self.DeclareAbstractState(AbstractValue.Make(PointMatches()))
        self._matches_output = self.DeclareAbstractOutputPort(
            "matches",
            lambda: AbstractValue.Make(PointMatches()),
            lambda context, output: output.set_value(
                context.get_abstract_state(self._matches).get_value()
            ),
            {self.abstract_state_ticket(self._matches)},
        )
        self._counts = Counts(self, "bad_image", "bad_imu", "gap", "frozen", "no_points")
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            period(rate), max(processing_time - _EARLY, 0.0), self._look
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period(imu_rate), 0.0, self._remember)

    def image_input_port(self) -> InputPort:
        """Returns the port of the pictures."""
        return self._image_input

    def imu_input_port(self) -> InputPort:
        """Returns the port of the gyro."""
        return self._imu_input

    def increment_input_port(self) -> InputPort:
        """Returns the port of the last rotation."""
        return self._increment_input

    def matches_output_port(self) -> OutputPort:
        """Returns the port of the matches."""
        return self._matches_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _remember(self, context: Context, discrete_state: DiscreteValues) -> None:
        if not self._imu_input.HasValue(context):
            return
        rate = self._imu_input.Eval(context)[:3]
        history = context.get_discrete_state(self._history).get_value().reshape(-1, 4)
        t = context.get_time()
        if not np.isfinite(rate).all():
            self._counts.add(context, discrete_state, bad_imu=1)
        elif not t <= history[-1, 0]:
            discrete_state.set_value(self._history, remembered(history, t, rate).ravel())

    def _look(self, context: Context, state: State) -> EventStatus:
        image: CameraImage = self._image_input.Eval(context)
        last: CameraImage = context.get_abstract_state(self._last).get_value()
        if math.isnan(image.stamp) or image.stamp == context.get_discrete_state(self._seen)[0]:
            return EventStatus.DidNothing()
        discrete_state: Any = state.get_mutable_discrete_state()
        discrete_state.set_value(self._seen, [image.stamp])
        matches = PointMatches(frame_id=image.frame_id)
        reason = None
        if not sound(image, self._view):
            reason = "bad_image"
        else:
            _set(state, self._last, image)
            if math.isfinite(last.stamp):
                matches, reason = self._compare(context, last, image)
        if reason is not None:
            self._counts.add(context, discrete_state, **{reason: 1})
        _set(state, self._matches, matches)
        return EventStatus.Succeeded()

    def _compare(
        self, context: Context, last: CameraImage, image: CameraImage
    ) -> tuple[PointMatches, str | None]:
        """Returns the matches of two sound pictures, or why there are none."""
        nothing = PointMatches(frame_id=image.frame_id)
        if not 0 < image.stamp - last.stamp <= self._parameters.max_interval:
            return nothing, "gap"
        before, now = grey(last), grey(image)
        points = corners(before, self._parameters)
        turned = self._turned(context, last.stamp, image.stamp)
        predicted = None if turned is None else self._view.turned(points, turned)
        if predicted is not None and np.array_equal(before, now):
            shift = np.abs(predicted - points)
            if np.isfinite(shift).any() and np.nanmedian(shift.max(axis=1)) > _MOVED:
                return nothing, "frozen"
        found, good = track(before, now, points, self._parameters, predicted)
        good &= self._view.inside(found)
        if not good.any():
            return nothing, "no_points"
        return PointMatches(
            image.stamp, last.stamp, image.frame_id, points[good], found[good]
        ), None

    def _turned(self, context: Context, start: float, end: float) -> Array | None:
        """Returns the rotation (3,) rad that is expected between two times; None if unknown."""
        history = context.get_discrete_state(self._history).get_value().reshape(-1, 4)
        turned = turned_between(history, start, end)
        if turned is None and self._increment_input.HasValue(context):
            last: RotationIncrement = self._increment_input.Eval(context)
            interval = last.stamp - last.previous_stamp
            # Only one that ends near where this begins tells of the present speed.
            if interval > 0 and abs(last.stamp - start) <= self._parameters.max_interval:
                turned = last.rotation * ((end - start) / interval)
        return turned if turned is not None and np.isfinite(turned).all() else None


def _set(state: State, index: Any, value: Any) -> None:
    state.get_mutable_abstract_state(int(index)).set_value(value)
