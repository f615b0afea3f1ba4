"""`tagtrail map` on recordings as people make them, right and wrong."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from diagrams.map_command import sizes
from systems.cameras import PinholeCamera
from systems.io.bag import BagWriter
from systems.io.ros_motion import FrameTransform, transforms_to_ros
from systems.io.ros_types import header, message_class
from systems.io.ros_vision import camera_to_ros, detections_to_ros
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap, load_map
from systems.messages import Detections
from tests.mapping_world import CAMERA, SIZE, Circuit, circuit
from tests.synthetic import Sheet, draw, expose

Array = NDArray[np.float64]
Refuse = Callable[..., str]

TYPE = "apriltag_msgs/msg/AprilTagDetectionArray"
TOPIC = "/limo/front_camera/detections"
FRAME = "limo/front_camera"
X_BC = RigidTransform(RollPitchYaw(-np.pi / 2, 0.0, -np.pi / 2), [0.1, 0.0, 0.2])
START = 1000.0  # s


@pytest.fixture(scope="module")
def world() -> Circuit:
    return circuit(frames=120, seed=3)


def seen(world: Circuit, seed: int = 0) -> list[Detections]:
    """What the camera saw, as a recording tells it."""
    return [
        replace(d, stamp=START + d.stamp, frame_id=FRAME, family="tag36h11")
        for d in world.detections(0.3, seed)
    ]


def record(
    folder: Path,
    detections: Sequence[Detections],
    *,
    camera: PinholeCamera | None = CAMERA,
    mounted: bool = False,
    wheels: Array | None = None,
    topics: Sequence[str] = (TOPIC,),
) -> Path:
    """Writes a recording of detections."""
    with BagWriter(folder) as bag:
        if camera is not None:
            info = camera_to_ros(camera, stamp=START, frame_id=FRAME)
            bag.write("/limo/front_camera/camera_info", "sensor_msgs/msg/CameraInfo", info, START)
        if mounted:
            chain = [
                FrameTransform(0.0, "limo/base_link", "limo/mast", RigidTransform([0.0, 0, 0.1])),
                FrameTransform(0.0, "limo/mast", FRAME, RigidTransform([0.0, 0, -0.1]) @ X_BC),
            ]
            bag.write(
                "/tf_static", "tf2_msgs/msg/TFMessage", transforms_to_ros(chain), START,
                latched=True,
            )  # fmt: skip
        for k, pose in enumerate(() if wheels is None else wheels):
            bag.write("/limo/odom", "nav_msgs/msg/Odometry", odometry(START + k / 10, pose),
                      START + k / 10)  # fmt: skip
        for k, entry in enumerate(detections):
            for topic in topics:
                bag.write(topic, TYPE, detections_to_ros(entry), START + k / 10)
    return folder


def odometry(stamp: float, pose: Array) -> Any:
    """A message of where wheels think that the body is."""
    make = message_class
    x, y, theta = pose.tolist()
    turned = make("geometry_msgs/msg/Quaternion")(0.0, 0.0, np.sin(theta / 2), np.cos(theta / 2))
    at = make("geometry_msgs/msg/Pose")(make("geometry_msgs/msg/Point")(x, y, 0.0), turned)
    still = make("geometry_msgs/msg/Vector3")(0.0, 0.0, 0.0)
    twist = make("geometry_msgs/msg/Twist")(still, still)
    unknown = np.zeros(36)
    return make("nav_msgs/msg/Odometry")(
        header(stamp, "odom"),
        "limo/base_link",
        make("geometry_msgs/msg/PoseWithCovariance")(at, unknown),
        make("geometry_msgs/msg/TwistWithCovariance")(twist, unknown),
    )


@pytest.fixture(scope="module")
def recording(world: Circuit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("recording") / "bag", seen(world), mounted=True)


def report_of(out: Path) -> dict[str, Any]:
    return json.loads((out / "report.json").read_text())


def true_map(world: Circuit, *ids: int, size: float = SIZE) -> MarkerMap:
    """The marker map of some tags, in the world's own frame."""
    scene = world.scene
    poses = {k: RigidTransform(RotationMatrix(scene.R_WT[k]), scene.p_WT[k]) for k in ids}
    markers = {k: Marker(k, X, size) for k, X in poses.items()}
    return MarkerMap(family("36h11"), size, markers)


