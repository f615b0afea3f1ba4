"""A person at the keyboard drives the LIMO from the browser."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.analysis import Simulator

from systems.io.bag import BagReader
from systems.io.meshcat_driver import MeshcatDriver
from systems.io.ros_motion import command_from_ros
from tests.diagrams.browser import CHROMIUM, Browser

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="the program chromium is not installed")

# A page of Meshcat is ready when the controls are there.
READY = "typeof viewer !== 'undefined' && Object.keys(viewer.gui_controllers).length >= 5"
# Stands for a gamepad: what the browser tells the page of one.
PAD = """
navigator.getGamepads = () => [{index: 0, connected: true,
  buttons: [0, 1, 2, 3].map((k) => ({value: k == BUTTON ? 1 : 0})), axes: AXES}]
"""


@pytest.fixture
def driven(tmp_path: Path) -> Iterator[tuple[Callable[[], Any], Browser]]:
    """The driver's block, sampled when asked, and a browser at its Meshcat."""
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    driver = MeshcatDriver(meshcat=meshcat)
    simulator = Simulator(driver)
    context = simulator.get_context()

    def sample() -> tuple[list[float], float]:
        simulator.AdvanceTo(context.get_time() + 0.05)
        command = driver.command_output_port().Eval(context)
        return command.round(6).tolist(), driver.finished_output_port().Eval(context)[0]

    browser = Browser(tmp_path / "profile", meshcat.web_url())
    try:
        browser.wait_for(READY)
        yield sample, browser
    finally:
        browser.close()


def becomes(sample: Callable[[], Any], expected: Any) -> None:
    """Samples until the browser's news is there."""
    end = time.monotonic() + 20
    while (found := sample()) != expected:
        assert time.monotonic() < end, f"{found}, not {expected}"
        time.sleep(0.05)


def test_keys(driven: tuple[Callable[[], Any], Browser]) -> None:
    sample, browser = driven
    assert sample() == ([0.0, 0.0], 0)
    browser.press("KeyW", 6)
    becomes(sample, ([0.3, 0.0], 0))
    browser.press("KeyA", 3)
    becomes(sample, ([0.3, 0.3], 0))  # to the left
    browser.press("KeyD", 5)
    becomes(sample, ([0.3, -0.2], 0))
    browser.press("KeyS")
    becomes(sample, ([0.25, -0.2], 0))
    browser.press("KeyX")
    becomes(sample, ([0.25, 0.0], 0))
    time.sleep(0.5)  # until the browser's own slider is back in the middle
    browser.press("KeyA", 2)
    becomes(sample, ([0.25, 0.2], 0))
    browser.press("Space")
    becomes(sample, ([0.0, 0.0], 0))
    browser.press("KeyY")
    becomes(sample, ([0.0, 0.0], 1))
    browser.press("KeyY")  # the next one is for whoever comes next
    becomes(sample, ([0.0, 0.0], 2))


def test_a_gamepad(driven: tuple[Callable[[], Any], Browser]) -> None:
    sample, browser = driven
    browser.press("KeyW", 2)
    becomes(sample, ([0.1, 0.0], 0))
    browser.evaluate(PAD.replace("BUTTON", "-1").replace("AXES", "[-1, -1, 0, 0]"))
    becomes(sample, ([0.6, 1.5], 0))
    # At rest it leaves the sliders their say.
    browser.evaluate(PAD.replace("BUTTON", "-1").replace("AXES", "[0.02, -0.01, 0, 0]"))
    becomes(sample, ([0.1, 0.0], 0))
    for count in (1, 2):
        browser.evaluate(PAD.replace("BUTTON", "3").replace("AXES", "[0, 0, 0, 0]"))
        becomes(sample, ([0.1, 0.0], count))
        assert sample() == ([0.1, 0.0], count)  # held down it counts once
        browser.evaluate(PAD.replace("BUTTON", "-1").replace("AXES", "[0, 0, 0, 0]"))
        time.sleep(0.3)
        sample()


def test_teaching_from_the_browser(tmp_path: Path) -> None:
    """The whole command: speed up, steer, end it by Y."""
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "tagtrail", "run", "teach", "--set", "driver=person",
         "--set", "sight=projected", "--set", "time_step=0.01", "--out", str(out)],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    browser = None
    try:
        assert process.stdout is not None
        url = None
        while url is None:
            line = process.stdout.readline()
            assert line or process.poll() is None, "the command has ended"
            url = re.search(r"^Meshcat: (http://\S+)", line)
        began = time.monotonic()
        browser = Browser(tmp_path / "profile", url[1])
        browser.wait_for(READY)
        browser.press("KeyW", 6)
        time.sleep(2.5)
        browser.press("KeyA", 2)
        time.sleep(0.5)
        browser.press("KeyY")
        rest, _ = process.communicate(timeout=60)
        lasted = time.monotonic() - began
    finally:
        if browser is not None:
            browser.close()
        process.kill()
    # It was not driven round: ended in view of the anchor, or not.
    report = json.loads((out / "report.json").read_text())
    assert report["outcome"] in ("taught", "no_anchor"), rest
    assert report["outcome"] in rest
    assert process.returncode == (0 if report["outcome"] == "taught" else 1)
    assert report["metrics"]["anchor_seen_at_start"]
    assert 0.3 < report["metrics"]["path_length_m"] < 4.0
    # A person's time is real time.
    assert report["sim_seconds"] <= lasted + 0.5
    sent = np.array(
        [command_from_ros(m) for _, _, m in BagReader(out / "bag").messages(["/limo/drive/sent"])]
    )
    assert sent[:, 0].max() == pytest.approx(0.3)
    assert sent[:, 1].max() == pytest.approx(0.2)
    assert (out / "replay.html").stat().st_size > 1e6
