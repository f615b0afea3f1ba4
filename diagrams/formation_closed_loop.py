"""Formations that go straight ahead for so many moves, closed loop: ours, and the paper's way.

The paper's way is Algorithm I with the closest-vertex rule and no estimator: every robot believes
that it stands where it was to go. Its errors are those of conditions under which Algorithm I builds
triangles as inexactly as [FORM] reports (see `systems.formation.trials`), and no others; the paper
states none. Ours has the errors of the bundled scenario.

[FORM]: Kang, Kwon, Bae, Kim, "Monocular Vision-Based Swarm Robot Localization Using Equilateral
Triangular Formations".
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from diagrams.study import load_study, run_study
from systems.formation.vertex_walk import SIDE

# A camera that looks 3 px aside is a principal point that is 3 px off.
_ASIDE = math.degrees(math.atan(3 / 485))
PAPERS_ERRORS = tuple(
    f"robot.sensors.{camera}.{key}"
    for camera, yaw in (("front_camera", _ASIDE), ("rear_camera", 180 + _ASIDE))
    for key in (
        "latency=0.2",
        "rate=20.0",
        "projector.pixel_noise=0.5",
        f"rpy_deg=[0.0, 0.0, {yaw:.4f}]",
    )
)
PAPERS_WAY = (
    "controller=algorithm1", "estimator=none", "planner=closest", "errors=none", *PAPERS_ERRORS,
)  # fmt: skip
WAYS: dict[str, tuple[str, ...]] = {"Algorithm I": PAPERS_WAY, "ours": ()}


def straight_ahead(moves: int) -> tuple[str, ...]:
    """Returns the overrides of the scenario `formation` by which it goes on for so many moves."""
    end = _FRONT + moves * SIDE / 2  # a move leads half a side on
    return (
        "sight=projected",
        f"destination=[{end:g}, 0.65]",
        f"world.arena.ground={2 * end + 10:g}",
        f"duration={_PATIENCE * moves:g}",
    )


def closed_loop(
    folder: Path, way: str, *, moves: int, runs: int, workers: int | None = None
) -> list[dict[str, Any]]:
    """Returns the records of runs in the plant (see `diagrams.study`), seeds 0 to `runs` - 1.

    Args:
        folder: where they are kept; those that are there already are not done again.
        way: one of `WAYS`.
        moves: how many.
        runs: how many.
        workers: processes; one for each core if left out.
    """
    study = load_study("formation", [*straight_ahead(moves), *WAYS[way]], [])
    return run_study(study, runs=runs, out=folder, workers=workers)


_PATIENCE = 80.0  # s for a move; it takes 50
_FRONT = 2.25  # m, where the foremost robot stands at the start
