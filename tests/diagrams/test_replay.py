"""The replay in a browser: what it shows, and that it moves as the run did."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from diagrams.scenario import load_scenario
from systems.io.bag import BagReader

CHROMIUM = next(filter(shutil.which, ("chromium", "chromium-browser", "google-chrome")), None)
WIDTH, HEIGHT = 800, 600
EARLY, LATE = 1.5, 5.5  # s of the animation

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="the program chromium is not installed")

# Reads where an object of the scene stands, after the animation was set to a time.
PROBE = """
<script>
setTimeout(() => {
  const at = (path) => {
    const object = viewer.scene_tree.find(["drake", ...path]).object;
    object.updateMatrix();
    const e = object.matrix.elements;  // in its parent's frame, which is the map's
    return {position: [e[12], e[13], e[14]], x_axis: [e[0], e[1], e[2]], visible: object.visible,
            scale: object.scale.toArray()};
  };
  const found = {};
  for (const t of TIMES) {
    viewer.animator.pause();
    viewer.animator.seek(t);
    found[t] = {estimate: at(["view", "estimate"]), ellipse: at(["view", "ellipse"]),
                disc: at(["view", "ellipse", "disc"])};
  }
  const note = document.createElement("pre");
  note.id = "probe";
  note.textContent = JSON.stringify(found);
  document.body.appendChild(note);
}, 2000);
</script>
"""
SEEK = """
<script>
setTimeout(() => { viewer.animator.pause(); viewer.animator.seek(TIME); }, 2000);
</script>
"""


def browse(page: Path, script: str, *arguments: str) -> str:
    """Opens the replay with a script at its end; returns what the browser printed."""
    content = page.read_text()
    end = content.rindex("</body>")
    changed = page.with_name("probed.html")
    changed.write_text(content[:end] + script + content[end:])
    assert CHROMIUM is not None
    finished = subprocess.run(
        [CHROMIUM, "--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
         "--enable-unsafe-swiftshader", "--virtual-time-budget=5000", "--hide-scrollbars",
         "--disable-background-networking", f"--user-data-dir={page.parent / 'profile'}",
         f"--window-size={WIDTH},{HEIGHT}", *arguments, changed.as_uri()],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    return finished.stdout


@pytest.fixture(scope="module")
def probe(shown: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[float, Any]:
    """Where estimate and ellipse stand in the browser's scene, by time."""
    page = tmp_path_factory.mktemp("probe") / "replay.html"
    page.write_bytes((shown.path / "replay.html").read_bytes())
    script = PROBE.replace("TIMES", json.dumps([EARLY, 3.0, LATE]))
    printed = browse(page, script, "--dump-dom")
    found = re.search(r'<pre id="probe">(.*?)</pre>', printed, re.DOTALL)
    assert found, printed[-2000:]
    return {float(t): value for t, value in json.loads(html.unescape(found[1])).items()}


