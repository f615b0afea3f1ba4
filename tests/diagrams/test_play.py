from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from systems.io.bag import BagReader, BagWriter

Play = Callable[..., Path]


@pytest.fixture(scope="module")
def play(tagtrail: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Play:
    """Plays a recording back; returns the folder of the results."""

    def play(recording: Path, *arguments: str) -> Path:
        out = tmp_path_factory.mktemp("played")
        result = tagtrail(
            "run", "navigation_open", "--no-meshcat", "--play", recording, *arguments, "--out", out
        )
        assert result.status in (0, 1), result.err
        assert result.err == ""
        return out

    return play


@pytest.fixture(scope="module")
def played(navigation: Any, play: Play) -> Path:
    """The whole run, played back."""
    return play(navigation.bag)


def lines(folder: Path, name: str = "estimate.tum") -> list[str]:
    return (folder / name).read_text().splitlines()


def report(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "report.json").read_text())


def copy(source: Path, target: Path, *, shift: float = 0.0, leave_out: str = " ") -> Path:
    """Copies a recording, later by `shift` (s), without the topics that begin with `leave_out`."""
    with BagWriter(target) as writer:
        for record in BagReader(source).records():
            if record.topic.startswith(leave_out):
                continue
            message = record.message()
            if shift and hasattr(message, "header"):
                message.header.stamp.sec += round(shift)
            writer.write(record.topic, message.__msgtype__, message, record.log_time * 1e-9 + shift)
    return target


def test_played_back_a_recording_gives_the_same_estimates(navigation: Any, played: Path) -> None:
    before, after = lines(navigation.path), lines(played)
    # The last sample may be missing: the recording ends with the run.
    assert len(before) - 1 <= len(after) <= len(before)
    assert after == before[: len(after)]
    truth = lines(played, "truth.tum")
    assert truth[:-1] == lines(navigation.path, "truth.tum")[: len(truth) - 1]


def test_so_does_one_of_the_kinematic_twin(kinematic: Any, play: Play) -> None:
    after = lines(play(kinematic.bag, "--duration", "8"))
    assert len(after) > 390
    assert after == lines(kinematic.path)[: len(after)]


def test_played_back_the_mission_ends_as_it_did(navigation: Any, played: Path) -> None:
    first, second = navigation.report, report(played)
    assert second["outcome"] in ("reached", "played")
    assert second["sim_seconds"] == pytest.approx(first["sim_seconds"], abs=0.15)
    for name in ("position_rmse_m", "heading_rmse_deg", "nees_mean", "path_length_m"):
        assert second["metrics"][name] == pytest.approx(first["metrics"][name], rel=0.01), name
    accepted = second["health"]["estimator"]["accepted"]
    assert abs(accepted - first["health"]["estimator"]["accepted"]) <= 2


def test_played_back_through_the_detector_the_estimates_are_the_same(
    rendered: Any, play: Play
) -> None:
    before, after = lines(rendered.path), lines(play(rendered.bag))
    assert len(before) - 1 <= len(after) <= len(before)
    assert after == before[: len(after)]
    # It was the detector that found the markers, not the detections that were recorded too.
    blind = play(rendered.bag, "--set", "robot.sensors.front_camera.detector.min_side=200")
    assert lines(blind) == []


def test_pictures_and_the_detections_in_them_are_recorded_together(rendered: Any) -> None:
    bag = BagReader(rendered.bag)
    stamps = {}
    for name in ("image/compressed", "detections"):
        messages = [m for _, _, m in bag.messages([f"/robot/front_camera/{name}"])]
        stamps[name] = [m.header.stamp.sec + m.header.stamp.nanosec * 1e-9 for m in messages]
    np.testing.assert_allclose(stamps["detections"], np.arange(45) / 15, atol=1e-9)
    assert stamps["image/compressed"] == stamps["detections"]


def test_another_filter_on_the_same_recording_estimates_otherwise(
    navigation: Any, play: Play
) -> None:
    arguments = ("--duration", "6", "--set")
    same = lines(play(navigation.bag, *arguments, "estimator.speed_noise=0.05"))
    other = lines(play(navigation.bag, *arguments, "estimator.speed_noise=0.005"))
    assert same == lines(navigation.path)[: len(same)]
    assert len(other) == len(same)
    assert other != same
    # The robot drives where it drove: only the estimate is another.
    moved = np.loadtxt(other)[:, 1:3] - np.loadtxt(same)[:, 1:3]
    assert 1e-5 < np.abs(moved).max() < 0.1


def test_the_station_hears_the_commands_that_were_sent(navigation: Any, play: Play) -> None:
    # A controller that would drive elsewhere changes nothing of what is estimated.
    arguments = ("--duration", "6", "--set", "controller.max_speed=0.01")
    played = lines(play(navigation.bag, *arguments))
    assert played == lines(navigation.path)[: len(played)]


