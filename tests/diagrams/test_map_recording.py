"""`tagtrail map` on the recording of a room that TagSLAM's author made."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from systems.markers.layout import load_map
from tests.aviary import rms_to_tagslam


@pytest.mark.recording
def test_the_map_is_as_exact_as_tagslams(
    tagtrail: Callable[..., Any], recordings: Path, tmp_path: Path
) -> None:
    folder, out = recordings / "tagslam_aviary", tmp_path / "M"
    result = tagtrail(
        "map", folder / "tag_detections.bag", "--size", 0.12, "--camera", folder / "cameras.yaml",
        "--out", out, "--no-meshcat",
    )  # fmt: skip
    assert (result.status, result.err) == (0, "")
    assert "the recording calls its family 'mit': taken as tag36h11" in result.out
    report = json.loads((out / "report.json").read_text())
    metrics = report["metrics"]
    assert (report["outcome"], report["reasons"]) == ("mapped", {})
    assert metrics["reprojection_rms_px"] <= 0.36
    assert metrics["corners_used_fraction"] >= 0.99
    assert (metrics["tags"], metrics["frames"]) == (96, 680)
    rows = np.loadtxt(out / "trajectory.tum")
    off, common = rms_to_tagslam(rows[:, 0], rows[:, 1:4])
    assert common == 680
    assert off <= 0.007
    # The boards have tags 0.15 m apart, in rows of three: nobody told us.
    found = load_map(out / "map.json")
    for first in (6, 24, 60, 96):
        p = [found.markers[first + k].X_WM.translation() for k in range(3)]
        gaps = np.linalg.norm(np.diff(p, axis=0), axis=1)
        np.testing.assert_allclose(gaps, 0.15, atol=0.002)


@pytest.mark.recording
def test_a_camera_file_that_is_wrong_by_3_per_cent_is_refused(
    tagtrail: Callable[..., Any], recordings: Path, tmp_path: Path
) -> None:
    folder, wrong = recordings / "tagslam_aviary", tmp_path / "wrong.yaml"
    text = (folder / "cameras.yaml").read_text()
    wrong.write_text(text.replace("1502.36", "1547.43").replace("1500.58", "1545.60"))
    result = tagtrail(
        "map", folder / "tag_detections.bag", "--size", 0.12, "--camera", wrong,
        "--out", tmp_path / "M", "--no-meshcat",
    )  # fmt: skip
    assert result.status == 1
    reason = json.loads((tmp_path / "M" / "report.json").read_text())["reasons"]["focal_length"]
    words = reason.split()
    assert words[-1] == "1547"
    assert float(words[5]) == pytest.approx(1501.5, rel=0.005)
