"""`make bench`: every table of the benchmarks."""

from __future__ import annotations

from tests.benchmarks import bench_detector, bench_pose, bench_run
from tests.benchmarks.table import show

for title, module in (
    ("Detector", bench_detector),
    ("Poses from markers", bench_pose),
    ("Bundled run", bench_run),
):
    show(title, module.rows())
