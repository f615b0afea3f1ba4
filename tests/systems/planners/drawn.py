"""Occupancy grids drawn with characters, for tests and benchmarks."""

from __future__ import annotations

import numpy as np

from systems.messages import OccupancyGrid

_LOG_ODDS = {"#": 3.5, ".": -2.0, "?": 0.0, " ": -2.0}


def drawn(*lines: str, resolution: float = 0.05, repeat: int = 1) -> OccupancyGrid:
    """`#` occupied, `.` or blank free, `?` unknown; the first line is the one with the largest y.

    Args:
        lines: the rows.
        resolution: side of a cell, m.
        repeat: side of the square of cells that a character stands for.
    """
    rows = [[_LOG_ODDS[character] for character in line] for line in reversed(lines)]
    cells = np.kron(np.array(rows), np.ones((repeat, repeat))).astype(np.float32)
    return OccupancyGrid(stamp=0.0, frame_id="map", resolution=resolution, log_odds=cells)


def room(side: float, resolution: float = 0.05) -> np.ndarray:
    """Log-odds of a free square room with walls of one cell."""
    n = round(side / resolution)
    cells = np.full((n, n), -2.0, np.float32)
    cells[[0, -1]] = cells[:, [0, -1]] = 3.5
    return cells