@pytest.fixture(scope="module")
def screenshots(shown: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[float, Any]:
    """Pictures (height, width, 3) of the replay, by time."""
    pictures = {}
    for t in (EARLY, LATE):
        page = tmp_path_factory.mktemp("shot") / "replay.html"
        page.write_bytes((shown.path / "replay.html").read_bytes())
        target = page.with_suffix(".png")
        browse(page, SEEK.replace("TIME", str(t)), f"--screenshot={target}")
        pictures[t] = cv2.cvtColor(cv2.imread(str(target)), cv2.COLOR_BGR2RGB)
    return pictures


def pose(folder: Path, name: str, t: float) -> NDArray[np.float64]:
    """[x, y, theta] of a TUM file at a time."""
    rows = np.loadtxt(folder / f"{name}.tum")
    row = rows[np.abs(rows[:, 0] - t).argmin()]
    assert abs(row[0] - t) < 0.011
    return np.array([row[1], row[2], 2 * np.arctan2(row[6], row[7])])


def pixel(point: Any) -> NDArray[np.float64]:
    """Where the browser draws a point of the bundled arena, by the camera that the run set.

    It looks at the arena's middle from the south and above, 75 degrees from top to bottom
    (three.js' own angle).
    """
    eye, forward = np.array([0.0, -0.55 * 5, 0.75 * 5]), np.array([0.0, 0.55, -0.75])
    forward /= np.linalg.norm(forward)
    right = np.array([1.0, 0.0, 0.0])
    d = np.asarray(point, float) - eye
    focal = HEIGHT / 2 / np.tan(np.deg2rad(75) / 2)
    down = -np.cross(right, forward)
    return np.array([WIDTH, HEIGHT]) / 2 + focal * np.array([d @ right, d @ down]) / (d @ forward)


def near(picture: NDArray[np.uint8], point: Any, radius: int) -> NDArray[np.int64]:
    """The pixels (n, 3) around a point of the arena."""
    u, v = np.rint(pixel(point)).astype(int)
    assert radius <= u < WIDTH - radius
    assert radius <= v < HEIGHT - radius
    patch = picture[v - radius : v + radius + 1, u - radius : u + radius + 1]
    return patch.reshape(-1, 3).astype(int)


def reddish(pixels: NDArray[np.int64]) -> int:
    r, g, b = pixels.T
    return int(((r > 100) & (r > 2 * g) & (r > 2 * b)).sum())


def test_the_file_needs_no_server(shown: Any) -> None:
    page = (shown.path / "replay.html").read_text()
    assert not re.search(r'<(?:script|link)[^>]+(?:src|href)="(?!data:)', page)


def test_the_estimate_stands_where_the_run_had_it(shown: Any, probe: dict[float, Any]) -> None:
    for t, found in probe.items():
        x, y, theta = pose(shown.path, "estimate", t)
        assert found["estimate"]["visible"]
        assert found["estimate"]["position"][:2] == pytest.approx([x, y], abs=0.02)
        cosine, sine, _ = found["estimate"]["x_axis"]
        assert np.angle(np.exp(1j * (np.arctan2(sine, cosine) - theta))) == pytest.approx(
            0.0, abs=0.05
        )
        assert found["ellipse"]["visible"]
        assert found["ellipse"]["position"][:2] == pytest.approx([x, y], abs=0.02)
        a, b, _ = found["disc"]["scale"]
        assert 0.001 < b <= a < 0.3
    travelled = np.subtract(
        probe[LATE]["estimate"]["position"], probe[EARLY]["estimate"]["position"]
    )
    assert np.linalg.norm(travelled) > 0.8


def test_the_ellipse_is_that_of_the_covariance(shown: Any, probe: dict[float, Any]) -> None:
    covariances = {
        round(t, 6): np.reshape(message.pose.covariance, (6, 6))[:2, :2]
        for _, t, message in BagReader(shown.bag).messages(["/robot/estimate"])
    }
    for t in (EARLY, LATE):
        axes = np.sqrt(5.9915 * np.linalg.eigvalsh(covariances[t]))  # chi-square, 2, 95 %
        assert probe[t]["disc"]["scale"][:2] == pytest.approx(
            np.maximum(axes[::-1], 5e-3), rel=0.15
        )


def test_robot_markers_waypoints_and_path_are_drawn(
    shown: Any, screenshots: dict[float, Any]
) -> None:
    late = screenshots[LATE]
    assert late.shape == (HEIGHT, WIDTH, 3)
    scenario = load_scenario("navigation_open")
    # Markers on the far wall: black cells and white margins close together.
    far = [m for m in scenario.world.marker_map() if abs(m.X_WM.translation()[1] - 2) < 0.1]
    assert len(far) >= 4
    for marker in far:
        grey = near(late, marker.X_WM.translation(), 9).mean(axis=1)
        assert grey.max() - grey.min() > 100
    # Waypoints: greener than the ground.
    for x, y in scenario.waypoints:
        r, g, b = near(late, [x, y, 0.0], 4).mean(axis=0)
        assert g > r + 10
        assert g > b + 10
    # The path of the estimate: red marks on the way that lies behind.
    for t in (0.8, 2.0, 3.0, 4.0):
        x, y, _ = pose(shown.path, "estimate", t)
        assert reddish(near(late, [x, y, 0.01], 6)) >= 2, t


def test_the_picture_moves(shown: Any, screenshots: dict[float, Any]) -> None:
    early, late = screenshots[EARLY], screenshots[LATE]
    changed = np.abs(early.astype(int) - late).max(axis=2) > 60
    robot = {t: [*pose(shown.path, "truth", t)[:2], 0.06] for t in (EARLY, LATE)}
    # Where the robot was and where it is, the pictures differ ...
    for point in robot.values():
        u, v = np.rint(pixel(point)).astype(int)
        assert changed[v - 8 : v + 9, u - 8 : u + 9].mean() > 0.15
    # ... along its way, too, and nowhere else.
    box = np.array([pixel(point) for point in robot.values()])
    low, high = box.min(axis=0) - 40, box.max(axis=0) + 40
    v, u = np.nonzero(changed)
    inside = (u > low[0]) & (u < high[0]) & (v > low[1]) & (v < high[1])
    assert inside.mean() > 0.97
    # What is not driven yet is not marked yet.
    x, y, _ = pose(shown.path, "estimate", 3.5)
    assert reddish(near(early, [x, y, 0.01], 5)) == 0
    assert reddish(near(late, [x, y, 0.01], 6)) >= 2
