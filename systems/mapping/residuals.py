"""How far the corners of a map lie from where it has them, by tag and by frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.mapping.mapping import TagMap
from systems.mapping.scene import corner_errors

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Residuals:
    """Of each of n tags, or of n frames.

    Attributes:
        used: (n,) sightings that the map rests on.
        outliers: (n,) sightings that were left out because they do not fit.
        squared: (n,) sum of the squared distances of the used corners, px^2.
        largest: (n,) distance of the worst corner, left out or not, px; inf for one that the map
            has behind the camera.
    """

    used: Indices
    outliers: Indices
    squared: Array
    largest: Array

    @property
    def rms(self) -> Array:
        """Root mean square distance of the used corners, (n,) px; NaN where there are none."""
        corners = np.where(self.used > 0, 4.0 * self.used, np.nan)
        return np.asarray(np.sqrt(self.squared / corners))


def residuals_of(tag_map: TagMap) -> tuple[Residuals, Residuals]:
    """Returns the residuals of the tags, in the order of `ids`, and of the frames."""
    s = tag_map.all_sightings
    r = corner_errors(tag_map.adjustment.scene, s).reshape(-1, 4, 2)
    squared = (r * r).sum(axis=2)
    pairs = s.frame * s.tags + s.tag
    used = np.isin(pairs, tag_map.sightings.frame * s.tags + tag_map.sightings.tag)

    def by(number: Indices, n: int) -> Residuals:
        summed, largest = np.zeros(n), np.zeros(n)
        np.add.at(summed, number[used], squared[used].sum(axis=1))
        np.maximum.at(largest, number, np.sqrt(squared.max(axis=1)))
        return Residuals(
            np.bincount(number[used], minlength=n),
            np.bincount(number[~used], minlength=n),
            summed,
            largest,
        )

    return by(s.tag, s.tags), by(s.frame, s.frames)
