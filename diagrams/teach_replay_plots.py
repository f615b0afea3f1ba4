"""The figure of teaching, optimisation and replay: what was chained, what came of it, how it went.

What is true, chained, optimised and planned differs in lines and marks, not only in colour.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from diagrams.replay_log import ReplayLog
from diagrams.replay_plots import draw_tags, draw_way
from diagrams.teach_log import chain_errors
from diagrams.teach_replay_mission import tag_errors

if TYPE_CHECKING:
    from diagrams.teach_replay import Taught

Array = NDArray[np.float64]

_TRUTH: dict[str, Any] = {"color": "black", "linestyle": "-", "linewidth": 1.4}
_NAIVE: dict[str, Any] = {"color": "tab:orange", "linestyle": "--", "linewidth": 1.1}
_OPTIMISED: dict[str, Any] = {"color": "tab:red", "linestyle": "-.", "linewidth": 1.3}
_ROUTE: dict[str, Any] = {"color": "tab:blue", "linestyle": ":", "linewidth": 1.8}


def plot_teach_replay(path: Path, taught: Taught, log: ReplayLog | None) -> None:
    """Writes the figure.

    Args:
        path: of the PNG.
        taught: what teaching and optimisation left.
        log: of the replay; None if it came to none.
    """
    figure = Figure(figsize=(15.0, 7.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = cast(NDArray[Any], figure.subfigures(1, 2, width_ratios=[1.0, 1.1]))
    plan = left.subplots()
    _plan(plan, taught)
    left.legend(*plan.get_legend_handles_labels(), loc="outside upper center", ncol=3, fontsize=8)
    axes = right.subplots(4, 1, height_ratios=[1.0, 1.2, 0.8, 0.8])
    _tags(axes[0], taught)
    if log is not None:
        draw_way(axes[1:], log)
    else:
        axes[1].set_title(f"no replay: {taught.failure}")
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _plan(ax: Axes, taught: Taught) -> None:
    log = taught.log
    if log.truth is not None:
        ax.plot(*log.truth[:, :2].T, label="taught, true", **_TRUTH)
    if "naive" in taught.chains:
        places = np.array([X.translation()[:2] for _, X in taught.chains["naive"].cameras()])
        ax.plot(*places.reshape(-1, 2).T, label="camera, naive chain", **_NAIVE)
        tags = [X.translation()[:2] for X in taught.chains["naive"].tags().values()]
        ax.plot(*np.transpose(tags), "+", color="tab:orange", label="tag, naive chain")
    if taught.path is not None:
        ax.plot(*taught.path.p_WB[:, :2].T, label="taught, optimised", **_OPTIMISED)
    if taught.plan is not None:
        ring = np.vstack([taught.plan.points, taught.plan.points[:1]])
        ax.plot(*ring.T, label="route", **_ROUTE)
    known = log.markers if taught.known is None else taught.known
    draw_tags(ax, log.markers, known)
    # What has been carried far away is cut off: the circuit is what matters.
    there = np.array([tag.X_WM.translation()[:2] for tag in log.markers])
    low, high = there.min(axis=0) - 0.8, there.max(axis=0) + 0.8
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")


def _tags(ax: Axes, taught: Taught) -> None:
    rows: list[tuple[str, dict[int, float], str]] = [("optimised", tag_errors(taught), "x")]
    for name, mark in (("gated", "s"), ("naive", "+")):
        if name in taught.chains and taught.log.truth is not None:
            errors = chain_errors(taught.chains[name], taught.log)[0]
            rows.append((f"{name} chain", errors, mark))
    for name, errors, mark in rows:
        if errors:
            ax.plot(list(errors), list(errors.values()), mark, fillstyle="none", label=name)
    ax.set_yscale("log")
    ax.set_xlabel("tag")
    ax.set_ylabel("error of place [m]")
    ax.grid(alpha=0.3)
    ax.legend(loc="center right", fontsize=8)
