"""The study of side lengths: that its numbers are those of the trials, and the trade-off shows."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import diagrams.formation_sides as study
from diagrams.formation_table import WHEEL_RADIUS
from systems.formation.trials import Outcome, TrialParameters
from systems.formation.vertex_walk import closest_vertex_walk


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "SIDES", (0.75, 1.5, 3.0))
        return study.by_measured_side(runs=30, seed=1)


def column(rows: list[dict[str, Any]], method: str, key: str) -> list[float]:
    return [row[key] for row in rows if row["method"] == method]


def test_longer_sides_take_fewer_moves_and_less_time(rows: list[dict[str, Any]]) -> None:
    for method in study.METHODS:
        for key in ("moves", "time_s"):
            assert (np.diff(column(rows, method, key)) < 0).all(), (method, key)


def test_what_bearings_miss_grows_with_the_side(rows: list[dict[str, Any]]) -> None:
    """An error of angle: the principal point is 3 px off, 0.35 degrees."""
    lateral = np.array(column(rows, "resection", "lateral_m"))
    assert (np.diff(lateral) > 0).all()
    assert lateral[-1] / lateral[0] == pytest.approx(4.0, rel=0.5)  # sides of 3 and 0.75 m


def test_resection_is_nearer_than_algorithm_1_at_every_side(rows: list[dict[str, Any]]) -> None:
    for key in ("lateral_m", "longitudinal_m", "error_m"):
        pairs = zip(column(rows, "resection", key), column(rows, "Algorithm I", key), strict=True)
        assert all(ours < paper for ours, paper in pairs), key


def always(seconds: float) -> Any:
    """Builds triangles that are all 30 mm to the left; one in four is never finished."""

    def build(number: int, _: Any, __: TrialParameters) -> Outcome:
        took = np.where(np.arange(number) % 4 == 0, np.nan, seconds)
        return Outcome(np.zeros(number), np.full(number, 0.03), took, took)

    return build


def test_numbers_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "SIDES", (1.5,))
    monkeypatch.setattr(study, "METHODS", {"given": always(10.0)})
    (row,) = study.by_measured_side(runs=8, seed=0)
    walk = closest_vertex_walk([(30.0, 0.65)], side=1.5)
    assert row["not_ended"] == 2
    assert row["lateral_m"] == pytest.approx(0.03)
    assert row["longitudinal_m"] == pytest.approx(0.0)
    assert row["moves"] == len(walk)
    driving = walk.drives.sum() / (5.8 * WHEEL_RADIUS)
    assert row["time_s"] == pytest.approx(driving + 10 * len(walk))
    left = walk.axes()[:, 0].sum(axis=0)
    assert row["error_m"] == pytest.approx(0.03 * np.linalg.norm(left))


def test_triangles_that_never_end_leave_gaps(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(study, "METHODS", {"Algorithm I": always(np.nan), "resection": always(5.0)})
    findings = study.formation_side(tmp_path, 8)
    assert findings.table.rows[0][2] == "-"
    assert findings.notes[-1].startswith(f"{8 * 7 + 2 * 7} triangles were never finished")


def test_the_command_prints_a_row_for_each_side(
    tagtrail: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study, "SIDES", (1.0, 3.0))
    result = tagtrail("study", "formation_side", "--runs", "5", "--out", tmp_path)
    assert (result.status, result.err) == (0, "")
    rows = json.loads((tmp_path / "sides.json").read_text())["rows"]
    assert len(rows) == 2 * len(study.SIDES)
    lines = [line for line in result.out.splitlines() if "resection" in line]
    assert len(lines) == len(study.SIDES)
    assert f"{1e3 * rows[-1]['lateral_m']:.1f}" in lines[-1]
    assert all(len(line) <= 80 for line in result.out.splitlines() if "│" in line)
    assert cv2.imread(str(tmp_path / "sides.png")).std() > 5
