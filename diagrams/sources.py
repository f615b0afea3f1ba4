"""Pictures out of whatever a user has: a file, a folder, a video, a recording."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from diagrams.schema import ScenarioError
from systems.cameras import PinholeCamera
from systems.io.bag import BagReader
from systems.io.ros_vision import camera_from_ros, image_from_ros

PICTURES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")
VIDEOS = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".webm")
RECORDINGS = (".bag", ".db3", ".mcap")

# What is no video is said in a line of ours; FFmpeg would add its own. Read at the first video.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

_IMAGE_TYPES = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture of a source.

    Attributes:
        name: says where it is from; fit for a file's name.
        stamp: time within its video or recording, s; 0 for a file of its own.
        image: uint8, (height, width) grey or (height, width, 3) RGB.
        camera: the calibrated camera that took it, where the source says so.
    """

    name: str
    stamp: float
    image: NDArray[np.uint8]
    camera: PinholeCamera | None = None


def pictures(source: Path) -> Iterator[Picture]:
    """Yields the pictures of a source, in order.

    Args:
        source: a picture, a video, a recording (ROS 1 bag, rosbag2 folder, MCAP), or a folder of
            any of these.

    Raises:
        ScenarioError: nothing at the path, nothing in it that is a picture, or a file that cannot
            be read.
    """
    files = list(_files(source))
    if not files:
        kinds = " ".join((*PICTURES, *VIDEOS, *RECORDINGS))
        raise ScenarioError(f"{source}: no pictures, videos or recordings in it ({kinds})")
    for path in files:
        # Names stay short where there is one file, and tell files apart where there are several.
        prefix = f"{path.stem}_" if len(files) > 1 else ""
        if path.suffix.lower() in PICTURES:
            yield Picture(path.name, 0.0, _read_picture(path))
        elif path.suffix.lower() in VIDEOS:
            yield from _video(path, prefix)
        else:
            yield from _recording(path, prefix)


def is_recording(source: Path) -> bool:
    """Whether a path is to be read as one recording: a bag's folder, or a file that is no picture.

    Raises:
        ScenarioError: there is nothing at the path.
    """
    if not source.exists():
        raise ScenarioError(f"{source}: no such file or folder")
    if source.is_dir():
        names = [path.name for path in source.iterdir()]
        return "metadata.yaml" in names or any(name.endswith((".mcap", ".db3")) for name in names)
    return source.suffix.lower() not in (*PICTURES, *VIDEOS)


def _files(source: Path) -> Iterator[Path]:
    if not source.exists():
        raise ScenarioError(f"{source}: no such file or folder")
    if source.is_file() or (source / "metadata.yaml").is_file():
        yield source
        return
    for path in sorted(source.iterdir()):
        is_bag = path.is_dir() and (path / "metadata.yaml").is_file()
        if is_bag or path.suffix.lower() in (*PICTURES, *VIDEOS, *RECORDINGS):
            yield path


def _read_picture(path: Path) -> NDArray[np.uint8]:
    # Read through a buffer: OpenCV prints a line of its own about a path that it cannot open.
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise ScenarioError(f"{path}: {error.strerror}") from error
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if image is None:
        raise ScenarioError(f"{path}: not a picture, or a damaged one")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def _video(path: Path, prefix: str) -> Iterator[Picture]:
    video = cv2.VideoCapture(str(path))
    try:
        count = 0
        while True:
            there, image = video.read()
            if not there:
                break
            stamp = video.get(cv2.CAP_PROP_POS_MSEC) / 1000  # of the picture just read
            yield Picture(f"{prefix}{count:06d}.png", stamp, cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
            count += 1
    finally:
        video.release()
    if count == 0:
        raise ScenarioError(f"{path}: not a video that OpenCV can read")


def _recording(path: Path, prefix: str) -> Iterator[Picture]:
    reader = BagReader(path)
    topics = reader.topics()
    images = [topic for topic, kind in topics.items() if kind in _IMAGE_TYPES]
    if not images:
        have = ", ".join(f"{t} ({k})" for t, k in sorted(topics.items()))
        raise ScenarioError(f"recording {path}: no pictures in it; it has {have}")
    cameras = cameras_of(reader)
    counts = dict.fromkeys(images, 0)
    for topic, _, message in reader.messages(images):
        picture = image_from_ros(message)
        name = f"{prefix}{topic.strip('/').replace('/', '_')}_{counts[topic]:06d}.png"
        counts[topic] += 1
        yield Picture(name, picture.stamp, picture.data, camera_of(topic, cameras))


def cameras_of(reader: BagReader) -> dict[str, PinholeCamera]:
    """Returns the calibrated cameras of a recording, by the topic of their CameraInfo."""
    kinds = reader.topics()
    infos = [topic for topic, kind in kinds.items() if kind == "sensor_msgs/msg/CameraInfo"]
    cameras: dict[str, PinholeCamera] = {}
    for topic in infos:
        message = next(reader.messages([topic]), None)
        if message is None:
            continue
        try:
            cameras[topic] = camera_from_ros(message[2])
        except ValueError as error:
            raise ScenarioError(f"recording {reader.path}: {topic}: {error}") from error
    return cameras


def camera_of(topic: str, cameras: dict[str, PinholeCamera]) -> PinholeCamera | None:
    """Returns the camera whose topic shares the longest beginning with a picture's topic."""
    if len(cameras) <= 1:
        return next(iter(cameras.values()), None)
    steps = topic.split("/")

    def shared(other: str) -> int:
        pairs = zip(steps, other.split("/"), strict=False)
        return next((k for k, (a, b) in enumerate(pairs) if a != b), len(steps))

    return cameras[max(cameras, key=shared)]
