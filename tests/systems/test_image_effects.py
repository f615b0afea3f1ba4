from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest

from systems.cameras import PinholeCamera
from systems.image_effects import ImageEffects, Lens, expose, linear_light

K = np.array([[260.0, 0.0, 161.5], [0.0, 255.0, 118.2], [0.0, 0.0, 1.0]])
STRAIGHT = PinholeCamera(320, 240, K)
BARREL = PinholeCamera(320, 240, K, np.array([-0.28, 0.09, 1e-3, -2e-3, -0.01]))
PINCUSHION = PinholeCamera(320, 240, K, np.array([0.2, 0.05, -2e-3, 1e-3, 0.0]))


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def flat(level: float, shape: tuple[int, ...] = (300, 400)) -> np.ndarray:
    return np.full(shape, level, np.uint8)


# --- Exposure ---


def test_without_effects_the_picture_is_what_it_was() -> None:
    image = generator().integers(0, 256, (40, 60), np.uint8)
    np.testing.assert_array_equal(expose(image, ImageEffects(), generator()), image)


@pytest.mark.parametrize("level", [20, 100, 200])
@pytest.mark.parametrize(("read", "shot"), [(3.0, 0.0), (0.0, 5.0), (2.0, 4.0)])
def test_noise_is_of_the_asked_size(level: int, read: float, shot: float) -> None:
    # Shot noise grows with the root of the light: `shot` is its deviation at white.
    effects = ImageEffects(read_noise=read, shot_noise=shot)
    found = expose(flat(level), effects, generator()).astype(float)
    n = found.size
    expected = math.sqrt(read**2 + shot**2 * level / 255 + 1 / 12)  # and rounding
    assert found.std() == pytest.approx(expected, rel=5 / math.sqrt(2 * n) + 0.005)
    assert found.mean() == pytest.approx(level, abs=5 * expected / math.sqrt(n))
    # White in space: neighbours know nothing of each other.
    rest = found - found.mean()
    for a, b in ((rest[:, 1:], rest[:, :-1]), (rest[1:], rest[:-1])):
        assert abs((a * b).mean()) < 5 * expected**2 / math.sqrt(n)


def test_noise_of_the_three_colours_is_independent() -> None:
    found = expose(flat(100, (200, 200, 3)), ImageEffects(read_noise=5.0), generator())
    correlation = np.corrcoef(found.reshape(-1, 3).T.astype(float))
    assert np.abs(correlation - np.eye(3)).max() < 5 / 200


