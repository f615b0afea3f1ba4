from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from diagrams.detect import annotate, detect
from systems.cameras import PinholeCamera
from systems.io.bag import BagWriter
from systems.io.ros_vision import camera_to_ros, image_to_ros
from systems.markers.family import family
from systems.markers.layout import marker_corners
from systems.messages import CameraImage, Detections
from tests.recordings import listed_tags, right_and_other
from tests.synthetic import Sheet, draw, expose

Array = NDArray[np.float64]

SIZE = 0.1
CAMERA = PinholeCamera(640, 480, np.array([[600.0, 0, 322.0], [0, 600.0, 238.0], [0, 0, 1.0]]))


def pose_homography(R: Array, p: Array, camera: PinholeCamera) -> Array:
    """From a marker's plane, as `Sheet` counts it (right, down, 1 for a side), to pixels."""
    # The sheet's right is the marker's y, its down is minus the marker's z.
    plane = np.column_stack([R[:, 1] * SIZE, -R[:, 2] * SIZE, p])
    return camera.K @ plane


def look(turn: float, tilt: float) -> Array:
    """`R_CM` of a marker that faces the camera, turned (rad, clockwise), tilted to its left."""
    facing = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    about_sight, _ = cv2.Rodrigues(np.array([0.0, 0.0, turn]))
    about_down, _ = cv2.Rodrigues(np.array([0.0, tilt, 0.0]))
    return about_down @ about_sight @ facing


# id: rotation and position (m) in the camera.
POSES: dict[int, tuple[Array, Array]] = {
    3: (look(0.2, 0.7), np.array([-0.20, 0.10, 0.80])),
    17: (look(-2.5, -0.6), np.array([0.15, -0.12, 0.70])),
    41: (look(1.6, 0.5), np.array([0.22, 0.15, 0.90])),
}


def corners_of(marker: int) -> Array:
    R, p = POSES[marker]
    return CAMERA.project(marker_corners(SIZE) @ R.T + p)


def scene(name: str, ids: tuple[int, ...], seed: int = 0, noise: float = 1.0) -> NDArray[np.uint8]:
    sheets = [Sheet(family(name), i, pose_homography(*POSES[i], CAMERA)) for i in ids]
    for sheet in sheets:
        np.testing.assert_allclose(sheet.corners(), corners_of(sheet.id), atol=1e-9)
    ideal = draw((CAMERA.height, CAMERA.width), sheets, blur=0.6)
    return expose(ideal, noise=noise, rng=np.random.default_rng(seed))


def table(folder: Path) -> list[dict[str, Any]]:
    return json.loads((folder / "detections.json").read_text())


def check_corners(row: dict[str, Any], within: float = 0.1) -> None:
    np.testing.assert_allclose(row["corners"], corners_of(row["id"]), atol=within)


def rotation(wxyz: list[float]) -> Array:
    """The matrix of a quaternion, by Rodrigues' formula."""
    w, *v = wxyz
    assert math.hypot(w, *v) == pytest.approx(1.0, abs=1e-6)
    s = math.hypot(*v)
    axis = np.array(v) / s * 2 * math.atan2(s, w) if s else np.zeros(3)
    return cv2.Rodrigues(axis)[0]


def angle(A: Array, B: Array) -> float:
    return math.degrees(math.acos(np.clip((np.trace(A.T @ B) - 1) / 2, -1, 1)))


@pytest.fixture
def camera_file(tmp_path: Path) -> Path:
    CAMERA.save(tmp_path / "camera.yaml")
    return tmp_path / "camera.yaml"


