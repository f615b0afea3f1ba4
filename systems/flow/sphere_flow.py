"""Flow on the sphere: the rigid rotation of a shell that carries matched points where they went.

Each match is taken back to the shell, where the curvature and the perspective are gone: one
rotation carries all points of the earlier picture to those of the later one. Consensus (RANSAC)
finds it among outliers, least squares over the agreeing points refine it, and their Jacobian gives
its covariance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.compiled import packed
from systems.flow.rotation_fit import common_turn, nearest_turn, refine_turn
from systems.flow.shell import ShellView
from systems.health import Counts
from systems.memo import Memo
from systems.messages import PointMatches, RotationIncrement
from systems.noise import generator, stream_key
from systems.periods import period
from systems.shell.angles import rotation_vector
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

REASONS = ("bad_matches", "bad_point", "few_points", "no_agreement")
_NEARLY_ALL = 0.9  # part of the points that makes a search among pairs needless
_STREAM = stream_key(0, "samples of sphere flow")


@dataclass
class SphereFlowParameters:
    """What agrees, and how sure it is.

    Attributes:
        pixel_noise: standard deviation of a match, each coordinate, px; that of the residuals is
            taken when it is larger.
        inlier_px: a match agrees with a rotation that carries it so near, px.
        hypotheses: pairs of matches that are tried. 64 find a pair of good ones among 70 % bad ones
            in 99.7 % of cases.
        min_inliers: fewer give no increment.
        min_inlier_share: part of the matches that must agree.
        points_per_error: so many neighbours share one error; the covariance grows by it. 1 for
            independent errors, as of projected points.
    """

    pixel_noise: float = 0.05
    inlier_px: float = 1.0
    hypotheses: int = 64
    min_inliers: int = 10
    min_inlier_share: float = 0.3
    points_per_error: float = 1.0

    def __post_init__(self) -> None:
        require_positive(pixel_noise=self.pixel_noise, inlier_px=self.inlier_px)
        require(self.hypotheses >= 1, "hypotheses", self.hypotheses, "1 or greater")
        require(self.min_inliers >= 3, "min_inliers", self.min_inliers, "3 or greater")
        require_non_negative(min_inlier_share=self.min_inlier_share)
        share = self.min_inlier_share
        require(share <= 1, "min_inlier_share", share, "0 to 1")
        sound = math.isfinite(self.points_per_error) and self.points_per_error >= 1
        require(sound, "points_per_error", self.points_per_error, "1 or greater")


@dataclass(frozen=True, eq=False)
class SphereFit:
    """An increment, and what was dropped on the way to it.

    Attributes:
        increment: not `valid` when there is none.
        dropped: reason to number; keys are `REASONS`.
    """

    increment: RotationIncrement
    dropped: dict[str, int]


def pair_rotations(before: Array, after: Array) -> Array:
    """Returns the rotations (b, 3, 3) that carry pairs of directions to others, best in the middle.

    Args:
        before: (b, 2, 3) unit vectors.
        after: (b, 2, 3) the same after the rotation; where the angle of a pair has changed, its
            bisector and its plane are carried exactly.
    """

    def frames(pairs: Array) -> Array:
        along = pairs[:, 0] + pairs[:, 1]
        normal = np.cross(pairs[:, 0], pairs[:, 1])
        with np.errstate(invalid="ignore", divide="ignore"):
            along = along / np.linalg.norm(along, axis=1, keepdims=True)
            normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        return np.stack([along, normal, np.cross(along, normal)], axis=2)

    R: Array = frames(after) @ frames(before).transpose(0, 2, 1)
    return R


class SphereFlowEstimator:
    """Finds the rotation of a body over a shell from matched points.

    Args:
        view: the camera and its place.
        parameters: what agrees.
        body_frame: name of B in the messages.
    """

    def __init__(
        self,
        *,
        view: ShellView,
        parameters: SphereFlowParameters | None = None,
        body_frame: str = "base_link",
    ) -> None:
        self.view = view
        self.parameters = parameters or SphereFlowParameters()
        self.body_frame = body_frame
        self._nothing = RotationIncrement(frame_id=body_frame)
        X_SC, camera = view.X_SC, view.camera
        self._place = *camera.matrices, packed(X_SC.rotation().matrix()), packed(X_SC.translation())
        # On the shell, a pixel is this long in the middle of the picture. The limit is doubled as
        # two points give a rough rotation.
        focal = min(camera.K[0, 0], camera.K[1, 1])
        limit = 2 * self.parameters.inlier_px * view.parameters.camera_height / focal
        # |R a - b|^2 = 2 (r^2 - b'R a).
        self._least = float(view.radius**2 - limit**2 / 2)

    def fit(self, matches: PointMatches) -> SphereFit:
        """Fits one rotation to the matches of two pictures.

        The samples depend on the stamp alone, so that the same matches give the same answer.
        """
        p = self.parameters
        dropped = dict.fromkeys(REASONS, 0)
        shapes = matches.previous.shape == matches.current.shape == (len(matches), 2)
        interval = matches.stamp - matches.previous_stamp
        if not (shapes and math.isfinite(interval) and interval > 0):
            dropped["bad_matches"] = int(not math.isnan(matches.stamp))
            return SphereFit(self._nothing, dropped)
        before, after, pixels = self.view.matched(matches.previous, matches.current)
        dropped["bad_point"] = len(matches) - len(pixels)
        if len(before) < p.min_inliers:
            dropped["few_points"] = 1
            return SphereFit(self._nothing, dropped)
        inliers, R_B2B1 = self._consensus(before, after, matches.stamp)
        enough = max(float(p.min_inliers), p.min_inlier_share * len(before))
        agreed = np.count_nonzero(inliers)
        if agreed < enough:
            dropped["no_agreement"] = 1
            return SphereFit(self._nothing, dropped)
        if agreed < len(before):
            R_B2B1 = nearest_turn(before[inliers], after[inliers])
        inverse = np.empty((3, 3))
        count, squares = refine_turn(
            before, pixels, *self._place, p.inlier_px, enough, R_B2B1, inverse
        )  # fmt: skip
        if count == 0:
            dropped["no_agreement"] = 1
            return SphereFit(self._nothing, dropped)
        variance = max(p.pixel_noise**2, squares / (2 * count - 3))
        increment = RotationIncrement(
            stamp=matches.stamp,
            previous_stamp=matches.previous_stamp,
            frame_id=self.body_frame,
            rotation=rotation_vector(R_B2B1.T),
            covariance=variance * p.points_per_error * inverse,
            inliers=count,
            inlier_share=count / len(matches),
        )
        return SphereFit(increment, dropped)

    def _consensus(
        self, before: Array, after: Array, stamp: float
    ) -> tuple[NDArray[np.bool_], Array]:
        """Returns a rotation (3, 3) that most points agree with, after which of them (n,) do.

        That of all points, if nearly all agree with it; else the best of those of random pairs.
        """
        p, view, n = self.parameters, self.view, len(before)
        R_all, together = np.empty((3, 3)), np.empty(n, bool)
        if common_turn(before, after, self._least, R_all, together) >= _NEARLY_ALL * n:
            return together, R_all
        random = generator(_STREAM, round(abs(stamp) * 1e9))
        first = random.integers(0, n, p.hypotheses)
        second = (first + random.integers(1, n, p.hypotheses)) % n
        pairs = np.stack([first, second], axis=1)
        R = pair_rotations(before[pairs] / view.radius, after[pairs] / view.radius)
        # All b'R a are one product of matrices.
        products = (after[:, :, None] * before[:, None, :]).reshape(n, 9)
        agree = products @ R.reshape(-1, 9).T > self._least
        best = np.argmax(agree.sum(axis=0))
        return agree[:, best], R[best]


class SphereFlow(LeafSystem):
    """Tells how the body turned over the shell between two pictures.

    .. pydrake_system::

        name: SphereFlow
        input_ports:
        - matches
        output_ports:
        - increment
        - health

    Args:
        estimator: the algorithm with the camera and its place.
        rate: how often new matches are looked at to count what was dropped, Hz; at least the
            camera's.

    Ports:
        matches (input, PointMatches): of two pictures.
        increment (output, RotationIncrement): the rotation of B relative to the shell, in B, with
            its covariance and the times of the two pictures; computed once for the same matches.
            Not `valid` (stamp NaN) without enough matches that agree. The velocity over the shell
            is radius times (w_y, -w_x) over the interval, forward and left.
        health (output, Health): `bad_matches`, messages of mismatched shapes or without an
            interval; `bad_point`, points out of the picture, not finite, or not on the shell;
            `few_points` and `no_agreement`, messages that gave no increment.

    The covariance is that of the matches' errors. Errors of radius, height and focal length scale
    the rotation about x and y and are the same in all increments: whoever fuses them estimates the
    scale.

    Source: ours; consensus after Fischler and Bolles, "Random sample consensus", 1981.

    Raises:
        ValueError: rate out of range.
    """

    def __init__(self, *, estimator: SphereFlowEstimator, rate: float = 60.0) -> None:
        super().__init__()
        require_positive(rate=rate)
        self._estimator = estimator
        self._memo = Memo(self, "fit")
        self._matches_input = self.DeclareAbstractInputPort(
            "matches", AbstractValue.Make(PointMatches())
        )
        self._increment_output = self.DeclareAbstractOutputPort(
            "increment",
            lambda: AbstractValue.Make(RotationIncrement()),
            lambda context, output: output.set_value(self._fit(context).increment),
            {self._matches_input.ticket()},
        )
        self._last_stamp = self.DeclareDiscreteState([math.nan])
        self._counts = Counts(self, *REASONS)
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._count)

    def matches_input_port(self) -> InputPort:
        """Returns the port of the matches."""
        return self._matches_input

    def increment_output_port(self) -> OutputPort:
        """Returns the port of the increments."""
        return self._increment_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _fit(self, context: Context) -> SphereFit:
        fit: SphereFit = self._memo(context, self._estimator.fit, self._matches_input.Eval(context))
        return fit

    def _count(self, context: Context, discrete_state: DiscreteValues) -> None:
        matches: PointMatches = self._matches_input.Eval(context)
        last_stamp = context.get_discrete_state(self._last_stamp)[0]
        if not math.isnan(matches.stamp) and matches.stamp != last_stamp:
            discrete_state.set_value(self._last_stamp, [matches.stamp])
            self._counts.add(context, discrete_state, **self._fit(context).dropped)
