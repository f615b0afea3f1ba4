"""Pictures, cameras and markers to ROS messages, and back."""

from __future__ import annotations

import apriltag
import cv2
import numpy as np
import pytest

from systems.cameras import PinholeCamera
from systems.io.ros_types import header, message_class, typestore
from systems.io.ros_vision import (
    camera_from_ros,
    camera_to_ros,
    detections_from_ros,
    detections_to_ros,
    homographies,
    image_from_ros,
    image_to_ros,
)
from systems.markers.family import family
from systems.messages import CameraImage, Detections

COMPRESSED = "sensor_msgs/msg/CompressedImage"
RAW = "sensor_msgs/msg/Image"
CAMERA = "sensor_msgs/msg/CameraInfo"
TAGS = "apriltag_msgs/msg/AprilTagDetectionArray"


def over_the_wire(message, msgtype):
    """The message after CDR and back, by another serialiser than ours: rosbags'."""
    store = typestore()
    return store.deserialize_cdr(bytes(store.serialize_cdr(message, msgtype)), msgtype)


def noise(*shape):
    return np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)


def raw_image(data, encoding, step=None):
    height, width = data.shape[:2]
    row = data.reshape(height, -1)
    step = step or row.shape[1]
    padded = np.full((height, step), 77, np.uint8)
    padded[:, : row.shape[1]] = row
    return message_class(RAW)(
        header(1.5, "camera"), height, width, encoding, 0, step, padded.ravel()
    )


@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 3), (1, 1), (7, 3, 3)])
def test_a_picture_survives_exactly(shape):
    image = CameraImage(stamp=12.345678901, frame_id="front/optical", data=noise(*shape))
    back = image_from_ros(over_the_wire(image_to_ros(image), COMPRESSED))
    assert (back.stamp, back.frame_id) == (image.stamp, image.frame_id)
    assert back.data.dtype == np.uint8
    np.testing.assert_array_equal(back.data, image.data)


def test_red_is_red_for_others():
    red = np.zeros((2, 2, 3), np.uint8)
    red[..., 0] = 255
    message = image_to_ros(CameraImage(stamp=0.0, data=red))
    decoded = cv2.imdecode(message.data, cv2.IMREAD_COLOR)  # OpenCV: blue first
    assert decoded[0, 0].tolist() == [0, 0, 255]
    assert message.format == "rgb8; png compressed bgr8"


