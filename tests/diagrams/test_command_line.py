from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from systems.io.bag import BagReader, BagWriter
from systems.markers.layout import load_map

ROOT = Path(__file__).resolve().parents[2]
MAP = ROOT / "diagrams" / "maps" / "navigation.json"
SHORT = ("--no-meshcat", "--set", "sight=projected", "--duration", "0.2")

Refuse = Callable[..., str]
Draw = Callable[[Path], Path]


# Arguments


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "the following arguments are required: COMMAND"),
        (("walk",), "invalid choice: 'walk'"),
        (("run",), "the following arguments are required: scenario"),
        (("run", "navigation_open", "--seed", "1.5"), "argument --seed: invalid int value: '1.5'"),
        (
            ("run", "navigation_open", "--duration", "long"),
            "argument --duration: invalid float value",
        ),
        (("run", "navigation_open", "--speed", "3"), "unrecognized arguments: --speed 3"),
        (("detect", "x.png"), "the following arguments are required: --family"),
    ],
)
def test_arguments_that_make_no_sense_are_refused_in_one_line(
    refuse: Refuse, arguments: tuple[str, ...], words: str
) -> None:
    assert words in refuse(*arguments)


def test_help_shows_every_command(tagtrail: Callable[..., Any]) -> None:
    result = tagtrail("--help")
    assert result.status == 0
    for command in ("list", "run", "study", "diagram", "markers", "map", "detect"):
        assert f"\n    {command} " in result.out


# run


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("navigatoin",), "scenario 'navigatoin': no such file or bundled name; did you mean "
                          "'navigation'?"),
        (("nope.yaml",), "scenario nope.yaml: no such file"),
        (("navigation_open", "--set", "seed"), "--set seed: must be KEY=VALUE"),
        (("navigation_open", "--seed", "-1"),
         "--set seed: seed is -1: must be a whole number from 0 to 2^53 - 1"),
        (("navigation_open", "--seed", str(2**53)),
         f"--set seed: seed is {2**53}: must be a whole number from 0 to 2^53 - 1"),
        (("navigation_open", "--duration", "0"),
         "--set duration: duration is 0.0: must be greater than 0"),
        (("navigation_open", "--duration", "nan"),
         "--set duration: duration is 'nan': must be a number"),
        (("navigation_open", "--realtime", "-1", "--no-meshcat"),
         "realtime is -1.0: must be 0 or greater"),
        (("navigation_open", "--play", "nope"),
         "--set recording: recording is 'nope': there is no such file or folder"),
    ],
)  # fmt: skip
def test_a_run_that_cannot_be_is_refused_in_one_line(
    refuse: Refuse, workshop: Path, arguments: tuple[str, ...], line: str
) -> None:
    assert refuse("run", *arguments) == line
    assert list(workshop.iterdir()) == []


def scene(folder: Path, text: str) -> Path:
    path = folder / "scene.yaml"
    path.write_text(f"extends: navigation_open\nsight: projected\n{text}")
    return path


def test_a_missing_map_is_refused(refuse: Refuse, workshop: Path) -> None:
    path = scene(workshop, "world: {markers: my_map.json}\n")
    assert refuse("run", path) == (
        f"{path}:3: world.markers is 'my_map.json': no such file in {workshop} or "
        f"{ROOT / 'diagrams' / 'scenarios'}; bundled: circuit.json, navigation.json, snailbot.json"
    )


def test_a_map_with_an_id_twice_is_refused(refuse: Refuse, workshop: Path) -> None:
    content = json.loads(MAP.read_text())
    content["tags"][3]["ID"] = content["tags"][1]["ID"]
    (workshop / "my_map.json").write_text(json.dumps(content))
    path = scene(workshop, "world: {markers: my_map.json}\n")
    number = content["tags"][1]["ID"]
    assert refuse("run", path, "--no-meshcat") == (
        f"marker map {workshop / 'my_map.json'}: tags[3].ID is {number}: there is a tag of that "
        "ID already"
    )
    refuse("markers", workshop / "my_map.json")


