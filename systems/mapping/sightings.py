"""What a recording says of tags: which was seen in which frame, and where its corners lay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.validation import require

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Sightings:
    """m sightings of tags in frames, ordered by frame; a tag is in a frame once at most.

    Attributes:
        frame: (m,) number of the frame, ascending.
        tag: (m,) number of the tag.
        rays: (m, 4, 2) x/z, y/z of its corners (`PinholeCamera.rays`).
        by_ray: (m, 4, 2, 2) derivative of the pixels by the rays, px.
        sizes: (tags,) sides of the black squares, m.
        frames: how many there are.

    Raises:
        ValueError: arrays that do not fit together; a tag twice in a frame.
    """

    frame: Indices
    tag: Indices
    rays: Array
    by_ray: Array
    sizes: Array
    frames: int

    def __post_init__(self) -> None:
        m = len(self.frame)
        require(self.tag.shape == (m,), "tag", self.tag.shape, f"({m},)")
        require(self.rays.shape == (m, 4, 2), "rays", self.rays.shape, f"({m}, 4, 2)")
        require(self.by_ray.shape == (m, 4, 2, 2), "by_ray", self.by_ray.shape, f"({m}, 4, 2, 2)")
        require(bool((np.diff(self.frame) >= 0).all()), "frame", "unordered", "ascending")
        inside = m == 0 or (
            self.frame[0] >= 0
            and self.frame[-1] < self.frames
            and self.tag.min() >= 0
            and self.tag.max() < len(self.sizes)
        )
        require(inside, "frame and tag", "out of range", "numbers of frames and of tags")
        pairs = self.frame.astype(np.int64) * len(self.sizes) + self.tag
        require(len(np.unique(pairs)) == m, "tag", "twice in a frame", "once at most")

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def tags(self) -> int:
        """How many tags there are."""
        return len(self.sizes)

    def select(self, mask: NDArray[np.bool_]) -> Sightings:
        """Returns those picked by a mask; frames and tags keep their numbers."""
        return Sightings(
            self.frame[mask],
            self.tag[mask],
            self.rays[mask],
            self.by_ray[mask],
            self.sizes,
            self.frames,
        )
