"""One recorded message, as every kind of recording gives it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple


class Record(NamedTuple):
    """One recorded message, not deserialised yet.

    Attributes:
        topic: where it was published.
        log_time: when it was recorded, ns.
        data: its bytes.
        deserialise: makes the message of the bytes; raises ValueError.
    """

    topic: str
    log_time: int
    data: bytes
    deserialise: Callable[[bytes], Any]

    def message(self) -> Any:
        """Returns the message.

        Raises:
            ValueError: the bytes do not fit the definition, or it cannot be read.
        """
        try:
            return self.deserialise(self.data)
        except ValueError as error:
            raise ValueError(f"message on {self.topic} at {self.log_time} ns: {error}") from error