def test_a_waypoint_in_a_wall_is_refused(refuse: Refuse, workshop: Path) -> None:
    path = scene(workshop, "waypoints:\n- [-1.7, 1.0]\n- [2.5, 0.0]\n")
    assert refuse("run", path) == (
        f"{path}:5: waypoints[1] = [2.5, 0] lies in walls[1]: the robot needs 0.125 m of room"
    )


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("width: 640\n", "height is None: must be a whole number of pixels"),
        ("width: 640\nheight: 480\nK: [1, 2, 3]\n", "must be 9 numbers, row by row"),
        ("width: 640\nheight: 480\nK: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nD: [1, 2, 3]\n",
         "D is [1.0, 2.0, 3.0]: must be 4 or 5 numbers"),
        ("width: [\n", "is not YAML"),
        ("- 640\n- 480\n", "must be a mapping with the keys width, height, K, D"),
    ],
)  # fmt: skip
def test_a_camera_file_that_is_none_is_refused_by_name(
    refuse: Refuse, workshop: Path, content: str, words: str
) -> None:
    (workshop / "my_camera.yaml").write_text(content)
    path = scene(workshop, "robot: {sensors: {front_camera: {calibration: my_camera.yaml}}}\n")
    line = refuse("run", path, "--no-meshcat")
    assert line.startswith(f"camera file {workshop / 'my_camera.yaml'}")
    assert words in line


def test_a_lens_that_cannot_be_rendered_is_refused_by_its_file(
    refuse: Refuse, workshop: Path
) -> None:
    (workshop / "folded.yaml").write_text(
        "width: 640\nheight: 480\nK: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nD: [5, -9, 0, 0]\n"
    )
    path = scene(workshop, "robot: {sensors: {front_camera: {calibration: folded.yaml}}}\n")
    line = refuse("run", path, "--no-meshcat", "--set", "sight=rendered")
    assert line.startswith(f"camera file {workshop / 'folded.yaml'}: D is [5.0, -9.0")


def test_results_that_cannot_be_written_are_refused(refuse: Refuse, workshop: Path) -> None:
    (workshop / "file").write_text("in the way")
    assert refuse("run", "navigation_open", *SHORT, "--out", "file") == "--out file: File exists"
    assert refuse("run", "navigation_open", *SHORT, "--out", "file/sub") == (
        "--out file/sub: Not a directory"
    )
    (workshop / "results" / "scenario.yaml").mkdir(parents=True)
    line = refuse("run", "navigation_open", *SHORT, "--out", "results")
    assert line == "results/scenario.yaml: Is a directory"


def test_a_second_run_replaces_the_first_ones_results(
    tagtrail: Callable[..., Any], workshop: Path
) -> None:
    out = workshop / "out"
    longer = [*SHORT[:-1], "0.4"]
    assert tagtrail("run", "navigation_open", *longer, "--out", out).status == 1
    first = json.loads((out / "report.json").read_text())
    (out / "replay.html").write_text("of a run with Meshcat")
    (out / "notes.txt").write_text("the user's own")
    again = tagtrail("run", "navigation_open", *SHORT, "--seed", "9", "--out", out)
    assert again.status == 1, again.err
    second = json.loads((out / "report.json").read_text())
    assert (first["sim_seconds"], second["sim_seconds"]) == (0.4, 0.2)
    assert BagReader(out / "bag").topics()
    stamps = [record.log_time for record in BagReader(out / "bag").records()]
    assert max(stamps) <= 200_000_000
    # No folder mixes two runs; what is not ours stays.
    assert not (out / "replay.html").exists()
    assert (out / "notes.txt").exists()


