"""The installed command in a terminal of its own: status, streams, signals, strangers."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from diagrams.model_studies import STUDIES
from systems.io.bag import BagReader

ROOT = Path(__file__).resolve().parents[2]
SHORT = ("--no-meshcat", "--set", "sight=projected", "--duration", "0.2")


def terminal(
    *arguments: str, cwd: Path, path: tuple[Path, ...] = ()
) -> subprocess.CompletedProcess[str]:
    """Runs the installed command as a user does, or the module where it is not installed."""
    installed = Path(sys.executable).with_name("tagtrail")
    program = [str(installed)] if installed.exists() else [sys.executable, "-m", "tagtrail"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (*path, ROOT)))}
    return subprocess.run(
        [*program, *arguments], cwd=cwd, env=environment, capture_output=True, text=True
    )


def error_line(finished: subprocess.CompletedProcess[str]) -> str:
    """The one line of a refusal."""
    assert finished.returncode == 2, finished
    assert finished.stdout == ""
    (line,) = finished.stderr.splitlines()
    return line


def test_the_installed_command_lists_the_scenarios_a_line_each(tmp_path: Path) -> None:
    finished = terminal("list", cwd=tmp_path)
    assert finished.returncode == 0
    assert finished.stderr == ""
    names = [line.split()[0] for line in finished.stdout.splitlines()]
    bundled = sorted(path.stem for path in (ROOT / "diagrams" / "scenarios").glob("*.yaml"))
    assert names == [*bundled, *STUDIES]
    assert "navigation_open" in names


def test_to_list_what_there_is_loads_neither_plots_nor_the_simulator() -> None:
    program = (
        "import sys; from diagrams.cli import main; main(['list']);"
        "print([name for name in ('matplotlib', 'diagrams.run') if name in sys.modules])"
    )
    finished = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True
    )
    assert finished.stdout.splitlines()[-1] == "[]", finished.stderr


def test_a_failed_run_ends_with_1_and_bad_input_with_2(tmp_path: Path) -> None:
    failed = terminal("run", "navigation_open", *SHORT, cwd=tmp_path)
    assert failed.returncode == 1, failed.stderr
    assert failed.stderr == ""
    assert "navigation_open: timeout" in failed.stdout
    # Without --out the results lie where the last line says.
    report = json.loads((tmp_path / "out" / "navigation_open" / "report.json").read_text())
    assert report["outcome"] == "timeout"
    refused = error_line(
        terminal("run", "navigation_open", "--set", "sihgt=projected", cwd=tmp_path)
    )
    assert refused == "tagtrail: --set sihgt: sihgt: unknown key; did you mean 'sight'?"


def in_a_terminal(*arguments: str, cwd: Path) -> tuple[int, str]:
    """Runs the command on a pseudo-terminal; returns exit status and what was to be seen."""
    pty = pytest.importorskip("pty")
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "tagtrail", *arguments],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT), "TERM": "xterm"},
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
    )
    os.close(theirs)
    seen = b""
    while True:
        try:
            chunk = os.read(ours, 65536)
        except OSError:  # the last one closed the terminal
            break
        if not chunk:
            break
        seen += chunk
    os.close(ours)
    return process.wait(), seen.decode()


def test_in_a_terminal_a_bar_shows_how_far_it_is(
    picture: Callable[[Path], Path], tmp_path: Path
) -> None:
    status, seen = in_a_terminal("run", "navigation_open", *SHORT[:-1], "3", cwd=tmp_path)
    assert status == 1, seen
    assert "Traceback" not in seen
    assert " / 3.0" in seen
    assert "navigation_open: timeout" in seen
    picture(tmp_path / "a.png")
    status, seen = in_a_terminal("detect", "a.png", "--family", "4x4_50", cwd=tmp_path)
    assert status == 0, seen
    assert "Traceback" not in seen


def test_an_interrupted_run_says_so_and_keeps_its_recording(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "tagtrail", "run", "navigation_open", *SHORT[:-2], "--realtime", "1",
         "--out", "out"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    recording = tmp_path / "out" / "bag" / "bag_0.mcap"
    deadline = time.monotonic() + 60
    while not (recording.exists() and recording.stat().st_size > 30_000):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate()
    assert (process.returncode, said) == (1, "tagtrail: interrupted\n")
    reader = BagReader(tmp_path / "out" / "bag")
    assert not reader.truncated
    assert sum(1 for _ in reader.records(["/robot/imu"])) > 50


@pytest.mark.parametrize("name", ["systems", "plants", "diagrams"])
def test_a_strangers_package_of_one_of_our_names_is_named(tmp_path: Path, name: str) -> None:
    stranger = tmp_path / "site"
    (stranger / name).mkdir(parents=True)
    (stranger / name / "__init__.py").write_text("class Diagram: pass\n")
    line = error_line(terminal("list", cwd=tmp_path, path=(stranger,)))
    assert line.startswith(f"tagtrail: the package {name!r} found at {stranger}")
    assert line.endswith("install tagtrail into an environment of its own")


def test_a_strangers_package_that_does_not_even_import_is_named(tmp_path: Path) -> None:
    stranger = tmp_path / "site"
    (stranger / "diagrams").mkdir(parents=True)
    (stranger / "diagrams" / "__init__.py").write_text("import a_module_that_is_not_there\n")
    line = error_line(terminal("list", cwd=tmp_path, path=(stranger,)))
    assert line.startswith("tagtrail: the package 'diagrams' cannot be imported: ")
    assert "a_module_that_is_not_there" in line


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.mp4", b"no video", "not a video that OpenCV can read"),
        ("a.mkv", b"no video", "not a video that OpenCV can read"),
        ("a.png", b"no picture", "not a picture, or a damaged one"),
        ("a.txt", b"no picture", "not a recording (MCAP, rosbag2 or ROS 1 bag)"),
    ],
)
def test_a_source_that_is_not_what_its_name_says_is_refused_in_one_line(
    tmp_path: Path, name: str, content: bytes, words: str
) -> None:
    # In a terminal: decoders write to the terminal themselves, past Python.
    (tmp_path / name).write_bytes(content)
    line = error_line(terminal("detect", name, "--family", "4x4_50", cwd=tmp_path))
    assert line.startswith("tagtrail: ")
    assert name in line
    assert line.endswith(words)
