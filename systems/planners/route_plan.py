"""A route from a taught path: optimised, timed, held to every limit at steps of a centimetre."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.markers.layout import MarkerMap
from systems.planners.path_spline import PathSpline
from systems.planners.route import Route
from systems.planners.route_limits import RouteLimits
from systems.planners.route_optimization import Candidate, Surroundings, optimize
from systems.planners.speed_profile import fastest, speed_caps, times
from systems.planners.tag_view import TagView
from systems.planners.taught_path import TaughtPath

Array = NDArray[np.float64]

FINE = 0.01  # m, between the places where limits are looked at
_STEP = 0.05  # s, between the samples of the route
_SEEN = 5  # places from one look at the tags in view to the next
_SPARES = (0.02, 0.05, 0.1)
_VIEW_PRICES = (0.0, 0.1, 0.5, 2.0)  # s
_FAR = 10.0  # m from every tag: no place of this map
_BINDS = 0.985  # of a limit, from which on it binds
_UNITS = {"max_curvature": "1/m", "corridor": "m", "tag_distance": "m"}


class Violation(NamedTuple):
    """Where a path violates a limit most.

    Attributes:
        limit: its name.
        place: (2,) where, m.
        run: way along the taught path, m.
        value: there.
        allowed: value.
    """

    limit: str
    place: Array
    run: float
    value: float
    allowed: float


@dataclass(frozen=True, eq=False)
class RoutePlan:
    """A route, and how it keeps its limits at k places a centimetre apart.

    Attributes:
        route: the route.
        taught: what it was made from.
        limits: that it keeps.
        run: (k,) way along it, m.
        points: (k, 2) m.
        heading: (k,) rad.
        speed: (k,) m/s.
        curvature: (k,) 1/m.
        acceleration: (k,) along it, m/s^2.
        offset: (k,) to the left of the taught path, m.
        tag_distance: (k,) to the nearest tag, m.
        tags_in_view: (k,) number; -1 where no camera is given.
        caps: by limit the speed that it allows at each place by itself (k,), m/s.
        binds: by limit the part of the way along which it binds.
    """

    route: Route
    taught: TaughtPath
    limits: RouteLimits
    run: Array
    points: Array
    heading: Array
    speed: Array
    curvature: Array
    acceleration: Array
    offset: Array
    tag_distance: Array
    tags_in_view: NDArray[np.intp]
    caps: dict[str, Array]
    binds: dict[str, float]

    def metrics(self) -> dict[str, float]:
        """Returns the numbers of a report."""
        seen = self.tags_in_view
        return {
            "lap_time_s": self.route.duration,
            "length_m": self.route.length,
            "taught_length_m": self.taught.length,
            "max_speed_mps": float(self.speed.max()),
            "min_speed_mps": float(self.speed.min()),
            "max_acceleration_mps2": float(np.abs(self.acceleration).max()),
            "max_lateral_acceleration_mps2": float((self.speed**2 * np.abs(self.curvature)).max()),
            "max_turn_rate_radps": float((self.speed * np.abs(self.curvature)).max()),
            "max_curvature_1pm": float(np.abs(self.curvature).max()),
            "max_offset_m": float(np.abs(self.offset).max()),
            "min_tag_distance_m": float(self.tag_distance.min()),
        } | (
            {
                "min_tags_in_view": int(seen.min()),
                "two_tag_fraction": float((seen >= 2).mean()),
                "enough_tags_fraction": float((seen >= self.limits.min_tags).mean()),
            }
            if seen.min() >= 0
            else {}
        )


def plan_route(
    taught: TaughtPath, tags: MarkerMap, limits: RouteLimits, view: TagView | None = None
) -> RoutePlan:
    """Makes the route.

    Args:
        taught: the taught path, in the map's frame.
        tags: the map.
        limits: to be kept.
        view: the camera; None leaves the tags in view out.

    Raises:
        ValueError: a map without tags, a path elsewhere than the map, or limits that cannot be
            kept together, with the place.
    """
    if len(tags) == 0:
        raise ValueError("the marker map has no tags")
    positions = np.array([tag.X_WM.translation()[:2] for tag in tags])
    away = np.linalg.norm(taught.points[:, None] - positions, axis=2).min(axis=1)
    if away.max() > _FAR:
        x, y = taught.points[int(np.argmax(away))]
        raise ValueError(
            f"the taught path is outside the map: {away.max():.1f} m from the nearest tag at "
            f"({x:.2f}, {y:.2f}), must be {_FAR:g} m or less"
        )
    needed = limits.min_tags > 0 and limits.view_share > 0
    whole = np.array([-limits.corridor, limits.corridor])
    edges = np.tile(whole, (len(taught.points), 1))
    for price in _VIEW_PRICES:
        best = _optimized(Surroundings(taught, positions, edges, price), limits)
        plan = _timed(best.spline, taught, limits, positions, view)
        few = plan.tags_in_view < limits.min_tags
        if view is None or not needed or few.mean() <= 1 - limits.view_share:
            return plan
        edges = view.intervals(_abreast(plan), limits.corridor, limits.min_tags)
        possible = np.isfinite(edges[:, 0])
        if possible.mean() < limits.view_share:
            break
        edges[~possible] = whole
    raise ValueError(_few_tags(plan))


def _abreast(plan: RoutePlan) -> Array:
    """Returns the poses at the taught points, with the headings of the route beside them."""
    off = np.linalg.norm(plan.taught.points[:, None] - plan.points, axis=2)
    return np.column_stack([plan.taught.points, plan.heading[np.argmin(off, axis=1)]])


def _optimized(around: Surroundings, limits: RouteLimits) -> Candidate:
    """Returns the fastest path that keeps the limits of the path everywhere."""
    found: list[Violation] = []
    for spare in _SPARES:
        best = optimize(around, limits, spare)
        found = path_violations(best.spline, around, limits)
        if not found:
            return best
        if max(map(_excess, found)) > 2 * spare:
            break
    raise ValueError(_refusal(max(found, key=_excess)))


def path_violations(
    spline: PathSpline, around: Surroundings, limits: RouteLimits
) -> list[Violation]:
    """Returns what limits of the path a spline violates at steps of a centimetre."""
    u, _ = spline.table(FINE)
    points = spline.at(u)
    place, _, run = around.taught.nearest(points)
    found = []
    for limit, value, allowed, sign in (
        ("max_curvature", np.abs(spline.curvature(u)), limits.max_curvature, 1.0),
        ("corridor", np.linalg.norm(points - place, axis=1), limits.corridor, 1.0),
        ("tag_distance", _to_tags(points, around.tags), limits.tag_distance, -1.0),
    ):
        k = int(np.argmax(sign * value))
        if sign * (value[k] - allowed) > 0:
            found.append(Violation(limit, points[k], float(run[k]), float(value[k]), allowed))
    return found


def _to_tags(points: Array, tags: Array) -> Array:
    return np.asarray(np.linalg.norm(points[:, None] - tags, axis=2).min(axis=1))


def _excess(violation: Violation) -> float:
    return abs(violation.value - violation.allowed) / max(violation.allowed, 1e-9)


def _refusal(violation: Violation) -> str:
    limit, (x, y), run, value, allowed = violation
    unit, word = _UNITS[limit], "at least" if limit == "tag_distance" else "at most"
    return (
        f"the limits cannot be kept together: {limit} is {value:.3g} {unit} at ({x:.2f}, {y:.2f}), "
        f"{run:.2f} m along the taught path, must be {word} {allowed:.3g} {unit} there"
    )


def _few_tags(plan: RoutePlan) -> str:
    few = np.asarray(plan.tags_in_view < plan.limits.min_tags)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], few.astype(int), [0]])))
    starts, ends = edges[::2], edges[1::2]
    k = int(np.argmax(ends - starts))
    x, y = plan.points[starts[k]]
    return (
        f"min_tags cannot be kept: fewer than {plan.limits.min_tags} tags are in view along "
        f"{few.mean():.1%} of the way, must be at most {1 - plan.limits.view_share:.1%}; the "
        f"longest stretch is {(ends[k] - starts[k]) * FINE:.2f} m from ({x:.2f}, {y:.2f}) on"
    )


def _timed(
    spline: PathSpline,
    taught: TaughtPath,
    limits: RouteLimits,
    tags: Array,
    view: TagView | None,
) -> RoutePlan:
    """Drives a path as fast as the limits allow, and looks at all of it."""
    closed = spline.closed
    u, run = spline.table(FINE)
    kappa, first = spline.curvature(u), spline.at(u, 1)
    heading = np.unwrap(np.arctan2(first[:, 1], first[:, 0]))
    steps = np.diff(run)
    squared = fastest(kappa[:-1] if closed else kappa, steps, limits, closed)
    reached = times(squared, steps, closed)
    if closed:
        squared = np.append(squared, squared[0])
    speed = np.sqrt(squared)
    points = spline.at(u)
    place, direction, _ = taught.nearest(points)
    off = points - place
    side = direction[:, 0] * off[:, 1] - direction[:, 1] * off[:, 0]
    plan = RoutePlan(
        route=_sampled(spline, u, reached, speed, limits),
        taught=taught,
        limits=limits,
        run=run,
        points=points,
        heading=heading,
        speed=speed,
        curvature=kappa,
        acceleration=np.append(np.diff(squared) / (2 * steps), 0.0),
        offset=np.asarray(np.copysign(np.linalg.norm(off, axis=1), side)),
        tag_distance=_to_tags(points, tags),
        tags_in_view=_in_view(points, heading, view),
        caps=speed_caps(kappa, limits),
        binds={},
    )
    return replace(plan, binds=_binding(plan))


def _sampled(
    spline: PathSpline, u: Array, reached: Array, speed: Array, limits: RouteLimits
) -> Route:
    count = max(round(reached[-1] / _STEP), 4)
    t = reached[-1] / count * np.arange(count if spline.closed else count + 1)
    at = np.interp(t, reached, u)
    points, first = spline.at(at), spline.at(at, 1)
    v = np.interp(t, reached, speed)
    theta = np.unwrap(np.arctan2(first[:, 1], first[:, 0]))
    return Route(
        t=t, x=points[:, 0], y=points[:, 1], theta=theta, v=v, omega=v * spline.curvature(at),
        closed=spline.closed, limits=dict(vars(limits)),
    )  # fmt: skip


def _in_view(points: Array, heading: Array, view: TagView | None) -> NDArray[np.intp]:
    if view is None:
        return np.full(len(points), -1)
    looks = np.arange(0, len(points), _SEEN)
    seen = view.count(np.column_stack([points[looks], heading[looks]]))
    return seen[np.minimum(np.round(np.arange(len(points)) / _SEEN).astype(int), len(looks) - 1)]


def _binding(plan: RoutePlan) -> dict[str, float]:
    limits = plan.limits
    # At an acceleration's ends lie places that another limit holds.
    rate = np.abs(plan.acceleration) >= _BINDS * limits.max_acceleration
    holds = {
        name: (plan.speed >= _BINDS * cap) & ~rate for name, cap in plan.caps.items()
    } | {
        "acceleration": rate,
        "curvature": np.abs(plan.curvature) >= 0.95 * limits.max_curvature,
        "corridor": np.abs(plan.offset) >= 0.95 * limits.corridor,
        "tag_distance": plan.tag_distance <= 1.05 * limits.tag_distance,
        "tags_in_view": plan.tags_in_view == limits.min_tags,
    }  # fmt: skip
    return {name: float(where.mean()) for name, where in holds.items()}
