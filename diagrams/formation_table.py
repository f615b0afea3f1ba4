"""Table 1 of the paper on formations, by models of the errors of triangles and dead reckoning.

Numbers only; `diagrams.formation_studies` writes them.

[FORM]: Kang, Kwon, Bae, Kim, "Monocular Vision-Based Swarm Robot Localization Using Equilateral
Triangular Formations".
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from systems.formation.dead_reckoning import DeadReckoningParameters, dead_reckoning_errors
from systems.formation.error_models import (
    RULES,
    ScaledErrors,
    StepErrors,
    chained_errors,
    summed_errors,
)
from systems.formation.vertex_walk import SIDE, VertexWalk, closest_vertex_walk
from systems.noise import generator, stream_key

Array = NDArray[np.float64]
Numbers = dict[str, Any]

WHEEL_RADIUS = 0.075  # m; illegible in [FORM], ours
WHEEL_SPEEDS = (5.8, 2.9)  # rad/s, [FORM] 5

# The corners are ours: along these there are as many moves as the paper's errors need.
_CENTRE = (1.125, 0.65)  # m, of the formation at the start
PATHS: dict[str, list[tuple[float, float]]] = {
    "path 1": [(0.0, 0.0), *(4 * [(12.0, 0.0), (12.0, 6.0), (0.0, 6.0), (0.0, 0.0)])],
    "path 2": [
        (_CENTRE[0] + x, _CENTRE[1] + y)
        for x, y in ((0.0, 0.0), (5.0, 0.0), (5.0, 3.0), (0.0, 3.0), (0.0, 0.0))
    ],
}
STRAIGHT = [(30.0, 0.65)]  # m, where all else than what is varied shall stay the same

# [FORM] table 1: mean error at the destination of 100 runs, m, by path and wheel speed.
PAPER: dict[str, dict[str, tuple[float, float]]] = {
    "dead reckoning": {"path 1": (0.81, 1.43), "path 2": (0.20, 0.42)},
    "triangles": {"path 1": (0.56, 0.51), "path 2": (0.15, 0.12)},
}
GYRO_BIAS = math.radians(0.012)  # rad/s, ours, see systems.formation.dead_reckoning
FITS = 0.15  # part of the paper's number by which ours may be off

_BLOCK = 2000  # runs at once, so that memory does not grow with their number
_INSTANTS = 100


def table1(
    *, runs: int, seed: int, errors: StepErrors, over_time: Numbers | None = None
) -> Numbers:
    """Returns {model: {path: numbers}}: the paper's models and ours, in the order of the table.

    Of dead reckoning: mean error at the destination for each wheel speed, its standard error, the
    paper's and whether they agree within 15 %. Of triangles, on which the speed has no influence,
    the same against the mean of the paper's two speeds; of chains also which part of the runs
    broke, after how many moves half of them had, and the mean over those that did not.

    Args:
        runs: of each model on each path.
        seed: of the study.
        errors: of a triangle.
        over_time: filled with the errors over time if given.
    """
    numbers: Numbers = {}
    curves: Numbers = {path: {} for path in PATHS}
    for name, model in dead_reckoning_models().items():
        numbers[name] = {}
        for path in PATHS:
            cells = []
            for speed, paper in zip(WHEEL_SPEEDS, PAPER["dead reckoning"][path], strict=True):
                times, sizes = _dead_reckoning(path, speed, model, runs, seed)
                cells.append({"wheel_speed_rad_s": speed, **cell(sizes[:, -1], paper)})
                curves[path][f"{name}, {speed} rad/s"] = _curve(times, sizes.mean(axis=0))
            numbers[name][path] = cells
    for path, corners in PATHS.items():
        walk = closest_vertex_walk(corners[1:])
        paper = float(np.mean(PAPER["triangles"][path]))
        sizes, chains = _triangles(walk, path, runs, seed, errors)
        numbers.setdefault("triangles, sum", {})[path] = [
            {"moves": len(walk), **cell(sizes[:, -1], paper)}
        ]
        series = {"triangles, sum": sizes.mean(axis=0)}
        for rule, (lasting, stood) in chains.items():
            name = f"triangles, chain ({rule})"
            whole = lasting[stood == len(walk), -1]
            chain_cell = {
                "moves": len(walk),
                **cell(whole, paper),
                "broken": float((stood < len(walk)).mean()),
                "half_broken_after_moves": _half_broken(stood, len(walk)),
                "broken_within_40_moves": float((stood < 40).mean()) if len(walk) >= 40 else None,
            }
            numbers.setdefault(name, {})[path] = [chain_cell]
            series[f"{name}, median"] = _median(lasting)
        for speed in WHEEL_SPEEDS:
            times = walk.times(speed=speed * WHEEL_RADIUS)
            for name, values in series.items():
                curves[path][f"{name}, {speed} rad/s"] = _curve(times, values)
    if over_time is not None:
        over_time.update(curves)
    return numbers


def dead_reckoning_models() -> dict[str, DeadReckoningParameters]:
    """Returns the models by name: as [FORM] states it, and with an integrated bias of the gyro."""
    return {
        "dead reckoning": DeadReckoningParameters(),
        "dead reckoning, gyro bias": DeadReckoningParameters(gyro_bias=GYRO_BIAS),
    }


def by_robots(*, runs: int, seed: int, errors: StepErrors) -> list[Numbers]:
    """Returns a row for each number of robots from 4 to 20 ([FORM] Fig. 15).

    On a straight line of about 30 m, and on path 1 (None where the closest-vertex rule does not
    lead a formation so long around its own corners). Errors are the sum's, chains are those of
    bearings. The draws are the same for all, so that rows differ by the moves alone.
    """
    rows = []
    for robots in range(4, 21, 2):
        row: Numbers = {"robots": robots}
        for name, waypoints in (("straight", STRAIGHT), ("path 1", PATHS["path 1"][1:])):
            try:
                walk = closest_vertex_walk(waypoints, robots=robots)
            except ValueError:
                row[name] = None
                continue
            sizes, chains = _triangles(walk, name, runs, seed, errors, rules=("bearings",))
            row[name] = {
                **_walk_numbers(walk),
                **_mean(sizes[:, -1]),
                "chain_broken": float((chains["bearings"][1] < len(walk)).mean()),
            }
        rows.append(row)
    return rows


def by_side(*, runs: int, seed: int, errors: StepErrors) -> list[Numbers]:
    """Returns a row for each side length: accuracy, number of moves, time ([FORM] 4.3).

    On a straight line of about 30 m. How the error of a triangle goes with its side is not in
    [FORM]. Both ends are shown: in proportion, as an error of angle does (pixels, principal point),
    and the same at every side, as what a robot drives too far until it stops.

    Args:
        runs: of each.
        seed: of the study.
        errors: of a triangle of 1.5 m.
    """
    rows = []
    for side in (0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0):
        walk = closest_vertex_walk(STRAIGHT, side=side)
        row: Numbers = {"side_m": side, **_walk_numbers(walk)}
        for name, factor in (("proportional", side / SIDE), ("constant", 1.0)):
            scaled = ScaledErrors(errors, factor)
            sizes, _ = _triangles(walk, "sides", runs, seed, scaled, rules=())
            row[f"{name}_errors"] = _mean(sizes[:, -1])
        rows.append(row)
    return rows


def _dead_reckoning(
    path: str, wheel_speed: float, model: DeadReckoningParameters, runs: int, seed: int
) -> tuple[Array, Array]:
    """Returns times (k,) s and sizes (runs, k) m of the errors."""
    parts = []
    times = np.empty(0)
    for block, count in _blocks(runs):
        times, errors = dead_reckoning_errors(
            PATHS[path],
            speed=wheel_speed * WHEEL_RADIUS,
            runs=count,
            random=study_random(seed, f"dead_reckoning/{path}/{wheel_speed}", block),
            parameters=model,
            instants=_INSTANTS,
        )
        parts.append(np.linalg.norm(errors, axis=2))
    return times, np.concatenate(parts)


def _triangles(
    walk: VertexWalk,
    name: str,
    runs: int,
    seed: int,
    errors: StepErrors,
    rules: tuple[str, ...] = RULES,
) -> tuple[Array, dict[str, tuple[Array, NDArray[np.int64]]]]:
    """Returns the sum's sizes (runs, m) m, and of each chain its sizes and the moves it stood."""
    sums: list[Array] = []
    chains: dict[str, list[tuple[Array, NDArray[np.int64]]]] = {rule: [] for rule in rules}
    for block, count in _blocks(runs):
        drawn = errors.draw(study_random(seed, f"triangles/{name}", block), (count, len(walk)))
        sums.append(np.linalg.norm(summed_errors(walk, drawn), axis=2))
        for rule in rules:
            chain = chained_errors(walk, drawn, rule=rule)
            chains[rule].append((np.linalg.norm(chain.errors, axis=2), chain.moves))
    joined = {
        rule: (np.concatenate([a for a, _ in parts]), np.concatenate([b for _, b in parts]))
        for rule, parts in chains.items()
    }
    return np.concatenate(sums), joined