def error(found: MarkerMap, world: Circuit) -> float:
    """The largest error of a tag's place, m, the world told in the frame of the map."""
    marker = next(iter(found))
    k = marker.id
    scene = world.scene
    X_MW = marker.X_WM @ RigidTransform(RotationMatrix(scene.R_WT[k]), scene.p_WT[k]).inverse()
    places = np.array([m.X_WM.translation() for m in found])
    return float(np.linalg.norm(places - [X_MW @ scene.p_WT[m.id] for m in found], axis=1).max())


def tum(path: Path) -> Array:
    return np.loadtxt(path, ndmin=2)


def test_a_recording_becomes_a_map(
    tagtrail: Callable[..., Any], recording: Path, world: Circuit, tmp_path: Path
) -> None:
    out = tmp_path / "M"
    result = tagtrail("map", recording, "--size", SIZE, "--anchor", 0, "--out", out)
    assert (result.status, result.err) == (0, "")
    assert {path.name for path in out.iterdir()} == {
        "map.json", "trajectory.tum", "covariances.npz", "frames.csv", "report.json", "summary.png",
        "replay.html",
    }  # fmt: skip
    found = load_map(out / "map.json")
    assert sorted(found.markers) == list(range(24))
    assert (found.family.name, found.size) == ("tag36h11", SIZE)
    np.testing.assert_array_equal(found.markers[0].X_WM.GetAsMatrix4(), np.eye(4))
    report = report_of(out)
    assert (report["outcome"], report["reasons"]) == ("mapped", {})
    metrics = report["metrics"]
    assert (metrics["tags"], metrics["frames"]) == (24, 120)
    assert 0.3 < metrics["reprojection_rms_px"] < 0.3 * np.sqrt(2)
    assert metrics["corners_used_fraction"] == 1.0
    assert metrics["chi2_per_dof"] == pytest.approx(1.0, abs=0.1)
    assert report["solve_seconds"] > 0
    assert report["camera"]["focal_length_px"] == 480.0
    assert report["camera"]["focal_length_freed_px"] == pytest.approx(480.0, abs=3.0)
    assert not any(n for counts in report["health"].values() for n in counts.values())
    assert error(found, world) < 4 * metrics["tag_sigma_max_m"]
    assert report["tags"][0] == {
        "ID": 0, "sightings": report["tags"][0]["sightings"],
        "outliers": 0, "reprojection_rms_px": pytest.approx(0.4, abs=0.1),
        "largest_px": pytest.approx(1.1, abs=0.5), "sigma_deg": 0.0, "sigma_m": 0.0,
    }  # fmt: skip
    assert all(row["sigma_m"] > 0 and row["sigma_deg"] > 0 for row in report["tags"][1:])
    covariances = np.load(out / "covariances.npz")
    assert covariances["tags"].shape == (24, 6, 6)
    assert covariances["poses"].shape == (120, 6, 6)
    for word in ("mapped", "reprojection_rms_px", f"results: {out}", "replay.html"):
        assert word in result.out
    assert cv2.imread(str(out / "summary.png")).std() > 5
    assert (
        b"map/moving" in (out / "replay.html").read_bytes()
        or len((out / "replay.html").read_bytes()) > 2_000_000
    )


def test_the_way_is_that_of_what_the_camera_is_mounted_on(
    tagtrail: Callable[..., Any], recording: Path, world: Circuit, tmp_path: Path
) -> None:
    out = tmp_path / "M"
    true_map(world, *range(24)).save(tmp_path / "map.json")
    result = tagtrail("map", recording, "--map", tmp_path / "map.json", "--localize-only",
                      "--out", out, "--no-meshcat")  # fmt: skip
    assert (result.status, result.err) == (0, "")
    report = report_of(out)
    assert report["outcome"] == "localized"
    assert report["map"]["trajectory_of"] == "limo/base_link"
    assert not (out / "map.json").exists()
    assert not (out / "replay.html").exists()
    rows = tum(out / "trajectory.tum")
    np.testing.assert_allclose(rows[:, 0], START + np.arange(120) / 10)
    R_WC = world.scene.R_CW.swapaxes(1, 2)
    p_WB = world.scene.positions() + R_WC @ X_BC.inverse().translation()
    off = np.linalg.norm(rows[:, 1:4] - p_WB, axis=1)
    sigma = np.sqrt(np.trace(np.load(out / "covariances.npz")["poses"][:, 3:, 3:], 0, 1, 2))
    assert np.sqrt((off**2).mean()) == pytest.approx(np.sqrt((sigma**2).mean()), rel=0.25)
    x, y, z, w = rows[:, 4:].T
    forward = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z)], axis=1)
    assert ((forward * R_WC[:, :2, 2]).sum(axis=1) > 0.999).all()  # B's x is the sight's direction