@pytest.mark.parametrize("name", ["DICT_4X4_50", "tag36h11"])
def test_a_folder_of_pictures(
    tagtrail: Callable[..., Any], tmp_path: Path, camera_file: Path, name: str
) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    contents = {"a.png": (3, 17, 41), "b.bmp": (17,), "c.jpg": ()}
    for k, (file, ids) in enumerate(contents.items()):
        cv2.imwrite(str(folder / file), scene(name, ids, seed=k))
    (folder / "notes.txt").write_text("no picture")
    result = tagtrail(
        "detect", folder, "--family", name, "--size", SIZE, "--camera", camera_file,
        "--out", tmp_path / "out",
    )  # fmt: skip
    assert (result.status, result.err) == (0, "")
    rows = table(tmp_path / "out")
    found: dict[str, list[int]] = {file: [] for file in contents}
    for row in rows:
        assert set(row) == {
            "image", "stamp", "id", "corners", "hamming", "decision_margin", "poses",
        }  # fmt: skip
        found[row["image"]].append(row["id"])
        check_corners(row)
        assert (row["stamp"], row["hamming"]) == (0.0, 0)
        assert row["decision_margin"] > 20
    assert {file: tuple(sorted(ids)) for file, ids in found.items()} == contents
    # What is said on the terminal: pictures, numbers, ids.
    assert "3 17 41" in result.out
    # Annotated pictures are of the same size, and outlined in green where the markers are.
    for file, ids in contents.items():
        shown = cv2.imread(str(tmp_path / "out" / (file if file == "a.png" else f"{file}.png")))
        assert shown.shape == (CAMERA.height, CAMERA.width, 3)
        for marker in ids:
            middle = corners_of(marker)[[0, 1]].mean(axis=0)
            u, v = np.rint(middle).astype(int)
            patch = shown[v - 2 : v + 3, u - 2 : u + 3].reshape(-1, 3).astype(int)
            assert ((patch[:, 1] > 150) & (patch[:, 0] < 100) & (patch[:, 2] < 100)).any()


def test_poses_are_right_and_both_solutions_are_told(tmp_path: Path, camera_file: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), scene("4x4_50", (3, 17, 41)))
    out = tmp_path / "out"
    detect(tmp_path / "a.png", family="4x4_50", size=SIZE, camera=camera_file, out=out)
    rows = table(out)
    assert {row["id"] for row in rows} == set(POSES)
    for row in rows:
        R, p = POSES[row["id"]]
        first, second = row["poses"]
        assert set(first) == {"translation", "quaternion", "reprojection_rms_px"}
        assert np.linalg.norm(np.subtract(first["translation"], p)) < 0.005 * np.linalg.norm(p)
        assert angle(rotation(first["quaternion"]), R) < 1.0
        assert first["reprojection_rms_px"] < 0.1
        # The other one: the same place, leaning the other way, not so good.
        assert np.linalg.norm(np.subtract(second["translation"], p)) < 0.03
        assert angle(rotation(second["quaternion"]), R) > 30
        assert second["reprojection_rms_px"] > 2 * first["reprojection_rms_px"]
        # What is said of the errors is true of the poses.
        for pose in (first, second):
            points = marker_corners(SIZE) @ rotation(pose["quaternion"]).T + pose["translation"]
            residuals = CAMERA.project(points) - row["corners"]
            rms = math.sqrt((residuals**2).sum() / 4)
            assert pose["reprojection_rms_px"] == pytest.approx(rms, abs=0.01)


def test_without_a_camera_there_are_no_poses_and_it_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), scene("4x4_50", (3,)))
    detect(tmp_path / "a.png", family="4x4_50", size=SIZE, camera=None, out=tmp_path / "out")
    (row,) = table(tmp_path / "out")
    assert "poses" not in row
    assert caplog.messages == ["no poses: no --camera is given, and a.png brings none"]


def test_pictures_of_one_stem_do_not_hide_each_other(tmp_path: Path) -> None:
    for file, marker in (("a.jpg", 3), ("a.png", 17)):
        cv2.imwrite(str(tmp_path / file), scene("4x4_50", (marker,)))
    detect(tmp_path, family="4x4_50", size=None, camera=None, out=tmp_path / "out")
    assert {(row["image"], row["id"]) for row in table(tmp_path / "out")} == {
        ("a.jpg", 3),
        ("a.png", 17),
    }
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["a.jpg.png", "a.png", "detections.json"]


