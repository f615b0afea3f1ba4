from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from diagrams.shell_metrics import NAMES, shell_metrics
from tests.diagrams.shell_report_log import shell_log

DEG = np.pi / 180


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_constant_error_about_an_axis_of_r_is_that_axis_rmse(axis: int) -> None:
    errors = np.zeros((300, 3))
    errors[:, axis] = -1.0
    metrics = shell_metrics(shell_log(errors))
    expected = [0.0, 0.0, 0.0]
    expected[axis] = 1.0
    found = [metrics[f"{name}_rmse_deg"] for name in ("roll", "pitch", "yaw")]
    np.testing.assert_allclose(np.array(found, float), expected, atol=1e-6)
    assert metrics["max_error_deg"] == pytest.approx(1.0)
    assert metrics["p95_error_deg"] == pytest.approx(1.0)
    assert metrics["outlier_rate_15deg"] == 0.0


def test_an_error_about_an_axis_of_the_body_is_another() -> None:
    made = shell_log(np.zeros((300, 3)))
    turned = Rotation.from_matrix(made.R) * Rotation.from_rotvec([2 * DEG, 0, 0])
    metrics = shell_metrics(replace(made, R_estimate=turned.as_matrix()))
    # Over the pole and along the equator B's x axis points everywhere: its direction's mean square
    # is what each axis of R gets.
    expected = 2 * np.sqrt((made.R[:, :, 0] ** 2).mean(axis=0))
    found = [metrics[f"{name}_rmse_deg"] for name in ("roll", "pitch", "yaw")]
    np.testing.assert_allclose(np.array(found, float), expected, rtol=1e-6)
    assert np.abs(expected - [2, 0, 0]).max() > 0.5


def test_errors_are_those_of_an_independent_library() -> None:
    rng = np.random.default_rng(3)
    made = shell_log(rng.normal(0, 60, (300, 3)))
    difference = Rotation.from_matrix(made.R_estimate) * Rotation.from_matrix(made.R).inv()
    np.testing.assert_allclose(made.errors(), np.degrees(difference.as_rotvec()), atol=1e-9)


def test_by_hand() -> None:
    errors = np.zeros((100, 3))
    errors[:, 0] = np.arange(100) / 10  # 0 to 9.9
    errors[:7, 2] = 16.0
    errors[7, 1] = -20.0
    metrics = shell_metrics(shell_log(errors))
    assert metrics["roll_rmse_deg"] == pytest.approx(np.sqrt(328350 / 100) / 10)  # sum of k^2
    # In the same samples the components of a rotation vector stay what they are.
    assert metrics["yaw_rmse_deg"] == pytest.approx(16 * np.sqrt(0.07))
    assert metrics["max_error_deg"] == pytest.approx(20.0)
    assert metrics["p95_error_deg"] == pytest.approx(16.0)  # yaw's, above roll's 9.4
    assert metrics["outlier_rate_15deg"] == pytest.approx(0.08)


def test_a_bad_start_is_not_scored_but_reported() -> None:
    errors = np.ones((200, 3))
    errors[:50] = [[30.0, 0.0, 40.0]]
    met = np.repeat([0, 1, 2, 3], [20, 30, 100, 50])
    made = shell_log(errors, markers_met=met)
    metrics = shell_metrics(made)
    assert metrics["start_rmse_deg"] == pytest.approx(50.0)
    assert metrics["scored_from_s"] == made.t[50]
    assert metrics["roll_rmse_deg"] == pytest.approx(1.0)
    assert metrics["max_error_deg"] == pytest.approx(1.0)
    assert metrics["outlier_rate_15deg"] == 0.0
    # Scored from the start, it would have been an outlier.
    early = shell_metrics(replace(made, markers_met=np.full(200, 2)))
    assert early["outlier_rate_15deg"] == 0.25
    assert early["start_rmse_deg"] is None
    assert early["scored_from_s"] == 0.0


def test_without_a_second_marker_there_is_a_start_only() -> None:
    metrics = shell_metrics(shell_log(np.full((10, 3), 2.0), markers_met=np.ones(10, int)))
    said = {name for name, value in metrics.items() if value is not None}
    assert said == {"start_rmse_deg", "marker_visible_fraction"}
    assert metrics["start_rmse_deg"] == pytest.approx(2 * np.sqrt(3))


def test_an_empty_log_says_nothing() -> None:
    assert shell_metrics(shell_log(np.zeros((0, 3)))) == dict.fromkeys(NAMES)


