"""What the tests of the wiring share: the command line, and runs that several of them look at."""

from __future__ import annotations

import contextlib
import io
import json
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from diagrams import cli
from systems.markers.family import family

PROJECTED = ("--no-meshcat", "--set", "sight=projected")


@dataclass(frozen=True)
class Result:
    """What a command left on the terminal."""

    status: int
    out: str
    err: str


@dataclass(frozen=True)
class RunFolder:
    """A finished run: its folder, its report, its exit status."""

    path: Path
    status: int

    @property
    def report(self) -> dict[str, Any]:
        return json.loads((self.path / "report.json").read_text())

    @property
    def bag(self) -> Path:
        return self.path / "bag"


Command = Callable[..., Result]


def command(*arguments: str | Path) -> Result:
    """Runs the command line in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = cli.main([str(argument) for argument in arguments])
        except SystemExit as end:  # argparse's own
            status = end.code if isinstance(end.code, int) else 1
    return Result(status, out.getvalue(), err.getvalue())


@pytest.fixture(scope="session", autouse=True)
def _hears_interrupts() -> None:
    """A shell makes what it runs in its background deaf to Ctrl-C, and so would the children be."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def tagtrail() -> Command:
    return command


@pytest.fixture
def refuse(tagtrail: Command) -> Callable[..., str]:
    """Runs a command that must be refused; returns its one line, without `tagtrail: `."""

    def run(*arguments: str | Path) -> str:
        result = tagtrail(*arguments)
        assert result.status == 2, result
        assert result.out == ""
        assert result.err.count("\n") == 1, result.err
        assert result.err.startswith("tagtrail")
        return result.err.removeprefix("tagtrail: ").rstrip("\n")

    return run


@pytest.fixture
def workshop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder that the test works in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def picture() -> Callable[[Path], Path]:
    """Writes a picture of 320x240 with a marker of DICT_4X4_50 in it."""

    def write(path: Path) -> Path:
        image = np.full((240, 320), 255, np.uint8)
        cells = family("4x4_50").cell_image(3, margin=0)
        image[60:120, 90:150] = np.kron(cells, np.ones((10, 10), np.uint8))
        cv2.imwrite(str(path), image)
        return path

    return write


@pytest.fixture
def write_scenario(tmp_path: Path) -> Callable[..., Path]:
    """Writes a scenario file whose first line, unless told not to, extends `navigation_open`."""

    def write(text: str, name: str = "scene.yaml", extends: str | None = "navigation_open") -> Path:
        path = tmp_path / name
        path.write_text((f"extends: {extends}\n" if extends else "") + text)
        return path

    return write


def _run(folder: Path, *arguments: str | Path) -> RunFolder:
    result = command("run", "navigation_open", *arguments, "--out", folder)
    assert result.status in (0, 1), result.err
    assert result.err == ""
    return RunFolder(folder, result.status)


@pytest.fixture(scope="session")
def navigation(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """The bundled scenario to its end: projected sight, multibody, seed 3."""
    return _run(tmp_path_factory.mktemp("navigation_open"), *PROJECTED, "--seed", "3")


@pytest.fixture(scope="session")
def kinematic(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """The bundled scenario to its end on the kinematic twin: projected sight, seed 3."""
    folder = tmp_path_factory.mktemp("kinematic")
    return _run(folder, *PROJECTED, "--seed", "3", "--set", "dynamics=kinematic")


@pytest.fixture(scope="session")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """Three seconds of the bundled scenario through the renderer, pictures recorded."""
    folder = tmp_path_factory.mktemp("rendered")
    return _run(folder, "--no-meshcat", "--set", "record.images=true", "--duration", "3")


@pytest.fixture(scope="session")
def shown(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """Six seconds of `kinematic`, with Meshcat and its replay."""
    folder = tmp_path_factory.mktemp("shown")
    return _run(
        folder,
        "--seed",
        "3",
        "--set",
        "sight=projected",
        "--set",
        "dynamics=kinematic",
        "--duration",
        "6",
    )