def test_wheels_smooth_the_way_if_asked(
    tagtrail: Callable[..., Any], refuse: Refuse, recording: Path, world: Circuit, tmp_path: Path
) -> None:
    true_map(world, *range(24)).save(tmp_path / "map.json")
    R_WB = world.scene.R_CW.swapaxes(1, 2) @ X_BC.rotation().matrix().T
    p_WB = world.scene.positions() - R_WB @ X_BC.translation()
    wheels = np.column_stack([p_WB[:, :2], np.arctan2(R_WB[:, 1, 0], R_WB[:, 0, 0])])
    few = [d.select(np.arange(len(d)) == k % len(d)) for k, d in enumerate(seen(world))]
    bag = record(tmp_path / "bag", few, mounted=True, wheels=wheels)
    known = ("--map", tmp_path / "map.json", "--localize-only", "--no-meshcat")
    off = []
    for arguments in ((), ("--odometry", "/limo/odom")):
        assert tagtrail("map", bag, *known, *arguments, "--out", tmp_path / "M").status == 0
        rows = tum(tmp_path / "M" / "trajectory.tum")
        frames = np.rint(10 * (rows[:, 0] - START)).astype(int)
        off.append(np.linalg.norm(rows[:, 1:4] - p_WB[frames], axis=1).mean())
    assert off[1] < off[0]
    line = refuse("map", recording, *known, "--odometry", "/odom", "--out", tmp_path / "M")
    assert line == f"--odometry /odom: recording {recording} has none"
    bare = record(tmp_path / "bare", few, wheels=wheels)
    line = refuse("map", bare, *known, "--odometry", "/limo/odom", "--out", tmp_path / "M")
    assert "/tf_static does not say where the camera is on the body" in line


def test_without_an_anchor_the_tag_seen_most_is_the_origin(
    tagtrail: Callable[..., Any], recording: Path, tmp_path: Path
) -> None:
    assert tagtrail("map", recording, "--size", SIZE, "--out", tmp_path, "--no-meshcat").status == 0
    report = report_of(tmp_path)
    most = max(report["tags"], key=lambda row: row["sightings"])
    assert report["map"]["held"] == [most["ID"]]
    X = load_map(tmp_path / "map.json").markers[most["ID"]].X_WM
    np.testing.assert_array_equal(X.GetAsMatrix4(), np.eye(4))


def test_new_tags_are_added_to_a_map_that_stays(
    tagtrail: Callable[..., Any], recording: Path, world: Circuit, tmp_path: Path
) -> None:
    given = true_map(world, 0, 5, 6, 12, 18)
    given.markers[400] = Marker(400, RigidTransform([9.0, 0.0, 0.0]), SIZE)
    given.save(tmp_path / "map.json")
    out = tmp_path / "M"
    result = tagtrail("map", recording, "--map", tmp_path / "map.json", "--out", out,
                      "--no-meshcat")  # fmt: skip
    assert result.status == 0
    found = load_map(out / "map.json")
    assert sorted(found.markers) == [*range(24), 400]  # also the one that was not seen
    for marker in given:
        X = found.markers[marker.id].X_WM
        np.testing.assert_allclose(X.GetAsMatrix4(), marker.X_WM.GetAsMatrix4(), atol=1e-12)
    assert (
        error(MarkerMap(found.family, SIZE, {k: found.markers[k] for k in range(24)}), world) < 0.05
    )
    assert report_of(out)["map"]["held"] == [0, 5, 6, 12, 18]


def test_an_anchor_with_a_pose_is_a_map_of_one_tag(
    tagtrail: Callable[..., Any], recording: Path, world: Circuit, tmp_path: Path
) -> None:
    true_map(world, 0).save(tmp_path / "anchor.json")
    out = tmp_path / "M"
    assert tagtrail("map", recording, "--map", tmp_path / "anchor.json", "--out", out,
                    "--no-meshcat").status == 0  # fmt: skip
    found = load_map(out / "map.json")
    places = np.array([found.markers[k].X_WM.translation() for k in range(24)])
    assert np.linalg.norm(places - world.scene.p_WT, axis=1).max() < 0.1