def test_a_recording_without_truth_is_estimated_without_score(
    navigation: Any, play: Play, tmp_path: Path
) -> None:
    folder = play(copy(navigation.bag, tmp_path / "real", leave_out="/truth"), "--duration", "4")
    metrics = report(folder)["metrics"]
    for name in ("position_rmse_m", "heading_rmse_deg", "nees_mean", "nees_in_bounds"):
        assert metrics[name] is None
    assert metrics["path_length_m"] > 0.5
    assert lines(folder) == lines(navigation.path)[: len(lines(folder))]
    assert not (folder / "truth.tum").exists()
    assert (folder / "summary.png").is_file()


def test_a_recording_that_counts_its_time_since_1970_is_played_from_its_start(
    navigation: Any, play: Play, tmp_path: Path
) -> None:
    late = copy(navigation.bag, tmp_path / "late", shift=1_700_000_000.0)
    played = lines(play(late, "--duration", "4"))
    assert len(played) > 190
    # The copy's log times are floats, good to a quarter of a microsecond in our days: what comes
    # that much late is seen a step of the filter later, 3 mm at this speed.
    expected = np.loadtxt(lines(navigation.path)[: len(played)])
    np.testing.assert_allclose(np.loadtxt(played), expected, atol=1e-2)


def test_a_recording_that_was_cut_off_plays_as_far_as_it_goes(
    navigation: Any, play: Play, tmp_path: Path
) -> None:
    data = (navigation.bag / "bag_0.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) // 3])
    folder = play(cut)
    assert report(folder)["outcome"] == "played"
    assert 5 < report(folder)["sim_seconds"] < navigation.report["sim_seconds"] / 2
    played = lines(folder)
    assert played[:-2] == lines(navigation.path)[: len(played) - 2]


def test_a_playback_is_recorded_like_a_run(navigation: Any, play: Play) -> None:
    folder = play(navigation.bag, "--duration", "3")
    first, second = BagReader(navigation.bag), BagReader(folder / "bag")
    assert second.topics() == first.topics()
    for topic in ("/robot/front_camera/detections", "/robot/imu", "/robot/drive/sent"):
        again = [(r.log_time, r.data) for r in second.records([topic])]
        assert len(again) > 40
        assert again == [(r.log_time, r.data) for r in first.records([topic])][: len(again)]


def test_a_run_is_recorded_in_ros_own_messages(navigation: Any, rendered: Any) -> None:
    expected = {
        "/robot/front_camera/camera_info": "sensor_msgs/msg/CameraInfo",
        "/robot/front_camera/detections": "apriltag_msgs/msg/AprilTagDetectionArray",
        "/robot/imu": "sensor_msgs/msg/Imu",
        "/robot/drive/sent": "geometry_msgs/msg/Twist",
        "/robot/estimate": "geometry_msgs/msg/PoseWithCovarianceStamped",
        "/truth/robot/clearance": "std_msgs/msg/Float64",
        "/truth/robot/contacts": "std_msgs/msg/UInt32",
        "/truth/robot/pose": "geometry_msgs/msg/PoseStamped",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/tf_static": "tf2_msgs/msg/TFMessage",
    }
    assert BagReader(navigation.bag).topics() == expected
    pictures = {"/robot/front_camera/image/compressed": "sensor_msgs/msg/CompressedImage"}
    assert BagReader(rendered.bag).topics() == expected | pictures


def test_another_reader_reads_the_recording(navigation: Any) -> None:
    # rosbags' own, which shares no code with our reader of MCAP.
    with Reader(navigation.bag) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        seconds = reader.duration * 1e-9
    assert seconds == pytest.approx(navigation.report["sim_seconds"], abs=0.05)
    assert counts["/robot/imu"] == pytest.approx(100 * seconds, abs=3)
    assert counts["/robot/front_camera/detections"] == pytest.approx(15 * seconds, abs=3)
    assert counts["/robot/estimate"] == pytest.approx(50 * seconds, abs=3)
    assert counts["/tf_static"] == counts["/robot/front_camera/camera_info"] == 1


def test_the_transforms_place_robot_and_camera(navigation: Any) -> None:
    bag = BagReader(navigation.bag)
    ((_, _, static),) = bag.messages(["/tf_static"])
    (mounting,) = static.transforms
    assert mounting.header.frame_id == "robot/base_link"
    assert mounting.child_frame_id == "robot/front_camera"
    p, q = mounting.transform.translation, mounting.transform.rotation
    assert (p.x, p.y, p.z) == pytest.approx((0.115, 0.0, 0.12))
    # REP 103: z forward, x to the right, y down. Roll and yaw of -90 degrees.
    assert np.sign(q.w) * np.array([q.w, q.x, q.y, q.z]) == pytest.approx([0.5, -0.5, 0.5, -0.5])
    estimates = {t: m.pose.pose.position for _, t, m in bag.messages(["/robot/estimate"])}
    for _, t, message in bag.messages(["/tf"]):
        (transform,) = message.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", "robot/base_link")
        assert transform.transform.translation.x == estimates[t].x
        assert transform.transform.translation.y == estimates[t].y
