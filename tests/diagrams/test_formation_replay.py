"""The replay of a formation in a browser: whose turn it is, triangles, ways, estimates."""

from __future__ import annotations

import html
import json
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.diagrams.conftest import command
from tests.diagrams.test_replay import CHROMIUM, HEIGHT, SEEK, WIDTH, browse

Array = NDArray[np.float64]

MOVING, OVER = 25.0, 58.0  # s; the first move takes until 51 s, the next one begins at 53 s

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="the program chromium is not installed")

PROBE = """
<script>
setTimeout(() => {
  const shown = (path) => {
    let object = viewer.scene_tree.find(["drake", ...path]).object;
    object.updateWorldMatrix(true, false);
    const e = object.matrixWorld.elements;
    let visible = true;
    for (let o = object; o; o = o.parent) visible = visible && o.visible;
    return {visible: visible, position: [e[12], -e[14], e[13]]};  // three.js has y upward
  };
  const found = {};
  for (const t of TIMES) {
    viewer.animator.pause();
    viewer.animator.seek(t);
    found[t] = Object.fromEntries(PATHS.map((path) => [path, shown(path.split("/"))]));
  }
  const note = document.createElement("pre");
  note.id = "probe";
  note.textContent = JSON.stringify(found);
  document.body.appendChild(note);
}, 2000);
</script>
"""
MARKS = [f"view/robot{k}/turn/arrow" for k in (1, 2, 3, 4)]
PINS = [f"view/robot{k}/estimate/pin" for k in (1, 2, 3, 4)]
FIRST = ["view/moves/1/beacons/0", "view/moves/1/sides to build/1/0", "view/moves/1/path/3"]
SECOND = ["view/moves/2/beacons/0", "view/moves/2/vertex", "view/built/1/0"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first move and the beginning of the second, on the kinematic twin."""
    folder: Path = tmp_path_factory.mktemp("formation")
    words = ["sight=projected", "dynamics=kinematic", "record.bag=false"]
    result = command(
        "run", "formation", *(a for word in words for a in ("--set", word)), "--duration", "60",
        "--out", folder,
    )  # fmt: skip
    assert result.err == ""
    return folder


@pytest.fixture(scope="module")
def probe(run: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[float, Any]:
    page = tmp_path_factory.mktemp("probe") / "replay.html"
    shutil.copy(run / "replay.html", page)
    paths = [*MARKS, *PINS, *FIRST, *SECOND]
    script = PROBE.replace("TIMES", json.dumps([MOVING, OVER]))
    printed = browse(page, script.replace("PATHS", json.dumps(paths)), "--dump-dom")
    found = re.search(r'<pre id="probe">(.*?)</pre>', printed, re.DOTALL)
    assert found, printed[-2000:]
    return {float(t): value for t, value in json.loads(html.unescape(found[1])).items()}


def truth(run: Path, robot: int, t: float) -> Array:
    rows = np.loadtxt(run / f"truth_robot{robot}.tum")
    return np.array([np.interp(t, rows[:, 0], rows[:, k]) for k in (1, 2)])


def test_robots_take_turns(run: Path, probe: dict[float, Any]) -> None:
    turns = {t: [k + 1 for k, name in enumerate(MARKS) if found[name]["visible"]]
             for t, found in probe.items()}  # fmt: skip
    assert turns == {MOVING: [2], OVER: [1]}
    for t, robot in ((MOVING, 2), (OVER, 1)):
        mark = probe[t][MARKS[robot - 1]]["position"][:2]
        np.testing.assert_allclose(mark, truth(run, robot, t), atol=0.03)


def test_each_move_has_its_triangles(probe: dict[float, Any]) -> None:
    for name in FIRST:
        assert [probe[t][name]["visible"] for t in (MOVING, OVER)] == [True, False], name
    for name in SECOND:
        assert [probe[t][name]["visible"] for t in (MOVING, OVER)] == [False, True], name


def test_who_stands_is_where_the_estimate_says(run: Path, probe: dict[float, Any]) -> None:
    for robot in (1, 3, 4):
        pin = probe[MOVING][PINS[robot - 1]]
        assert pin["visible"]
        np.testing.assert_allclose(pin["position"][:2], truth(run, robot, MOVING), atol=0.01)
    moved = probe[OVER][PINS[1]]
    assert moved["visible"]
    np.testing.assert_allclose(moved["position"][:2], truth(run, 2, OVER), atol=0.01)


def test_the_picture_shows_colours_of_all_that(
    run: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    page = tmp_path_factory.mktemp("shot") / "replay.html"
    shutil.copy(run / "replay.html", page)
    target = page.with_suffix(".png")
    browse(page, SEEK.replace("TIME", str(MOVING)), f"--screenshot={target}")
    picture = cv2.cvtColor(cv2.imread(str(target)), cv2.COLOR_BGR2RGB).astype(int)
    assert picture.shape == (HEIGHT, WIDTH, 3)
    r, g, b = np.moveaxis(picture, 2, 0)
    seen = {
        "turn": (r > 150) & (g > r / 3) & (g < 0.75 * r) & (b < g / 2),
        "plan": (b > 120) & (r < b / 2) & (g < 0.6 * b),
        "pins": (r > 120) & (g < r / 2.5) & (b < r / 2.5),
        "destination": (g > 100) & (r < 0.6 * g) & (b < 0.7 * g),
        "lines": (r < 30) & (g < 30) & (b < 30),
    }
    counts = {name: int(mask.sum()) for name, mask in seen.items()}
    assert min(counts.values()) > 15, counts
    background = np.median(picture.reshape(-1, 3), axis=0)
    assert (np.abs(picture - background).max(axis=2) < 40).mean() > 0.5  # lit evenly
