"""The figure of a formation's run: where the robots went, and how exactly they built triangles.

Line styles and marks tell all; colour only helps.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from diagrams.formation_metrics import FormationLog, MoveEnd, looked
from diagrams.plots import draw_arena
from diagrams.viewer import ellipse
from plants.arena import ArenaParameters
from systems.planners.formation_obstacles import Obstacles

Array = NDArray[np.float64]

_STYLES = ("-", "--", "-.", ":")
_MARKS = "osD^v<>ph*"
_MAGNIFIED = 10.0


def plot_formation(
    path: Path,
    log: FormationLog,
    *,
    arena: ArenaParameters,
    destination: list[float],
    side: float,
    sensed: Obstacles | None = None,
) -> None:
    """Writes the figure; see `formation_figure`, `path` is of the PNG."""
    figure = formation_figure(log, arena=arena, destination=destination, side=side, sensed=sensed)
    figure.savefig(path, dpi=110)


def formation_figure(
    log: FormationLog,
    *,
    arena: ArenaParameters,
    destination: list[float],
    side: float,
    sensed: Obstacles | None = None,
) -> Figure:
    """Returns the figure, of the moves that were not given up.

    Args:
        log: with the truth.
        arena: what stands around.
        destination: [x, y] m.
        side: nominal, of the triangles, m.
        sensed: what the robots took for obstacles at the end, if they had to sense them.
    """
    figure = Figure(figsize=(14, 9), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 3, height_ratios=[1.4, 1.0])
    ended = [(k, move) for k, move in zip(log.ends(), log.moves(), strict=True) if move.done]
    moves = [move for _, move in ended]
    plan = figure.add_subplot(grid[0, :])
    _plan(plan, log, moves, arena, destination)
    if sensed is not None:
        _sensed(plan, sensed)
    below = [figure.add_subplot(grid[1, k]) for k in range(3)]
    _errors(below[0], moves)
    _sides(below[1], moves, side)
    _belief(below[2], log, ended)
    for ax in below:
        last = moves[-1].number if moves else 1
        ax.set(xlabel="move", xlim=(0.5, last + 0.5))
        ax.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        ax.grid(alpha=0.3)
        if moves:
            ax.legend(fontsize=8)
    return figure


def _plan(
    ax: Axes,
    log: FormationLog,
    moves: list[MoveEnd],
    arena: ArenaParameters,
    destination: list[float],
) -> None:
    assert log.truth is not None
    draw_arena(ax, arena)
    for k in range(log.truth.shape[1]):
        way = log.truth[:, k, :2]
        (line,) = ax.plot(*way.T, _STYLES[k % len(_STYLES)], linewidth=1.0, label=f"robot{k + 1}")
        mark, colour = _MARKS[k % len(_MARKS)], line.get_color()
        ax.plot(*way[0], mark, color=colour, markerfacecolor="none", markersize=9)
        ax.plot(*way[-1], mark, color=colour, markersize=9)
    for move in moves:
        stand = log.truth[np.searchsorted(log.t, move.t), move.beacons[:2], :2]
        triangle = np.vstack([stand[0], move.place, stand[1]])
        ax.plot(*triangle.T, color="0.75", linewidth=0.8, zorder=0)
        ax.annotate(
            str(move.number),
            (float(move.target[0]), float(move.target[1])),
            xytext=(0, 11),
            textcoords="offset points",
            fontsize=9,
            ha="center",
        )
    _believed(ax, log)
    ax.plot(*destination, "k*", markersize=13, markerfacecolor="none", label="destination")
    ax.set(
        xlabel="x [m]",
        ylabel="y [m]",
        aspect="equal",
        title="true paths; open marks: start, full ones: end, numbers: moves",
    )
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=9)


def _believed(ax: Axes, log: FormationLog) -> None:
    """Draws where the robots are believed to stand at the end."""
    ax.plot(*log.believed[-1].T, "k+", markersize=14, linestyle="", label="believed, at the end")
    if log.covariance is None or log.estimate is None:
        return
    for k, (x, y, _) in enumerate(log.estimate[-1]):
        a, b, angle = ellipse(log.covariance[-1][3 * k : 3 * k + 2, 3 * k : 3 * k + 2])
        patch = Ellipse(
            (float(x), float(y)),
            2 * _MAGNIFIED * a,
            2 * _MAGNIFIED * b,
            angle=float(np.degrees(angle)),
            fill=False,
            edgecolor="0.3",
            label=f"95 %, {_MAGNIFIED:g} times as large" if k == 0 else None,
        )
        ax.add_patch(patch)


def _sensed(ax: Axes, sensed: Obstacles) -> None:
    polygons = PolyCollection(
        list(sensed.polygons), facecolor="C3", edgecolor="C3", alpha=0.5, label="sensed at the end"
    )
    ax.add_collection(polygons)
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=9)


def _errors(ax: Axes, moves: list[MoveEnd]) -> None:
    number = [move.number for move in moves]
    ax.plot(number, [1e3 * move.lateral for move in moves], "o-", label="lateral")
    ax.plot(number, [1e3 * move.longitudinal for move in moves], "s--", label="longitudinal")
    ax.axhline(0.0, color="0.6", linewidth=0.8)
    ax.set(title="true place against the vertex of its beacons", ylabel="error [mm]")


def _sides(ax: Axes, moves: list[MoveEnd], side: float) -> None:
    number = [move.number for move in moves]
    off = [1e3 * np.linalg.norm(move.place - move.target) for move in moves]
    worst = [1e3 * np.abs(move.sides - side).max() for move in moves]
    ax.plot(number, off, "o-", label="place against the perfect lattice")
    ax.plot(number, worst, "s--", label=f"worse side against {side:g} m")
    ax.set(title="the formation against a perfect one", ylabel="error [mm]", ylim=(0, None))


def _belief(ax: Axes, log: FormationLog, ended: list[tuple[np.intp, MoveEnd]]) -> None:
    """Draws how wrong the robot that moved is believed to stand, and how wrong it may be."""
    assert log.truth is not None
    number = [move.number for _, move in ended]
    off, bound = [], []
    for end, move in ended:
        k, r = looked(log, end), move.robot
        off.append(1e3 * np.linalg.norm(log.believed[k, r] - log.truth[k, r, :2]))
        if log.covariance is not None:
            block = log.covariance[k][3 * r : 3 * r + 2, 3 * r : 3 * r + 2]
            bound.append(1e3 * ellipse(block)[0])
    ax.plot(number, off, "o-", label="believed place against the true one")
    if bound:
        ax.plot(number, bound, "k_", markersize=10, linestyle=":", label="95 % (longer semi-axis)")
    ax.set(title="the belief about who moved", ylabel="error [mm]", ylim=(0, None))