def test_what_cannot_be_used_is_dropped_and_counted(
    tagtrail: Callable[..., Any], world: Circuit, tmp_path: Path
) -> None:
    frames = seen(world)
    frames[10] = replace(frames[10], stamp=frames[3].stamp)  # back
    frames[11] = replace(frames[11], stamp=frames[11].stamp + 3600)  # far ahead, once
    first = frames[20].select(np.zeros(1, int))
    twice = {
        name: np.concatenate([getattr(frames[20], name), getattr(first, name)])
        for name in ("ids", "corners", "hamming", "decision_margin")
    }
    frames[20] = replace(frames[20], **twice)
    frames[30] = replace(frames[30], ids=np.append(frames[30].ids[:-1], 5000))
    corners = frames[40].corners.copy()
    corners[0] += 60.0
    frames[40] = replace(frames[40], corners=corners)
    corners = frames[50].corners.copy()
    corners[0, 2, 1] = np.nan
    frames[50] = replace(frames[50], corners=corners)
    bag = record(tmp_path / "bag", frames)
    result = tagtrail("map", bag, "--size", SIZE, "--out", tmp_path / "M", "--no-meshcat")
    assert result.status == 0, result
    health = report_of(tmp_path / "M")["health"]
    assert health["recording"] == {"truncated": 0, "foreign_id": 1, "unknown_tag": 0}
    counts = health["sightings"]
    assert (counts["bad_stamp"], counts["repeated_id"], counts["bad_corners"]) == (2, 2, 1)
    assert 1 <= counts["outlier"] <= 4
    assert error(load_map(tmp_path / "M" / "map.json"), world) < 0.1
    assert "dropped: sightings, repeated_id" in result.out


def test_a_recording_that_is_cut_off_is_read_as_far_as_it_goes(
    tagtrail: Callable[..., Any], recording: Path, tmp_path: Path
) -> None:
    whole = next(recording.glob("*.mcap")).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    result = tagtrail("map", tmp_path / "cut.mcap", "--size", SIZE, "--out", tmp_path / "M",
                      "--no-meshcat")  # fmt: skip
    assert result.status == 0, result
    assert "cut.mcap is cut off or damaged: what is there was read" in result.out.replace("\n", "")
    report = report_of(tmp_path / "M")
    assert report["health"]["recording"]["truncated"] == 1
    assert 30 < report["metrics"]["frames"] < 120


# Maps that are not to be trusted


def refused(result: Any, out: Path) -> dict[str, str]:
    """The reasons, once it is certain that nothing was left that could be used by mistake."""
    assert result.status == 1
    assert result.err == ""
    report = report_of(out)
    assert report["outcome"] == "refused"
    assert (out / "summary.png").exists()
    assert not (out / "map.json").exists()
    assert not (out / "trajectory.tum").exists()
    for reason in report["reasons"].values():
        assert f"refused: {reason}\n" in result.out
    return report["reasons"]


