"""One row of the benchmark's table: what was measured, what is to be reached, what peers do."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from rich.console import Console
from rich.table import Table


class Row(NamedTuple):
    """One measurement.

    Attributes:
        what: was measured.
        value: as text.
        to_reach: the goal, as text.
        reached: whether it was; None where there is no goal.
        peers: the same of others, measured in the same run.
    """

    what: str
    value: str
    to_reach: str = ""
    reached: bool | None = None
    peers: str = ""


def show(title: str, rows: Iterable[Row]) -> bool:
    """Prints the rows; returns whether every goal was reached."""
    rows = list(rows)
    table = Table(title=title, title_justify="left")
    for column in ("what", "measured", "to reach", "", "peers, same run"):
        table.add_column(column, overflow="fold")
    marks = {True: "yes", False: "NO", None: ""}
    for row in rows:
        table.add_row(row.what, row.value, row.to_reach, marks[row.reached], row.peers)
    Console(width=140).print(table)
    return all(row.reached is not False for row in rows)
