"""The figure of a formation's run: where the robots went, and how exactly they built triangles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from diagrams.formation_metrics import FormationLog, MoveEnd
from diagrams.plots import draw_arena
from diagrams.viewer import ellipse
from plants.arena import ArenaParameters

_STYLES = ("-", "--", "-.", ":")
_MARKS = "osD^v<>ph*"


def plot_formation(
    path: Path, log: FormationLog, *, arena: ArenaParameters, destination: list[float], side: float
) -> None:
    """Writes the figure.

    Args:
        path: of the PNG.
        log: with the truth.
        arena: what stands around.
        destination: [x, y] m.
        side: nominal, of the triangles, m.
    """
    figure = Figure(figsize=(14, 9), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, height_ratios=[1.6, 1.0])
    moves = log.moves()
    _plan(figure.add_subplot(grid[0, :]), log, moves, arena, destination)
    _errors(figure.add_subplot(grid[1, 0]), moves)
    _sides(figure.add_subplot(grid[1, 1]), moves, side)
    figure.savefig(path, dpi=110)


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
        mark = _MARKS[k % len(_MARKS)]
        ax.plot(*way[0], mark, color=line.get_color(), markerfacecolor="none", markersize=9)
        ax.plot(*way[-1], mark, color=line.get_color(), markersize=9)
        if log.covariance is not None and log.estimate is not None:
            a, b, angle = ellipse(log.covariance[-1][3 * k : 3 * k + 2, 3 * k : 3 * k + 2])
            ax.add_patch(
                Ellipse(
                    (float(log.estimate[-1, k, 0]), float(log.estimate[-1, k, 1])),
                    20 * a,
                    20 * b,
                    angle=float(np.degrees(angle)),
                    fill=False,
                    edgecolor="0.3",
                )
            )
    for move in moves:
        stand = log.truth[np.searchsorted(log.t, move.t), move.beacons[:2], :2]
        triangle = np.vstack([stand[0], move.place, stand[1]])
        ax.plot(*triangle.T, color="0.75", linewidth=0.8, zorder=0)
        ax.annotate(str(move.number), (move.target[0], move.target[1]), fontsize=8, ha="right")
    ax.plot(*destination, "kx", markersize=12, label="destination")
    ellipses = "; ellipses: 95 %, ten times as large" if log.covariance is not None else ""
    ax.set(
        xlabel="x [m]",
        ylabel="y [m]",
        aspect="equal",
        title=f"true paths; open marks: start, full ones: end, numbers: moves{ellipses}",
    )
    ax.legend(loc="upper left", fontsize=8, ncols=2)


def _errors(ax: Axes, moves: list[MoveEnd]) -> None:
    number = np.array([move.number for move in moves])
    ax.plot(number, [1e3 * move.lateral for move in moves], "o-", label="lateral")
    ax.plot(number, [1e3 * move.longitudinal for move in moves], "s--", label="longitudinal")
    ax.axhline(0.0, color="0.6", linewidth=0.8)
    ax.set(
        xlabel="move",
        ylabel="place against the vertex\nof its beacons [mm]",
    )
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3)


def _sides(ax: Axes, moves: list[MoveEnd], side: float) -> None:
    number = np.array([move.number for move in moves])
    off = [1e3 * np.linalg.norm(move.place - move.target) for move in moves]
    longest = [1e3 * np.abs(move.sides - side).max() for move in moves]
    ax.plot(number, off, "o-", label="place against the perfect lattice")
    ax.plot(number, longest, "s--", label="sides against the nominal one")
    ax.set(xlabel="move", ylabel="error [mm]", ylim=(0, None))
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3)
