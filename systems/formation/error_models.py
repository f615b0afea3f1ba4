"""How the errors of triangles add up over the moves of a formation, for many runs at once.

[FORM] measures the error of building one triangle and gives the error at the destination after many
moves, but not how it comes to the one from the other. Two ways are here:

- the sum: each move's error is added as if the orientation of the triangle were known. This gives
  the numbers of its table 1.
- the chain: each triangle stands on robots that stand where the moves before left them. This is
  what happens when nothing but the triangle is measured: a wrong triangle is a wrong orientation
  and a wrong side for all that follow, and the formation breaks.

Errors are [lateral, longitudinal], m: to the mover's left, and forward, away from its anchor.

[FORM]: Kang, Kwon, Bae, Kim, "Monocular Vision-Based Swarm Robot Localization Using Equilateral
Triangular Formations".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from systems.formation.vertex_walk import VertexWalk, left_and_forward
from systems.validation import require, require_non_negative

Array = NDArray[np.float64]

SIGNS = ("random", "constant")
RULES = ("bearings", "edge")
SHORTEST, LONGEST = 0.6, 1.6  # of a side that still stands, as parts of the nominal one

_HALF_NORMAL = math.sqrt(math.pi / 2 - 1)  # deviation by mean of |N(0, s)|, the largest there is


# --- The error of one triangle ---


class StepErrors(Protocol):
    """Where the errors of building a triangle come from."""

    def draw(self, random: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Returns (*shape, 2) independent signed errors [lateral, longitudinal], m."""
        ...


@dataclass
class StepErrorParameters:
    """Size of the error of building one triangle; the numbers are those of [FORM] 4.2.

    Attributes:
        lateral_mean: of the absolute error, m.
        lateral_deviation: of the absolute error, m.
        longitudinal_mean: of the absolute error, m.
        longitudinal_deviation: of the absolute error, m.
        sign: of the errors; ours. "random": each is as often to either side. "constant": they are
            mostly to the left and forward, as a wrong principal point makes them. Around a closed
            path these cancel in the sum; only random ones give table 1 of [FORM].
    """

    lateral_mean: float = 0.036
    lateral_deviation: float = 0.021
    longitudinal_mean: float = 0.013
    longitudinal_deviation: float = 0.009
    sign: str = "random"

    def __post_init__(self) -> None:
        for axis in ("lateral", "longitudinal"):
            mean, deviation = f"{axis}_mean", f"{axis}_deviation"
            values = getattr(self, mean), getattr(self, deviation)
            require_non_negative(**{mean: values[0], deviation: values[1]})
            require(
                values[1] <= _HALF_NORMAL * values[0] * (1 + 1e-12),
                deviation,
                values[1],
                f"at most {_HALF_NORMAL:.4f} times {mean}, as that of a half-normal error",
            )
        require(self.sign in SIGNS, "sign", self.sign, f"one of {', '.join(SIGNS)}")


