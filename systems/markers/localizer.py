"""The body's pose in the map, from all markers of the map that a picture shows, solved together."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.cameras import PinholeCamera
from systems.health import Counts
from systems.markers.carried_pose import pose_of_body, poses_of_map
from systems.markers.corner_noise import corner_deviation
from systems.markers.layout import MarkerMap
from systems.markers.planar_pose import SAME_POSE, closed_form, planar_poses
from systems.markers.pnp import (
    PnpSolution,
    covariance,
    refine,
    squared_errors_by_object,
)
from systems.markers.sifting import sift
from systems.memo import Memo
from systems.messages import Detections, PoseEstimate
from systems.periods import period
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

_TAIL = 4.0
_TOLERANCE = 1e-5  # of chi-square: the pose is then within a hundredth of its deviation
_HOPELESS = 1000.0  # chi-square by which a second minimum cannot come near the first any more

REASONS = ("unknown_id", "repeated_id", "too_small", "bad_corners", "outlier", "inconsistent")


@dataclass
class LocalizerParameters:
    """What is trusted.

    Attributes:
        pixel_noise: standard deviation of a corner's coordinate, of a large marker, px.
        pixel_noise_by_side: more noise of small ones, px^2 (see `systems.markers.corner_noise`).
        use: `all` markers together, or the `best` one (largest in the picture) alone.
        min_side: markers whose shortest side is shorter are left out, px.
        max_reprojection: a marker whose corners lie further (RMS) from where the common pose puts
            them is left out, px; a pose that leaves more is none.
        ambiguity_ratio: a pose counts as ambiguous unless its likelihood is this many times that
            of the best other minimum.
    """

    pixel_noise: float = 0.3
    pixel_noise_by_side: float = 0.0
    use: str = "all"
    min_side: float = 12.0
    max_reprojection: float = 2.0
    ambiguity_ratio: float = 1000.0

    def __post_init__(self) -> None:
        require_positive(
            pixel_noise=self.pixel_noise,
            max_reprojection=self.max_reprojection,
            ambiguity_ratio=self.ambiguity_ratio,
        )
        require_non_negative(min_side=self.min_side, pixel_noise_by_side=self.pixel_noise_by_side)
        require(self.use in ("all", "best"), "use", self.use, "'all' or 'best'")


@dataclass(frozen=True, eq=False)
class Localization:
    """What one picture says of the pose.

    Attributes:
        pose: the best pose; not `valid` when there is none.
        alternative: the other minimum, when there is one; both solutions travel on.
        dropped: reason (one of `REASONS`) to number of markers left out for it;
            `inconsistent` counts pictures whose markers fit no common pose.
    """

    pose: PoseEstimate
    alternative: PoseEstimate
    dropped: dict[str, int]


@dataclass(frozen=True, eq=False)
class _View:
    """The markers of one picture.

    Attributes:
        index: (n,) where they are in the map.
        points: (n, 4, 3) their corners in W, m.
        rays: (n, 4, 2) x/z, y/z of the corners.
        by_ray: (n, 4, 2, 2) derivative by the rays of the pixels, in units of their noise: the
            squared errors of this view are chi-squares, not px^2.
        deviation: (n,) noise of the corners, px.
    """

    index: NDArray[np.intp]
    points: Array
    rays: Array
    by_ray: Array
    deviation: Array

    def select(self, mask: NDArray[np.bool_]) -> _View:
        if mask.all():
            return self
        return _View(*(getattr(self, entry.name)[mask] for entry in fields(self)))

    def refine(self, R: Array, p: Array) -> PnpSolution:
        """Returns the minima over all corners together, from b poses."""
        return refine(
            R,
            p,
            self.points.reshape(-1, 3),
            self.rays.reshape(-1, 2),
            self.by_ray.reshape(-1, 2, 2),
            tolerance=_TOLERANCE,
            hopeless=_HOPELESS,
        )

    def errors_by_marker(self, R: Array, p: Array) -> Array:
        """Returns (b, n) root mean square errors of each marker under each of b poses, px."""
        errors = squared_errors_by_object(R, p, self.points, self.rays, self.by_ray)
        return np.sqrt(errors / 4) * self.deviation

    def agree(self, solution: PnpSolution, limit: float) -> NDArray[np.bool_]:
        """Returns (n,) which markers lie within `limit` (px) of where the best minimum has them."""
        best = [int(np.argmin(solution.squared_error))]
        return np.asarray(self.errors_by_marker(solution.R[best], solution.p[best])[0] <= limit)


class MapLocalizer:
    """Solves `X_WB` of the body from detections of a map's markers.

    Args:
        marker_map: the markers, in W.
        camera: the camera.
        X_BC: pose of the optical frame in the body.
        parameters: what is trusted.
        body_frame: name of the body's frame.
    """

    def __init__(
        self,
        *,
        marker_map: MarkerMap,
        camera: PinholeCamera,
        X_BC: RigidTransform,
        parameters: LocalizerParameters | None = None,
        body_frame: str = "base_link",
    ) -> None:
        self.marker_map = marker_map
        self.camera = camera
        self.X_BC = X_BC
        self.parameters = parameters or LocalizerParameters()
        self.body_frame = body_frame
        self._nothing = PoseEstimate(frame_id=marker_map.frame, child_frame_id=body_frame)
        self._index = {marker.id: k for k, marker in enumerate(marker_map)}
        self._sizes = np.array([marker.size for marker in marker_map])
        self._corners = marker_map.corners(np.array(list(self._index)))
        X_CB = X_BC.inverse()
        self._X_CB = X_CB.rotation().matrix().copy(order="C"), X_CB.translation().copy()
        poses = [marker.X_WM for marker in marker_map]
        self._R_MW = np.array([X.rotation().matrix().T for X in poses]).reshape(-1, 3, 3)
        self._p_WM = np.array([X.translation() for X in poses]).reshape(-1, 3)

    def locate(self, detections: Detections) -> Localization:
        """Solves the body's pose from one picture's detections; never NaN, never an exception."""
        dropped = dict.fromkeys(REASONS, 0)
        nothing = Localization(self._nothing, self._nothing, dropped)
        if len(detections) == 0:
            return nothing
        index, corners = self._usable(detections, dropped)
        if len(index) == 0:
            return nothing
        rays, by_ray = self.camera.rays(corners)
        p = self.parameters
        deviation = corner_deviation(corners, p.pixel_noise, p.pixel_noise_by_side)
        by_ray /= deviation[:, None, None, None]
        view = _View(index, self._corners[index], rays, by_ray, deviation)
        if len(index) > 1:
            solvable, R_CM, p_CM = closed_form(rays, self._sizes[index])
            view = view.select(solvable)
        count = len(view.index)
        dropped["bad_corners"] += len(index) - count
        if count == 0:
            return nothing
        if count == 1:
            solutions, errors = self._single(view)
        else:
            candidates = self._candidates(R_CM, p_CM, view.index)
            solutions, errors = self._common_pose(*candidates, view)
        if len(solutions) == 0 or not math.isfinite(solutions.squared_error[0]):
            dropped["bad_corners"] += count
            return nothing
        used = errors.shape[1]
        dropped["outlier"] += count - used
        rms = np.sqrt((errors * errors).sum(axis=1) / used).tolist()
        if rms[0] > p.max_reprojection:
            dropped["inconsistent"] += 1
            return nothing
        ambiguous = False
        if len(solutions) > 1:
            first, second = solutions.squared_error.tolist()
            ratio = _log_likelihood_ratio(first, second, 8 * used)
            ambiguous = ratio < math.log(p.ambiguity_ratio)
        covariances = covariance(solutions.information, 1.0)
        estimates = [
            self._estimate(
                solutions.R[k], solutions.p[k], covariances[k], rms[k], detections.stamp,
                ambiguous, used,
            )
            for k in range(len(solutions))
            if rms[k] <= p.max_reprojection
        ]  # fmt: skip
        pose, alternative, *_ = *estimates, self._nothing
        return Localization(pose, alternative, dropped)

    def _usable(
        self, detections: Detections, dropped: dict[str, int]
    ) -> tuple[NDArray[np.intp], Array]:
        """Returns where the markers that serve are in the map, and their corners.

        The largest come first; the others are counted.
        """
        ours = detections.family in ("", self.marker_map.family.name)
        ids = detections.ids.tolist()
        known = np.array([self._index.get(i, -1) if ours else -1 for i in ids], np.intp)
        chosen, left_out = sift(known, detections.corners, self.parameters.min_side)
        dropped |= left_out
        if self.parameters.use == "best":
            chosen = chosen[:1]
        return known[chosen], detections.corners[chosen]

    def _candidates(self, R_CM: Array, p_CM: Array, index: NDArray[np.intp]) -> tuple[Array, Array]:
        """Returns `X_CW` by each marker's two poses: (2n, 3, 3) and (2n, 3)."""
        R_CW = R_CM @ self._R_MW[index][:, None]
        p_CW = p_CM - (R_CW @ self._p_WM[index][:, None, :, None])[..., 0]
        return R_CW.reshape(-1, 3, 3), p_CW.reshape(-1, 3)

    def _single(self, view: _View) -> tuple[PnpSolution, Array]:
        """Returns both poses by one marker: minima, or a minimum and its mirror image.

        And the errors (px) of the marker: (0 to 2, 1).
        """
        poses, k = planar_poses(view.rays, view.by_ray, self._sizes[view.index]), view.index[0]
        b = np.count_nonzero(np.isfinite(poses.squared_error))
        R, p, product = np.empty((b, 3, 3)), np.empty((b, 3)), np.empty((b, 7, 7))
        poses_of_map(
            poses.R[0], poses.p[0], self._R_MW[k], self._p_WM[k], view.points[0], view.rays[0],
            view.by_ray[0], R, p, product,
        )  # fmt: skip
        solution = PnpSolution(R, p, product[:, 6, 6], product[:, :6, :6])
        return solution, np.sqrt(solution.squared_error[:, None] / 4) * view.deviation

    def _common_pose(self, R: Array, p: Array, view: _View) -> tuple[PnpSolution, Array]:
        """Returns the best one or two minima over all markers that agree on them.

        Both poses of the first and largest marker are refined over all markers. When one of them
        then lies too far off, the search starts anew from every candidate, each with those that
        agree with it, and the largest agreement wins.

        Returns:
            The minima, the best first, and the errors (px) of the m markers that they rest on:
            (1 or 2, m).
        """
        limit = self.parameters.max_reprojection
        # A marker's other pose leads to the other minimum, where there is one.
        solution = view.refine(R[:2], p[:2])
        errors = view.errors_by_marker(solution.R, solution.p)
        if not (errors[solution.squared_error.argmin()] <= limit).all():
            # A marker's own pose, carried over to others, errs more than a common pose will.
            near = view.errors_by_marker(R, p) <= 4 * limit
            trials = [
                self._consensus(view, R[[k, k ^ 1]], p[[k, k ^ 1]], near[k]) for k in range(len(R))
            ]
            agreements = [
                ((used & view.agree(s, limit)).sum(), -s.squared_error.min()) for s, used in trials
            ]
            solution, used = trials[max(range(len(trials)), key=agreements.__getitem__)]
            errors = view.select(used).errors_by_marker(solution.R, solution.p)
        order = _distinct_best_first(solution)
        return solution.select(order), errors[order]

    def _consensus(
        self, view: _View, R: Array, p: Array, used: NDArray[np.bool_]
    ) -> tuple[PnpSolution, NDArray[np.bool_]]:
        """Refines over the markers that agree, until those used are those that agree."""
        if used.sum() < 2:
            used = np.ones(len(used), bool)
        solution = view.select(used).refine(R, p)
        for _ in range(len(used)):
            agree = view.agree(solution, self.parameters.max_reprojection)
            if agree.sum() < 2 or (agree == used).all():
                break
            used = agree
            solution = view.select(used).refine(solution.R, solution.p)
        return solution, used

    def _estimate(
        self,
        R_CW: Array,
        p_CW: Array,
        covariance: Array,
        rms: float,
        stamp: float,
        ambiguous: bool,
        markers: int,
    ) -> PoseEstimate:
        R_WB, p_WB, cov = np.empty((3, 3)), np.empty(3), np.empty((6, 6))
        pose_of_body(R_CW, p_CW, covariance, *self._X_CB, R_WB, p_WB, cov)
        return PoseEstimate(
            stamp=stamp,
            frame_id=self.marker_map.frame,
            child_frame_id=self.body_frame,
            pose=RigidTransform(RotationMatrix(R_WB), p_WB),
            covariance=cov,
            reprojection_rms=rms,
            ambiguous=ambiguous,
            markers=markers,
        )


