"""ROS messages of which only the stamp and some numbers change, straight to their bytes.

Most messages of a recording are like the one before but for a few numbers. A stencil has rosbags
serialise an example, once, and then fills in what changes: several times faster than making message
objects and serialising each.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.io.ros_types import sec_and_nanosec, typestore
from systems.validation import require

Numbers = Sequence[float] | NDArray[np.float64]

_TIME = struct.Struct("=iI")
# The body of a message, in which each float64 is aligned to 8 bytes, begins after 4.
_LEAD = 4


@dataclass(slots=True)
class SerialisedMessage:
    """A message as a recording holds it.

    Attributes:
        __msgtype__: in ROS 2's naming, as rosbags' messages have it.
        data: CDR.
    """

    __msgtype__: str
    data: bytes


class _Cut(NamedTuple):
    """An example and its holes.

    Attributes:
        msgtype: in ROS 2's naming.
        words: (n,) the example's bytes after `_LEAD` zeros, as float64.
        size: of those, in bytes.
        fields: (k,) which words are to be filled.
        stamps: at which bytes stamps begin.
    """

    msgtype: str
    words: NDArray[np.float64]
    size: int
    fields: NDArray[np.intp]
    stamps: list[int]


class Stencil:
    """Writes messages that differ in their stamp and in some float64 fields only.

    It is an encoder, as `systems.io.recorder.Channel` takes it.

    Args:
        example: makes the message of a stamp (s), with NaN in each field that is to be filled.
            All other fields, and the lengths of all arrays, stay as they are there.
        numbers: makes what the fields are filled with, in the message's order, of a port's value;
            by default the value itself.
    """

    def __init__(
        self,
        example: Callable[[float], Any],
        numbers: Callable[[Any], Numbers] = lambda value: value,
    ) -> None:
        self._example = example
        self._numbers = numbers

    def __call__(self, value: Any, stamp: float) -> SerialisedMessage:
        """Returns the message of a value, with all its stamps (s), if it has any, at `stamp`.

        Raises:
            ValueError: a stamp that ROS cannot keep, or more or fewer numbers than fields.
        """
        msgtype, words, size, fields, stamps = self._cut
        numbers = self._numbers(value)
        if len(numbers) != len(fields):
            require(False, f"numbers of {msgtype}", numbers, f"{len(fields)} as the fields")
        filled = words.copy()
        filled[fields] = numbers
        for place in stamps:
            _TIME.pack_into(filled.data, place, *sec_and_nanosec(stamp))
        return SerialisedMessage(msgtype, filled.tobytes()[_LEAD:size])

    @cached_property
    def _cut(self) -> _Cut:
        # Not in the constructor: who records nothing shall not wait for the definitions.
        message = self._example(0.0)
        msgtype = message.__msgtype__
        example = bytes(_LEAD) + typestore().serialize_cdr(message, msgtype)
        # In -1 s and 999999999 ns each byte is another one than in 0 s and 0 ns.
        later = bytes(_LEAD) + typestore().serialize_cdr(self._example(-1e-9), msgtype)
        changed = [k for k, (a, b) in enumerate(zip(example, later, strict=True)) if a != b]
        words = np.frombuffer(example + bytes(-len(example) % 8), np.float64)
        return _Cut(msgtype, words, len(example), np.flatnonzero(np.isnan(words)), changed[::8])
