"""Marker maps: where each marker is, of which family, how large.

The file is JSON in the shape of WPILib's field layout, with the family and the size beside it:

    {"family": "DICT_4X4_50", "size": 0.1, "frame": "map",
     "tags": [{"ID": 7, "pose": {"translation": {"x": 0, "y": 0, "z": 0},
                                 "rotation": {"quaternion": {"W": 1, "X": 0, "Y": 0, "Z": 0}}}}]}

A tag may have a `size` of its own. Marker frame (as WPILib): origin at the centre of the black
square, x out of the printed face toward the viewer, y to the viewer's right, z up.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from systems.markers.family import Family, family
from systems.validation import nearest

Array = NDArray[np.float64]

_QUATERNION_TOLERANCE = 1e-3


def marker_corners(size: float) -> Array:
    """Returns the corners of a marker in its own frame: (4, 3) m, in the design's order.

    Top-left, top-right, bottom-right, bottom-left as the viewer sees the upright marker.
    """
    h = size / 2
    return np.array([[0.0, -h, h], [0.0, h, h], [0.0, h, -h], [0.0, -h, -h]])


@dataclass(frozen=True)
class Marker:
    """One marker of a map.

    Attributes:
        id: its number in the family.
        X_WM: its pose in the map's frame.
        size: side of the black square, m.
    """

    id: int
    X_WM: RigidTransform
    size: float

    def corners(self) -> Array:
        """Returns the corners in the map's frame: (4, 3) m."""
        return self.X_WM.multiply(marker_corners(self.size).T).T


@dataclass(frozen=True, eq=False)
class MarkerMap:
    """A set of markers of one family.

    Attributes:
        family: the family.
        size: side of the black square of markers that have no size of their own, m.
        markers: by id.
        frame: name of the frame that the poses are given in.
    """

    family: Family
    size: float
    markers: dict[int, Marker] = field(default_factory=dict)
    frame: str = "map"

    def __len__(self) -> int:
        return len(self.markers)

    def __iter__(self) -> Iterator[Marker]:
        return iter(self.markers.values())

    def __contains__(self, marker_id: int) -> bool:
        return marker_id in self.markers

    def corners(self, ids: NDArray[np.int64]) -> Array:
        """Returns the corners of those markers in the map's frame: (n, 4, 3) m."""
        if len(ids) == 0:
            return np.zeros((0, 4, 3))
        return np.stack([self.markers[int(i)].corners() for i in ids])

    def to_json(self) -> dict[str, Any]:
        """Returns the file's content."""
        tags = []
        for marker in self:
            q = marker.X_WM.rotation().ToQuaternion()
            x, y, z = (float(value) for value in marker.X_WM.translation())
            tag: dict[str, Any] = {
                "ID": marker.id,
                "pose": {
                    "translation": {"x": x, "y": y, "z": z},
                    "rotation": {"quaternion": {"W": q.w(), "X": q.x(), "Y": q.y(), "Z": q.z()}},
                },
            }
            if marker.size != self.size:
                tag["size"] = marker.size
            tags.append(tag)
        return {"family": self.family.name, "size": self.size, "frame": self.frame, "tags": tags}

    def save(self, path: Path) -> None:
        """Writes the marker map as JSON."""
        path.write_text(json.dumps(self.to_json(), indent=1) + "\n")


def load_map(path: Path) -> MarkerMap:
    """Reads a marker map.

    Raises:
        ValueError: the file is missing or not JSON, or its content is refused (see
            `map_from_json`); the message names the file.
    """
    try:
        content = json.loads(path.read_text())
    except OSError as error:
        raise ValueError(f"marker map {path}: {error.strerror}") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"marker map {path} is not JSON: {error}") from error
    try:
        return map_from_json(content)
    except ValueError as error:
        raise ValueError(f"marker map {path}: {error}") from error


def map_from_json(content: Any) -> MarkerMap:
    """Returns the marker map that a file's content describes.

    Raises:
        ValueError: unknown key or family, an id twice or outside the family, a quaternion that is
            not of unit length, a size that is not positive, a value that is no finite number; the
            message names which tag and which value.
    """
    # "field" is what WPILib's own files carry beside the tags: the playing field's dimensions.
    _check_keys(content, "the marker map", {"family", "size", "tags"}, {"frame", "field"})
    kind = family(_typed(content["family"], "family", str, "a name"))
    size = _positive(content["size"], "size")
    frame = _typed(content.get("frame", "map"), "frame", str, "a name")
    markers: dict[int, Marker] = {}
    for index, tag in enumerate(_typed(content["tags"], "tags", list, "a list")):
        where = f"tags[{index}]"
        _check_keys(tag, where, {"ID", "pose"}, {"size"})
        marker_id = tag["ID"]
        if isinstance(marker_id, bool) or not isinstance(marker_id, int):
            raise ValueError(f"{where}.ID is {marker_id!r}: must be a whole number")
        if marker_id in markers:
            raise ValueError(f"{where}.ID is {marker_id}: there is a tag of that ID already")
        try:
            kind.check_id(marker_id)
        except ValueError as error:
            raise ValueError(f"{where}.{error}") from None
        markers[marker_id] = Marker(
            id=marker_id,
            X_WM=_pose(tag["pose"], f"{where}.pose (ID {marker_id})"),
            size=_positive(tag.get("size", size), f"{where}.size (ID {marker_id})"),
        )
    return MarkerMap(family=kind, size=size, markers=markers, frame=frame)


def _pose(content: Any, where: str) -> RigidTransform:
    _check_keys(content, where, {"translation", "rotation"}, set())
    _check_keys(content["translation"], f"{where}.translation", {"x", "y", "z"}, set())
    _check_keys(content["rotation"], f"{where}.rotation", {"quaternion"}, set())
    quaternion = content["rotation"]["quaternion"]
    _check_keys(quaternion, f"{where}.rotation.quaternion", {"W", "X", "Y", "Z"}, set())
    p = [_number(content["translation"][k], f"{where}.translation.{k}") for k in "xyz"]
    q = np.array([_number(quaternion[k], f"{where}.rotation.quaternion.{k}") for k in "WXYZ"])
    length = float(np.linalg.norm(q))
    if abs(length - 1) > _QUATERNION_TOLERANCE:
        raise ValueError(
            f"{where}.rotation.quaternion is of length {length:.6g}: must be of length 1"
        )
    return RigidTransform(RotationMatrix(Quaternion(q / length)), p)


def _check_keys(content: Any, where: str, needed: set[str], optional: set[str]) -> None:
    if not isinstance(content, dict):
        raise ValueError(f"{where} is {content!r}: must be an object with {sorted(needed)}")
    for key in content:
        if key not in needed | optional:
            raise ValueError(
                f"{where} has the unknown key {key!r}: {nearest(key, needed | optional)}"
            )
    for key in sorted(needed - set(content)):
        raise ValueError(f"{where} lacks the key {key!r}")


def _typed(value: Any, where: str, kind: type, allowed: str) -> Any:
    if not isinstance(value, kind):
        raise ValueError(f"{where} is {value!r}: must be {allowed}")
    return value


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{where} is {value!r}: must be a finite number")
    return float(value)


def _positive(value: Any, where: str) -> float:
    if _number(value, where) <= 0:
        raise ValueError(f"{where} is {value!r}: must be greater than 0 (metres)")
    return float(value)
