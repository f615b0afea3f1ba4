"""Sparse optical flow to ROS 2 messages, and back. The reader takes ROS 1 messages too.

A match is a point of a cloud without a third dimension: where it is in the later picture, where it
was in the earlier one, and how much older that one was, which a cloud has no other place for.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from systems.io.ros_types import header, message_class, nanoseconds, seconds, time_from_ros
from systems.messages import PointMatches
from systems.validation import require

_PLACES = ("u", "v", "previous_u", "previous_v")  # px
_AGE = "previous_age"  # ns before the header's stamp, as lidars tell the times of their points
_POINT = np.dtype([*((name, "<f8") for name in _PLACES), (_AGE, "<u4")])
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
    age = nanoseconds(matches.stamp) - nanoseconds(matches.previous_stamp)
    require(
        0 <= age < 2**32,
        "previous_stamp",
        matches.previous_stamp,
        f"up to 4.29 s before {matches.stamp}",
    )
    places = np.hstack([matches.current, matches.previous])
    points = np.empty(max(len(places), 1), _POINT)
    for name, column in zip(_PLACES, places.T, strict=True):
        points[name] = column if len(places) else np.nan
    points[_AGE] = age
    field = message_class("sensor_msgs/msg/PointField")
    return message_class("sensor_msgs/msg/PointCloud2")(
        header=header(matches.stamp, matches.frame_id),
        height=1,
        width=len(points),
        fields=[
            field(name, 8 * k, _NUMBERS[points[name].dtype.str[1:]], 1)
            for k, name in enumerate((*_PLACES, _AGE))
        ],
        is_bigendian=False,
        point_step=_POINT.itemsize,
        row_step=points.nbytes,
        data=points.view(np.uint8),
        is_dense=bool(len(places) and np.isfinite(places).all()),
    )


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