def test_a_folder_without_markers_gives_an_empty_table(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((60, 80), 128, np.uint8))
    summary = detect(tmp_path / "a.png", family="36h11", size=0.1, camera=None, out=tmp_path / "o")
    assert summary == [("a.png", "0", "")]
    assert table(tmp_path / "o") == []


@pytest.mark.parametrize(("suffix", "code"), [(".avi", "MJPG"), (".mp4", "mp4v")])
def test_a_video(tmp_path: Path, suffix: str, code: str) -> None:
    path = tmp_path / f"walk{suffix}"
    video = cv2.VideoWriter(
        str(path), cv2.VideoWriter_fourcc(*code), 10.0, (CAMERA.width, CAMERA.height)
    )
    if not video.isOpened():
        pytest.skip(f"this OpenCV cannot write {code}")
    frames = [(3,), (), (17, 41)]
    for k, ids in enumerate(frames):
        video.write(cv2.cvtColor(scene("4x4_50", ids, seed=k), cv2.COLOR_GRAY2BGR))
    video.release()
    summary = detect(path, family="4x4_50", size=None, camera=None, out=tmp_path / "out")
    assert [row[0] for row in summary] == ["000000.png", "000001.png", "000002.png"]
    rows = table(tmp_path / "out")
    found = [{row["id"] for row in rows if row["image"] == s[0]} for s in summary]
    assert found == [set(ids) for ids in frames]
    for row in rows:
        check_corners(row, within=0.3)  # lossy
        assert row["stamp"] == pytest.approx(int(row["image"][:6]) / 10, abs=1e-6)
    assert all((tmp_path / "out" / s[0]).is_file() for s in summary)


def record(folder: Path, cameras: dict[str, tuple[PinholeCamera, tuple[int, ...]]]) -> Path:
    """Records two pictures a camera, a tenth of a second apart."""
    with BagWriter(folder) as writer:
        for name, (camera, _) in cameras.items():
            info = camera_to_ros(camera, stamp=0.0, frame_id=name)
            writer.write(f"/{name}/camera_info", info.__msgtype__, info, 0.0)
        for k in range(2):
            for name, (_, ids) in cameras.items():
                image = CameraImage(stamp=0.1 * k, frame_id=name, data=scene("4x4_50", ids, seed=k))
                message = image_to_ros(image)
                topic = f"/{name}/image/compressed"
                writer.write(topic, message.__msgtype__, message, 0.1 * k + 0.02)
    return folder


def test_a_recording_brings_its_camera(tagtrail: Callable[..., Any], tmp_path: Path) -> None:
    bag = record(tmp_path / "bag", {"eye": (CAMERA, (3, 41))})
    out = tmp_path / "out"
    result = tagtrail("detect", bag, "--family", "4x4_50", "--size", SIZE, "--out", out)
    assert (result.status, result.err) == (0, "")
    rows = table(out)
    assert sorted((row["image"], row["id"]) for row in rows) == [
        (f"eye_image_compressed_{k:06d}.png", marker) for k in range(2) for marker in (3, 41)
    ]
    for row in rows:
        check_corners(row)
        R, p = POSES[row["id"]]
        assert row["stamp"] == pytest.approx(0.1 * int(row["image"][-10:-4]), abs=1e-9)
        assert np.linalg.norm(np.subtract(row["poses"][0]["translation"], p)) < 0.01
        assert angle(rotation(row["poses"][0]["quaternion"]), R) < 1.5
    # The file alone is the same recording.
    detect(bag / "bag_0.mcap", family="4x4_50", size=SIZE, camera=None, out=tmp_path / "o2")
    assert table(tmp_path / "o2") == rows


