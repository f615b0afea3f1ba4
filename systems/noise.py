"""Noise that repeats bit for bit: counter-based random numbers keyed by seed, stream and sample.

A draw depends on nothing but (seed, stream name, sample index): not on what was drawn before, by
whom, or how often a port was evaluated. So two runs with one seed are equal, adding a sensor does
not change the noise of the others, and a recording can be recomputed from the middle. The generator
is Philox (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011), as in NumPy.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.random.bit_generator import ISeedSequence
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from systems.validation import require

_BLOCK = 64  # samples


@lru_cache(maxsize=1024)
def stream_key(seed: int, name: str) -> int:
    """Returns the 128-bit key of the stream `name` under `seed` (any integer)."""
    digest = hashlib.blake2b(f"{seed}/{name}".encode(), digest_size=16).digest()
    return int.from_bytes(digest, "little")


class _Key(ISeedSequence):
    """Hands Philox its key.

    Given as `key=`, it would come to the same, but NumPy then asks the operating system for a seed
    first, hashes it and throws it away, which takes three times as long as all the rest.
    """

    def __init__(self, key: int) -> None:
        self._words = np.array([key % 2**64, key >> 64], np.uint64)

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> NDArray[Any]:  # noqa: ARG002
        return self._words


@lru_cache(maxsize=1024)
def _philox_key(key: int) -> Any:  # NumPy's stubs want a `SeedSequence`, its code the interface
    return _Key(key)


def generator(key: int, index: int) -> np.random.Generator:
    """Returns the random generator of sample `index` (>= 0) in the stream `key`.

    The index is the high half of Philox's 256-bit counter, so the numbers of different samples
    never overlap, however many are drawn for one.
    """
    return np.random.Generator(np.random.Philox(_philox_key(key), counter=index << 128))


@lru_cache(maxsize=1024)
def _block_of_normals(key: int, block: int, size: int) -> NDArray[np.float64]:
    normals = generator(key, block).standard_normal((_BLOCK, size))
    normals.setflags(write=False)
    return normals


@lru_cache
def _normal_quantiles() -> NDArray[np.float32]:
    normal = NormalDist()
    return np.array([normal.inv_cdf((k + 0.5) / 2**16) for k in range(2**16)], np.float32)


def coarse_bits(
    random: np.random.Generator, count: int
) -> tuple[NDArray[np.uint16], NDArray[np.float32]]:
    """Returns normal numbers of 16 random bits each, six times faster than NumPy's.

    They are the 65536 quantiles, from -4.3 to 4.3: enough for the noise of a picture's pixels,
    whose grey levels are coarser.

    Returns:
        (count,) the bits, and (65536,) the standard normal numbers that they stand for.
    """
    bits = random.bit_generator.random_raw((count + 3) // 4).view(np.uint16)[:count]
    return bits, _normal_quantiles()


def sample_index(t: float, rate: float) -> int:
    """Returns the index of the periodic sample taken at time `t` (s) at `rate` (Hz)."""
    return round(t * rate)


class NoiseStream:
    """A block's noise: its name, and its seed as a numeric parameter of the Context.

    Args:
        system: the block; call this in its constructor.
        seed: default of the parameter, a whole number below 2^53.
        name: name of the stream; two blocks of one name draw the same numbers.
    """

    def __init__(self, system: LeafSystem, *, seed: int, name: str) -> None:
        require(0 <= seed < 2**53, "seed", seed, "a whole number from 0 to 2^53 - 1")
        self._name = name
        self._seed = int(system.DeclareNumericParameter(BasicVector([float(seed)])))

    def generator(self, context: Context, index: int) -> np.random.Generator:
        """Returns the random generator of sample `index`."""
        return generator(self._key(context), index)

    def normals(self, context: Context, index: int, size: int) -> NDArray[np.float64]:
        """Returns (size,) standard normal numbers of sample `index`, for a few at a high rate.

        Those of many samples are drawn together: making a generator takes longer than using it.
        A block draws either these or from `generator`.
        """
        block, row = divmod(index, _BLOCK)
        numbers: NDArray[np.float64] = _block_of_normals(self._key(context), block, size)[row]
        return numbers

    def _key(self, context: Context) -> int:
        return stream_key(int(context.get_numeric_parameter(self._seed)[0]), self._name)