class FoldedNormalErrors:
    """Errors whose absolute values have given means and deviations: folded normal ones.

    Args:
        parameters: means and deviations.
    """

    def __init__(self, *, parameters: StepErrorParameters | None = None) -> None:
        p = parameters or StepErrorParameters()
        lateral = unfold(p.lateral_mean, p.lateral_deviation)
        longitudinal = unfold(p.longitudinal_mean, p.longitudinal_deviation)
        self._offset, self._deviation = np.transpose([lateral, longitudinal])
        self._random_sign = p.sign == "random"

    def draw(self, random: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Returns (*shape, 2) independent signed errors [lateral, longitudinal], m."""
        errors = self._offset + self._deviation * random.standard_normal((*shape, 2))
        if self._random_sign:
            errors *= 2 * random.integers(0, 2, (*shape, 2)) - 1
        return np.asarray(errors)


class MeasuredErrors:
    """Errors drawn, with replacement, from trials of building a triangle.

    Args:
        trials: (n, 2) signed errors [lateral, longitudinal], m, of the trials that ended.

    Raises:
        ValueError: there is none, or one is not a number.
    """

    def __init__(self, trials: ArrayLike) -> None:
        samples = np.array(trials, float)
        fits = samples.ndim == 2 and samples.shape[1] == 2 and len(samples) > 0
        require(fits, "trials", np.shape(trials), "of shape (n, 2), n at least 1")
        require(bool(np.isfinite(samples).all()), "trials", "not finite", "finite numbers")
        self._trials = samples

    def draw(self, random: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Returns (*shape, 2) errors [lateral, longitudinal], m, both of the same trial."""
        return np.asarray(self._trials[random.integers(0, len(self._trials), shape)])


class ScaledErrors:
    """Errors of another source times a factor.

    Args:
        errors: the source.
        factor: for example the side by that of the source, for errors of angle.
    """

    def __init__(self, errors: StepErrors, factor: float) -> None:
        require_non_negative(factor=factor)
        self._errors = errors
        self._factor = factor

    def draw(self, random: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Returns (*shape, 2) signed errors [lateral, longitudinal], m."""
        return self._factor * self._errors.draw(random, shape)


def unfold(mean: float, deviation: float) -> tuple[float, float]:
    """Returns the mean (>= 0) and deviation of the normal x for which |x| has those given.

    Folding keeps the mean square, so one equation is left; its root is bisected.
    """
    square = mean**2 + deviation**2
    low, high = 0.0, mean
    while low < (middle := (low + high) / 2) < high:
        if _folded_mean(middle, math.sqrt(square - middle**2)) < mean:
            low = middle
        else:
            high = middle
    return high, math.sqrt(square - high**2)


def _folded_mean(mean: float, deviation: float) -> float:
    if deviation == 0:
        return abs(mean)
    z = mean / (math.sqrt(2) * deviation)
    return deviation * math.sqrt(2 / math.pi) * math.exp(-z * z) + mean * math.erf(z)


# --- Many moves ---


def summed_errors(walk: VertexWalk, errors: Array) -> Array:
    """Returns the error of the new vertex after each move, were each triangle's orientation known.

    Args:
        walk: m moves.
        errors: (runs, m, 2) of each triangle, [lateral, longitudinal], m.

    Returns:
        (runs, m, 2) m, in W.
    """
    _require_errors_of(walk, errors)
    return np.asarray(np.einsum("rma,mai->rmi", errors, walk.axes()).cumsum(axis=1))


@dataclass(frozen=True)
class Chain:
    """What became of many runs of a chain of triangles.

    Attributes:
        errors: (runs, m, 2) m, in W, of the new vertex after each move; NaN once broken.
        moves: (runs,) moves after which the formation still stood; m if it never broke.
        worst_sides: (runs,) the side farthest from 1 (by ratio) as part of the nominal one, up to
            the move that broke the formation; NaN where a robot found no vertex at all.
    """

    errors: Array
    moves: NDArray[np.int64]
    worst_sides: Array

    def broken(self) -> NDArray[np.bool_]:
        """Returns (runs,) whether each formation broke."""
        return self.moves < self.errors.shape[1]


def chained_errors(walk: VertexWalk, errors: Array, *, rule: str = "bearings") -> Chain:
    """Returns the errors of runs in which each triangle stands on robots displaced before.

    A formation is broken when two robots that should be one side apart are nearer than 0.6 or
    farther than 1.6 times the nominal side.

    Args:
        walk: m moves.
        errors: (runs, m, 2) of each triangle, [lateral, longitudinal], m, along the mover's axes as
            they are, not as they should be.
        rule: what the mover takes for the vertex, see `new_vertex`.

    Raises:
        ValueError: an argument is out of range.
    """
    _require_errors_of(walk, errors)
    require(rule in RULES, "rule", rule, f"one of {', '.join(RULES)}")
    runs, moves = errors.shape[:2]
    at = np.repeat(walk.start[None], runs, axis=0)
    found = np.full((runs, moves, 2), np.nan)
    stood = np.full(runs, moves)
    worst = np.ones(runs)
    standing = np.arange(runs)
    for k in range(moves):
        left, right, anchor = (at[:, beacon] for beacon in walk.beacons[k])
        vertex = new_vertex(left, right, anchor, rule=rule)
        axes = left_and_forward(vertex - anchor)
        vertex += np.einsum("ra,rai->ri", errors[standing, k], axes)
        at[:, walk.movers[k]] = vertex
        sides = np.linalg.norm(at[:, walk.neighbours[k]] - vertex[:, None], axis=2) / walk.side
        side = np.take_along_axis(sides, _off(sides).argmax(axis=1)[:, None], axis=1)[:, 0]
        worse = ~(_off(side) <= _off(worst[standing]))
        worst[standing[worse]] = side[worse]
        stands = ((sides >= SHORTEST) & (sides <= LONGEST)).all(axis=1)
        stood[standing[~stands]] = k
        standing, at = standing[stands], at[stands]
        found[standing, k] = at[:, walk.movers[k]] - walk.vertices[k]
    return Chain(errors=found, moves=stood, worst_sides=worst)


def new_vertex(left: Array, right: Array, anchor: Array, *, rule: str = "bearings") -> Array:
    """Returns (runs, 2) m, where a robot builds its triangle on displaced beacons.

    "bearings": where it sees `left` and `right` 30 degrees to either side of `anchor`, which is all
    that Algorithm I of [FORM] measures. Each angle puts it on a circle through two beacons; both
    pass through the anchor, and their other common point is its mirror image in the line through
    the centres. "edge": the tip of the equilateral triangle on `left` and `right`, wherever the
    anchor is: what a robot could do that measures more than angles.

    Args:
        left: (runs, 2) m, the beacon on the robot's left as it faces away from the anchor.
        right: (runs, 2) m, that on its right.
        anchor: (runs, 2) m.
        rule: "bearings" or "edge".
    """
    if rule == "edge":
        return _centre(left, right, math.sqrt(3) / 2)
    to_left = _centre(left, anchor, math.sqrt(3) / 2)
    to_right = _centre(anchor, right, math.sqrt(3) / 2)
    along = to_right - to_left
    with np.errstate(divide="ignore", invalid="ignore"):  # one circle: any point of it would do
        along /= np.linalg.norm(along, axis=1, keepdims=True)
    from_left = anchor - to_left
    foot = np.einsum("ri,ri->r", from_left, along)[:, None] * along
    return np.asarray(to_left + 2 * foot - from_left)


def _centre(left: Array, right: Array, height: float) -> Array:
    """Returns the point on the far side of left-right, `height` of its length off its middle.

    At cos(30 deg) = sqrt(3) / 2 that is both the tip of the equilateral triangle and the centre of
    the circle from which left-right is seen under 30 degrees.
    """
    edge = left - right
    return np.asarray((left + right) / 2 + height * np.stack([edge[:, 1], -edge[:, 0]], axis=1))


def _off(sides: Array) -> Array:
    """Returns how far sides are from 1, by ratio; NaN is the largest to NumPy."""
    return np.asarray(np.maximum(sides, 1 / np.maximum(sides, 1e-300)))


def _require_errors_of(walk: VertexWalk, errors: Array) -> None:
    fits = errors.ndim == 3 and errors.shape[1:] == (len(walk), 2)
    require(fits, "errors", errors.shape, f"of shape (runs, {len(walk)}, 2)")
    require(bool(np.isfinite(errors).all()), "errors", "not finite", "finite numbers")
