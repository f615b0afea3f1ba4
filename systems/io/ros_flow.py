"""Sparse optical flow to ROS 2 messages, and back. The reader takes ROS 1 messages too.

A match is a point of a cloud without a third dimension: where it is in the later picture, where it
was in the earlier one, and how much older that one was, which a cloud has no other place for.
"""

from __future__ import annotations

import math
import struct
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from systems.io.ros_types import (
    header,
    message_class,
    nanoseconds,
    sec_and_nanosec,
    seconds,
    time_from_ros,
    typestore,
)
from systems.io.stencils import SerialisedMessage
from systems.messages import PointMatches
from systems.validation import require

_PLACES = ("u", "v", "previous_u", "previous_v")  # px
_AGE = "previous_age"  # ns before the header's stamp, as lidars tell the times of their points
_POINT = np.dtype([*((name, "<f8") for name in _PLACES), (_AGE, "<u4")])
_PLACED = np.dtype([("now", "<f8", 2), ("before", "<f8", 2), (_AGE, "<u4")])  # the same
_TIME, _LENGTH, _LENGTHS = struct.Struct("=iI"), struct.Struct("=I"), struct.Struct("=II")
# By the numbers of sensor_msgs/msg/PointField.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_NUMBERS = {kind: number for number, kind in _TYPES.items()}


def matches_to_ros(matches: PointMatches) -> Any:
    """Returns `sensor_msgs/msg/PointCloud2` with the fields u, v, previous_u, previous_v (px).

    And previous_age (ns). Without matches it holds one point that is NaN, for the age; so a single
    match of NaN alone is lost.

    Raises:
        ValueError: a stamp that is not finite, or the earlier picture is not earlier, or by more
            than 4 s.
    """
    points = _cloud(matches)
    field = message_class("sensor_msgs/msg/PointField")
    return message_class("sensor_msgs/msg/PointCloud2")(
        header=header(matches.stamp, matches.frame_id),
        height=1,
        width=len(points),
        fields=[
            field(name, 8 * k, _NUMBERS[_POINT[name].str[1:]], 1)
            for k, name in enumerate((*_PLACES, _AGE))
        ],
        is_bigendian=False,
        point_step=_POINT.itemsize,
        row_step=points.size,
        data=points.ravel(),
        is_dense=_is_dense(matches),
    )


def serialised_matches(matches: PointMatches) -> SerialisedMessage:
    """Returns the bytes of what `matches_to_ros` returns, and raises what it raises.

    Their number changes, so no stencil of `systems.io.stencils` fits them.
    """
    points = _cloud(matches)
    before, after = _around(matches.frame_id)
    n = len(points)
    data = b"".join(
        (
            before[:4], _TIME.pack(*sec_and_nanosec(matches.stamp)), before[12:],
            _LENGTH.pack(n), after, _LENGTHS.pack(points.size, points.size), points.tobytes(),
            b"\1" if _is_dense(matches) else b"\0",
        )
    )  # fmt: skip
    return SerialisedMessage("sensor_msgs/msg/PointCloud2", data)


@lru_cache
def _around(frame_id: str) -> tuple[bytes, bytes]:
    """Returns the bytes of a cloud up to its width, and from there to its row's size."""
    message = matches_to_ros(PointMatches(0.0, 0.0, frame_id))
    data = bytes(typestore().serialize_cdr(message, message.__msgtype__))
    head = 12 + 4 + len(frame_id.encode()) + 1
    width = head + -head % 4 + 4
    end = len(data) - 1 - _POINT.itemsize - _LENGTHS.size
    return data[:width], data[width + 4 : end]


def _cloud(matches: PointMatches) -> NDArray[np.uint8]:
    """Returns the points, (n, bytes of a point)."""
    age = nanoseconds(matches.stamp) - nanoseconds(matches.previous_stamp)
    require(
        0 <= age < 2**32,
        "previous_stamp",
        matches.previous_stamp,
        f"up to 4.29 s before {matches.stamp}",
    )
    n = len(matches.current)
    points = np.empty(max(n, 1), _PLACED)
    points["now"] = matches.current if n else math.nan
    points["before"] = matches.previous if n else math.nan
    points[_AGE] = age
    return points.view(np.uint8).reshape(len(points), -1)


def _is_dense(matches: PointMatches) -> bool:
    places = (matches.current, matches.previous)
    return bool(len(matches.current) and all(np.isfinite(part).all() for part in places))


def matches_from_ros(message: Any) -> PointMatches:
    """Returns the matches of a `PointCloud2` with such fields, whatever others it has.

    Raises:
        ValueError: a field is lacking, or there are no points, or too few bytes for them.
    """
    points = _points(message)
    require(len(points) > 0, "width", 0, "1 or more: without a point there is no age")
    places = np.column_stack([points[name].astype(np.float64) for name in _PLACES])
    if len(places) == 1 and np.isnan(places).all():
        places = places[:0]
    stamp = message.header.stamp
    now = time_from_ros(stamp)
    return PointMatches(
        stamp=now,
        previous_stamp=seconds(nanoseconds(now) - int(points[_AGE][0])),
        frame_id=message.header.frame_id,
        previous=places[:, 2:].copy(),
        current=places[:, :2].copy(),
    )


def _points(message: Any) -> NDArray[Any]:
    """Returns the points of a cloud, with our fields."""
    fields = {field.name: field for field in message.fields}
    for name in (*_PLACES, _AGE):
        require(name in fields, "fields", sorted(fields), f"among others {name!r}")
        kind = fields[name].datatype
        require(kind in _TYPES, f"datatype of {name!r}", kind, "1 to 8")
    order = ">" if message.is_bigendian else "<"
    layout = np.dtype(
        {
            "names": [*_PLACES, _AGE],
            "formats": [order + _TYPES[fields[name].datatype] for name in (*_PLACES, _AGE)],
            "offsets": [fields[name].offset for name in (*_PLACES, _AGE)],
            "itemsize": message.point_step,
        }
    )
    data = np.ascontiguousarray(message.data, np.uint8)
    height, width, step = message.height, message.width, message.row_step
    require(
        step >= width * message.point_step and data.size >= height * step,
        "data",
        f"{data.size} bytes",
        f"{height} rows of {width} points of {message.point_step} bytes",
    )
    rows = data[: height * step].reshape(height, -1)[:, : width * message.point_step]
    return np.ascontiguousarray(rows).view(layout).ravel()