def test_a_wrong_camera_file_is_refused_with_what_it_looks_like(
    tagtrail: Callable[..., Any], recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "M"
    assert tagtrail("map", recording, "--size", SIZE, "--out", out, "--no-meshcat").status == 0
    PinholeCamera.from_focal_length(640, 480, 520.0).save(tmp_path / "wrong.yaml")
    result = tagtrail("map", recording, "--size", SIZE, "--camera", tmp_path / "wrong.yaml",
                      "--out", out, "--no-meshcat")  # fmt: skip
    reasons = refused(result, out)
    assert reasons["focal_length"].startswith("the focal length looks like 4")
    assert reasons["focal_length"].endswith("px, the camera says 520")


def test_tags_that_nothing_connects_are_refused_or_left_out(
    tagtrail: Callable[..., Any], world: Circuit, tmp_path: Path
) -> None:
    frames = [
        d.select(d.ids < 12 if (d.ids < 12).any() else np.arange(len(d)) == 0) for d in seen(world)
    ]
    bag = record(tmp_path / "bag", frames)
    out = tmp_path / "M"
    arguments = ("map", bag, "--size", SIZE, "--anchor", 0, "--out", out, "--no-meshcat")
    reasons = refused(tagtrail(*arguments), out)
    assert reasons["disconnected"].startswith("no picture connects the tags 12, ")
    assert tagtrail(*arguments, "--connected-only").status == 0
    found = load_map(out / "map.json")
    assert max(found.markers) < 12
    assert report_of(out)["health"]["sightings"]["disconnected"] > 0
    assert error(found, world) < 0.1


def test_new_tags_of_a_wrong_size_are_refused(
    tagtrail: Callable[..., Any], recording: Path, world: Circuit, tmp_path: Path
) -> None:
    true_map(world, *range(0, 24, 2)).save(tmp_path / "map.json")
    result = tagtrail("map", recording, "--map", tmp_path / "map.json", "--size", 1.25 * SIZE,
                      "--out", tmp_path / "M", "--no-meshcat")  # fmt: skip
    reasons = refused(result, tmp_path / "M")
    assert reasons["new_size"] == "the new tags look 0.80 times as large as they are said to be"


# Bad input


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "--size: how large are the tags? (side of the black square, metres)"),
        (("--size", "0"), "--size is 0.0: must be greater than 0"),
        (("--size", "big"), "--size big: must be metres, or ID=metres"),
        (("--size", "0.1", "--size", "0.2"), "--size: one for all, not 0.1, 0.2"),
        (("--size", "0.1", "--size", "3=-1"), "--size of tag 3 is -1.0: must be greater than 0"),
        (("--size", "0.1", "--anchor", "99"),
         "anchor is 99: must be one of the tags that were seen: 0, 1, 2, 3,"),
        (("--size", "0.1", "--anchor", "3", "--anchor", "4"), "--anchor: one tag, not 3, 4"),
        (("--size", "0.1", "--family", "25h9"),
         "--family tag25h9: the recording's tags are of tag36h11"),
        (("--size", "0.1", "--family", "fiducial"), "marker family is 'fiducial': unknown"),
        (("--size", "0.1", "--topic", "/tags"),
         f"has {TOPIC} (AprilTagDetectionArray)"),
        (("--localize-only",), "--localize-only needs --map FILE"),
        (("--size", "0.1", "--camera", "none.yaml"), "camera file none.yaml: No such file"),
        (("--map", "none.json"), "marker map none.json: No such file"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_in_one_line(
    refuse: Refuse, recording: Path, tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    assert words in refuse("map", recording, *arguments, "--out", tmp_path / "M")
    assert not (tmp_path / "M").exists()


def test_a_map_goes_with_neither_anchor_nor_other_sizes(
    refuse: Refuse, recording: Path, world: Circuit, tmp_path: Path
) -> None:
    path = tmp_path / "map.json"
    true_map(world, 0, 1).save(path)
    known = ("map", recording, "--map", path, "--out", tmp_path / "M")
    assert "leave one of them out" in refuse(*known, "--anchor", 0)
    assert refuse(*known, "--size", "1=0.5") == "--size of tag 1 is 0.5: the map has it at 0.18"
    assert "their sizes are the map's" in refuse(*known, "--localize-only", "--size", "0.2")
    true_map(world, 0, 1).save(path)
    strangers = MarkerMap(family("36h11"), SIZE, {300: Marker(300, RigidTransform(), SIZE)})
    strangers.save(path)
    assert "known tags is '300': must be in part among the tags that were seen: 0, 1" in refuse(
        *known
    )
    MarkerMap(family("25h9"), SIZE, {3: Marker(3, RigidTransform(), SIZE)}).save(path)
    assert refuse(*known) == "--family tag25h9: the recording's tags are of tag36h11"


def test_recordings_without_what_is_needed_are_refused(
    refuse: Refuse, world: Circuit, tmp_path: Path
) -> None:
    def line(path: Path, *arguments: str | Path) -> str:
        return refuse("map", path, "--size", SIZE, "--out", tmp_path / "M", *arguments)

    some = seen(world)[:5]
    assert line(tmp_path / "none.bag").endswith("none.bag: no such file or folder")
    (tmp_path / "empty.bag").write_bytes(b"")
    assert line(tmp_path / "empty.bag").endswith("empty.bag: empty file")
    (tmp_path / "text.bag").write_text("text")
    assert "not a recording" in line(tmp_path / "text.bag")
    with BagWriter(tmp_path / "still") as bag:
        bag.flush()
    assert line(tmp_path / "still").endswith("holds no message")
    blind = record(tmp_path / "blind", some, camera=None)
    assert line(blind).endswith("no CameraInfo in it, give --camera FILE")
    two = record(tmp_path / "two", some, topics=("/left/tags", "/right/tags"))
    assert line(two).endswith(
        "choose with --topic; it has /left/tags (AprilTagDetectionArray), /right/tags "
        "(AprilTagDetectionArray)"
    )
    dark = record(tmp_path / "dark", [d.select(np.zeros(0, int)) for d in some])
    assert line(dark) == f"{TOPIC}: no tag of tag36h11 in it"
    assert "without a tag seen often enough" in line(record(tmp_path / "short", some[:2]))
    CAMERA.scaled(0.5).save(tmp_path / "half.yaml")
    small = line(record(tmp_path / "large", some), "--camera", tmp_path / "half.yaml")
    assert "half.yaml is for pictures of 320x240: corners lie at up to (" in small
    other = [replace(d, family="tag25h9") if k else d for k, d in enumerate(some)]
    mixed = line(record(tmp_path / "mixed", [d.select(d.ids < 30) for d in other]))
    assert mixed.endswith("has tags of several families: tag25h9, tag36h11")


def test_sizes_are_metres_or_of_single_tags() -> None:
    assert sizes(["0.16", "7=0.3", "12=0.2"]) == (0.16, {7: 0.3, 12: 0.2})
    assert sizes([]) == (None, {})


# Pictures


def test_a_folder_of_pictures_is_mapped(tagtrail: Callable[..., Any], tmp_path: Path) -> None:
    camera = PinholeCamera.from_focal_length(640, 480, 600.0)
    camera.save(tmp_path / "camera.yaml")
    side, kind = 0.1, family("36h11")
    facing = RotationMatrix(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]))
    places = {4: [-0.15, 0.08, 0.0], 9: [0.12, 0.07, 0.05], 30: [0.02, -0.1, -0.04]}
    poses = {
        i: RigidTransform(RotationMatrix.MakeYRotation(0.3 * k - 0.3) @ facing, p)
        for k, (i, p) in enumerate(places.items())
    }
    (tmp_path / "pictures").mkdir()
    for k in range(6):
        turn = RotationMatrix(RollPitchYaw(0.15 * (k % 3) - 0.1, 0.25 * k - 0.6, 0.05 * k))
        X_CW = RigidTransform(turn, [0.0, 0.0, 0.75])
        sheets = []
        for i, X_WT in poses.items():
            X = X_CW @ X_WT
            R, p = X.rotation().matrix(), X.translation()
            plane = np.column_stack([R[:, 1] * side, -R[:, 2] * side, p])
            sheets.append(Sheet(kind, i, camera.K @ plane))
        ideal = draw((camera.height, camera.width), sheets, blur=0.6)
        image = expose(ideal, noise=1.0, rng=np.random.default_rng(k))
        cv2.imwrite(str(tmp_path / "pictures" / f"{k}.png"), image)
    out = tmp_path / "M"
    result = tagtrail("map", tmp_path / "pictures", "--size", side, "--anchor", 4, "--camera",
                      tmp_path / "camera.yaml", "--out", out, "--no-meshcat")  # fmt: skip
    assert result.status == 0, result
    found = load_map(out / "map.json")
    assert sorted(found.markers) == [4, 9, 30]
    for i in (9, 30):
        off = (poses[4].inverse() @ poses[i]).inverse() @ found.markers[i].X_WM
        assert np.linalg.norm(off.translation()) < 0.001
        assert off.rotation().ToAngleAxis().angle() < np.radians(0.5)
    assert report_of(out)["metrics"]["frames"] == 6
    assert tum(out / "trajectory.tum")[:, 0].tolist() == list(range(6))


def test_recorded_pictures_and_recorded_detections_give_the_same_map(
    tagtrail: Callable[..., Any], rendered: Any, tmp_path: Path
) -> None:
    maps = []
    for name, topic in (("pictures", "image/compressed"), ("detections", "detections")):
        out = tmp_path / name
        result = tagtrail("map", rendered.bag, "--family", "4x4_50", "--size", 0.15, "--anchor", 10,
                          "--topic", f"/robot/front_camera/{topic}", "--out", out,
                          "--no-meshcat")  # fmt: skip
        assert result.status == 0, result
        assert report_of(out)["map"]["trajectory_of"] == "robot/base_link"
        maps.append(load_map(out / "map.json"))
    assert sorted(maps[0].markers) == sorted(maps[1].markers)
    for marker in maps[0]:
        other = maps[1].markers[marker.id].X_WM
        assert np.linalg.norm(marker.X_WM.translation() - other.translation()) < 1e-3
