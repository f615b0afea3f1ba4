"""What `tagtrail map` says of single frames."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from systems.cameras import PinholeCamera
from tests.diagrams.test_map import SIZE, START, record, report_of, seen, tum
from tests.mapping_world import circuit

SPOILT = 40


def rows_of(out: Path) -> list[dict[str, float]]:
    with (out / "frames.csv").open(newline="") as file:
        return [{key: float(x) for key, x in row.items()} for row in csv.DictReader(file)]


def test_each_frame_has_a_row_and_the_report_the_worst(
    tagtrail: Callable[..., Any], tmp_path: Path
) -> None:
    frames = seen(circuit(frames=120, seed=3))
    corners = frames[SPOILT].corners.copy()
    corners[0] += (60.0, -80.0)
    frames[SPOILT] = replace(frames[SPOILT], corners=corners)
    bag, out = record(tmp_path / "bag", frames), tmp_path / "M"
    result = tagtrail("map", bag, "--size", SIZE, "--out", out, "--no-meshcat")
    assert result.status == 0, result
    rows, report = rows_of(out), report_of(out)
    np.testing.assert_allclose([row["time"] for row in rows], START + np.arange(120) / 10)
    assert [row["tags"] + row["outliers"] for row in rows] == [len(d) for d in frames]
    spoilt = rows[SPOILT]
    assert spoilt["outliers"] == 1
    assert spoilt["largest_px"] == pytest.approx(100.0, abs=3.0)
    others = rows[:SPOILT] + rows[SPOILT + 1 :]
    assert max(row["largest_px"] for row in others) < 6 * 0.3
    assert sum(row["outliers"] for row in others) == 0
    assert all(0.1 < row["reprojection_rms_px"] < 0.7 for row in rows)
    worst = report["worst_frames"]
    assert len(worst) == 10
    assert worst[0] == pytest.approx(spoilt, abs=1e-4)
    assert [row["largest_px"] for row in worst] == pytest.approx(
        sorted((row["largest_px"] for row in rows), reverse=True)[:10], abs=1e-4
    )
    # By frame, by tag and as a whole: the same corners.
    tags = report["tags"]
    for key in ("tags", "sightings"), ("outliers", "outliers"):
        assert sum(row[key[0]] for row in rows) == sum(row[key[1]] for row in tags)
    squared = [sum(r["reprojection_rms_px"] ** 2 * r["tags"] for r in rows)]
    squared += [sum(r["reprojection_rms_px"] ** 2 * r["sightings"] for r in tags)]
    sightings = sum(row["sightings"] for row in tags)
    whole = report["metrics"]["reprojection_rms_px"]
    np.testing.assert_allclose(np.sqrt(np.array(squared) / sightings), whole, rtol=1e-3)
    posed = [row["time"] for row in rows if row["pose"] == 1]
    np.testing.assert_allclose(posed, tum(out / "trajectory.tum")[:, 0])


def test_a_refused_map_leaves_the_rows_that_show_why(
    tagtrail: Callable[..., Any], tmp_path: Path
) -> None:
    bag, out = record(tmp_path / "bag", seen(circuit(frames=120, seed=3))), tmp_path / "M"
    PinholeCamera.from_focal_length(640, 480, 520.0).save(tmp_path / "wrong.yaml")
    result = tagtrail("map", bag, "--size", SIZE, "--camera", tmp_path / "wrong.yaml",
                      "--out", out, "--no-meshcat")  # fmt: skip
    assert result.status == 1
    rows = rows_of(out)
    assert len(rows) == 120
    assert sum(row["outliers"] for row in rows) == report_of(out)["health"]["sightings"]["outlier"]
    assert sum(row["reprojection_rms_px"] > 2 * 0.3 for row in rows) > 20