def test_each_camera_of_a_recording_is_calibrated_for_itself(tmp_path: Path) -> None:
    # The same pictures, said to be by a camera of twice the focal length: twice as far away.
    K = CAMERA.K.copy()
    K[0, 0] = K[1, 1] = 1200.0
    far = PinholeCamera(CAMERA.width, CAMERA.height, K, np.array([1e-9, 0, 0, 0, 0]))
    bag = record(tmp_path / "bag", {"left": (CAMERA, (17,)), "right": (far, (17,))})
    detect(bag, family="4x4_50", size=SIZE, camera=None, out=tmp_path / "out")
    distance: dict[str, list[float]] = {"left": [], "right": []}
    for row in table(tmp_path / "out"):
        distance[row["image"].split("_")[0]].append(row["poses"][0]["translation"][2])
    assert len(distance["left"]) == len(distance["right"]) == 2
    np.testing.assert_allclose(distance["left"], POSES[17][1][2], rtol=0.01)
    assert np.min(distance["right"]) > 1.6 * POSES[17][1][2]


def test_a_recording_of_another_size_than_its_camera_is_refused(tmp_path: Path) -> None:
    small = PinholeCamera.from_focal_length(320, 240, 300.0)
    bag = record(tmp_path / "bag", {"eye": (small, (3,))})
    with pytest.raises(ValueError, match="the recording's CameraInfo is for pictures of 320x240"):
        detect(bag, family="4x4_50", size=SIZE, camera=None, out=tmp_path / "out")


def test_outlines_ids_and_first_corners_are_drawn_on_the_picture() -> None:
    image = np.full((200, 200), 255, np.uint8)
    corners = np.array([[[50.0, 50.0], [150.0, 50.0], [150.0, 150.0], [50.0, 150.0]]])
    found = Detections(
        ids=np.array([7]), corners=corners, hamming=np.zeros(1, int), decision_margin=np.ones(1)
    )
    drawn = annotate(image, found)
    assert drawn.shape == (200, 200, 3)
    assert (image == 255).all()  # a copy was drawn on
    r, g, b = drawn[50, 100].tolist()
    assert g > 200
    assert max(r, b) < 40
    assert drawn[50, 50].tolist() == [255, 60, 0]  # top left
    assert drawn[150, 150].tolist() != [255, 60, 0]
    inside = drawn[70:130, 70:130].reshape(-1, 3)
    assert (inside == [255, 255, 0]).all(axis=1).any()  # the id
    assert (drawn[:40] == 255).all()


# Real pictures


@pytest.mark.recording
def test_the_tags_in_three_photographs(
    tagtrail: Callable[..., Any], recordings: Path, tmp_path: Path
) -> None:
    photos = recordings / "apriltag_photos"
    result = tagtrail("detect", photos, "--family", "36h11", "--out", tmp_path)
    assert (result.status, result.err) == (0, "")
    rows = table(tmp_path)
    listed = 0
    counts = np.zeros(2, int)
    for path in sorted(photos.glob("*.txt")):
        found = [row for row in rows if Path(row["image"]).stem == path.stem]
        tags = listed_tags(path)
        listed += len(tags)
        ids, corners = [row["id"] for row in found], [row["corners"] for row in found]
        counts += right_and_other(ids, corners, tags)
    assert listed == 47
    assert counts[0] >= 46
    assert counts[1] == 0


@pytest.mark.recording
def test_the_markers_before_a_real_camera(
    tagtrail: Callable[..., Any], recordings: Path, tmp_path: Path
) -> None:
    result = tagtrail(
        "detect", recordings / "aruco_camera", "--family", "DICT_5X5_1000", "--size", "0.14",
        "--out", tmp_path,
    )  # fmt: skip
    assert (result.status, result.err) == (0, "")
    rows = table(tmp_path)
    assert sorted(row["id"] for row in rows) == [100, 103, 106, 107, 110, 111, 112]
    for row in rows:
        first, second = row["poses"]
        assert first["reprojection_rms_px"] <= second["reprojection_rms_px"]
        assert first["reprojection_rms_px"] < 1.5
        assert 0.3 < first["translation"][2] < 5.0
        assert rotation(first["quaternion"])[2, 0] < 0  # its face looks toward the camera
