"""How exactly a formation moved, from logs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap
from systems.formation.triangles import arrival_heading, components, next_vertex

Array = NDArray[np.float64]

BROKEN = (0.6, 1.6)  # a side outside this, by the nominal one


@dataclass(frozen=True, eq=False)
class MoveEnd:
    """A move that has ended.

    Attributes:
        number: counted from 1.
        t: when, s.
        robot: that moved, from 0.
        beacons: (3,) robots.
        target: (2,) the vertex had every triangle been perfect, m.
        done: whether it got there, as it believes.
        place: (2,) where it truly stands, m.
        vertex: (2,) the vertex of the beacons where they truly stand, m.
        lateral: of place against vertex, m.
        longitudinal: m.
        sides: (2,) true distances to beacons 1 and 2, m.
        waits: how often it stood and waited.
        retries: tries after the first.
    """

    number: int
    t: float
    robot: int
    beacons: NDArray[np.int64]
    target: Array
    done: bool
    place: Array
    vertex: Array
    lateral: float
    longitudinal: float
    sides: Array
    waits: int
    retries: int

    def to_plain(self) -> dict[str, Any]:
        """Returns plain data."""
        return {
            key: value.tolist() if isinstance(value, np.ndarray) else value
            for key, value in vars(self).items()
        }


@dataclass(frozen=True, eq=False)
class FormationLog:
    """Truth, belief and moves at common times.

    Attributes:
        t: (m,) s.
        record: (m, 10) as `FormationTurns` sends it.
        truth: (m, n, 3) true poses; None when nobody knows them.
        believed: (m, n, 2) m, where the robots are believed to be.
        estimate: (m, n, 3) of the estimator, if there is one.
        covariance: (m, 3 n, 3 n) of it.
    """

    t: Array
    record: Array
    truth: Array | None
    believed: Array
    estimate: Array | None
    covariance: Array | None

    def known(self, robot: int) -> NDArray[np.bool_]:
        """Returns at which times the estimator knows at all where a robot is, (m,)."""
        assert self.covariance is not None
        own = [3 * robot, 3 * robot + 1]
        return np.asarray(self.covariance[:, own, own].sum(axis=1) < _LOST**2)

    def ends(self) -> NDArray[np.intp]:
        """Returns the samples at which moves had ended."""
        return np.flatnonzero(np.diff(self.record[:, 0], prepend=0.0) > 0)

    def moves(self) -> list[MoveEnd]:
        """Returns the moves that have ended; none when nobody knows the truth."""
        return [] if self.truth is None else [self._move(k, self.truth[k]) for k in self.ends()]

    def _move(self, k: np.intp, truth: Array) -> MoveEnd:
        number, robot, *rest = self.record[k]
        beacons = np.array(rest[:3], int)
        place, stand = truth[int(robot), :2], truth[beacons, :2]
        vertex = next_vertex(stand)
        longitudinal, lateral = components(place - vertex, arrival_heading(vertex, stand[2]))
        return MoveEnd(
            number=int(number),
            t=float(self.t[k]),
            robot=int(robot),
            beacons=beacons,
            target=np.array(rest[3:5]),
            done=bool(rest[5] > 0),
            place=place,
            vertex=vertex,
            lateral=float(lateral),
            longitudinal=float(longitudinal),
            sides=np.linalg.norm(stand[:2] - place, axis=1),
            waits=int(rest[6]),
            retries=int(rest[7]),
        )


def formation_metrics(log: FormationLog, side: float) -> dict[str, Any]:
    """Returns the metrics; None where nobody knows the truth or nothing has moved.

    `destination_error_m`: of the last robot that moved, against the vertex that it was to build had
    every triangle been perfect. `side_error_max_m`: of the sides that moves have built, against the
    nominal one. `broken`: whether one of those was outside 0.6 to 1.6 times that.
    `lateral_error_mm` and `longitudinal_error_mm`: means of the sizes, of each place against the
    vertex of its beacons where those truly stand; they take the estimator's corrections for errors.
    `nees_mean`: of all poses that are known together after each move, per dimension. `waits`: how
    often a robot on its way stood and waited; `retries`: tries of moves after the first; `replans`:
    moves that were given up, and others planned.
    """
    moves = [move for move in log.moves() if move.done]
    ended = log.record[log.ends()]
    metrics: dict[str, Any] = {
        "moves": int(log.record[-1, 0]) if len(log.record) else 0,
        "destination_error_m": None,
        "side_error_max_m": None,
        "broken": None,
        "lateral_error_mm": None,
        "longitudinal_error_mm": None,
        "nees_mean": nees_mean(log),
        "waits": int(ended[:, 8].sum()),
        "retries": int(ended[:, 9].sum()),
        "replans": int((ended[:, 7] < 0).sum()),
    }
    if not moves:
        return metrics
    sides = np.array([move.sides for move in moves])
    ratio = sides / side
    metrics |= {
        "destination_error_m": float(np.linalg.norm(moves[-1].place - moves[-1].target)),
        "side_error_max_m": float(np.abs(sides - side).max()),
        "broken": bool((ratio.min() < BROKEN[0]) | (ratio.max() > BROKEN[1])),
        "lateral_error_mm": float(1e3 * np.mean([abs(move.lateral) for move in moves])),
        "longitudinal_error_mm": float(1e3 * np.mean([abs(move.longitudinal) for move in moves])),
    }
    return metrics


def nees_mean(log: FormationLog) -> float | None:
    """Returns the normalised error squared of all poses after moves, per dimension; 1 is right."""
    if log.truth is None or log.estimate is None or log.covariance is None or not len(log.ends()):
        return None
    values = []
    for k in log.ends():
        k = looked(log, k)
        error = log.estimate[k] - log.truth[k]
        error[:, 2] = wrap(error[:, 2])
        # Of who is lost the covariance says no more than that.
        known = np.repeat([log.known(robot)[k] for robot in range(len(error))], 3)
        e = error.ravel()[known]
        P = log.covariance[k][np.ix_(known, known)]
        values.append(float(e @ np.linalg.solve(P, e)) / max(len(e), 1))
    return float(np.mean(values))


def looked(log: FormationLog, end: np.intp) -> int:
    """Returns the sample a second after a move has ended: then all have looked at each other.

    Args:
        log: truth, belief and moves.
        end: sample at which the move had ended.
    """
    after = np.searchsorted(log.t, log.t[end] + _LOOK - 1e-9)
    return int(min(after, len(log.t) - 1))


_LOOK = 1.0  # s
_LOST = 1.0  # m; a robot on its way that nobody sees
