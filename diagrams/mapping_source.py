"""What `tagtrail map` maps: the detections of a recording, or of pictures, and their camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from diagrams.schema import ScenarioError
from diagrams.sources import camera_of, cameras_of, is_recording, pictures
from systems.angles import planar_pose
from systems.cameras import PinholeCamera, load_camera
from systems.io.bag import BagReader
from systems.io.ros_motion import estimate_from_ros, transforms_from_ros
from systems.io.ros_vision import detections_from_ros, image_from_ros, tags_of
from systems.markers.detector import MarkerDetector
from systems.markers.family import Family
from systems.markers.family import family as family_named
from systems.messages import CameraImage, Detections

DETECTIONS = (
    "apriltag_msgs/msg/AprilTagDetectionArray",
    "apriltag_msgs/msg/ApriltagArrayStamped",
)
ODOMETRY = "nav_msgs/msg/Odometry"
IMAGES = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
USUAL_FAMILY = "tag36h11"
_OUTSIDE = 0.01  # of the corners may lie this far out of the picture:
_MARGIN = 2.0  # px

Array = NDArray[np.float64]
Progress = Callable[[float, float], None]


@dataclass(frozen=True, eq=False)
class Observed:
    """What was seen.

    Attributes:
        detections: in the order of the recording.
        camera: that saw it.
        family: of the markers.
        source: where the detections are from: a topic, or files.
        frame_id: the camera's optical frame, as the recording calls it; empty if it does not.
        body: the frame that the camera is mounted on; empty if nobody says.
        X_BC: pose of the camera in it.
        dropped: what of the recording could not be used, by reason.
        notes: what a person should know, a line each.
    """

    detections: list[Detections]
    camera: PinholeCamera
    family: Family
    source: str
    frame_id: str = ""
    body: str = ""
    X_BC: RigidTransform | None = None
    dropped: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def observe(
    source: Path,
    *,
    family: str | None = None,
    camera: Path | None = None,
    topic: str | None = None,
    progress: Progress | None = None,
) -> Observed:
    """Reads what there is to map.

    Args:
        source: recording, or pictures (`systems.markers.detector` looks at those): a video, or a
            folder of pictures, which count as one a second in the order of their names.
        family: of the markers; None takes what the recording says, else 36h11.
        camera: camera file; None takes the recording's own.
        topic: of detections or pictures, where a recording has several.
        progress: called with the frames done and the whole (inf: unknown).

    Raises:
        ValueError: bad input, in one line.
    """
    kind = family_named(family) if family is not None else None
    given = load_camera(camera) if camera is not None else None
    if is_recording(source):
        found = _of_recording(BagReader(source), kind, given, topic, progress)
    else:
        if topic is not None:
            raise ScenarioError(f"--topic {topic}: {source} is no recording")
        found = _of_pictures(source, kind or family_named(USUAL_FAMILY), given, progress)
    what = f"camera file {camera}" if camera is not None else "the recording's CameraInfo"
    _check_picture(found, what)
    return _without_foreign_ids(found)


def _of_recording(
    reader: BagReader,
    family: Family | None,
    given: PinholeCamera | None,
    topic: str | None,
    progress: Progress | None,
) -> Observed:
    path, kinds = reader.path, reader.topics()
    topic = _chosen(path, kinds, topic)
    camera = given or camera_of(topic, cameras_of(reader))
    if camera is None:
        raise ScenarioError(f"recording {path}: no CameraInfo in it, give --camera FILE")
    notes: list[str] = []
    if kinds[topic] in DETECTIONS:
        named, detections = _recorded(reader, topic, family, notes)
    else:
        named = family or family_named(USUAL_FAMILY)
        detector = MarkerDetector(family=named, camera=camera)
        frames = _pictures_of(reader, topic, camera)
        detections = _detected(detector, frames, progress)
    frame_id = next((found.frame_id for found in detections if found.frame_id), "")
    body, X_BC = _mounting(reader, frame_id)
    dropped = {"truncated": int(reader.truncated)}
    if reader.truncated:
        notes.append(f"recording {path} is cut off or damaged: what is there was read")
    return Observed(detections, camera, named, topic, frame_id, body, X_BC, dropped, notes)


def wheel_odometry(recording: Path, topic: str, observed: Observed) -> tuple[Array, Array]:
    """Returns stamps (m,) s and planar poses (m, 3) of a recorded `nav_msgs/Odometry`.

    Samples whose stamps do not ascend are dropped and counted (`bad_odometry`).

    Raises:
        ValueError: no such topic, or nobody says how the camera is mounted on the body.
    """
    reader = BagReader(recording)
    kinds = reader.topics()
    if kinds.get(topic) != ODOMETRY:
        have = ", ".join(sorted(t for t, kind in kinds.items() if kind == ODOMETRY))
        raise ScenarioError(f"--odometry {topic}: recording {recording} has {have or 'none'}")
    if observed.X_BC is None:
        raise ScenarioError(
            f"--odometry {topic}: /tf_static does not say where the camera is on the body"
        )
    stamps: list[float] = []
    poses: list[Array] = []
    dropped = 0
    for _, _, message in reader.messages([topic]):
        found = estimate_from_ros(message)
        pose = planar_pose(found.pose)
        if np.isfinite(pose).all() and (not stamps or found.stamp > stamps[-1]):
            stamps.append(found.stamp)
            poses.append(pose)
        else:
            dropped += 1
    observed.dropped["bad_odometry"] = dropped
    return np.array(stamps), np.reshape(poses, (-1, 3))


def _chosen(path: Path, kinds: dict[str, str], topic: str | None) -> str:
    """Returns the topic to read."""
    candidates = [t for t, kind in kinds.items() if kind in DETECTIONS]
    candidates = candidates or [t for t, kind in kinds.items() if kind in IMAGES]
    usable = sorted(t for t, kind in kinds.items() if kind in DETECTIONS + IMAGES)
    have = ", ".join(f"{t} ({kinds[t].rsplit('/', 1)[-1]})" for t in usable)
    if topic is not None:
        if topic not in usable:
            raise ScenarioError(f"--topic {topic}: recording {path} has {have or 'no such one'}")
        return topic
    if not candidates:
        all_of_them = ", ".join(f"{t} ({k})" for t, k in sorted(kinds.items()))
        raise ScenarioError(
            f"recording {path}: neither detections nor pictures in it; it has {all_of_them}"
        )
    if len(candidates) > 1:
        raise ScenarioError(f"recording {path}: choose with --topic; it has {have}")
    return candidates[0]


def _recorded(
    reader: BagReader, topic: str, family: Family | None, notes: list[str]
) -> tuple[Family, list[Detections]]:
    """Returns the family and the detections of a topic."""
    messages = [(message, log_time) for _, log_time, message in reader.messages([topic])]
    names = sorted({entry.family for message, _ in messages for entry in tags_of(message)} - {""})
    known = {name: _family_or_none(name) for name in names}
    said = sorted({kind.name for kind in known.values() if kind is not None})
    if len(said) > 1:
        raise ScenarioError(
            f"recording {reader.path}: {topic} has tags of several families: {', '.join(said)}"
        )
    if family is None:
        family = family_named(said[0] if said else USUAL_FAMILY)
        if names and not said:
            notes.append(
                f"the recording calls its family {names[0]!r}: taken as {family.name} "
                "(--family says otherwise)"
            )
    elif said and said[0] != family.name:
        raise ScenarioError(f"--family {family.name}: the recording's tags are of {said[0]}")
    found = [detections_from_ros(message, family=family.name) for message, _ in messages]
    if all(entry.stamp == 0 for entry in found):  # some recorders leave it at that
        found = [replace(f, stamp=t) for f, (_, t) in zip(found, messages, strict=True)]
    return family, found


def _family_or_none(name: str) -> Family | None:
    try:
        return family_named(name)
    except ValueError:
        return None


def _pictures_of(reader: BagReader, topic: str, camera: PinholeCamera) -> Iterator[CameraImage]:
    for _, log_time, message in reader.messages([topic]):
        image = image_from_ros(message)
        _check_size(image, camera, f"{reader.path} {topic}")
        yield image if image.stamp > 0 else replace(image, stamp=log_time)


def _of_pictures(
    source: Path, family: Family, camera: PinholeCamera | None, progress: Progress | None
) -> Observed:
    if camera is None:
        raise ScenarioError(f"{source}: pictures bring no camera, give --camera FILE")

    def frames() -> Iterator[CameraImage]:
        for k, picture in enumerate(pictures(source)):
            # A picture that is a file of its own has no time.
            image = CameraImage(stamp=picture.stamp or float(k), data=picture.image)
            _check_size(image, camera, picture.name)
            yield image

    detector = MarkerDetector(family=family, camera=camera)
    return Observed(_detected(detector, frames(), progress), camera, family, str(source))


def _detected(
    detector: MarkerDetector, frames: Iterator[CameraImage], progress: Progress | None
) -> list[Detections]:
    found = []
    for image in frames:
        entry = detector.detect(image.data, image.stamp)
        found.append(replace(entry, frame_id=image.frame_id))
        if progress is not None:
            progress(len(found), math.inf)
    return found


def _check_size(image: CameraImage, camera: PinholeCamera, name: str) -> None:
    height, width = image.data.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise ScenarioError(
            f"the camera is for pictures of {camera.width}x{camera.height}: {name} is "
            f"{width}x{height}"
        )


def _check_picture(found: Observed, what: str) -> None:
    """Refuses corners that lie outside of the camera's picture."""
    corners = [d.corners.reshape(-1, 2) for d in found.detections if len(d)]
    if not corners:
        raise ScenarioError(f"{found.source}: no tag of {found.family.name} in it")
    points = np.concatenate(corners)
    points = points[np.isfinite(points).all(axis=1)]
    size = np.array([found.camera.width, found.camera.height])
    outside = ((points < -_MARGIN) | (points > size + _MARGIN)).any(axis=1)
    if outside.mean() > _OUTSIDE:
        x, y = points.max(axis=0)
        raise ScenarioError(
            f"{what} is for pictures of {size[0]}x{size[1]}: corners lie at up to ({x:.0f}, "
            f"{y:.0f}) px"
        )


def _without_foreign_ids(found: Observed) -> Observed:
    """Leaves out ids that the family does not have."""
    detections, dropped = [], 0
    for entry in found.detections:
        own = (entry.ids >= 0) & (entry.ids < found.family.count)
        dropped += int((~own).sum())
        detections.append(entry if own.all() else entry.select(own))
    return replace(found, detections=detections, dropped=found.dropped | {"foreign_id": dropped})


def _mounting(reader: BagReader, frame_id: str) -> tuple[str, RigidTransform | None]:
    """Returns the frame at the root of the fixed transforms above the camera's, and `X_BC`."""
    if not frame_id or "/tf_static" not in reader.topics():
        return "", None
    parents: dict[str, tuple[str, RigidTransform]] = {}
    for _, _, message in reader.messages(["/tf_static"]):
        for entry in transforms_from_ros(message):
            parents[entry.child_frame_id.strip("/")] = (entry.frame_id.strip("/"), entry.pose)
    body, X_BC = frame_id.strip("/"), RigidTransform()
    passed = set()
    while body in parents and body not in passed:
        passed.add(body)
        body, X_parent = parents[body]
        X_BC = X_parent.multiply(X_BC)
    return (body, X_BC) if passed and body not in passed else ("", None)
