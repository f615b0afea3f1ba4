from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy import stats

from diagrams.metrics import (
    NEES_BOUNDS,
    PoseLog,
    clearance_metrics,
    integrated_jerk,
    nees,
    nis_mean,
    path_length,
    pose_metrics,
)
from diagrams.trajectories import write_tum


def log(
    truth: ArrayLike,
    estimate: ArrayLike,
    covariance: ArrayLike | None = None,
    known: ArrayLike | None = None,
) -> PoseLog:
    n = len(np.array(estimate))
    return PoseLog(
        t=np.linspace(0.0, 1.0, n),
        truth=np.array(truth, float),
        estimate=np.array(estimate, float),
        covariance=np.tile(np.eye(3), (n, 1, 1)) if covariance is None else np.array(covariance),
        known=np.ones(n, bool) if known is None else np.array(known),
    )


def test_nees_by_hand() -> None:
    errors = np.array([[1.0, 2.0, 3.0], [1.0, 1.0, 0.0]])
    diagonal = np.diag([1.0, 4.0, 9.0])
    correlated = np.array([[2.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1.0]])
    # 1/1 + 4/4 + 9/9; and [1 1] times [[2 -1] [-1 2]] / 3 times [1 1]'.
    np.testing.assert_allclose(nees(errors, np.stack([diagonal, correlated])), [3.0, 2 / 3])


def test_nees_of_whoever_claims_to_be_certain_is_infinite() -> None:
    covariance = np.stack([np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0]), np.eye(3)])
    values = nees(np.full((3, 3), 2.0), covariance)
    np.testing.assert_array_equal(values, [np.inf, np.inf, 12.0])


def test_errors_are_scored_with_the_heading_wrapped() -> None:
    truth = [[0.0, 0.0, 3.1], [1.0, 0.0, -3.1], [0.0, 1.0, 0.0]]
    estimate = [[3.0, 4.0, -3.1], [1.0, 0.0, 3.1], [0.0, 1.0, 0.0]]
    turn = 2 * np.pi - 6.2  # over the seam, not 6.2 rad
    made = log(truth, estimate)
    np.testing.assert_allclose(
        made.errors(), [[3.0, 4.0, turn], [0.0, 0.0, -turn], [0.0, 0.0, 0.0]], atol=1e-12
    )
    metrics = pose_metrics(made)
    assert metrics["position_rmse_m"] == pytest.approx(np.sqrt(25 / 3))
    assert metrics["heading_rmse_deg"] == pytest.approx(np.rad2deg(turn * np.sqrt(2 / 3)))
    # One dimension of three is 1 for an estimate that is right about itself.
    assert metrics["nees_mean"] == pytest.approx((25 + 2 * turn**2) / 9)
    assert metrics["nees_in_bounds"] == 0.0


def test_only_what_is_known_is_scored() -> None:
    metrics = pose_metrics(
        log(
            truth=np.zeros((3, 3)),
            estimate=[[np.nan, 9.0, 9.0], [0.3, 0.4, 0.0], [0.3, -0.4, 0.0]],
            covariance=np.tile(np.diag([0.01, 0.16, 1.0]), (3, 1, 1)),
            known=[False, True, True],
        )
    )
    assert metrics["position_rmse_m"] == pytest.approx(0.5)
    assert metrics["nees_mean"] == pytest.approx((9 + 1) / 3)


def test_without_truth_or_estimate_there_is_nothing_to_say() -> None:
    nothing = dict.fromkeys(("position_rmse_m", "heading_rmse_deg", "nees_mean", "nees_in_bounds"))
    blind = log(np.zeros((2, 3)), np.zeros((2, 3)), known=[False, False])
    assert pose_metrics(blind) == nothing
    real = PoseLog(blind.t, None, blind.estimate, blind.covariance, np.ones(2, bool))
    assert pose_metrics(real) == nothing


def test_the_bounds_are_those_of_chi_square() -> None:
    assert pytest.approx(stats.chi2(3).ppf([0.025, 0.975]), rel=1e-4) == NEES_BOUNDS


def test_a_consistent_estimator_scores_as_one() -> None:
    rng = np.random.default_rng(5)
    n = 20_000
    L = np.array([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [-0.05, 0.02, 0.1]])
    truth = rng.uniform(-3, 3, (n, 3))
    estimate = truth + rng.standard_normal((n, 3)) @ L.T
    metrics = pose_metrics(log(truth, estimate, np.tile(L @ L.T, (n, 1, 1))))
    # Standard deviations of the means: sqrt(2/3/n) and sqrt(0.95 0.05/n).
    assert metrics["nees_mean"] == pytest.approx(1.0, abs=4 * np.sqrt(2 / 3 / n))
    assert metrics["nees_in_bounds"] == pytest.approx(0.95, abs=4 * np.sqrt(0.0475 / n))
    assert metrics["position_rmse_m"] == pytest.approx(np.sqrt(0.09 + 0.05), rel=0.03)


def test_the_length_of_a_path_by_hand() -> None:
    assert path_length(np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 4.0], [3.0, 0.0]])) == 9.0
    assert path_length(np.zeros((1, 2))) == 0.0


def test_a_tum_file_holds_time_position_and_quaternion(tmp_path: Path) -> None:
    path = tmp_path / "x.tum"
    poses = np.array([[1.0, -2.0, np.pi / 2], [0.5, 0.25, -np.pi]])
    write_tum(path, np.array([0.1, 1e5 + 0.02]), poses)
    first, second = (line.split(" ") for line in path.read_text().splitlines())
    half = f"{np.sqrt(0.5):.9f}"
    assert first == ["0.100000000", "1.000000000", "-2.000000000", *["0.000000000"] * 3, half, half]
    assert second[0] == "100000.020000000"
    assert np.abs(np.array(second[4:], float)) == pytest.approx([0.0, 0.0, 1.0, 0.0], abs=1e-9)


def test_jerk_of_known_motions() -> None:
    t = np.arange(0.0, 10.0, 0.02)
    # x = sin 2t: the jerk is -8 cos 2t, its square 32 in the mean over whole periods.
    swinging = np.stack([np.sin(2 * t), np.zeros_like(t)], axis=1)
    mean = 32 + 32 * np.sin(4 * 10.0) / (4 * 10.0)
    assert integrated_jerk(t, swinging) == pytest.approx(mean * 10.0, rel=0.06)
    # Uniform acceleration has none, whichever way it goes.
    falling = np.stack([0.3 * t - 0.05 * t**2, 0.1 * t**2], axis=1)
    assert integrated_jerk(t, falling) == pytest.approx(0.0, abs=1e-12)
    assert integrated_jerk(t[:3], falling[:3]) == 0.0  # too short to have one


def test_clearance_and_contacts() -> None:
    found = clearance_metrics(np.array([0.5, -0.01, 0.2, 0.31]), np.array([0.0, 1.0, 1.0, 1.0]))
    assert found == {"contacts": 1, "min_clearance_m": -0.01, "mean_clearance_m": 0.25}


def test_each_update_counts_once_in_the_nis() -> None:
    nis = [[np.nan, 0], [0.5, 1], [0.5, 1], [1.5, 2], [1.5, 2], [4.0, 4]]
    assert nis_mean(np.array(nis)) == pytest.approx(2.0)
    assert nis_mean(np.array(nis[:1])) is None
