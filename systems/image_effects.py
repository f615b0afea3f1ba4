"""What a real camera does to an ideal picture: lens, exposure, noise."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from systems.cameras import PinholeCamera
from systems.compiled import compiled
from systems.noise import coarse_bits
from systems.validation import require, require_non_negative, require_positive

Image = NDArray[np.uint8]

_NO_NOISE = np.zeros(0, np.uint16), np.zeros(0, np.float32)


@dataclass
class ImageEffects:
    """Effects, in the order in which light meets them.

    Attributes:
        supersampling: the ideal picture is formed this many times larger along each side and
            reduced by area: anti-aliasing, at the square of the cost.
        exposure: time that the shutter is open, s; blurs motion when exposure_samples > 1.
        exposure_samples: pictures averaged over the exposure; 1 does without motion blur.
        focus_blur: standard deviation of the lens' blur, px.
        gain: brightness factor; what exceeds white is clipped.
        shot_noise: standard deviation at white, grey levels; falls with the root of brightness.
        read_noise: standard deviation at every brightness, grey levels.
        gamma: the picture holds light to the power 1 / gamma. At 1 it is proportional to light, and
            edges are unbiased. Around 2.2 (photographs, most consumer cameras) a blurred edge
            moves toward the dark side, and black squares shrink by about 0.3 px a corner.
        grey: one channel instead of three.
    """

    supersampling: int = 1
    exposure: float = 0.01
    exposure_samples: int = 1
    focus_blur: float = 0.0
    gain: float = 1.0
    shot_noise: float = 0.0
    read_noise: float = 0.0
    gamma: float = 1.0
    grey: bool = True

    def __post_init__(self) -> None:
        for name in ("supersampling", "exposure_samples"):
            value = getattr(self, name)
            whole = 1 <= value <= 64 and value == int(value)
            require(whole, name, value, "a whole number from 1 to 64")
        require_positive(gain=self.gain, gamma=self.gamma)
        require_non_negative(
            exposure=self.exposure,
            focus_blur=self.focus_blur,
            shot_noise=self.shot_noise,
            read_noise=self.read_noise,
        )


class Lens:
    """Forms the pictures of a distorted camera out of those of an ideal one.

    Args:
        camera: the camera whose pictures are wanted.
        supersampling: factor by which the ideal picture is larger along each side.

    Attributes:
        ideal: the undistorted camera to render with; it sees all that `camera` sees.

    Raises:
        ValueError: the distortion cannot be inverted everywhere in the picture.
    """

    def __init__(self, camera: PinholeCamera, supersampling: int = 1) -> None:
        self._supersampling = supersampling
        large = camera.scaled(supersampling)
        if not camera.distorted:
            self.ideal = large
            self._maps = None
            return
        v, u = np.mgrid[0 : large.height, 0 : large.width]
        rays = large.undistort(np.stack([u, v], axis=-1).astype(float))
        require(
            bool(np.isfinite(rays).all()),
            "D",
            camera.D.tolist(),
            "invertible over the whole picture",
        )
        pixels = rays * large.K[[0, 1], [0, 1]]
        low = np.floor(pixels.min(axis=(0, 1))) - 1
        high = np.ceil(pixels.max(axis=(0, 1))) + 1
        K = large.K.copy()
        K[:2, 2] = -low
        width, height = (int(n) + 1 for n in high - low)
        self.ideal = PinholeCamera(width, height, K)
        self._maps = cv2.convertMaps(
            *np.moveaxis((pixels - low).astype(np.float32), -1, 0), cv2.CV_16SC2
        )

    def __call__(self, ideal: Image) -> Image:
        """Returns the camera's picture of what the ideal camera saw."""
        image = ideal
        if self._maps is not None:
            image = cv2.remap(image, *self._maps, cv2.INTER_LINEAR)
        if self._supersampling > 1:
            size = (image.shape[1] // self._supersampling, image.shape[0] // self._supersampling)
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return image


def expose(image: Image, effects: ImageEffects, rng: np.random.Generator) -> Image:
    """Applies blur, gain, noise, gamma and rounding to a picture.

    Args:
        image: uint8 (height, width) or (height, width, 3), proportional to light.
        effects: what to apply.
        rng: source of the noise.

    Returns:
        uint8 of the same shape.
    """
    if effects.focus_blur > 0:
        image = cv2.GaussianBlur(image, (0, 0), effects.focus_blur)
    noisy = effects.shot_noise > 0 or effects.read_noise > 0
    if effects.gain == 1 and effects.gamma == 1 and not noisy:
        return image
    levels = np.arange(256, dtype=np.float32) * np.float32(effects.gain)
    variance = effects.read_noise**2 + effects.shot_noise**2 / 255 * levels
    light: NDArray[np.float32] = np.empty(image.shape, np.float32)
    bits, normals = coarse_bits(rng, light.size) if noisy else _NO_NOISE
    pixels = np.require(image, np.uint8, ["C", "W"]).reshape(-1)
    _shed_light(pixels, levels, np.sqrt(variance), bits, normals, light.reshape(-1))
    if effects.gamma != 1:
        np.power(light / 255, np.float32(1 / effects.gamma), out=light)
        light *= 255
    return np.rint(light, out=light).astype(np.uint8)


@compiled("void(u1[::1], f4[::1], f4[::1], u2[::1], f4[::1], f4[::1])")
def _shed_light(
    pixels: Image,
    levels: NDArray[np.float32],
    deviation: NDArray[np.float32],
    bits: NDArray[np.uint16],
    normals: NDArray[np.float32],
    light: NDArray[np.float32],
) -> None:
    """Writes what a sensor counts of pixels (n,), 0 to 255.

    Args:
        pixels: (n,).
        levels: (256,) without noise.
        deviation: (256,) of the noise.
        bits: (n,) which of the normal numbers; of size 0 without noise.
        normals: (65536,).
        light: (n,), written.
    """
    for k in range(len(pixels)):
        level = levels[pixels[k]]
        if len(bits):
            level += deviation[pixels[k]] * normals[bits[k]]
        light[k] = min(max(level, np.float32(0)), np.float32(255))


def linear_light(image: Image) -> Image:
    """Returns a picture proportional to light, of a renderer's picture for screens (sRGB).

    Drake's renderer encodes what it draws for a screen (IEC 61966-2-1) once a scene has a glTF, as
    our marker boards are. A sensor counts light.

    Args:
        image: uint8 (height, width) or (height, width, 3).
    """
    return cv2.LUT(image, _LINEAR)


def _linear_table() -> Image:
    encoded = np.arange(256) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return np.rint(255 * linear).astype(np.uint8)


_LINEAR = _linear_table()
