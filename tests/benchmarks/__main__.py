"""`make bench`: every table of the benchmarks."""

from __future__ import annotations

from tests.benchmarks import (
    bench_detector,
    bench_drawing,
    bench_filter,
    bench_flow,
    bench_formation_filter,
    bench_formation_models,
    bench_formation_run,
    bench_lidar,
    bench_madgwick,
    bench_mapping,
    bench_planner,
    bench_pose,
    bench_run,
    bench_shell_ekf,
    bench_snailbot,
    bench_triangle,
)
from tests.benchmarks.table import show

for title, module in (
    ("Detector", bench_detector),
    ("Poses from markers", bench_pose),
    ("Lidar", bench_lidar),
    ("Planar filters", bench_filter),
    ("Planner, mapper and collision monitor", bench_planner),
    ("Drawn camera", bench_drawing),
    ("Flow over the shell", bench_flow),
    ("Attitude filter", bench_madgwick),
    ("Filter of the pose on the shell", bench_shell_ekf),
    ("Mapping", bench_mapping),
    ("Building a triangle", bench_triangle),
    ("Estimator of a formation", bench_formation_filter),
    ("Models of a formation's errors", bench_formation_models),
    ("Formation", bench_formation_run),
    ("Navigation robot", bench_run),
    ("SnailBot", bench_snailbot),
):
    show(title, module.rows())
