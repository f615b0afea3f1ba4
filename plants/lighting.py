"""Light for rendered pictures: even enough that a marker is seen whichever way it faces."""

from __future__ import annotations

import numpy as np
from pydrake.geometry import LightParameter

# Three lights light all upright faces nearly alike, the worst by 87 % of the best (four: 71 %).
_AZIMUTHS = np.radians([0.0, 120.0, 240.0])
_ELEVATION = np.radians(30.0)
# Drake's renderer of glTF scenes divides by pi: this makes upright white paper 78 to 91 % of full
# white, by the way that it faces.
_INTENSITY = 3.4


def daylight() -> list[LightParameter]:
    """Returns three lights from afar, all around, fixed in the world.

    The renderer's own default is one lamp at the camera, which leaves whatever it does not face
    black.
    """
    return [
        LightParameter(
            type="directional",
            frame="world",
            intensity=_INTENSITY,
            direction=[
                np.cos(azimuth) * np.cos(_ELEVATION),
                np.sin(azimuth) * np.cos(_ELEVATION),
                -np.sin(_ELEVATION),
            ],
        )
        for azimuth in _AZIMUTHS
    ]
