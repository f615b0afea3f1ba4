"""The studies of models that the command line knows by name.

What they import, plots and statistics, is loaded when one is run: to list them takes no time.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from diagrams.study_report import TextTable


@dataclass(frozen=True)
class Findings:
    """What a study of models has found.

    Attributes:
        table: of the numbers.
        notes: lines below the table.
    """

    table: TextTable
    notes: list[str]


@dataclass(frozen=True)
class ModelStudy:
    """A study that the command line knows by name.

    Attributes:
        description: a line.
        place: `module:function` that writes files into an existing folder from so many runs.
    """

    description: str
    place: str

    def run(self, folder: Path, runs: int) -> Findings:
        """Does the study; writes its files into an existing folder."""
        module, _, name = self.place.partition(":")
        function: Callable[[Path, int], Findings] = getattr(importlib.import_module(module), name)
        return function(folder, runs)


STUDIES = {
    "formation_error_model": ModelStudy(
        "Error of building one triangle by Algorithm I, beside the paper's numbers",
        "diagrams.formation_studies:error_model_findings",
    ),
    "formation_table1": ModelStudy(
        "Error of triangles and of dead reckoning at the destination, beside the paper's table 1",
        "diagrams.formation_studies:table1_findings",
    ),
    "formation_side": ModelStudy(
        "Side length of a formation's triangles against their errors, number of moves and time",
        "diagrams.formation_sides:formation_side",
    ),
}
