"""Pictures, cameras and markers to ROS 2 messages, and back.

AprilTag's nodes list a marker's corners from the bottom-left counter-clockwise, ours go from the
top-left clockwise; ROS colours are what a message's encoding says, ours RGB: both are turned here
and nowhere else. The readers take ROS 1 messages too.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from systems.cameras import PinholeCamera
from systems.compiled import compiled, in_rows
from systems.io.ros_types import header, message_class, time_from_ros
from systems.markers.family import family as family_named
from systems.messages import CameraImage, Detections
from systems.validation import require

Array = NDArray[np.float64]


def image_to_ros(image: CameraImage) -> Any:
    """Returns `sensor_msgs/msg/CompressedImage`: PNG, which loses nothing.

    Raises:
        ValueError: there is no picture, or it is not uint8, grey or RGB.
    """
    data = image.data
    grey = data.ndim == 2
    require(
        data.size > 0 and data.dtype == np.uint8 and (grey or data.shape[2:] == (3,)),
        "image",
        (data.dtype.name, data.shape),
        "uint8 of (height, width) or (height, width, 3)",
    )
    picture = data if grey else cv2.cvtColor(data, cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".png", picture)
    # As ROS's compressed_image_transport names them, so that its subscribers undo the BGR.
    form = "mono8; png compressed " if grey else "rgb8; png compressed bgr8"
    return message_class("sensor_msgs/msg/CompressedImage")(
        header(image.stamp, image.frame_id), form, encoded.ravel()
    )


def image_from_ros(message: Any) -> CameraImage:
    """Returns the picture of a `CompressedImage` (PNG, JPEG) or an `Image` (mono8, rgb8, bgr8).

    Raises:
        ValueError: another encoding, or data that are not such a picture.
    """
    data = _decompress(message) if hasattr(message, "format") else _unpack(message)
    stamp = time_from_ros(message.header.stamp)
    return CameraImage(stamp=stamp, frame_id=message.header.frame_id, data=data)


def _decompress(message: Any) -> NDArray[np.uint8]:
    try:
        picture = cv2.imdecode(np.asarray(message.data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        picture = None
    if picture is None or picture.dtype != np.uint8 or picture.shape[2:] not in ((), (3,)):
        raise ValueError(f"format is {message.format!r}: data must be a grey or colour PNG or JPEG")
    return np.asarray(picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))


def _unpack(message: Any) -> NDArray[np.uint8]:
    channels = {"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3}.get(message.encoding)
    if channels is None:
        raise ValueError(f"encoding is {message.encoding!r}: must be mono8, rgb8 or bgr8")
    height, width, step = message.height, message.width, message.step
    data = np.asarray(message.data, np.uint8)
    if step < width * channels or data.size < height * step:
        raise ValueError(f"{data.size} bytes: too few for {width}x{height} {message.encoding}")
    rows = data[: height * step].reshape(height, step)[:, : width * channels]
    if channels == 1:
        return rows.copy()
    picture = rows.reshape(height, width, 3)
    return picture[..., ::-1].copy() if message.encoding == "bgr8" else picture.copy()


def camera_to_ros(camera: PinholeCamera, *, stamp: float, frame_id: str) -> Any:
    """Returns `sensor_msgs/msg/CameraInfo` (plumb_bob, not rectified, no region of interest).

    Pixels count from the first one's centre in both.
    """
    projection = np.column_stack([camera.K, np.zeros(3)])
    return message_class("sensor_msgs/msg/CameraInfo")(
        header=header(stamp, frame_id),
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob",
        d=camera.D.copy(),
        k=camera.K.ravel(),
        r=np.eye(3).ravel(),
        p=projection.ravel(),
        binning_x=0,
        binning_y=0,
        roi=message_class("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False),
    )


def camera_from_ros(message: Any) -> PinholeCamera:
    """Returns the camera of a `CameraInfo`.

    Raises:
        ValueError: another distortion model than plumb_bob, a part of the sensor only, or numbers
            that make no camera (an uncalibrated one says 0).
    """
    model = message.distortion_model
    require(model in ("plumb_bob", ""), "distortion_model", model, "plumb_bob")
    binning = max(message.binning_x, message.binning_y)
    require(binning <= 1, "binning", binning, "0 or 1")
    roi = message.roi
    require(
        (roi.width, roi.height) in ((0, 0), (message.width, message.height)),
        "roi",
        (roi.width, roi.height),
        "the whole picture",
    )
    K, D = (message.k, message.d) if hasattr(message, "k") else (message.K, message.D)  # ROS 1
    return PinholeCamera(message.width, message.height, np.asarray(K), np.asarray(D))


def detections_to_ros(detections: Detections) -> Any:
    """Returns `apriltag_msgs/msg/AprilTagDetectionArray`.

    Corners in AprilTag's order, in float64; the decision margin in float32; centre and homography
    follow from the corners. An empty array does not say its family.
    """
    array = message_class("apriltag_msgs/msg/AprilTagDetectionArray")
    if not len(detections):
        return array(header(detections.stamp, detections.frame_id), [])
    point = message_class("apriltag_msgs/msg/Point")
    detection = message_class("apriltag_msgs/msg/AprilTagDetection")
    H = homographies(detections.corners)
    columns = zip(
        detections.ids.tolist(),
        detections.hamming.tolist(),
        detections.decision_margin.tolist(),
        H[:, :2, 2].tolist(),
        detections.corners[:, ::-1].tolist(),
        H.reshape(-1, 9),
        strict=True,
    )
    found = [
        detection(
            family=detections.family,
            id=number,
            hamming=bits,
            goodness=0.0,  # AprilTag 3 has none
            decision_margin=margin,
            centre=point(*centre),
            corners=[point(x, y) for x, y in corners],
            homography=homography,
        )
        for number, bits, margin, centre, corners, homography in columns
    ]
    return array(header(detections.stamp, detections.frame_id), found)


def detections_from_ros(
    message: Any, *, family: str | None = None, offset: float = 0.0
) -> Detections:
    """Returns the markers of an `AprilTagDetectionArray`.

    Also those of `ApriltagArrayStamped`, which TagSLAM records.

    Args:
        message: the message.
        family: which family they are, when the message names one by a name of its own, or none.
        offset: added to the corners, px. AprilTag's own nodes count pixels from the corner of the
            first one: -0.5 makes their corners ours.

    Raises:
        ValueError: no or several families, or an unknown one.
    """
    entries = tags_of(message)
    names = {family} if family else {entry.family for entry in entries}
    require(len(names) <= 1, "families", sorted(names), "one in an array")
    corners = [[(p.x, p.y) for p in reversed(entry.corners)] for entry in entries]
    return Detections(
        stamp=time_from_ros(message.header.stamp),
        frame_id=message.header.frame_id,
        family=family_named(names.pop()).name if names else "",
        ids=np.array([entry.id for entry in entries], np.int64),
        corners=np.array(corners, float).reshape(-1, 4, 2) + offset,
        hamming=np.array([entry.hamming for entry in entries], np.int64),
        decision_margin=np.array([getattr(e, "decision_margin", math.nan) for e in entries], float),
    )


def tags_of(message: Any) -> list[Any]:
    """Returns the entries of an `AprilTagDetectionArray` or an `ApriltagArrayStamped`."""
    return list(message.detections if hasattr(message, "detections") else message.apriltags)


def homographies(corners: Array) -> Array:
    """Returns the homography of each marker, as AprilTag 3 defines it.

    It maps the marker's plane, in which the corners are at +-1, x right and y down, to pixels.

    Args:
        corners: (n, 4, 2) px, in our order.

    Returns:
        (n, 3, 3) with a 1 at the lower right; not finite for corners on a line.

    Source: Heckbert, "Fundamentals of texture mapping and image warping", 1989, section 2.2.3.
    """
    H = np.empty((len(corners), 3, 3))
    _homographies(in_rows(corners, 4, 2), H)
    return H


@compiled("void(f8[:,:,::1], f8[:,:,::1])")
def _homographies(corners: Array, H: Array) -> None:
    for n in range(len(corners)):
        (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners[n]
        px, py, qx, qy = bx - cx, by - cy, dx - cx, dy - cy
        sx, sy = ax - bx + cx - dx, ay - by + cy - dy
        area = px * qy - py * qx
        g, h = (sx * qy - sy * qx) / area, (px * sy - py * sx) / area
        # From the unit square it would be [u v a; g h 1]; half of that, from its middle.
        scale = 1 + (g + h) / 2
        for i in range(2):
            a, b, d = corners[n, 0, i], corners[n, 1, i], corners[n, 3, i]
            u, v = b - a + g * b, d - a + h * d
            H[n, i, 0], H[n, i, 1] = u / 2 / scale, v / 2 / scale
            H[n, i, 2] = (a + (u + v) / 2) / scale
        H[n, 2, 0], H[n, 2, 1], H[n, 2, 2] = g / 2 / scale, h / 2 / scale, 1.0
