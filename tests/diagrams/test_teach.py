"""Teaching by the scripted driver: the run, its recording, its report, what is refused."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform, RotationMatrix

from diagrams.run import simulate
from diagrams.scenario import load_scenario
from plants.circuit import in_view
from plants.circuit_parameters import CircuitCamera, CircuitParameters
from systems.cameras import load_camera
from systems.io.bag import BagReader
from systems.io.ros_motion import estimate_from_ros, odometry_from_ros, transforms_from_ros
from systems.io.ros_vision import camera_from_ros, detections_from_ros
from systems.mapping.chain import gated_chain
from systems.mapping.gathering import gather
from systems.markers.layout import load_map
from systems.planners.closed_curve import ClosedCurve

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[2]
CAMERA = load_camera(ROOT / "diagrams/cameras/limo.yaml")
PROJECTED = ("--no-meshcat", "--set", "sight=projected")
FAST = ("--set", "driver={type: scripted, speed: 0.6}", "--set", "dynamics=kinematic")


@pytest.fixture(scope="module")
def taught(tagtrail: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled scenario to its end: projected sight, multibody."""
    folder = tmp_path_factory.mktemp("teach")
    result = tagtrail("run", "teach", *PROJECTED, "--seed", "2", "--out", folder)
    assert (result.status, result.err) == (0, ""), result
    return folder


def report(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return found


def poses(path: Path) -> tuple[Array, list[RigidTransform]]:
    """Reads a TUM file."""
    rows = np.loadtxt(path)
    found = []
    for row in rows:
        x, y, z, w = row[4:]
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        found.append(RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), row[1:4]))
    return rows[:, 0], found


def test_it_is_driven_round_once_and_seen_to_be(taught: Path) -> None:
    found = report(taught)
    assert found["outcome"] == "taught"
    m = found["metrics"]
    assert m["anchor_seen_at_start"]
    assert m["anchor_seen_at_end"]
    assert m["tags_seen"] == m["tags_total"] == 24
    # As the installer promises, though the driver sways.
    assert m["low_observability_frames"] == 0
    assert m["two_tag_fraction"] == 1.0
    assert m["frames"] == pytest.approx(10 * found["sim_seconds"], abs=3)
    assert m["path_length_m"] == pytest.approx(15.2, abs=0.3)
    assert m["mean_speed"] == pytest.approx(0.3, rel=0.02)
    assert m["speed_deviation"] < 0.03
    assert m["nearest_tag_m"] > 0.35
    # Odometry whose track is 1.3 % wrong turns 5 degrees too little.
    assert 0.02 < m["odometry_error_m"] < 0.6
    # What optimisation is to mend.
    assert 0.2 < m["naive_tag_error_mean_m"] < 6.0
    assert 0.02 < m["gated_tag_error_mean_m"] < 0.25
    assert m["gated_trajectory_error_mean_m"] < 0.25
    assert m["gated_tag_error_mean_m"] < 0.4 * m["naive_tag_error_mean_m"]


def test_the_truth_stays_on_the_circuit(taught: Path) -> None:
    scenario = load_scenario(str(taught / "scenario.yaml"))
    _, truth = poses(taught / "truth.tum")
    places = np.array([X.translation()[:2] for X in truth])
    curve = ClosedCurve(scenario.route)
    assert curve.distances(places).max() < 0.08
    for tag in scenario.world.marker_map():
        assert np.hypot(*(places - tag.X_WM.translation()[:2]).T).min() > 0.35


def test_the_folder_holds_what_it_should(taught: Path) -> None:
    names = {str(p.relative_to(taught)) for p in taught.rglob("*") if p.is_file()}
    assert names == {
        "report.json", "scenario.yaml", "summary.png", "anchor.json", "truth.tum",
        "truth_camera.tum", "naive_camera.tum", "gated_camera.tum", "bag/bag_0.mcap",
        "bag/metadata.yaml",
    }  # fmt: skip
    anchor = load_map(taught / "anchor.json")
    bundled = load_map(ROOT / "diagrams/maps/circuit.json")
    assert list(anchor.markers) == [0]
    assert anchor.markers[0].X_WM.IsNearlyEqualTo(bundled.markers[0].X_WM, 1e-12)