def test_jpeg_is_read():
    ramp = np.add.outer(np.arange(48), np.arange(64)).astype(np.uint8)
    colour = np.stack([ramp, 255 - ramp, ramp // 2], axis=-1)
    data = cv2.imencode(".jpg", colour[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].ravel()
    back = image_from_ros(message_class(COMPRESSED)(header(0.0, ""), "jpeg", data))
    assert np.abs(back.data.astype(int) - colour).mean() < 3  # red and blue swapped: over 50


@pytest.mark.parametrize("extra", [0, 5])
def test_raw_pictures_are_read_with_and_without_padded_rows(extra):
    grey, colour = noise(5, 7), noise(5, 7, 3)
    for data, encoding, expected in (
        (grey, "mono8", grey),
        (colour, "rgb8", colour),
        (colour[..., ::-1], "bgr8", colour),
    ):
        step = data[0].size + extra
        message = over_the_wire(raw_image(np.ascontiguousarray(data), encoding, step), RAW)
        back = image_from_ros(message)
        np.testing.assert_array_equal(back.data, expected)
        assert back.stamp == 1.5


def test_pictures_that_are_none_are_refused():
    with pytest.raises(ValueError, match="encoding is 'bayer_rggb8'"):
        image_from_ros(raw_image(noise(4, 4), "bayer_rggb8"))
    short = raw_image(noise(4, 4), "mono8")
    short.data = short.data[:-1]
    with pytest.raises(ValueError, match="too few for 4x4 mono8"):
        image_from_ros(short)
    for data in (noise(100), np.zeros(0, np.uint8), np.frombuffer(b"\x89PNG\r\n\x1a\n", np.uint8)):
        with pytest.raises(ValueError, match="format is 'png'"):
            image_from_ros(message_class(COMPRESSED)(header(0.0, ""), "png", data))
    deep = cv2.imencode(".png", np.zeros((4, 4), np.uint16))[1].ravel()
    with pytest.raises(ValueError, match="grey or colour"):
        image_from_ros(message_class(COMPRESSED)(header(0.0, ""), "png", deep))


@pytest.mark.parametrize(
    "data", [np.zeros((0, 0), np.uint8), np.zeros((4, 4)), np.zeros((4, 4, 4), np.uint8)]
)
def test_only_pictures_are_written(data):
    with pytest.raises(ValueError, match="image is"):
        image_to_ros(CameraImage(stamp=0.0, data=data))


def test_a_camera_survives_exactly():
    camera = PinholeCamera(
        1280,
        960,
        np.array([[1014.3431, 0, 637.246371], [0, 1011.69373, 469.566378], [0, 0, 1]]),
        np.array([0.157005801, -0.286270492, -5.60164774e-05, 0.00158636209, 1 / 3]),
    )
    message = over_the_wire(camera_to_ros(camera, stamp=2.0, frame_id="front"), CAMERA)
    back = camera_from_ros(message)
    assert (back.width, back.height) == (1280, 960)
    np.testing.assert_array_equal(back.K, camera.K)
    np.testing.assert_array_equal(back.D, camera.D)
    # What a ROS node does with P: it projects a point as our undistorted camera does.
    point = np.array([0.1, -0.2, 2.0])
    u, v, w = np.asarray(message.p).reshape(3, 4) @ [*point, 1.0]
    undistorted = PinholeCamera(1280, 960, camera.K)
    np.testing.assert_allclose([u / w, v / w], undistorted.project(point), rtol=1e-14)


def test_cameras_that_we_cannot_be_are_refused():
    message = camera_to_ros(PinholeCamera.from_focal_length(8, 6, 5.0), stamp=0.0, frame_id="")
    for changes, text in (
        ({"distortion_model": "equidistant"}, "distortion_model"),
        ({"binning_x": 2}, "binning"),
        ({"roi": message_class("sensor_msgs/msg/RegionOfInterest")(0, 0, 3, 4, False)}, "roi"),
        ({"k": np.zeros(9)}, "K is"),
    ):
        changed = over_the_wire(message, CAMERA)
        for name, value in changes.items():
            setattr(changed, name, value)
        with pytest.raises(ValueError, match=text):
            camera_from_ros(changed)


def some_detections(n=5):
    rng = np.random.default_rng(3)
    square = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    corners = rng.uniform(50, 400, (n, 1, 2)) + 20 * square + rng.uniform(-3, 3, (n, 4, 2))
    return Detections(
        stamp=0.1,
        frame_id="front",
        family="DICT_4X4_50",
        ids=rng.integers(0, 50, n),
        corners=corners,
        hamming=rng.integers(0, 3, n),
        decision_margin=rng.uniform(0, 100, n),
    )


def test_detections_survive_exactly_but_for_the_margin():
    detections = some_detections()
    back = detections_from_ros(over_the_wire(detections_to_ros(detections), TAGS))
    assert (back.stamp, back.frame_id, back.family) == (0.1, "front", "DICT_4X4_50")
    np.testing.assert_array_equal(back.ids, detections.ids)
    np.testing.assert_array_equal(back.corners, detections.corners)
    np.testing.assert_array_equal(back.hamming, detections.hamming)
    np.testing.assert_array_equal(
        back.decision_margin, detections.decision_margin.astype(np.float32)
    )
    assert back.ids.dtype == back.hamming.dtype == np.int64


def test_no_detections_survive():
    nothing = Detections(stamp=3.0, frame_id="front", family="tag36h11")
    back = detections_from_ros(over_the_wire(detections_to_ros(nothing), TAGS))
    assert (len(back), back.stamp, back.family) == (0, 3.0, "")
    assert back.corners.shape == (0, 4, 2)
    again = detections_from_ros(detections_to_ros(nothing), family="36h11")
    assert again.family == "tag36h11"


def test_the_homography_maps_the_corners_of_the_marker():
    detections = some_detections()
    square = np.array([[-1.0, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
    for H, corners in zip(homographies(detections.corners), detections.corners, strict=True):
        mapped = square @ H.T
        np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], corners, atol=1e-10)
        assert H[2, 2] == 1.0
    assert not np.isfinite(homographies(np.zeros((1, 4, 2)))).all()


def as_apriltag_ros_publishes(found):
    """The message of a detection, copied field by field as christianrauch/apriltag_ros does."""
    point = message_class("apriltag_msgs/msg/Point")
    return message_class(TAGS)(
        header(1.0, "camera"),
        [
            message_class("apriltag_msgs/msg/AprilTagDetection")(
                "tag36h11",
                int(one["id"]),
                int(one["hamming"]),
                0.0,
                float(one["margin"]),
                point(*map(float, one["center"])),
                [point(*map(float, corner)) for corner in one["lb-rb-rt-lt"]],
                np.asarray(one["homography"], float).ravel(),
            )
            for one in found
        ],
    )


@pytest.fixture(scope="module")
def photographed():
    """A picture of tag36h11 number 42 in perspective, its true corners, what AprilTag 3 finds."""
    cells = family("tag36h11").cell_image(42)
    scale = 32
    sheet = cv2.resize(cells, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    low, high = scale - 0.5, scale + 8 * scale - 0.5
    on_sheet = np.array([[low, low], [high, low], [high, high], [low, high]], np.float32)
    corners = np.array([[210, 140], [430, 165], [415, 350], [190, 330]], np.float32)
    H = cv2.getPerspectiveTransform(on_sheet, corners)
    picture = cv2.warpPerspective(sheet, H, (640, 480), flags=cv2.INTER_LINEAR, borderValue=255)
    return corners, apriltag.apriltag("tag36h11").detect(picture)


def test_a_recording_of_apriltag_ros_gives_the_corners_in_our_order(photographed):
    corners, found = photographed
    message = over_the_wire(as_apriltag_ros_publishes(found), TAGS)
    detections = detections_from_ros(message, offset=-0.5)
    assert detections.ids.tolist() == [42]
    assert detections.family == "tag36h11"
    np.testing.assert_allclose(detections.corners[0], corners, atol=0.3)


def test_apriltag_ros_would_write_what_we_write(photographed):
    _, found = photographed
    theirs = as_apriltag_ros_publishes(found).detections[0]
    detections = detections_from_ros(as_apriltag_ros_publishes(found))
    ours = detections_to_ros(detections).detections[0]
    assert [(p.x, p.y) for p in ours.corners] == [(p.x, p.y) for p in theirs.corners]
    # AprilTag refines its homography and its corners in one, so they agree to its float32.
    np.testing.assert_allclose(ours.homography, theirs.homography, rtol=1e-4, atol=1e-4)
    assert ours.centre.x == pytest.approx(theirs.centre.x, abs=1e-3)
    assert ours.centre.y == pytest.approx(theirs.centre.y, abs=1e-3)


def test_families_are_normalised_and_must_be_one():
    message = detections_to_ros(some_detections(2))
    for name in ("36h11", "tag36h11", "DICT_APRILTAG_36h11"):
        for entry in message.detections:
            entry.family = name
        assert detections_from_ros(message).family == "tag36h11"
    message.detections[0].family = "25h9"
    with pytest.raises(ValueError, match="families is"):
        detections_from_ros(message)
    assert detections_from_ros(message, family="4x4_50").family == "DICT_4X4_50"
    message.detections[0].family = message.detections[1].family = "tagStandard41h12"
    with pytest.raises(ValueError, match="marker family is 'tagStandard41h12'"):
        detections_from_ros(message)
