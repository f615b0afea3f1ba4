"""The residuals of a map frame by frame: a table for the eye, a spreadsheet or pandas."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np

from systems.mapping.mapping import TagMap
from systems.mapping.residuals import Residuals
from systems.mapping.trajectory import Trajectory

COLUMNS = ("time", "tags", "outliers", "reprojection_rms_px", "largest_px", "pose")
WORST = 10  # frames that the report names


def frame_rows(tag_map: TagMap, of_frames: Residuals, path: Trajectory) -> list[dict[str, Any]]:
    """Returns for each frame what `COLUMNS` name.

    `time` is its stamp (s); `tags` counts the tags that its pose rests on, `outliers` those left
    out because they do not fit; `reprojection_rms_px` is of the corners of the former (NaN without
    any), `largest_px` of the worst corner of both. `pose` is 1 where the trajectory has the frame
    and 0 where it was left out.
    """
    has_pose = np.isin(tag_map.stamps, path.stamps)
    columns = (
        tag_map.stamps,
        of_frames.used,
        of_frames.outliers,
        of_frames.rms,
        of_frames.largest,
        has_pose.astype(int),
    )
    return [
        dict(zip(COLUMNS, row, strict=True))
        for row in zip(*(column.tolist() for column in columns), strict=True)
    ]


def worst_frames(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the few frames with the worst corners, the worst first."""
    return sorted(rows, key=lambda row: -row["largest_px"])[:WORST]


def write_frames(path: Path, rows: list[dict[str, Any]]) -> None:
    """Writes the rows as a CSV file, times as `trajectory.tum` has them."""
    with path.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for row in rows:
            rms, largest = f"{row['reprojection_rms_px']:.4f}", f"{row['largest_px']:.4f}"
            table.writerow(
                [f"{row['time']:.9f}", row["tags"], row["outliers"], rms, largest, row["pose"]]
            )