def test_the_recording_is_of_standard_messages(taught: Path) -> None:
    assert BagReader(taught / "bag").topics() == {
        "/limo/front_camera/camera_info": "sensor_msgs/msg/CameraInfo",
        "/limo/front_camera/detections": "apriltag_msgs/msg/AprilTagDetectionArray",
        "/limo/imu": "sensor_msgs/msg/Imu",
        "/limo/encoders": "sensor_msgs/msg/JointState",
        "/limo/odom": "nav_msgs/msg/Odometry",
        "/limo/drive/sent": "geometry_msgs/msg/Twist",
        "/limo/camera_pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
        "/limo/low_observability": "std_msgs/msg/Bool",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/tf_static": "tf2_msgs/msg/TFMessage",
        "/truth/limo/pose": "geometry_msgs/msg/PoseStamped",
        "/truth/limo/clearance": "std_msgs/msg/Float64",
        "/truth/limo/contacts": "std_msgs/msg/UInt32",
    }


def test_what_is_recorded_is_what_was_seen(taught: Path) -> None:
    reader = BagReader(taught / "bag")
    markers = load_map(ROOT / "diagrams/maps/circuit.json")
    (_, _, static), *_ = reader.messages(["/tf_static"])
    (mounting,) = transforms_from_ros(static)
    assert (mounting.frame_id, mounting.child_frame_id) == ("limo/base_link", "limo/front_camera")
    np.testing.assert_allclose(mounting.pose.translation(), [0.1, 0.0, 0.18])
    (_, _, info), *_ = reader.messages(["/limo/front_camera/camera_info"])
    np.testing.assert_allclose(camera_from_ros(info).K, CAMERA.K)
    t, cameras = poses(taught / "truth_camera.tum")
    true = dict(zip(t.round(6), cameras, strict=True))
    detections = {
        d.stamp: d
        for _, _, m in reader.messages(["/limo/front_camera/detections"])
        for d in [detections_from_ros(m)]
    }
    assert len(detections) >= len(true)
    # Corners are where the true camera sees them, within the noise of 0.3 px.
    residuals = []
    for stamp, X_WC in true.items():
        found = detections[stamp]
        for tag, corners in zip(found.ids, found.corners, strict=True):
            p_C = X_WC.inverse().multiply(markers.markers[int(tag)].corners().T).T
            residuals.append(CAMERA.project(p_C) - corners)
    assert np.array(residuals).std() == pytest.approx(0.3, abs=0.1)
    # cam_T_tag of every tag of a picture, and world_T_cam where the anchor is seen.
    transforms = [tf for _, _, m in reader.messages(["/tf"]) for tf in transforms_from_ros(m)]
    assert {tf.child_frame_id for tf in transforms} == {f"tag36h11:{k}" for k in range(24)}
    assert len(transforms) == sum(len(d) for d in detections.values())
    estimates = [estimate_from_ros(m) for _, _, m in reader.messages(["/limo/camera_pose"])]
    with_anchor = [d.stamp for d in detections.values() if 0 in d.ids]
    assert [e.stamp for e in estimates] == with_anchor
    errors = [
        float(np.linalg.norm(e.pose.translation() - true[round(e.stamp, 6)].translation()))
        for e in estimates
        if round(e.stamp, 6) in true
    ]
    assert 0.01 < np.median(errors) < 0.5
    anchored = {tf.stamp: tf.pose for tf in transforms if tf.child_frame_id == "tag36h11:0"}
    for e in estimates[::7]:
        X = markers.markers[0].X_WM @ anchored[e.stamp].inverse()
        assert X.IsNearlyEqualTo(e.pose, 1e-9)