def test_a_generator_repeats_the_noise() -> None:
    effects = ImageEffects(read_noise=5.0, shot_noise=3.0)
    first, again, other = (expose(flat(100), effects, generator(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.5


def test_gain_brightens_and_white_is_the_end() -> None:
    image = np.array([[0, 10, 100, 127, 128, 200, 255]], np.uint8)
    found = expose(image, ImageEffects(gain=2.0), generator())
    assert found.tolist() == [[0, 20, 200, 254, 255, 255, 255]]
    found = expose(image, ImageEffects(gain=0.5), generator())
    assert found.tolist() == [[0, 5, 50, 64, 64, 100, 128]]


def test_noise_is_clipped_not_wrapped() -> None:
    effects = ImageEffects(read_noise=20.0)
    black, white = (expose(flat(level), effects, generator()) for level in (0, 255))
    assert (black == 0).mean() == pytest.approx(0.51, abs=0.01)
    assert (white == 255).mean() == pytest.approx(0.51, abs=0.01)
    assert black.max() < 130
    assert white.min() > 125


def test_gamma_comes_after_the_noise_of_light() -> None:
    image = np.array([[0, 55, 255]], np.uint8)
    found = expose(image, ImageEffects(gamma=2.0), generator())
    assert found.tolist() == [[0, round(255 * math.sqrt(55 / 255)), 255]]
    # A slope of 1 / (2 sqrt(x)) at x = 1/4: noise of light comes out as it was.
    found = expose(flat(64), ImageEffects(gamma=2.0, read_noise=4.0), generator())
    assert found.astype(float).std() == pytest.approx(4.0, rel=0.03)


def test_focus_blur_is_a_gaussian_of_that_deviation() -> None:
    image = np.zeros((41, 41), np.uint8)
    image[18:23, 18:23] = 255  # a square of variance (5^2 - 1) / 12
    for sigma in (1.0, 2.0):
        found = expose(image, ImageEffects(focus_blur=sigma), generator()).astype(float)
        x = np.arange(41) - 20
        weight = found.sum(axis=0) / found.sum()
        assert (weight * x).sum() == pytest.approx(0.0, abs=0.01)
        assert (weight * x**2).sum() == pytest.approx(2.0 + sigma**2, rel=0.05)


def test_noise_is_not_blurred() -> None:
    sharp, blurred = (
        expose(flat(100), ImageEffects(read_noise=5.0, focus_blur=b), generator()) for b in (0, 2)
    )
    np.testing.assert_array_equal(sharp, blurred)


def test_a_screens_picture_is_taken_back_to_light() -> None:
    light = np.linspace(0, 1, 64)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    found = linear_light(np.rint(255 * encoded).astype(np.uint8))
    np.testing.assert_allclose(found, 255 * light, atol=2.0)
    assert linear_light(flat(0, (2, 3, 3))).shape == (2, 3, 3)
    assert linear_light(np.array([0, 255], np.uint8)).tolist() == [0, 255]


# --- Lens ---


def test_without_distortion_the_lens_shows_what_it_is_given() -> None:
    lens = Lens(STRAIGHT)
    assert (lens.ideal.width, lens.ideal.height) == (320, 240)
    np.testing.assert_array_equal(lens.ideal.K, K)
    image = generator().integers(0, 256, (240, 320), np.uint8)
    np.testing.assert_array_equal(lens(image), image)


def test_supersampling_takes_the_mean_over_each_pixel() -> None:
    image = generator().integers(0, 256, (24, 36), np.uint8)
    small = PinholeCamera.from_focal_length(12, 8, 10.0)
    expected = image.reshape(8, 3, 12, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(Lens(small, 3)(image), expected, atol=0.51)


def spots(camera: PinholeCamera, rays: np.ndarray, sigma: float) -> np.ndarray:
    """Draws a soft bright spot on each ray (n, 2) as an undistorted camera sees it."""
    centres = camera.project(np.column_stack([rays, np.ones(len(rays))]))
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    image = np.zeros((camera.height, camera.width))
    reach = math.ceil(5 * sigma)
    for x, y in centres:
        near = np.s_[round(y) - reach : round(y) + reach, round(x) - reach : round(x) + reach]
        image[near] += 250 * np.exp(-((u[near] - x) ** 2 + (v[near] - y) ** 2) / (2 * sigma**2))
    return np.rint(image).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("camera", [STRAIGHT, BARREL, PINCUSHION])
@pytest.mark.parametrize("supersampling", [1, 2, 3])
def test_the_lens_puts_points_where_opencv_projects_them(
    camera: PinholeCamera, supersampling: int
) -> None:
    rng = generator(3)
    grid = np.stack(np.meshgrid(np.linspace(-0.45, 0.45, 5), np.linspace(-0.33, 0.33, 4)), -1)
    rays = grid.reshape(-1, 2) + rng.uniform(-0.02, 0.02, (20, 2))
    expected, _ = cv2.projectPoints(
        np.column_stack([rays, np.ones(20)]), np.zeros(3), np.zeros(3), camera.K, camera.D
    )
    lens = Lens(camera, supersampling)
    seen = lens(spots(lens.ideal, rays, 1.5 * supersampling))
    assert seen.shape == (240, 320)
    for x, y in expected[:, 0]:
        left, top = round(x) - 7, round(y) - 7
        patch = seen[top : top + 15, left : left + 15].astype(float)
        v, u = np.mgrid[0:15, 0:15]
        found = np.array([(patch * u).sum(), (patch * v).sum()]) / patch.sum() + [left, top]
        np.testing.assert_allclose(found, [x, y], atol=0.05)


@pytest.mark.parametrize("camera", [BARREL, PINCUSHION])
@pytest.mark.parametrize("supersampling", [1, 2])
def test_the_ideal_camera_sees_all_that_the_real_one_does(
    camera: PinholeCamera, supersampling: int
) -> None:
    lens = Lens(camera, supersampling)
    assert not lens.ideal.distorted
    white = np.full((lens.ideal.height, lens.ideal.width), 255, np.uint8)
    assert (lens(white) == 255).all()
    u, v = np.meshgrid(np.linspace(-0.5, 319.5, 40), np.linspace(-0.5, 239.5, 30))
    rays = camera.undistort(np.stack([u, v], -1))
    pixels = lens.ideal.project(np.concatenate([rays, np.ones((*u.shape, 1))], -1))
    assert (pixels >= 0).all()
    assert (pixels <= [lens.ideal.width - 1, lens.ideal.height - 1]).all()


def test_colours_go_through_the_lens_alike() -> None:
    lens = Lens(BARREL, 2)
    shape = (lens.ideal.height, lens.ideal.width, 3)
    image = generator().integers(0, 256, shape, np.uint8)
    found = lens(image)
    assert found.shape == (240, 320, 3)
    for channel in range(3):
        np.testing.assert_array_equal(found[..., channel], lens(image[..., channel].copy()))


def test_a_lens_that_folds_within_the_picture_is_refused() -> None:
    folded = PinholeCamera(320, 240, K, np.array([-1.2, 0.0, 0.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match=r"D is .*: must be invertible over the whole picture"):
        Lens(folded)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("supersampling", 0),
        ("supersampling", 65),
        ("supersampling", 1.5),
        ("exposure_samples", 0),
        ("exposure_samples", math.nan),
        ("gain", 0.0),
        ("gamma", -1.0),
        ("exposure", -0.1),
        ("focus_blur", math.nan),
        ("shot_noise", -1.0),
        ("read_noise", math.inf),
    ],
)
def test_nonsense_is_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}: must be "):
        ImageEffects(**{field: value})
