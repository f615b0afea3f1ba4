"""Noise that repeats bit for bit: counter-based random numbers keyed by seed, stream and sample.

A draw depends on nothing but (seed, stream name, sample index): not on what was drawn before, by
whom, or how often a port was evaluated. So two runs with one seed are equal, adding a sensor does
not change the noise of the others, and a recording can be recomputed from the middle. The generator
is Philox (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011), as in NumPy.
"""

from __future__ import annotations

import hashlib

import numpy as np


def stream_key(seed: int, name: str) -> int:
    """Returns the 128-bit key of the stream `name` under `seed` (any integer)."""
    digest = hashlib.blake2b(f"{seed}/{name}".encode(), digest_size=16).digest()
    return int.from_bytes(digest, "little")


def generator(key: int, index: int) -> np.random.Generator:
    """Returns the random generator of sample `index` (>= 0) in the stream `key`.

    The index is the high half of Philox's 256-bit counter, so the numbers of different samples
    never overlap, however many are drawn for one.
    """
    return np.random.Generator(np.random.Philox(key=key, counter=index << 128))


def sample_index(t: float, rate: float) -> int:
    """Returns the index of the periodic sample taken at time `t` (s) at `rate` (Hz)."""
    return round(t * rate)