def test_odometry_is_recorded(taught: Path) -> None:
    readings = [
        (t, *odometry_from_ros(m), m) for t, _, m in (
            (t, topic, m) for topic, t, m in BagReader(taught / "bag").messages(["/limo/odom"])
        )
    ]  # fmt: skip
    assert readings[0][-1].header.frame_id == "limo/odom"
    assert readings[0][-1].child_frame_id == "limo/base_link"
    speeds = np.array([velocity[0] for _, _, _, velocity, _ in readings])
    assert np.median(speeds) == pytest.approx(0.3, rel=0.02)
    variances = np.array([np.diag(P) for _, _, P, _, _ in readings])
    assert (np.diff(variances, axis=0)[:, 2] >= 0).all()  # of the heading: it only grows
    _, truth = poses(taught / "truth.tum")
    start = truth[0]
    for t, pose, _, _, _ in readings[:: len(readings) // 6]:
        true = start.inverse() @ truth[min(round(t * 50), len(truth) - 1)]
        assert np.hypot(*(pose[:2] - true.translation()[:2])) < 0.02 + 0.015 * 0.3 * t + 0.3


def test_the_recording_can_be_chained_again(taught: Path) -> None:
    found = (
        detections_from_ros(m)
        for _, _, m in BagReader(taught / "bag").messages(["/limo/front_camera/detections"])
    )
    markers = load_map(ROOT / "diagrams/maps/circuit.json")
    gathered = gather(found, camera=CAMERA, size=0.18)
    chained = gated_chain(gathered.sightings, anchor=0, X_W_anchor=markers.markers[0].X_WM)
    true = np.array([markers.markers[int(i)].X_WM.translation() for i in gathered.ids])
    errors = np.linalg.norm(chained.scene.p_WT - true, axis=1)[1:]
    assert errors.mean() == pytest.approx(
        report(taught)["metrics"]["gated_tag_error_mean_m"], rel=0.05
    )


def test_a_seed_is_a_run(tagtrail: Callable[..., Any], tmp_path: Path) -> None:
    metrics = []
    for k, seed in enumerate(("2", "2", "3")):
        arguments = (*PROJECTED, *FAST, "--duration", "12", "--seed", seed)
        result = tagtrail("run", "teach", *arguments, "--out", tmp_path / str(k))
        assert result.status == 1
        metrics.append(report(tmp_path / str(k))["metrics"])
    assert metrics[0] == metrics[1] != metrics[2]
    assert report(tmp_path / "0")["outcome"] == "timeout"
    assert not metrics[0]["anchor_seen_at_end"]


def test_a_recording_is_played_back(
    taught: Path, tagtrail: Callable[..., Any], tmp_path: Path
) -> None:
    result = tagtrail("run", "teach", "--no-meshcat", "--play", taught / "bag", "--out", tmp_path)
    assert (result.status, result.err) == (0, "")
    before, after = report(taught)["metrics"], report(tmp_path)["metrics"]
    assert report(tmp_path)["outcome"] == "played"
    # The same pictures, so the same maps to the last bit; the way is told less often.
    of_pictures = [key for key in before if "tag" in key or "frames" in key]
    assert len(of_pictures) > 12
    for key in of_pictures:
        assert after[key] == before[key], key
    assert after["path_length_m"] == pytest.approx(before["path_length_m"], rel=0.01)
    assert after["odometry_error_m"] == pytest.approx(before["odometry_error_m"], abs=0.01)


def test_the_replay_shows_what_was_chained(tmp_path: Path) -> None:
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    settings = {"sight": "projected", "dynamics": "kinematic", "duration": 6.0}
    run = simulate(load_scenario("teach", settings), out=tmp_path, meshcat=meshcat)
    placed = run.mission.chains(run.context)["naive"].tags()  # type: ignore[attr-defined]
    assert len(placed) >= 4
    for tag in range(24):
        assert meshcat.HasPath(f"frames/true/tag {tag}/x")
        assert meshcat.HasPath(f"frames/chained/tag {tag}/x") == (tag in placed)
    assert meshcat.HasPath("frames/chained/path/0")
    assert meshcat.HasPath("frames/route/20")


def test_few_tags_do_not_end_it(tagtrail: Callable[..., Any], tmp_path: Path) -> None:
    faults = "robot.faults=[{signal: front_camera.detections, kind: silent, start: 6, duration: 4}]"
    hidden = "robot.sensors.front_camera.projector.max_range=1.3"
    arguments = (*PROJECTED, *FAST, "--set", faults, "--set", hidden)
    result = tagtrail("run", "teach", *arguments, "--out", tmp_path)
    assert result.status in (0, 1), result.err
    m = report(tmp_path)["metrics"]
    assert m["low_observability_frames"] > 20
    assert 0 < m["two_tag_fraction"] < 0.95
    assert m["path_length_m"] > 15
    reader = BagReader(tmp_path / "bag")
    marks = [message.data for _, _, message in reader.messages(["/limo/low_observability"])]
    assert any(marks)
    assert not all(marks)


def test_a_drive_that_never_sees_the_anchor(tagtrail: Callable[..., Any], tmp_path: Path) -> None:
    faults = "robot.faults=[{signal: front_camera.detections, kind: silent, start: 0}]"
    result = tagtrail("run", "teach", *PROJECTED, *FAST, "--set", faults, "--out", tmp_path)
    assert result.status == 1
    found = report(tmp_path)
    assert found["outcome"] == "no_anchor"
    assert found["metrics"]["naive_tag_error_mean_m"] is None
    assert (tmp_path / "summary.png").exists()


def test_a_run_that_is_killed_leaves_its_recording(tmp_path: Path) -> None:
    arguments = [sys.executable, "-m", "tagtrail", "run", "teach", *PROJECTED, "--realtime", "4"]
    process = subprocess.Popen(
        [*arguments, "--out", str(tmp_path)], cwd=ROOT, stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    path, deadline = tmp_path / "bag/bag_0.mcap", time.monotonic() + 60
    last = 0.0
    while last < 5.0 and time.monotonic() < deadline:  # until five seconds of it are written
        time.sleep(0.2)
        if path.exists() and path.stat().st_size > 20_000:
            last = max(t for _, t, _ in BagReader(path).messages(["/limo/odom"]))
    process.send_signal(signal.SIGKILL)
    _, error = process.communicate()
    assert process.returncode == -signal.SIGKILL, error
    assert not (tmp_path / "report.json").exists()
    reader = BagReader(tmp_path / "bag")
    times = [t for _, t, _ in reader.messages(["/limo/front_camera/detections"])]
    assert times[-1] >= 4.5
    assert len(times) == pytest.approx(10 * times[-1], abs=3)
    found = (
        detections_from_ros(m) for _, _, m in reader.messages(["/limo/front_camera/detections"])
    )
    assert len(gather(found, camera=CAMERA, size=0.18).ids) >= 4
    assert {"/tf_static", "/limo/front_camera/camera_info", "/limo/odom"} <= set(reader.topics())


def test_a_random_circuit_from_the_seed(tagtrail: Callable[..., Any], tmp_path: Path) -> None:
    arguments = (*PROJECTED, *FAST, "--seed", "5", "--duration", "3")
    tagtrail("run", "teach_random", *arguments, "--out", tmp_path)
    scenario = load_scenario(str(tmp_path / "scenario.yaml"))
    again = load_scenario("teach_random", {"seed": 5, "sight": "projected"})
    other = load_scenario("teach_random", {"seed": 9})
    assert scenario.route == again.route != other.route
    assert scenario.world.markers == again.world.markers
    assert len(again.world.marker_map()) == 24
    position, heading = ClosedCurve(again.route).at(0.0)
    start = again.robot.start.pose()
    np.testing.assert_allclose(start[:2], position, atol=1e-9)
    assert math.remainder(start[2] - heading, 2 * math.pi) == pytest.approx(0.0, abs=1e-6)
    # A camera that looks up sees tags later: the circuit is one for it.
    upward = load_scenario(
        "teach_random", {"seed": 5, "robot.sensors.front_camera.rpy_deg": [0.0, -30.0, 0.0]}
    )
    assert upward.world.markers != again.world.markers
    p = CircuitParameters(camera=CircuitCamera(pitch_deg=-30.0))
    curve = ClosedCurve(upward.route)
    assert in_view(curve, upward.world.marker_map(), p).min() >= 2
    assert in_view(ClosedCurve(again.route), again.world.marker_map(), p).min() < 2


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        (["anchor=99"], "--set anchor: anchor is 99: must be one of the tags: 0, 1, 2"),
        (["camera=eye"], "camera is 'eye': must be one of the robot's sensors that fit: front_cam"),
        (["encoders=imu"], "encoders is 'imu': must be one of the robot's sensors that fit: enc"),
        (["route=[[0, 0], [1, 1]]"], "route: [[0.0, 0.0], [1.0, 1.0]]: must be [x, y] three"),
        (["route=[[0, 0], [1], [2, 2]]"], "route[1] is [1.0]: must be [x, y] in metres"),
        (["driver=robot"], "driver is 'robot': no such driver"),
        (["driver.speed=-1"], "speed is -1.0: must be greater than 0"),
        (["driver.spede=1"], "driver.spede: unknown key; did you mean 'speed'"),
        (["robot.drive=dc_motors"], "limo.drive is 'dc_motors': must be wheel_servo"),
        (["robot.body.track=-1"], "track is -1.0: must be greater than 0"),
        (["pixel_noise=0"], "pixel_noise is 0.0: must be greater than 0"),
        (["driver=person"], "driver is 'person': needs Meshcat's controls in the browser"),
    ],
)
def test_nonsense_is_one_line(
    refuse: Callable[..., str], tmp_path: Path, settings: list[str], line: str
) -> None:
    given = [text for value in settings for text in ("--set", value)]
    assert line in refuse("run", "teach", *PROJECTED, *given, "--out", tmp_path / "out")


def test_bad_circuits_are_one_line(refuse: Callable[..., str], tmp_path: Path) -> None:
    def line(setting: str) -> str:
        return refuse("run", "teach_random", "--no-meshcat", "--set", setting, "--out", tmp_path)

    assert "world.random.tags is 0: must be 1 or more" in line("world.random.tags=0")
    assert "world.random.tagz: unknown key" in line("world.random.tagz=3")
    assert "circuit: none of 60 of 15 m" in line("world.random.clearance=1.5")
