"""Mapping: the real recording beside TagSLAM and GTSAM."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Iterator

import numpy as np
from pydrake.math import RigidTransform

from systems.mapping.adjustment import adjust, robust_cost
from systems.mapping.mapping import build_map
from systems.mapping.start import find_start
from systems.mapping.trajectory import trajectory
from tests.aviary import AVIARY, aviary, rms_to_tagslam
from tests.benchmarks.table import Row, show

FASTER = 10.0  # than GTSAM with factors in Python
REPEATS = 3


def rows() -> Iterator[Row]:
    """Yields the measurements."""
    if not AVIARY.is_dir():
        yield Row("real recording", "not there: set TAGTRAIL_DATA")
        return
    observed, gathered = aviary()
    seconds = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        tag_map = build_map(gathered)
        seconds.append(time.perf_counter() - started)
    what = f"real recording, {len(tag_map.stamps)} frames, {len(tag_map.ids)} tags"
    rms, used = tag_map.rms(), tag_map.used
    yield Row(f"{what}: reprojection RMS", f"{rms:.3f} px", "<= 0.36 px", rms <= 0.36)
    yield Row(f"{what}: corners used", f"{used:.2%}", ">= 99 %", used >= 0.99)
    way, _ = trajectory(tag_map, X_BC=observed.X_BC)
    off, common = rms_to_tagslam(way.stamps, way.p_WB)
    yield Row(f"{what}: way, RMS to TagSLAM's", f"{1e3 * off:.1f} mm in {common} frames",
              "<= 7 mm", off <= 0.007)  # fmt: skip
    yield from _beside_gtsam(what, min(seconds))


def _beside_gtsam(what: str, whole: float) -> Iterator[Row]:
    """The same sightings, start, noise and robust cost for both."""
    _, gathered = aviary()
    anchor = int(np.argmax(gathered.sightings_of()))
    before = time.perf_counter()
    start = find_start(gathered.sightings, known={anchor: RigidTransform()})
    to_start = time.perf_counter() - before
    noise, seconds = 0.3, []
    for _ in range(REPEATS):
        before = time.perf_counter()
        ours = adjust(start.scene, start.sightings, anchor=anchor, pixel_noise=noise,
                      tolerance=1e-5, covariances=False)  # fmt: skip
        seconds.append(time.perf_counter() - before)
    cost = float(robust_cost(ours.scene, start.sightings, noise).sum())
    told = f"{min(seconds):.2f} s to a robust chi-square of {cost:.0f}"
    yield Row(f"{what}: all with outliers and flips", f"{whole:.1f} s", "", None,
              f"the start alone: {to_start:.1f} s")  # fmt: skip
    if importlib.util.find_spec("gtsam") is None:
        yield Row(f"{what}: adjusted", told, "", None, "GTSAM is not there: pip install gtsam")
        return
    from tests.benchmarks.gtsam_mapping import solve

    theirs = solve(start.scene, start.sightings, anchor=anchor, pixel_noise=noise)
    yield Row(
        f"{what}: adjusted", told, f"a {FASTER:.0f}th of GTSAM's time, no larger chi-square",
        bool(FASTER * min(seconds) <= theirs.seconds and cost <= 1.001 * theirs.cost),
        f"GTSAM, factors in Python: {theirs.seconds:.1f} s to {theirs.cost:.0f} in "
        f"{theirs.iterations} steps",
    )  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(0 if show("Mapping", rows()) else 1)