def test_a_refused_run_leaves_the_last_ones_results(
    refuse: Refuse, tagtrail: Callable[..., Any], workshop: Path
) -> None:
    tagtrail("run", "navigation_open", *SHORT, "--out", "out")
    before = {path: path.read_bytes() for path in (workshop / "out").rglob("*") if path.is_file()}
    (workshop / "empty.yaml").write_text("")
    camera = "robot.sensors.front_camera.calibration=empty.yaml"
    refuse("run", "navigation_open", *SHORT, "--out", "out", "--set", camera)
    assert before == {p: p.read_bytes() for p in (workshop / "out").rglob("*") if p.is_file()}


# run --play


def test_what_is_no_recording_is_refused(refuse: Refuse, workshop: Path) -> None:
    (workshop / "empty").mkdir()
    (workshop / "text.mcap").write_text("no recording")
    assert refuse("run", "navigation_open", "--no-meshcat", "--play", "empty") == (
        f"recording {workshop / 'empty'}: no recording in this folder"
    )
    assert refuse("run", "navigation_open", "--no-meshcat", "--play", "text.mcap") == (
        f"recording {workshop / 'text.mcap'}: not a recording (MCAP, rosbag2 or ROS 1 bag)"
    )


def test_a_recording_without_a_needed_topic_is_refused(
    refuse: Refuse, navigation: Any, workshop: Path
) -> None:
    with BagWriter(workshop / "poor") as writer:
        for record in BagReader(navigation.bag).records():
            if record.topic != "/robot/imu":
                message = record.message()
                writer.write(record.topic, message.__msgtype__, message, record.log_time * 1e-9)
    line = refuse("run", "navigation_open", "--no-meshcat", "--play", "poor")
    assert line.startswith(f"recording {workshop / 'poor'}: lacks the topic /robot/imu; has ")
    assert "/robot/front_camera/detections" in line


def test_a_camera_file_of_another_size_than_the_recordings_is_refused(
    refuse: Refuse, navigation: Any, workshop: Path
) -> None:
    (workshop / "small.yaml").write_text(
        "width: 320\nheight: 240\nK: [250, 0, 160, 0, 250, 120, 0, 0, 1]\n"
    )
    camera = "robot.sensors.front_camera.calibration=small.yaml"
    line = refuse(
        "run", "navigation_open", "--no-meshcat", "--play", navigation.bag, "--set", camera
    )
    assert line == (
        f"camera file {workshop / 'small.yaml'} is for pictures of 320x240: "
        "/robot/front_camera/camera_info of the recording is of 640x480"
    )


def test_a_recording_is_not_overwritten_by_its_own_playback(
    refuse: Refuse, navigation: Any, workshop: Path
) -> None:
    shutil.copytree(navigation.path, workshop / "copy")
    before = (workshop / "copy" / "bag" / "bag_0.mcap").read_bytes()
    for played in ("copy/bag", "copy/bag/bag_0.mcap"):
        line = refuse("run", "navigation_open", "--no-meshcat", "--play", played, "--out", "copy")
        assert line == "--out copy: holds the recording that is played"
    assert (workshop / "copy" / "bag" / "bag_0.mcap").read_bytes() == before


def test_a_recording_may_have_any_name(
    tagtrail: Callable[..., Any], navigation: Any, workshop: Path
) -> None:
    # YAML would take the first for a number and the second for a mapping.
    for name in ("20240131", "a: b, [c]"):
        shutil.copytree(navigation.bag, workshop / name)
        result = tagtrail(
            "run", "navigation_open", "--no-meshcat", "--duration", "0.2", "--play", name
        )
        assert result.status == 1, result.err


# markers


def test_markers_of_a_bundled_map_become_a_pdf(
    tagtrail: Callable[..., Any], workshop: Path
) -> None:
    result = tagtrail("markers", "navigation.json", "-o", "sheets.pdf")
    assert result.status == 0, result.err
    data = (workshop / "sheets.pdf").read_bytes()
    assert data.startswith(b"%PDF-")
    assert data.count(b"/Type /Page ") + data.count(b"/Type /Page\n") == len(load_map(MAP))
    assert f"{len(load_map(MAP))} markers" in result.out


