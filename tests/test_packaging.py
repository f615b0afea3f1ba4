"""The wheel: what is in it, and that it works from wherever it is installed."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("systems", "plants", "diagrams")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a clone's files by pip."""
    folder = tmp_path_factory.mktemp("wheel")
    alone = ["--no-build-isolation"] if importlib.util.find_spec("hatchling") else []
    finished = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", ROOT, "--no-deps", *alone, "--wheel-dir", folder],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    said = finished.stdout + finished.stderr
    if finished.returncode != 0 and "No module named pip" in said:
        pytest.skip("this environment has no pip")
    if finished.returncode != 0 and not alone and "hatchling" in said:
        pytest.skip("hatchling, which builds the wheel, is neither installed nor to be had")
    assert finished.returncode == 0, finished.stderr
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that the wheel, and nothing else, is installed in."""
    folder = tmp_path_factory.mktemp("installed")
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", folder, wheel],
        check=True,
        capture_output=True,
    )
    return folder


def python(installed: Path, cwd: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs Python with the installed wheel before all else on its path."""
    environment = os.environ | {"PYTHONPATH": str(installed)}
    return subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env=environment, capture_output=True, text=True
    )


def test_the_wheel_holds_all_that_is_needed_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if ".dist-info/" not in name}
    wanted = {"tagtrail.py"}
    for package in PACKAGES:
        wanted |= {
            path.relative_to(ROOT).as_posix()
            for path in (ROOT / package).rglob("*")
            if path.is_file() and "__pycache__" not in path.parts
        }
    assert packed == wanted
    assert {path.split("/")[0] for path in packed} == {*PACKAGES, "tagtrail.py"}
    for data in ("scenarios/navigation.yaml", "maps/navigation.json", "cameras/vga.yaml"):
        assert f"diagrams/{data}" in packed


def test_every_folder_of_code_is_a_package() -> None:
    # A folder without __init__.py imports from a clone and is easily lost elsewhere.
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            assert (path.parent / "__init__.py").is_file(), path


def test_the_wheel_says_what_it_is(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
        metadata = Parser().parsestr(archive.read(name).decode())
        entry_points = archive.read(name.replace("METADATA", "entry_points.txt")).decode()
        licences = [n for n in archive.namelist() if n.endswith("LICENSE")]
    assert metadata["Name"] == "tagtrail"
    assert metadata["Requires-Python"] == ">=3.11"
    assert metadata["License-Expression"] == "BSD-3-Clause"
    assert "tagtrail = tagtrail:main" in entry_points
    assert licences
    # Ranges, not pins: others have requirements too.
    needed = metadata.get_all("Requires-Dist")
    assert needed
    assert not [line for line in needed if "==" in line.split(";")[0]]


def test_the_installed_command_lists_the_scenarios(installed: Path, tmp_path: Path) -> None:
    finished = python(installed, tmp_path, "-m", "tagtrail", "list")
    assert (finished.returncode, finished.stderr) == (0, "")
    names = [line.split()[0] for line in finished.stdout.splitlines()]
    assert {"formation", "navigation", "snailbot", "snailbot_chain"} <= set(names)


def test_the_installed_wheel_finds_its_files_and_runs(installed: Path, tmp_path: Path) -> None:
    program = (
        "import sys, diagrams, plants, systems, tagtrail\n"
        "print(*(m.__file__ for m in (diagrams, plants, systems, tagtrail)), sep='\\n')\n"
        "sys.argv = ['tagtrail', 'run', 'navigation', '--no-meshcat', '--set', 'sight=projected',\n"
        "            '--duration', '0.5', '--out', 'out']\n"
        "sys.exit(tagtrail.main())\n"
    )
    finished = python(installed, tmp_path, "-c", program)
    assert finished.returncode == 1, finished.stderr  # the time was too short to arrive
    told = finished.stderr.splitlines()
    assert all(re.fullmatch(r"tagtrail: compiling \d+ small loops, .*", line) for line in told)
    assert len(told) <= 1
    files = finished.stdout.splitlines()[:4]
    assert all(Path(file).is_relative_to(installed) for file in files), files
    assert (tmp_path / "out" / "report.json").is_file()
    # Bundled files are named, not pointed at: the scenario runs on other machines too.
    text = (tmp_path / "out" / "scenario.yaml").read_text()
    assert "\n  markers: navigation.json\n" in text
    assert str(installed) not in text
    assert str(ROOT) not in text
