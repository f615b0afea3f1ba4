"""Machine code for the small inner loops that NumPy is slow at.

NumPy spends about a microsecond on each call, whatever it does; a problem with four corners and six
unknowns is hundreds of such calls. Numba compiles the same arithmetic, written as plain loops, and
keeps what it compiled in `__pycache__` (or in the user's cache where that cannot be written): only
the first run on a machine takes some seconds longer. Set `NUMBA_DISABLE_JIT=1` to step through
the loops in a debugger.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import sigutils
from numpy.typing import NDArray

Function = TypeVar("Function", bound=Callable[..., object])

_log = logging.getLogger(__name__)

_WAITING: list[tuple[Any, str]] = []


def compiled(signature: str = "") -> Callable[[Function], Function]:
    """Compiles a function of numbers and arrays.

    A division by zero gives inf or NaN, as in NumPy. Numbers are the same from run to run: nothing
    is reordered for speed and nothing runs in parallel.

    Args:
        signature: Numba's of a function that Python calls, such as `f8(f8[:, ::1], i8)`; left out
            for one that only compiled functions call. `prepare` compiles for it; otherwise a
            function is compiled when it is first called.
    """

    def decorate(function: Function) -> Function:
        try:
            made: Any = numba.njit(cache=True, error_model="numpy")(function)
        except RuntimeError:  # nowhere to keep it: no folder can be written
            made = numba.njit(error_model="numpy")(function)
        if signature and hasattr(made, "compile"):  # Numba is not disabled
            _WAITING.append((made, signature))
        return cast(Function, made)

    return decorate


def prepare() -> None:
    """Compiles, or fetches from the cache, all functions of the modules imported so far.

    For whoever is about to start a clock or a robot: no picture then waits for a compiler.
    """
    told = False
    while _WAITING:
        function, signature = _WAITING.pop()
        # Without the return type, as when compiled for a caller: it is part of the cache's key.
        arguments, _ = sigutils.normalize_signature(signature)
        function.compile(arguments)
        if function.stats.cache_misses and not told:
            told = True
            _log.info("compiling %d small loops, once on this machine", len(_WAITING) + 1)


def packed(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns values as a writable row-major array of floats: one type for compiled code.

    Each other layout, and what is read-only, would be compiled for anew.
    """
    if values.flags.carray and values.dtype == np.float64:
        return values
    return np.array(values, np.float64, order="C")


def in_rows(values: NDArray[np.float64], *shape: int) -> NDArray[np.float64]:
    """Returns values, packed, as an array of shape (-1, *shape)."""
    return packed(values if values.shape[1:] == shape else values.reshape(-1, *shape))
