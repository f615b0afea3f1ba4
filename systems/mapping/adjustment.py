"""All tags and all camera poses together from all corners: bundle adjustment with square tags.

The unknowns are `X_CW` of every frame's camera and `X_WT` of every tag but the anchor, or anchors,
whose poses are given and fix the gauge. Residuals are those of the corners, in units of their
noise, and, where there is odometry, of the motion from each frame to the next. Levenberg and
Marquardt; in each step the cameras are eliminated (Schur complement): without odometry their matrix
is block-diagonal, with it block-tridiagonal, and Cholesky's factors have the same shape. What is
left is a dense system in the tags, of which there are few.

Tangents: rotation first, a small rotation vector in the parent (C for cameras, W for tags), then
the position in the parent. A sighting that fits badly counts less (Huber; of its 8 residuals
together).

Sources: Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle adjustment - a modern synthesis", 2000;
damping by the part of the promised gain that came true: Nielsen, "Damping parameter in Marquardt's
method", IMM-REP-1999-05.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from systems.mapping.scene import Motion, Scene, corner_errors, motion_residuals, residuals
from systems.mapping.sightings import Sightings

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# The same for all, 1/rad^2 and 1/m^2: it holds back what is hardly known, such as the lean of a tag
# seen from the front, which a part of each diagonal would not.
_DAMPING_START, _DAMPING_LEAST, _DAMPING_END = 1.0, 1e-4, 1e12
_TAG_DAMPING = 1e-6  # of the diagonals, when tags are settled alone
_GROWTH = 4.0  # of the damping after a step that failed; twice that after the next one
_LEAST = 1e-9  # information of what nothing is known of, 1/rad^2 and 1/m^2
_ROUNDING = 1e-12  # of a block's diagonal, that it be positive whatever rounding does
_SIX = np.arange(6)
_HOPELESS = 1e12  # chi-square of what is behind the camera, where infinity cannot be compared
CHUNK = 128  # frames that are eliminated at a time: bounds the memory
_HUBER = 6.0  # of a sighting's 8 residuals in units of their noise: 36 is their 1 - 2e-5 quantile


@dataclass(frozen=True, eq=False)
class Adjustment:
    """A scene that fits best.

    Attributes:
        scene: where cameras and tags are.
        squared: (m,) sum of the 8 squared residuals of each sighting, in units of the noise.
        squared_motion: (n,) the same of the motions; empty without odometry.
        iterations: steps that were tried.
        converged: whether the last step promised next to nothing.
        tag_covariance: (tags, 6, 6), zeros for the anchor; NaN for tags never seen. Empty if they
            were not asked for.
        camera_covariance: (frames, 6, 6) of `X_CW`; NaN for frames of which nothing is known. Empty
            if they were not asked for.
    """

    scene: Scene
    squared: Array
    squared_motion: Array
    iterations: int
    converged: bool
    tag_covariance: Array
    camera_covariance: Array


class System:
    """The normal equations of a step, and their solution with the cameras eliminated."""

    def __init__(
        self,
        scene: Scene,
        sightings: Sightings,
        motion: Motion | None,
        anchor: int | Indices,
        huber: float,
    ) -> None:
        s = sightings
        frames, tags = s.frames, s.tags
        r, by_camera, by_tag = residuals(scene, s)
        self.squared = (r * r).sum(axis=1)
        weight = np.minimum(1.0, huber / np.sqrt(np.maximum(self.squared, 1e-300)))
        self.cost = float(_huber(np.minimum(self.squared, _HOPELESS), huber).sum())
        self.squared_motion = np.zeros(0)
        r[~np.isfinite(self.squared)] = 0.0
        weighted = np.sqrt(weight)[:, None]
        J = np.concatenate([by_camera, by_tag, r[..., None]], axis=2) * weighted[..., None]
        product = J.swapaxes(1, 2) @ J
        self.sightings = s
        self.cross = product[:, :6, 6:12]
        self.H_cameras = summed(product[:, :6, :6], s.frame, frames)
        self.g_cameras = summed(product[:, :6, 12], s.frame, frames)
        self.H_tags = summed(product[:, 6:12, 6:12], s.tag, tags)
        self.g_tags = summed(product[:, 6:12, 12], s.tag, tags)
        self.coupling: Array | None = None
        if motion is not None:
            e, here, there = motion_residuals(scene, motion)
            self.squared_motion = (e * e).sum(axis=1)
            self.cost += float(self.squared_motion.sum())
            self.H_cameras[:-1] += here.swapaxes(1, 2) @ here
            self.H_cameras[1:] += there.swapaxes(1, 2) @ there
            self.g_cameras[:-1] += (here.swapaxes(1, 2) @ e[..., None])[..., 0]
            self.g_cameras[1:] += (there.swapaxes(1, 2) @ e[..., None])[..., 0]
            self.coupling = there.swapaxes(1, 2) @ here  # (n, 6, 6), row: the next camera
        self.free = np.flatnonzero(
            ~np.isin(np.arange(tags), anchor) & (np.bincount(s.tag, minlength=tags) > 0)
        )
        self.place = np.full(tags, -1)
        self.place[self.free] = np.arange(len(self.free))

    def factor(self, damping: float) -> tuple[Array, Array, Array, Array]:
        """Eliminates the cameras.

        Returns:
            Inverse Cholesky factors (frames, 6, 6) of the cameras' blocks, what couples each to the
            one before (frames, 6, 6), the Schur complement (6t, 6t) of the t free tags and its
            right-hand side (6t,).
        """
        s, t = self.sightings, len(self.free)
        H = _damped(self.H_cameras, damping)
        S = np.zeros((6 * t, 6 * t))
        S.reshape(t, 6, t, 6)[np.arange(t), :, np.arange(t), :] = _damped(
            self.H_tags[self.free], damping
        )
        b = -self.g_tags[self.free].ravel()
        frames = s.frames
        before = np.zeros((frames, 6, 6))
        if self.coupling is None:
            inverse = np.linalg.inv(np.linalg.cholesky(H))
        else:
            inverse = np.empty((frames, 6, 6))
            D = H[0]
            for k in range(frames):
                if k:
                    before[k] = self.coupling[k - 1] @ inverse[k - 1].T
                    D = H[k] - before[k] @ before[k].T
                inverse[k] = np.linalg.inv(np.linalg.cholesky(D))
        for Y in self.chunks(inverse, before):
            W = Y.reshape(-1, Y.shape[2])
            S -= W[:, :-1].T @ W[:, :-1]
            b -= W[:, :-1].T @ W[:, -1]
        return inverse, before, S, b

    def chunks(self, inverse: Array, before: Array) -> Iterator[Array]:
        """Yields the cross terms after forward substitution, some frames at a time.

        Yields:
            (n, 6, 6t + 1) of n frames, the gradient (turned round) in the last column.
        """
        s, t = self.sightings, len(self.free)
        last = np.zeros((6, 6 * t + 1))
        columns = 6 * self.place[s.tag]
        for start in range(0, s.frames, CHUNK):
            end = min(start + CHUNK, s.frames)
            Y = np.zeros((end - start, 6, 6 * t + 1))
            Y[:, :, -1] = -self.g_cameras[start:end]
            mine = np.arange(*np.searchsorted(s.frame, [start, end]))
            mine = mine[columns[mine] >= 0]
            rows = s.frame[mine, None, None] - start
            Y[rows, _SIX[:, None], columns[mine, None, None] + _SIX] = self.cross[mine]
            if self.coupling is None:
                yield inverse[start:end] @ Y
                continue
            for k in range(end - start):
                last = Y[k] = inverse[start + k] @ (Y[k] - before[start + k] @ last)
            yield Y

    def step(self, damping: float) -> tuple[Array, Array, float]:
        """Returns the steps of cameras and tags, and by how much the cost is to fall."""
        inverse, before, S, b = self.factor(damping)
        tags = np.zeros((self.sightings.tags, 6))
        if len(self.free):
            tags[self.free] = np.linalg.solve(S, b).reshape(-1, 6)
        cameras = self.back_substituted(inverse, before, tags)
        gain = -float((self.g_cameras * cameras).sum() + (self.g_tags * tags).sum())
        return cameras, tags, gain

    def back_substituted(self, inverse: Array, before: Array, tags: Array) -> Array:
        """Returns the steps (frames, 6) of the cameras, given those of the tags."""
        s = self.sightings
        pull = (self.cross @ tags[s.tag][..., None])[..., 0]
        right = -self.g_cameras - summed(pull, s.frame, s.frames)
        y = (inverse @ right[..., None])[..., 0]
        if self.coupling is not None:
            for k in range(1, len(y)):
                y[k] = inverse[k] @ (right[k] - before[k] @ y[k - 1])
            for k in range(len(y) - 2, -1, -1):
                y[k] -= before[k + 1].T @ (inverse[k + 1].T @ y[k + 1])
        return (inverse.swapaxes(1, 2) @ y[..., None])[..., 0]

    def covariances(self) -> tuple[Array, Array]:
        """Returns the marginal covariances of tags (tags, 6, 6) and cameras (frames, 6, 6)."""
        s, t = self.sightings, len(self.free)
        inverse, before, S, _ = self.factor(0.0)
        of_tags = np.full((s.tags, 6, 6), np.nan)
        of_tags[self.place < 0] = np.where(
            (np.bincount(s.tag, minlength=s.tags) > 0)[self.place < 0, None, None], 0.0, np.nan
        )
        root = _inverse_root(S)
        covariance = (root.T @ root).reshape(t, 6, t, 6)
        of_tags[self.free] = covariance[np.arange(t), :, np.arange(t), :]
        P = inverse.swapaxes(1, 2) @ inverse
        Z = np.concatenate([Y[..., :-1] for Y in self.chunks(inverse, before)])
        if self.coupling is None:
            Z = inverse.swapaxes(1, 2) @ Z
            P[np.bincount(s.frame, minlength=s.frames) == 0] = np.nan
        else:
            for k in range(s.frames - 1, -1, -1):
                if k + 1 < s.frames:
                    back = before[k + 1].T
                    Z[k] -= back @ Z[k + 1]
                    G = inverse[k].T @ back
                    P[k] += G @ P[k + 1] @ G.T
                Z[k] = inverse[k].T @ Z[k]
        spread = Z @ root.T
        return of_tags, P + spread @ spread.swapaxes(1, 2)


def summed(values: Array, index: NDArray[np.intp], count: int) -> Array:
    """Returns (count, ...) sums of the values (m, ...) of each index."""
    flat = values.reshape(len(values), -1)
    total = np.empty((count, flat.shape[1]))
    for k in range(flat.shape[1]):
        total[:, k] = np.bincount(index, flat[:, k], minlength=count)
    return total.reshape(count, *values.shape[1:])


def _inverse_root(S: Array) -> Array:
    """Returns a matrix whose square, root' root, is the inverse of S.

    Directions that nothing determines get a huge variance instead of an infinite one.
    """
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(S)))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(S)
        least = 1e-12 * max(values[-1], 1e-12)
        return np.asarray((vectors / np.sqrt(np.maximum(values, least))).T)


def _damped(H: Array, damping: float) -> Array:
    """Returns blocks (n, 6, 6) with their diagonals raised; one of nothing becomes harmless."""
    raised = _ROUNDING * np.diagonal(H, axis1=1, axis2=2)[:, None, :] + damping + _LEAST
    return H + np.eye(6) * raised


def adjust(
    scene: Scene,
    sightings: Sightings,
    *,
    anchor: int | Indices,
    pixel_noise: float = 1.0,
    motion: Motion | None = None,
    huber: float = _HUBER,
    iterations: int = 50,
    tolerance: float = 1e-6,
    covariances: bool = True,
) -> Adjustment:
    """Moves cameras and tags to where the corners, and the motion, say that they are.

    Args:
        scene: to start from.
        sightings: of tags in frames.
        anchor: number of the tag that stays where `scene` has it, or numbers of several.
        pixel_noise: standard deviation of a corner's coordinate, px.
        motion: odometry, if there is any.
        huber: a sighting whose 8 residuals are longer together than this, in units of their noise,
            pulls no more than it would there; inf for plain least squares.
        iterations: steps that are tried at most.
        tolerance: a step that promises to lower the cost by less than this part of it, or by less
            than this, is the last.
        covariances: whether to work them out.

    Returns:
        The best scene, with marginal covariances for the given noise.
    """
    scaled = replace(sightings, by_ray=sightings.by_ray / pixel_noise)
    damping, growth, converged, tries = _DAMPING_START, _GROWTH, False, 0
    system = System(scene, scaled, motion, anchor, huber)
    while tries < iterations and damping < _DAMPING_END:
        tries += 1
        cameras, tags, gain = system.step(damping)
        if not gain > tolerance * (1 + system.cost):
            converged = True
            break
        moved = scene.moved(cameras, tags)
        trial = System(moved, scaled, motion, anchor, huber)
        kept = (system.cost - trial.cost) / gain  # of the promise
        if kept > 0:
            scene, system, growth = moved, trial, _GROWTH
            damping = max(damping * max(0.1, 1 - (2 * kept - 1) ** 3), _DAMPING_LEAST)
        else:
            damping, growth = damping * growth, 2 * growth
    none = np.zeros((0, 6, 6))
    of_tags, of_cameras = system.covariances() if covariances else (none, none)
    return Adjustment(
        scene, system.squared, system.squared_motion, tries, converged, of_tags, of_cameras
    )


def robust_cost(scene: Scene, sightings: Sightings, pixel_noise: float) -> Array:
    """Returns (tags,) Huber's cost of each tag's sightings, in units of the noise.

    What `adjust` minimises, tag by tag.
    """
    r = corner_errors(scene, sightings)
    squared = np.minimum((r * r).sum(axis=1) / pixel_noise**2, _HOPELESS)
    cost = np.bincount(sightings.tag, _huber(squared, _HUBER), minlength=sightings.tags)
    return np.asarray(cost, np.float64)


def settle_tags(
    scene: Scene, sightings: Sightings, pixel_noise: float, iterations: int = 20
) -> Scene:
    """Moves each tag to where its own sightings have it, the cameras fixed; all tags at once."""
    s = replace(sightings, by_ray=sightings.by_ray / pixel_noise)
    damping = np.full(s.tags, _TAG_DAMPING)
    cost = robust_cost(scene, s, 1.0)
    moving = np.ones(s.tags, bool)
    for _ in range(iterations):
        r, _, by_tag = residuals(scene, s)
        squared = (r * r).sum(axis=1)
        weight = np.minimum(1.0, _HUBER / np.sqrt(np.maximum(squared, 1e-300)))
        r[~np.isfinite(squared)] = 0.0
        J = np.concatenate([by_tag, r[..., None]], axis=2) * np.sqrt(weight)[:, None, None]
        product = summed(J.swapaxes(1, 2) @ J, s.tag, s.tags)
        H = product[:, :6, :6]
        H = H + np.eye(6) * (damping[:, None, None] * H + _LEAST)
        steps = np.asarray(-np.linalg.solve(H, product[:, :6, 6:])[..., 0], np.float64)
        moved = scene.moved(np.zeros((s.frames, 6)), steps)
        trial = robust_cost(moved, s, 1.0)
        better = moving & (trial < cost)
        R, p = scene.R_WT.copy(), scene.p_WT.copy()
        R[better], p[better] = moved.R_WT[better], moved.p_WT[better]
        scene = replace(scene, R_WT=R, p_WT=p)
        moving &= np.abs(trial - cost) > 1e-4 * (1 + cost)
        cost = np.where(better, trial, cost)
        damping *= np.where(better, 0.1, 10.0)
        if not moving.any():
            break
        s = s.select(moving[s.tag])
    return scene


def _huber(squared: Array, huber: float) -> Array:
    """Returns Huber's cost of squared lengths: quadratic near, linear far."""
    if np.isinf(huber):
        return squared
    far = squared > huber**2
    return np.where(far, 2 * huber * np.sqrt(squared) - huber**2, squared)
