from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from diagrams.shell_metrics import AXES, ShellLog
from diagrams.shell_table import PAPER, table, table_figure, write_table
from tests.diagrams.shell_report_log import shell_log


def random_log(iterations: int = 5, n: int = 2000) -> ShellLog:
    rng = np.random.default_rng(11)
    size = 1 + np.arange(n)[:, None] / n  # so that iterations differ
    met = np.minimum(np.arange(n) // 50, 9)
    return shell_log(
        [0.5, 0, 0] + size * rng.normal(0, [2.0, 4.0, 7.0], (n, 3)),
        iterations=iterations,
        markers_met=met,
    )


def test_every_row_holds_the_papers_numbers() -> None:
    made = table(random_log())
    for row, cells in made.items():
        assert list(cells) == list(AXES)
        assert all(list(cell) == ["ours", "paper", "ours_angle"] for cell in cells.values())
        expected = PAPER.get(row, (None, None, None))
        assert tuple(cell["paper"] for cell in cells.values()) == expected
    assert len(PAPER) == 16
    assert set(made) - set(PAPER) == {"share_of_samples"}


def test_the_papers_numbers_hang_together() -> None:
    # Typed wrong, they would hardly: RMSE^2 = mean^2 + deviation^2 with a mean below the deviation,
    # and the order of the quantiles and rates.
    numbers = {row: np.array(values) for row, values in PAPER.items()}
    assert (numbers["standard_deviation_deg"] <= numbers["rmse_deg"]).all()
    quantiles = ["median_deg", "p95_deg", "p99_deg", "p99_5_deg", "maximum_deg"]
    assert (np.diff([numbers[row] for row in quantiles], axis=0) > 0).all()
    rates = [numbers[f"rate_above_{k}_deg"] for k in (5, 10, 15, 20)]
    assert (np.diff(rates, axis=0) <= 0).all()
    for name in ("rmse", "mae"):
        off = numbers[f"iterations_{name}_mean_deg"] - numbers[f"{name}_deg"]
        assert (np.abs(off) < numbers[f"iterations_{name}_std_deg"]).all()


@pytest.mark.parametrize("kind", ["ours", "ours_angle"])
def test_rows_against_numpy(kind: str) -> None:
    log = random_log()
    made = table(log)
    used = log.markers_met >= 2
    errors = log.errors()
    if kind == "ours_angle":
        errors, defined = log.angle_errors()
        used &= defined
    for k, axis in enumerate(AXES):
        e = errors[used, k]
        size = np.sort(np.abs(e))
        parts = [errors[used & (log.iteration == i), k] for i in range(5)]
        rmse = [np.linalg.norm(part) / np.sqrt(len(part)) for part in parts]
        mae = [np.sum(np.abs(part)) / len(part) for part in parts]
        expected = {
            "rmse_deg": np.linalg.norm(e) / np.sqrt(len(e)),
            "mae_deg": np.sum(size) / len(e),
            "median_deg": np.interp(0.5, np.linspace(0, 1, len(e)), size),
            "p95_deg": np.interp(0.95, np.linspace(0, 1, len(e)), size),
            "p99_deg": np.interp(0.99, np.linspace(0, 1, len(e)), size),
            "p99_5_deg": np.interp(0.995, np.linspace(0, 1, len(e)), size),
            "maximum_deg": size[-1],
            "standard_deviation_deg": np.sqrt(np.mean(e**2) - np.mean(e) ** 2),
            "rate_above_5_deg": np.sum(size > 5) / len(e),
            "rate_above_10_deg": np.sum(size > 10) / len(e),
            "rate_above_15_deg": np.sum(size > 15) / len(e),
            "rate_above_20_deg": np.sum(size > 20) / len(e),
            "iterations_rmse_mean_deg": np.mean(rmse),
            "iterations_rmse_std_deg": np.sqrt(np.sum((rmse - np.mean(rmse)) ** 2) / 4),
            "iterations_mae_mean_deg": np.mean(mae),
            "iterations_mae_std_deg": np.sqrt(np.sum((mae - np.mean(mae)) ** 2) / 4),
            "share_of_samples": np.sum(used) / len(log.t),
        }
        assert set(expected) == set(made)
        for row, value in expected.items():
            assert made[row][axis][kind] == pytest.approx(value, rel=1e-9), row


def test_by_hand() -> None:
    errors = np.zeros((100, 3))
    errors[:, 0] = 1.0  # no deviation
    errors[::2, 2] = 8.0
    errors[1::2, 2] = -12.0
    made = table(shell_log(errors))
    roll, yaw = ({row: cells[axis]["ours"] for row, cells in made.items()} for axis in AXES[::2])
    assert roll["rmse_deg"] == pytest.approx(1.0)
    assert roll["standard_deviation_deg"] == pytest.approx(0.0, abs=1e-9)
    assert yaw["mae_deg"] == pytest.approx(10.0)
    assert yaw["median_deg"] == pytest.approx(10.0)
    assert yaw["rmse_deg"] == pytest.approx(np.sqrt(104))
    assert yaw["standard_deviation_deg"] == pytest.approx(10.0)
    assert yaw["rate_above_5_deg"] == 1.0
    assert yaw["rate_above_10_deg"] == 0.5
    assert yaw["rate_above_15_deg"] == 0.0
    assert yaw["share_of_samples"] == 1.0


def test_components_and_angles_are_not_the_same_numbers() -> None:
    # Turned about z, the robot's yaw is wrong by that much everywhere, its roll nowhere.
    made = table(shell_log(np.tile([0.0, 0.0, 3.0], (500, 1))))
    assert made["rmse_deg"]["yaw"]["ours"] == pytest.approx(3.0)
    assert made["rmse_deg"]["yaw"]["ours_angle"] == pytest.approx(3.0)
    assert made["rmse_deg"]["roll"]["ours_angle"] == pytest.approx(0.0, abs=1e-9)
    # Turned about x, which on the equator at yaw 90 is the axis of -pitch, at yaw 180 of -roll.
    made = table(shell_log(np.tile([3.0, 0.0, 0.0], (500, 1))))
    assert made["rmse_deg"]["pitch"]["ours"] == pytest.approx(0.0, abs=1e-9)
    assert made["rmse_deg"]["pitch"]["ours_angle"] is not None
    assert made["rmse_deg"]["pitch"]["ours_angle"] > 0.5
    share = made["share_of_samples"]["roll"]
    assert share["ours"] == 1.0
    assert share["ours_angle"] == pytest.approx(1 - 0.4 * 20 / 180, abs=0.01)  # 20 deg of the pole


def test_a_bad_start_is_left_out() -> None:
    errors = np.ones((100, 3))
    errors[:25] = 40.0
    made = table(shell_log(errors, markers_met=np.repeat([1, 2], [25, 75])))
    assert made["maximum_deg"]["roll"]["ours"] == pytest.approx(1.0)
    assert made["share_of_samples"]["roll"]["ours"] == 0.75


def test_one_iteration_has_no_spread() -> None:
    made = table(random_log(iterations=1))
    rows = [row for row in made if row.startswith("iterations")]
    assert len(rows) == 4
    assert all(made[row][axis]["ours"] is None for row in rows for axis in AXES)
    assert all(made[row][axis]["ours_angle"] is None for row in rows for axis in AXES)


def test_with_nothing_scored_there_is_nothing_to_say() -> None:
    for log in (shell_log(np.ones((20, 3)), markers_met=np.ones(20, int)), shell_log([])):
        made = table(log)
        for row in PAPER:
            assert made[row]["yaw"]["ours"] is None
            assert made[row]["yaw"]["paper"] is not None


def test_no_number_is_above_every_limit(tmp_path: Path) -> None:
    log = random_log()
    broken = log.R_estimate.copy()
    broken[150] = np.nan
    made = write_table(replace(log, R_estimate=broken), tmp_path)
    assert made["rmse_deg"]["roll"]["ours"] is None
    assert made["rate_above_20_deg"]["roll"]["ours"] == pytest.approx(1 / 1900)


def test_the_files_hold_the_table(tmp_path: Path) -> None:
    log = random_log()
    made = write_table(log, tmp_path)
    assert json.loads((tmp_path / "table1.json").read_text()) == made == table(log)
    picture = (tmp_path / "table1.png").read_bytes()
    assert cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE).shape[1] == 1600
    write_table(log, tmp_path, "_again")
    assert (tmp_path / "table1_again.png").read_bytes() == picture
    assert json.loads((tmp_path / "table1_again.json").read_text()) == made


def test_better_and_worse_are_told_without_colour() -> None:
    made = table(random_log())
    cells = {
        "better": {"ours": 1.0, "paper": 3.2965, "ours_angle": None},
        "worse": {"ours": 4.0, "paper": 3.1783, "ours_angle": 3.1783},
    }
    made["rmse_deg"]["roll"], made["rmse_deg"]["pitch"] = cells["better"], cells["worse"]
    texts = {text.get_text(): text for text in table_figure(made).axes[0].texts}
    assert texts["▼ 1.0000"].get_fontweight() == "bold"
    assert texts["▲ 4.0000"].get_fontstyle() == "italic"
    assert "-" in texts
    printed = [text.get_text() for text in table_figure(made).axes[0].texts]
    assert printed.count("3.1783") == 2  # the paper's, and ours that is equal
    for values in PAPER.values():  # all of them stand there, to the paper's last digit
        assert all(f"{value:.4f}" in printed for value in values)