def test_markers_that_cannot_be_printed_are_refused(refuse: Refuse, workshop: Path) -> None:
    assert refuse("markers", "nope.json") == (
        "marker map nope.json: no such file; bundled: circuit.json, navigation.json, snailbot.json"
    )
    assert refuse("markers", "navigation.json", "--page", "A7").startswith("page is 'A7': unknown")
    assert refuse("markers", "navigation.json", "-o", "nowhere/x.pdf") == (
        "nowhere/x.pdf: No such file or directory"
    )
    (workshop / "empty.json").write_text(json.dumps({"family": "36h11", "size": 0.1, "tags": []}))
    assert "must have at least one" in refuse("markers", "empty.json")
    content = json.loads(MAP.read_text()) | {"size": 3.0}
    for tag in content["tags"]:
        tag.pop("size", None)
    (workshop / "huge.json").write_text(json.dumps(content))
    assert "to fit on A3 with its white margin" in refuse("markers", "huge.json")
    assert not (workshop / "markers.pdf").exists()


# detect


def test_what_detect_cannot_do_is_refused(refuse: Refuse, picture: Draw, workshop: Path) -> None:
    picture(workshop / "a.png")
    (workshop / "empty").mkdir()
    assert refuse("detect", "nope", "--family", "4x4_50") == "nope: no such file or folder"
    assert refuse("detect", "empty", "--family", "4x4_50").startswith(
        "empty: no pictures, videos or recordings in it"
    )
    assert refuse("detect", "a.png", "--family", "tag36h12") == (
        "marker family is 'tag36h12': unknown; did you mean 'tag36h11'?"
    )
    assert refuse("detect", "a.png", "--family", "4x4_50", "--size", "-0.1") == (
        "size is -0.1: must be greater than 0"
    )
    assert refuse("detect", "a.png", "--family", "4x4_50", "--camera", "nope.yaml") == (
        "camera file nope.yaml: No such file or directory"
    )
    (workshop / "file").write_text("in the way")
    assert refuse("detect", "a.png", "--family", "4x4_50", "--out", "file") == (
        "--out file: File exists"
    )


def test_a_camera_file_of_another_size_than_the_pictures_is_refused(
    refuse: Refuse, picture: Draw, workshop: Path
) -> None:
    picture(workshop / "a.png")
    (workshop / "vga.yaml").write_text(
        "width: 640\nheight: 480\nK: [500, 0, 320, 0, 500, 240, 0, 0, 1]\n"
    )
    line = refuse("detect", "a.png", "--family", "4x4_50", "--camera", "vga.yaml")
    assert line == "camera file vga.yaml is for pictures of 640x480: a.png is 320x240"


def test_detect_does_not_write_over_the_pictures(
    refuse: Refuse, picture: Draw, workshop: Path
) -> None:
    (workshop / "pictures").mkdir()
    path = picture(workshop / "pictures" / "a.png")
    before = path.read_bytes()
    words = "holds the pictures, which annotated ones would replace"
    for source in ("pictures", "pictures/a.png"):
        line = refuse("detect", source, "--family", "4x4_50", "--out", "pictures")
        assert line == f"--out pictures: {words}"
    assert path.read_bytes() == before


# diagram


def test_a_drawing_that_cannot_be_made_is_refused(
    refuse: Refuse, workshop: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    projected = ("--set", "sight=projected")
    assert refuse("diagram", "navigation_open", *projected, "-o", "n.png") == (
        "--out n.png: must end in .svg or .dot"
    )
    assert refuse("diagram", "navigation_open", *projected, "-o", "nowhere/n.dot") == (
        "--out nowhere/n.dot: No such file or directory"
    )
    monkeypatch.setenv("PATH", str(workshop))
    assert refuse("diagram", "navigation_open", *projected, "-o", "n.svg") == (
        "the program 'dot' is missing: install the system package graphviz, or write the source "
        "with -o FILE.dot"
    )
    assert list(workshop.iterdir()) == []
