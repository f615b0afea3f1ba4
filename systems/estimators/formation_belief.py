"""Where the robots of a formation are, picture by picture and move by move, without Drake.

A robot that stands is a constant: sightings between two that stand are averaged as long as they
do. A robot that moves is a stranger, whom only the pictures of this moment place; nothing that it
sees or shows on its way counts for the others. When it stands again, it is placed anew, and from
then on it is a landmark as the others are.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.estimators.formation_filter_parameters import FormationFilterParameters
from systems.estimators.formation_information import (
    Prior,
    Solution,
    leave,
    solve,
    start,
)
from systems.estimators.formation_model import (
    SIDES,
    Layout,
    SightingModel,
    Sightings,
    mean_values,
    variances,
)
from systems.estimators.formation_start import guess

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

REASONS = (
    "accepted", "gated", "late", "unknown_marker", "repeated_marker", "bad_corners", "unplaced",
)  # fmt: skip

# Columns of `Belief.robots` and of `Belief.memory`.
_STARTED, _STOPPED, _KNOWN, _FIXED, _TRACKED = range(5)
_FRAMES, _LASTING, _VALUES = 0, 1, slice(2, 4)

_EARLY = 1e-6  # of a period that times may be rounded by
_OUTLIERS = 2  # that are looked for at once, when a robot is placed
# How well a robot must be known from another that it sees, m, so that the model is straight enough
# for a gate. From W it may be known far less.
_PLACED = 0.1


class Look(NamedTuple):
    """What one picture shows.

    Attributes:
        observer: the robot whose picture it is.
        camera: which of its cameras.
        stamp: s.
        markers: (n,) ids.
        values: (n, 2) as in `Sightings`; NaN where the corners make no marker.
    """

    observer: int
    camera: int
    stamp: float
    markers: NDArray[np.int64]
    values: Array


@dataclass(eq=False)
class Belief:
    """All that the estimator remembers, in numbers.

    Attributes:
        x: (size,) poses and yaw errors.
        P: (size, size) their covariance.
        origin: (size,) of the prior, as are the next two (see `formation_information.Prior`).
        A: (size, size).
        b: (size,).
        robots: (N, 5) when each last set out, s; since when it stands, s (inf while it moves);
            whether it has been placed since; whether its derivatives are fixed; when it was last
            placed on its way, s.
        memory: (N, C, 4 N, 4) by observer, camera and marker: how many pictures; whether they
            are of two robots that stand; mean bearing and logarithm of the distance.
        stamps: (N, C) of the last picture, s.
        nis: (2,) of the last robot that was placed, and how many were.
    """

    x: Array
    P: Array
    origin: Array
    A: Array
    b: Array
    robots: Array
    memory: Array
    stamps: Array
    nis: Array

    def arrays(self) -> list[Array]:
        """Returns all of it, in the order of the attributes."""
        return [getattr(self, field.name) for field in fields(self)]

    @property
    def moving(self) -> Mask:
        """Which robots move, (N,)."""
        return np.asarray(self.robots[:, _STOPPED] == np.inf)


class _Fit(NamedTuple):
    """A solution, the worst square among the sightings that place a robot, and which it used."""

    solution: Solution
    worst: float
    kept: Mask


@dataclass(frozen=True, eq=False)
class FormationEstimator:
    """What does not change: the formation, its cameras, the noise.

    Attributes:
        start_poses: (N, 3) m, m, rad.
        camera_yaws: (C,) where the cameras of each robot look, from its x axis, rad.
        focal_length: of all cameras, px.
        parameters: noise, sizes and options.
    """

    start_poses: Array
    camera_yaws: Array
    focal_length: float
    parameters: FormationFilterParameters

    @cached_property
    def layout(self) -> Layout:
        """What the numbers of the state stand for."""
        return Layout(len(self.start_poses), self.camera_yaws, self.parameters.marker_offset)

    def start(self) -> Belief:
        """Returns what is known before the first picture."""
        n, cameras = self.layout.robots, self.layout.cameras
        x = np.concatenate([self.start_poses.ravel(), np.zeros(n * cameras)])
        deviations = self.parameters.start_deviations(n, cameras)
        prior = start(self.layout, x, deviations)
        robots = np.tile([-np.inf, -np.inf, 1.0, 0.0, -np.inf], (n, 1))
        memory = np.zeros((n, cameras, SIDES * n, 4))
        stamps = np.full((n, cameras), -np.inf)
        nis = np.array([np.nan, 0.0])
        P = np.diag(deviations**2)
        return Belief(x, P, prior.origin, prior.A, prior.b, robots, memory, stamps, nis)

    def depart(
        self, belief: Belief, robot: int, t: float, displacement: Array | None = None
    ) -> None:
        """Lets a robot set out at time t (s): what it said stays, where it is opens up.

        Args:
            belief: is changed.
            robot: the one that moves from now on.
            t: s; pictures up to then that come later are dropped.
            displacement: (3,) where it gets to by its own account, in W; zeros if left out.
        """
        moved = np.zeros(3) if displacement is None else displacement
        seen = self._remembered(belief)
        own = (seen.observer == robot) | (seen.target == robot)
        told = seen.select(own & self._lasting(belief, seen))
        prior = leave(
            self.layout,
            self._prior(belief),
            told,
            self._weights(belief, told),
            belief.x,
            robot,
            displacement=moved,
            deviations=self.parameters.move_deviations(),
        )
        belief.origin, belief.A, belief.b = prior.origin, prior.A, prior.b
        belief.x[3 * robot : 3 * robot + 3] += moved
        belief.robots[:, _FIXED] = prior.fixed
        belief.robots[robot, :3] = t, np.inf, 0.0
        self._forget(belief, seen.select(own))
        self._finish(belief, self._solve(belief, seen.select(~own)))

    def stop(self, belief: Belief, robot: int, t: float) -> None:
        """Lets a robot stand from time t (s) on."""
        belief.robots[robot, _STOPPED] = t + self.parameters.settle_time

    def look(self, belief: Belief, t: float, looks: Iterable[Look]) -> Counter[str]:
        """Takes new pictures.

        Args:
            belief: is changed.
            t: now, s.
            looks: at most one for each camera; those not newer than the last are not looked at.

        Returns:
            How many sightings were accepted, and how many dropped, by `REASONS`.
        """
        counts: Counter[str] = Counter()
        new = [look for look in looks if look.stamp > belief.stamps[look.observer, look.camera]]
        if not new:
            return counts
        self._remember(belief, new, counts)
        seen = self._remembered(belief)
        # Sightings of moving robots grow old also when the camera sends nothing any more.
        late = belief.stamps[seen.observer, seen.camera] < t - self.parameters.memory
        old = late & ~self._lasting(belief, seen)
        self._forget(belief, seen.select(old))
        seen = seen.select(~old)
        unknown = belief.robots[:, _KNOWN] == 0
        strange = unknown[seen.observer] | unknown[seen.target]
        if strange.any():
            if belief.moving[unknown].all():
                last = belief.robots[unknown, _TRACKED]
                if t - last.min() < (1 - _EARLY) / self.parameters.track_rate:
                    return counts  # nothing is built upon where a robot is on its way
                belief.robots[unknown, _TRACKED] = t
            self._place(belief, seen, strange, counts)
        else:
            self._finish(belief, self._solve(belief, seen))
        return counts

    def _remember(self, belief: Belief, looks: list[Look], counts: Counter[str]) -> None:
        for look in looks:
            belief.stamps[look.observer, look.camera] = look.stamp
            memory = belief.memory[look.observer, look.camera]
            memory[memory[:, _LASTING] == 0, _FRAMES] = 0.0

        number = [len(look.markers) for look in looks]
        i = np.repeat([look.observer for look in looks], number)
        c = np.repeat([look.camera for look in looks], number)
        stamp = np.repeat([look.stamp for look in looks], number)
        ids = np.concatenate([look.markers for look in looks])
        values = np.concatenate([look.values for look in looks])

        markers = SIDES * self.layout.robots
        known = (ids >= 0) & (ids < markers) & (ids // SIDES != i)
        target = np.where(known, ids // SIDES, 0)
        picture = np.repeat(np.arange(len(looks)), number)
        code = picture * markers + np.where(known, ids, 0)
        once = (np.bincount(code, known, len(looks) * markers) == 1)[code]
        began = np.maximum(belief.robots[i, _STARTED], belief.robots[target, _STARTED])
        stood = np.maximum(belief.robots[i, _STOPPED], belief.robots[target, _STOPPED])
        good = np.ones(len(ids), bool)
        for reason, fits in (
            ("unknown_marker", known),
            ("repeated_marker", once),
            ("bad_corners", np.isfinite(values).all(axis=1)),
            ("late", stamp > began),
        ):
            counts[reason] += int((good & ~fits).sum())
            good &= fits
        inside = good.copy()
        inside[good] = self._inside_gate(belief, Sightings(i, c, ids, values).select(good))
        counts["accepted"] += int(inside.sum())
        counts["gated"] += int((good & ~inside).sum())

        where = i[inside], c[inside], ids[inside]
        lasting = (stamp >= stood)[inside]
        rows = belief.memory[where]
        rows[rows[:, _LASTING] != lasting, _FRAMES] = 0.0
        rows[:, _LASTING] = lasting
        rows[:, _FRAMES] += 1
        rows[:, _VALUES] = mean_values(rows[:, _VALUES], values[inside], rows[:, _FRAMES])
        belief.memory[where] = rows

    def _inside_gate(self, belief: Belief, seen: Sightings) -> Mask:
        """Returns which agree with what is known, (n,); those of unknown robots pass."""
        known = belief.robots[:, _KNOWN] == 1
        tested = known[seen.observer] & known[seen.target]
        inside = np.ones(len(tested), bool)
        if not tested.any():
            return inside
        seen = seen.select(tested)
        used = self._numbers
        model = SightingModel(self.layout, seen)
        J = model.jacobian(belief.x)[:, :used]
        R = self._variances(seen.values, np.ones(len(J)))[:, :used]
        S = J @ belief.P @ J.transpose(0, 2, 1) + R[:, :, None] * np.eye(used)
        r = model.residuals(belief.x)[:, :used, None]
        inside[tested] = (r * np.linalg.solve(S, r)).sum(axis=(1, 2)) <= self.parameters.gate
        return inside

    def _place(self, belief: Belief, seen: Sightings, strange: Mask, counts: Counter[str]) -> None:
        """Solves with robots of whom only these sightings tell, without those that lie."""
        unknown = np.flatnonzero(belief.robots[:, _KNOWN] == 0)
        unknown = np.intersect1d(unknown, [*seen.observer[strange], *seen.target[strange]])
        kept = np.ones(len(strange), bool)
        best = self._fit(belief, seen, kept, strange, unknown)
        while best.worst > self.parameters.gate:
            suspects = np.flatnonzero(best.kept & strange)
            # Without one more there must be something left to agree or not.
            spare = self._numbers * (len(suspects) - 1) - 3 * len(unknown)
            if spare <= 0 or (~best.kept).sum() == _OUTLIERS:
                break
            trials = []
            for suspect in suspects:
                kept = best.kept.copy()
                kept[suspect] = False
                trials.append(self._fit(belief, seen, kept, strange, unknown))
            best = min(trials, key=lambda trial: trial.worst)
        placed = best.worst <= self.parameters.gate
        kept = best.kept if placed else ~strange
        solution = best.solution if placed else self._solve(belief, seen.select(kept))
        counts["unplaced"] += not placed
        counts["gated"] += int((~kept).sum())
        counts["accepted"] -= int((~kept).sum())
        self._forget(belief, seen.select(~kept))
        self._finish(belief, solution)
        if placed and not belief.moving[unknown].all():
            self._recognise(belief, seen.select(kept), strange[kept], unknown, solution)

    def _fit(
        self,
        belief: Belief,
        seen: Sightings,
        kept: Mask,
        strange: Mask,
        unknown: NDArray[np.intp],
    ) -> _Fit:
        """Solves with the kept sightings, from two starts if need be."""
        some, matter = seen.select(kept), strange[kept]

        def fit(x: Array) -> _Fit:
            solution = self._solve(belief, some, x)
            worst = float((solution.residuals[matter] ** 2).max(initial=0.0))
            return _Fit(solution, worst, kept)

        def anew() -> Array:
            return guess(self.layout, belief.x, some.select(matter), unknown)

        # On its way a robot is near where it was in the last picture; else that may be far off.
        own = np.concatenate([3 * unknown, 3 * unknown + 1])
        tracked = bool((belief.P[own, own] < _PLACED**2).all())
        first = fit(belief.x if tracked else anew())
        if first.worst <= self.parameters.gate:
            return first
        second = fit(anew() if tracked else belief.x)
        return min(first, second, key=lambda trial: trial.worst)

    def _recognise(
        self,
        belief: Belief,
        seen: Sightings,
        strange: Mask,
        unknown: NDArray[np.intp],
        solution: Solution,
    ) -> None:
        """Lets robots that stand and have been placed well be landmarks."""
        told = seen.select(self._lasting(belief, seen))
        near = _apart(belief.P, told.observer, told.target) < _PLACED
        good = np.concatenate([told.observer[near], told.target[near]])
        recognised = np.intersect1d(unknown, good)
        if len(recognised) == 0:
            return
        belief.robots[recognised, _KNOWN] = 1.0
        freedom = self._numbers * int(strange.sum()) - 3 * len(unknown)
        if freedom > 0:
            before = self._solve(belief, seen.select(~strange))
            belief.nis[:] = (solution.cost - before.cost) / freedom, belief.nis[1] + 1

    def _solve(self, belief: Belief, seen: Sightings, x: Array | None = None) -> Solution:
        weights = self._weights(belief, seen)
        return solve(self.layout, self._prior(belief), seen, weights, belief.x if x is None else x)

    def _finish(self, belief: Belief, solution: Solution) -> None:
        belief.x = solution.x
        P = np.linalg.inv(solution.information)
        belief.P = (P + P.T) / 2

    def _prior(self, belief: Belief) -> Prior:
        return Prior(belief.origin, belief.A, belief.b, belief.robots[:, _FIXED] == 1)

    def _remembered(self, belief: Belief) -> Sightings:
        observer, camera, marker = index = np.nonzero(belief.memory[..., _FRAMES])
        return Sightings(observer, camera, marker, belief.memory[index][:, _VALUES])

    def _forget(self, belief: Belief, seen: Sightings) -> None:
        belief.memory[seen.observer, seen.camera, seen.marker, _FRAMES] = 0.0

    def _rows(self, belief: Belief, seen: Sightings) -> Array:
        return belief.memory[seen.observer, seen.camera, seen.marker]

    def _lasting(self, belief: Belief, seen: Sightings) -> Mask:
        return np.asarray(self._rows(belief, seen)[:, _LASTING] == 1)

    @property
    def _numbers(self) -> int:
        """How many numbers of a sighting count."""
        return 2 if self.parameters.use_range else 1

    def _weights(self, belief: Belief, seen: Sightings) -> Array:
        weights = 1 / self._variances(seen.values, self._rows(belief, seen)[:, _FRAMES])
        weights[:, self._numbers :] = 0.0
        return weights

    def _variances(self, values: Array, frames: Array) -> Array:
        return variances(
            values,
            frames,
            focal_length=self.focal_length,
            marker_size=self.parameters.marker_size,
            noise=self.parameters.sighting_noise(),
        )


def _apart(P: Array, a: NDArray[np.intp], b: NDArray[np.intp]) -> Array:
    """Returns how well robots are known from one another: standard deviations (n,), m."""
    squares = np.zeros(len(a))
    for axis in range(2):
        i, j = 3 * a + axis, 3 * b + axis
        squares += P[i, i] + P[j, j] - 2 * P[i, j]
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)))