def _blocks(runs: int) -> list[tuple[int, int]]:
    """Returns (index, number of runs) of blocks of runs."""
    return [(k, min(_BLOCK, runs - start)) for k, start in enumerate(range(0, runs, _BLOCK))]


def study_random(seed: int, name: str, block: int = 0) -> np.random.Generator:
    """Returns the random numbers of a part of a study, of one block of its runs."""
    return generator(stream_key(seed, f"formation/{name}"), block)


def cell(sizes: Array, paper: float) -> Numbers:
    """Returns mean, standard error, and how the mean compares to the paper's number (m)."""
    numbers = _mean(sizes)
    mean = numbers["mean_m"]
    ratio = None if mean is None else mean / paper
    fits = None if ratio is None else abs(ratio - 1) <= FITS
    return {**numbers, "paper_m": paper, "ratio": ratio, "fits": fits}


def _mean(sizes: Array) -> Numbers:
    if len(sizes) < 2:
        return {"mean_m": None, "standard_error_m": None}
    error = sizes.std(ddof=1) / math.sqrt(len(sizes))
    return {"mean_m": float(sizes.mean()), "standard_error_m": float(error)}


def _walk_numbers(walk: VertexWalk) -> Numbers:
    time = walk.times(speed=WHEEL_SPEEDS[0] * WHEEL_RADIUS)[-1]
    return {"moves": len(walk), "time_s": float(time)}


def _median(sizes: Array) -> Array:
    """Returns the median over all runs, the broken ones as worst of all: inf once half are."""
    return np.asarray(np.median(np.where(np.isnan(sizes), np.inf, sizes), axis=0))


def _half_broken(stood: NDArray[np.int64], moves: int) -> int | None:
    """Returns the move by which half the runs had broken."""
    middle = int(np.sort(stood)[(len(stood) - 1) // 2])
    return middle + 1 if middle < moves else None


def _curve(times: Array, values: Array) -> Numbers:
    known = np.isfinite(values)
    return {"time_s": times[known].tolist(), "error_m": values[known].tolist()}