def _log_likelihood_ratio(first: float, second: float, count: int) -> float:
    """Returns the logarithm of the likelihood of the first minimum over that of the second.

    Corner errors have heavier tails than a Gaussian's, and one bad edge moves two corners: so the
    residuals count as a multivariate Student t of `_TAIL` degrees of freedom. Where both minima
    leave much, more must lie between them.

    Args:
        first: sum of the squared residuals in units of their noise.
        second: of the other minimum.
        count: number of residuals.
    """
    return (_TAIL + count) / 2 * math.log((_TAIL + second) / (_TAIL + first))


def _distinct_best_first(solution: PnpSolution) -> list[int]:
    """Returns the poses ordered by error; of two that ended in one minimum, the better one."""
    error = solution.squared_error.tolist()
    order = sorted(range(len(error)), key=error.__getitem__)
    if len(order) > 1:
        cosine = (float((solution.R[order[0]] * solution.R[order[1]]).sum()) - 1) / 2
        same = math.acos(min(max(cosine, -1.0), 1.0)) < SAME_POSE
        if same or not math.isfinite(error[order[1]]):
            order = order[:1]
    return order


class Localizer(LeafSystem):
    """Turns detections into the body's pose in the map.

    .. pydrake_system::

        name: Localizer
        input_ports:
        - detections
        output_ports:
        - pose
        - alternative
        - health

    Args:
        localizer: the algorithm with its map, camera and mounting.
        rate: how often new detections are looked for to count what was dropped, Hz; at least the
            camera's.

    Ports:
        detections (input, Detections): those of another family than the map's count as
            `unknown_id`; without a family they count as the map's.
        pose (output, PoseEstimate): `X_WB` with covariance, of the latest picture; not `valid`
            (stamp NaN) when that shows no usable marker. `ambiguous` is set when the alternative
            is nearly as likely.
        alternative (output, PoseEstimate): the other minimum of the same picture, not `valid` when
            there is none.
        health (output, Health): markers left out, by reason (see `REASONS`).

    Source: planar poses after Collins and Bartoli (2014), then all corners in one least-squares
    problem with the covariance of its Jacobian.
    """

    def __init__(self, *, localizer: MapLocalizer, rate: float) -> None:
        super().__init__()
        require_positive(rate=rate)
        self._localizer = localizer
        self._memo = Memo(self, "localization")
        self._detections_input = self.DeclareAbstractInputPort(
            "detections", AbstractValue.Make(Detections())
        )
        ticket = {self._detections_input.ticket()}
        self._pose_output = self.DeclareAbstractOutputPort(
            "pose",
            lambda: AbstractValue.Make(PoseEstimate()),
            lambda context, output: output.set_value(self._locate(context).pose),
            ticket,
        )
        self._alternative_output = self.DeclareAbstractOutputPort(
            "alternative",
            lambda: AbstractValue.Make(PoseEstimate()),
            lambda context, output: output.set_value(self._locate(context).alternative),
            ticket,
        )
        self._last_stamp = self.DeclareDiscreteState([np.nan])
        self._counts = Counts(self, *REASONS)
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._count)

    def detections_input_port(self) -> InputPort:
        """Returns the port of the detections."""
        return self._detections_input

    def pose_output_port(self) -> OutputPort:
        """Returns the port of the pose."""
        return self._pose_output

    def alternative_output_port(self) -> OutputPort:
        """Returns the port of the second solution."""
        return self._alternative_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of what was left out."""
        return self._counts.output_port

    def _locate(self, context: Context) -> Localization:
        detections = self._detections_input.Eval(context)
        found: Localization = self._memo(context, self._localizer.locate, detections)
        return found

    def _count(self, context: Context, discrete_state: DiscreteValues) -> None:
        detections = self._detections_input.Eval(context)
        last_stamp = context.get_discrete_state(self._last_stamp)[0]
        if math.isfinite(detections.stamp) and detections.stamp != last_stamp:
            discrete_state.set_value(self._last_stamp, [detections.stamp])
            dropped = self._locate(context).dropped
            self._counts.add(context, discrete_state, **dropped)
