"""Checks of constructor arguments: one line that names the field, the value and what is allowed."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from typing import Any


def require(condition: bool, name: str, value: Any, allowed: str) -> None:
    """Raises `ValueError` "{name} is {value!r}: must be {allowed}" unless `condition` holds."""
    if not condition:
        raise ValueError(f"{name} is {value!r}: must be {allowed}")


def require_positive(**values: float) -> None:
    """Raises `ValueError` for the first value that is not finite and > 0."""
    for name, value in values.items():
        require(math.isfinite(value) and value > 0, name, value, "greater than 0")


def require_non_negative(**values: float) -> None:
    """Raises `ValueError` for the first value that is not finite and >= 0."""
    for name, value in values.items():
        require(math.isfinite(value) and value >= 0, name, value, "0 or greater")


def nearest(word: str, known: Iterable[str]) -> str:
    """Returns a hint for a word that is not among `known`: the nearest one, else all of them."""
    choices = sorted(known)
    in_lower_case = {choice.lower(): choice for choice in choices}
    close = difflib.get_close_matches(word.lower(), in_lower_case, n=1, cutoff=0.6)
    if close:
        return f"did you mean {in_lower_case[close[0]]!r}?"
    return "known: " + ", ".join(choices) if choices else "none is known"
