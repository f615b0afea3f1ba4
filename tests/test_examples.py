"""Every example runs as a person runs it: alone, in a folder of its own."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def test_there_are_examples_in_order() -> None:
    assert EXAMPLES
    assert [int(path.name[:2]) for path in EXAMPLES] == list(range(1, len(EXAMPLES) + 1))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_says_what_it_shows(path: Path) -> None:
    text = path.read_text()
    assert len(text.splitlines()) < 60
    assert len(ast.get_docstring(ast.parse(text)) or "") > 40


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_and_leaves_a_picture(path: Path, tmp_path: Path) -> None:
    finished = subprocess.run(
        [sys.executable, "-W", "error::DeprecationWarning", path],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
    )
    assert finished.returncode == 0, finished.stderr
    assert finished.stderr == ""
    pictures = list(tmp_path.rglob("*.png"))
    assert pictures
    for picture in pictures:
        image = cv2.imread(str(picture))
        assert min(image.shape[:2]) >= 300
        assert image.std() > 5  # something is drawn on it
        assert picture.name in finished.stdout
    # Whatever it simulates gets where it is meant to.
    if "waypoint" in path.read_text():
        outcomes = [line for line in finished.stdout.splitlines() if ": " in line]
        assert outcomes
        assert all(": reached " in line for line in outcomes)
