"""ROS's message definitions, and time as ROS keeps it.

The definitions and the serialisation are those of `rosbags`: its `ROS2_HUMBLE` store, which later
distributions read too, and `apriltag_msgs` beside it, which no distribution carries as standard.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

from rosbags.typesys import (
    Stores,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)
from rosbags.typesys.store import Typestore

_BILLION = 10**9

# https://github.com/christianrauch/apriltag_msgs, msg/
_APRILTAG_MSGS = {
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y\n",
    "apriltag_msgs/msg/AprilTagDetection": (
        "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
        "Point centre\nPoint[4] corners\nfloat64[9] homography\n"
    ),
    "apriltag_msgs/msg/AprilTagDetectionArray": (
        "std_msgs/Header header\nAprilTagDetection[] detections\n"
    ),
}


@cache
def typestore() -> Typestore:
    """Returns the definitions of the messages that we write."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    types: dict[str, Any] = {}
    for name, text in _APRILTAG_MSGS.items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


@cache
def message_class(msgtype: str) -> Any:
    """Returns the class of a message type, such as `geometry_msgs/msg/Twist`."""
    return typestore().types[msgtype]


@cache
def definition(msgtype: str) -> str:
    """Returns the text of a message's definition with all that it depends on (`ros2msg`)."""
    text, _ = typestore().generate_msgdef(msgtype, ros_version=2)
    return text


@cache
def typestore_for(msgtype: str, text: str, encoding: str) -> Typestore:
    """Returns a store that reads `msgtype` as a recording defines it.

    Args:
        msgtype: in ROS 2's naming.
        text: the definition in the recording; empty when it carries none, as rosbag2 did before
            Iron: then ROS 2's standard one is taken.
        encoding: `msg` or `idl`.

    Raises:
        ValueError: the definition cannot be read, or there is none at all.
    """
    standard = typestore()
    if not text:
        if msgtype not in standard.fielddefs:
            raise ValueError(
                f"{msgtype} is no standard message and the recording does not define it"
            )
        return standard
    try:
        types = _parse_idl(text) if encoding == "idl" else get_types_from_msg(text, msgtype)
        # The same fields: then what is compiled already serves, whatever the comments say.
        if all(_same_fields(types[name], standard.fielddefs.get(name)) for name in types):
            return standard
        own = get_typestore(Stores.EMPTY)
        own.register(types)
        own.get_msgdef(msgtype)  # compiles: shows now whether a part is missing
    except Exception as error:  # a strange text may trip parser and compiler anywhere
        raise ValueError(
            f"the definition of {msgtype} cannot be read: {first_line(error)}"
        ) from None
    return own


def deserialise(data: bytes, *, msgtype: str, text: str, encoding: str, ros1: bool) -> Any:
    """Returns the message of recorded bytes, by the recording's own definition.

    Args:
        data: CDR, or ROS 1's serialisation.
        msgtype: in ROS 2's naming.
        text: see `typestore_for`.
        encoding: see `typestore_for`.
        ros1: which serialisation.

    Raises:
        ValueError: see `typestore_for`, or the bytes do not fit the definition.
    """
    store = typestore_for(msgtype, text, encoding)
    try:
        return (store.deserialize_ros1 if ros1 else store.deserialize_cdr)(data, msgtype)
    except Exception as error:  # damaged bytes may trip the decoder anywhere
        raise ValueError(f"{msgtype} cannot be read: {first_line(error)}") from error


def first_line(error: BaseException) -> str:
    """Returns the first line of an error's text, or its kind when it has none."""
    text = str(error)
    return text.splitlines()[0] if text else type(error).__name__


def _parse_idl(text: str) -> dict[str, Any]:
    separator = "=" * 80 + "\n"
    parts = text.split(separator) if text.startswith(separator) else [text]
    types: dict[str, Any] = {}
    for part in parts:
        body = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
        if body.strip():
            types.update(get_types_from_idl(body))
    return types


def _same_fields(ours: Any, theirs: Any) -> bool:
    return theirs is not None and ours[1] == theirs[1]


def nanoseconds(t: float) -> int:
    """Returns the nearest whole number of nanoseconds to `t` (s), exactly.

    `round(t * 1e9)` is off by up to 128 ns for times since 1970; here nothing is rounded but the
    last step.

    Raises:
        ValueError: `t` is not finite.
    """
    if not math.isfinite(t):
        raise ValueError(f"time is {t!r}: must be finite")
    whole = math.floor(t)
    return whole * _BILLION + round((t - whole) * 1e9)


def seconds(ns: int) -> float:
    """Returns the float nearest to `ns` nanoseconds, s; the inverse of `nanoseconds`.

    A time that is the float nearest to a whole number of nanoseconds survives both ways, the ones
    since 1970 included.
    """
    return ns / _BILLION  # of two ints: rounded once


def sec_and_nanosec(t: float) -> tuple[int, int]:
    """Returns the two fields of a `builtin_interfaces/msg/Time` of `t` (s).

    Raises:
        ValueError: `t` is not finite or outside of 32 bits of seconds.
    """
    sec, nanosec = divmod(nanoseconds(t), _BILLION)
    if not -(2**31) <= sec < 2**31:
        raise ValueError(f"time is {t!r}: ROS keeps 32 bits of seconds")
    return sec, nanosec


def time_to_ros(t: float) -> Any:
    """Returns `builtin_interfaces/msg/Time` of `t` (s).

    Raises:
        ValueError: `t` is not finite or outside of 32 bits of seconds.
    """
    return message_class("builtin_interfaces/msg/Time")(*sec_and_nanosec(t))


def time_from_ros(time: Any) -> float:
    """Returns the seconds of a `builtin_interfaces/msg/Time`."""
    return seconds(time.sec * _BILLION + time.nanosec)


def header(stamp: float, frame_id: str) -> Any:
    """Returns `std_msgs/msg/Header` of a measurement at `stamp` (s)."""
    return message_class("std_msgs/msg/Header")(time_to_ros(stamp), frame_id)