def test_the_visible_part_is_of_the_whole_run() -> None:
    made = shell_log(np.zeros((100, 3)), markers_met=np.repeat([0, 2], 50))
    seen = np.zeros(100, bool)
    seen[:30] = True
    assert shell_metrics(replace(made, visible=seen))["marker_visible_fraction"] == 0.3


def test_the_position_is_the_robots() -> None:
    made = shell_log(np.zeros((100, 3)))
    off = np.zeros((100, 3))
    off[::2] = [0.003, 0.0, -0.004]
    metrics = shell_metrics(replace(made, p_estimate=made.p + off))
    assert metrics["position_rmse_m"] == pytest.approx(0.005 / np.sqrt(2))


def test_a_consistent_estimate_scores_as_one() -> None:
    rng = np.random.default_rng(8)
    n = 20_000
    # Correlated, in degrees; small, so that one rotation vector is as good as another.
    L = np.array([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [-0.05, 0.02, 0.1]])
    covariance = np.tile(np.eye(6), (n, 1, 1))
    covariance[:, :3, :3] = L @ L.T * DEG**2
    made = shell_log(rng.standard_normal((n, 3)) @ L.T, covariance=covariance)
    metrics = shell_metrics(made)
    # Standard deviations of the means: sqrt(2/3/n) and sqrt(0.95 0.05/n).
    assert metrics["nees_mean"] == pytest.approx(1.0, abs=4 * np.sqrt(2 / 3 / n))
    assert metrics["nees_in_bounds"] == pytest.approx(0.95, abs=4 * np.sqrt(0.0475 / n))
    # The same covariance, said in the body's frame, is another claim.
    turned = covariance.copy()
    turned[:, :3, :3] = np.swapaxes(made.R, 1, 2) @ covariance[:, :3, :3] @ made.R
    wrong = shell_metrics(replace(made, covariance=turned))
    assert wrong["nees_mean"] is not None
    assert wrong["nees_mean"] > 1.5


def test_who_claims_to_be_certain_and_who_claims_nothing() -> None:
    errors = np.full((4, 3), 1.0)
    covariance = np.tile(np.eye(6) * DEG**2, (4, 1, 1))
    made = shell_log(errors, covariance=covariance)
    assert shell_metrics(made)["nees_mean"] == pytest.approx(1.0)
    certain, ignorant = covariance.copy(), covariance.copy()
    certain[2] = 0.0
    ignorant[2] = np.inf
    assert shell_metrics(replace(made, covariance=certain))["nees_mean"] == np.inf
    assert shell_metrics(replace(made, covariance=certain))["nees_in_bounds"] == 0.75
    assert shell_metrics(replace(made, covariance=ignorant))["nees_mean"] == pytest.approx(1.0)
    nothing = shell_metrics(replace(made, covariance=np.full((4, 6, 6), np.inf)))
    assert nothing["nees_mean"] is None
    assert nothing["nees_in_bounds"] is None


def test_no_number_is_an_outlier() -> None:
    made = shell_log(np.zeros((10, 3)))
    broken = made.R_estimate.copy()
    broken[3] = np.nan
    assert shell_metrics(replace(made, R_estimate=broken))["outlier_rate_15deg"] == 0.1


def test_differences_of_angles_are_the_papers_where_they_mean_something() -> None:
    rng = np.random.default_rng(4)
    made = shell_log(rng.normal(0, 1.0, (300, 3)))
    found, defined = made.angle_errors()
    latitude = np.degrees(np.arcsin(made.R[:, 2, 2]))
    np.testing.assert_array_equal(defined, np.abs(latitude) < 80)
    assert 0 < defined.mean() < 1
    # The robot's own pitch: the latitude of where its z axis points.
    pitch = np.degrees(np.arcsin(made.R_estimate[:, 2, 2])) - latitude
    np.testing.assert_allclose(found[:, 1], pitch, atol=1e-9)
    # On the equator at yaw 0 heading to the pole, x and z of R are the axes of roll and yaw; y is
    # that of -pitch: the latitude rises by turning about -y.
    first = made.errors()[0]
    np.testing.assert_allclose(found[0], first * [1, -1, 1], atol=0.05)
    # Farther along the two differ: not the same numbers under another name.
    assert np.abs(np.abs(found) - np.abs(made.errors()))[defined].max() > 0.5
