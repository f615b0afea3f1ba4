from __future__ import annotations

import cv2
import numpy as np
import pytest

from systems.cameras import PinholeCamera
from systems.markers.layout import marker_corners
from systems.markers.planar_pose import (
    SAME_POSE,
    PlanarPoses,
    angle_between,
    closed_form,
    homography_of_square,
    planar_poses,
)
from systems.markers.pnp import rotation_from_vector, squared_errors

K = np.array([[590.0, 0.0, 322.5], [0.0, 610.0, 236.2], [0.0, 0.0, 1.0]])
STRAIGHT = PinholeCamera(640, 480, K)
BARREL = PinholeCamera(640, 480, K, np.array([-0.28, 0.09, 1e-3, -2e-3, -0.01]))
# R_CM of a marker that looks straight into the camera: its x comes toward the camera, its y goes
# to the right of the picture, its z up.
R_FACING = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])


def facing(tilt: float, axis: float = np.pi / 2, turn: float = 0.0) -> np.ndarray:
    """R_CM of a marker turned in its plane, then tilted about an axis of the picture, rad."""
    lean, _ = cv2.Rodrigues(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))
    spin, _ = cv2.Rodrigues(np.array([turn, 0.0, 0.0]))
    return lean @ R_FACING @ spin


def random_markers(
    n: int, seed: int = 0, max_tilt: float = 1.2
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses R_CM, p_CM and sizes of markers in the picture, seen from the front."""
    rng = np.random.default_rng(seed)
    R = np.array(
        [facing(rng.uniform(0, max_tilt), *rng.uniform(0, 2 * np.pi, 2)) for _ in range(10 * n)]
    )
    z = rng.uniform(0.4, 3.0, (len(R), 1))
    p = np.column_stack([rng.uniform(-0.45, 0.45, (len(R), 2)) * z * [1.0, 0.7], z])
    incidence = -(R[:, :, 0] * p).sum(axis=1) / np.linalg.norm(p, axis=1)
    seen = np.flatnonzero(incidence > np.cos(max_tilt))[:n]
    assert len(seen) == n
    return R[seen], p[seen], rng.uniform(0.05, 0.3, n)


def pixels_of(camera: PinholeCamera, R: np.ndarray, p: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    points = marker_corners(1.0) * np.reshape(sizes, (-1, 1, 1))
    return camera.project(points @ R.swapaxes(-1, -2) + p[:, None])


def solve(camera: PinholeCamera, pixels: np.ndarray, sizes: np.ndarray) -> PlanarPoses:
    return planar_poses(*camera.rays(pixels), np.asarray(sizes, float))


def opencv(camera: PinholeCamera, pixels: np.ndarray, size: float) -> list[float]:
    """Squared errors (px^2) of OpenCV's poses, each refined until nothing changes."""
    h = size / 2
    square = np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])
    _, turns, places, _ = cv2.solvePnPGeneric(
        square, pixels, camera.K, camera.D, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    errors = []
    for turn, place in zip(turns, places, strict=True):
        if not (np.isfinite(turn).all() and np.isfinite(place).all()):
            continue
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-12)
        turn, place = cv2.solvePnPRefineLM(
            square, pixels, camera.K, camera.D, turn.copy(), place.copy(), criteria
        )
        seen, _ = cv2.projectPoints(square, turn, place, camera.K, camera.D)
        errors.append(float(((seen[:, 0] - pixels) ** 2).sum()))
    return sorted(errors)


def test_homographies_are_opencvs() -> None:
    rng = np.random.default_rng(1)
    square = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]], np.float32)
    pixels = pixels_of(STRAIGHT, *random_markers(50)) + rng.normal(0, 1, (50, 4, 2))
    for H, quad in zip(homography_of_square(pixels), pixels, strict=True):
        expected = cv2.getPerspectiveTransform(square, quad.astype(np.float32))
        np.testing.assert_allclose(H, expected, rtol=1e-3, atol=1e-3)
        mapped = np.column_stack([square, np.ones(4)]) @ H.T
        np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], quad, atol=1e-9)


@pytest.mark.parametrize("camera", [STRAIGHT, BARREL])
def test_without_noise_the_true_pose_comes_first(camera: PinholeCamera) -> None:
    R, p, sizes = random_markers(500)
    poses = solve(camera, pixels_of(camera, R, p, sizes), sizes)
    np.testing.assert_allclose(poses.R[:, 0], R, atol=1e-7)
    np.testing.assert_allclose(poses.p[:, 0], p, atol=1e-7)
    np.testing.assert_allclose(poses.squared_error[:, 0], 0.0, atol=1e-12)
    assert (poses.squared_error[:, 1] > 1e-6).all()
    np.testing.assert_array_equal(poses.reprojection_rms(), np.sqrt(poses.squared_error / 4))


def test_without_noise_the_closed_form_needs_no_refinement() -> None:
    R, p, sizes = random_markers(200, seed=2)
    rays = STRAIGHT.undistort(pixels_of(STRAIGHT, R, p, sizes))
    good, R_both, p_both = closed_form(rays, sizes)
    assert good.all()
    best = angle_between(R_both, R[:, None]).argmin(axis=1)
    np.testing.assert_allclose(R_both[np.arange(200), best], R, atol=1e-6)
    np.testing.assert_allclose(p_both[np.arange(200), best], p, atol=1e-6)


@pytest.mark.parametrize("camera", [STRAIGHT, BARREL])
@pytest.mark.parametrize("noise", [0.1, 0.5])
def test_never_worse_than_opencv(camera: PinholeCamera, noise: float) -> None:
    R, p, sizes = random_markers(150, seed=3)
    pixels = pixels_of(camera, R, p, sizes)
    pixels += np.random.default_rng(4).normal(0, noise, pixels.shape)
    poses = solve(camera, pixels, sizes)
    ours = pixels_of(camera, poses.R[:, 0], poses.p[:, 0], sizes) - pixels
    for k, error in enumerate((ours**2).sum(axis=(1, 2))):
        theirs = opencv(camera, pixels[k], sizes[k])
        assert error <= theirs[0] * (1 + 2e-3) + 1e-5
        # Theirs may end in one minimum, from either start.
        if poses.second_is_minimum[k] and len(theirs) == 2 and theirs[1] > 1.1 * theirs[0]:
            assert poses.squared_error[k, 1] <= theirs[1] * (1 + 2e-2) + 1e-4


def test_both_poses_are_minima_of_their_own() -> None:
    R, p, sizes = random_markers(200, seed=5)
    pixels = pixels_of(STRAIGHT, R, p, sizes)
    pixels += np.random.default_rng(6).normal(0, 0.3, pixels.shape)
    rays, by_ray = STRAIGHT.rays(pixels)
    poses = planar_poses(rays, by_ray, sizes)
    # A second pose that leaves more than 2 px is none for anyone, and may be a saddle.
    two = poses.second_is_minimum & (poses.reprojection_rms()[:, 1] < 2.0)
    assert two.sum() > 60
    assert (poses.squared_error[:, 0] <= poses.squared_error[:, 1]).all()
    assert (angle_between(poses.R[two, 0], poses.R[two, 1]) >= SAME_POSE).all()
    points = marker_corners(1.0) * sizes[:, None, None]
    rng = np.random.default_rng(7)
    for which in (0, 1):
        error = poses.squared_error[two, which]
        for step in (1e-3, 1e-2):
            for _ in range(5):
                away = rotation_from_vector(rng.normal(0, step, (two.sum(), 3)))
                near = squared_errors(
                    away @ poses.R[two, which],
                    poses.p[two, which] * rng.normal(1, step, (two.sum(), 1)),
                    points[two],
                    rays[two],
                    by_ray[two],
                )
                assert (near > error * (1 - 1e-5) - 1e-6).all()


def test_seen_from_the_front_the_second_is_the_mirror_image() -> None:
    for offset in ([0.0, 0.0], [0.2, -0.1]):
        p = np.array([[*offset, 1.0]])
        to_camera = -p[0] / np.linalg.norm(p[0])
        # Tilted so little that 0.2 px of noise leave but one minimum.
        R = facing(np.deg2rad(3))[None]
        pixels = pixels_of(STRAIGHT, R, p, [0.1])
        merged = 0
        for seed in range(40):
            noisy = pixels + np.random.default_rng(seed).normal(0, 0.2, pixels.shape)
            poses = solve(STRAIGHT, noisy, [0.1])
            if poses.second_is_minimum[0]:
                continue
            merged += 1
            first, second = poses.R[0, :, :, 0]  # the normals
            reflected = 2 * (first @ to_camera) * to_camera - first
            np.testing.assert_allclose(second, reflected, atol=5e-3)
            assert poses.squared_error[0, 1] >= poses.squared_error[0, 0]
            np.testing.assert_allclose(poses.p[0, 1], poses.p[0, 0], rtol=0.05, atol=5e-3)
        assert merged > 5


@pytest.mark.parametrize("camera", [STRAIGHT, BARREL])
@pytest.mark.parametrize("place", [[0.0, 0.0], [0.1, 0.05], [-0.2, 0.15]])
@pytest.mark.parametrize("turn", [0.0, np.pi / 4, 2.0])
def test_frontal_markers_have_a_pose(
    camera: PinholeCamera, place: list[float], turn: float
) -> None:
    # The one centred on the principal point is where OpenCV's IPPE_SQUARE gives NaN.
    R, p = facing(0.0, turn=turn)[None], np.array([[*place, 1.0]])
    poses = solve(camera, pixels_of(camera, R, p, [0.1]), [0.1])
    np.testing.assert_allclose(poses.R[0, 0], R[0], atol=1e-3)
    np.testing.assert_allclose(poses.p[0, 0], p[0], atol=1e-5)
    assert np.isfinite(poses.R).all()
    assert np.isfinite(poses.p).all()
    assert np.isfinite(poses.squared_error).all()


def test_exact_squares_about_the_principal_point_never_give_nan() -> None:
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 1.0
    for side in np.linspace(5.0, 200.0, 40):
        poses = solve(STRAIGHT, (K[:2, 2] + square * side / 2)[None], [0.1])
        assert np.isfinite(poses.squared_error).all()
        assert np.isfinite(poses.R).all()
        # Not a square in rays: fx and fy differ by 3 %, so it is seen tilted by 15 degrees.
        assert poses.p[0, 0, 2] == pytest.approx(0.1 * 600 / side, rel=0.05)


@pytest.mark.parametrize(
    "order",
    [[0, 2, 1, 3], [3, 2, 1, 0], [0, 0, 2, 3], [0, 0, 0, 0]],
    ids=["crossed", "from behind", "triangle", "point"],
)
def test_corners_that_admit_no_pose(order: list[int]) -> None:
    pixels = pixels_of(BARREL, *random_markers(3))
    pixels[1] = pixels[1, order]
    sizes = np.full(3, 0.1)
    poses = solve(BARREL, pixels, sizes)
    assert np.isinf(poses.squared_error[1]).all()
    np.testing.assert_array_equal(poses.R[1], [np.eye(3)] * 2)
    assert np.isfinite(poses.squared_error[[0, 2]]).all()
    assert closed_form(BARREL.undistort(pixels), sizes)[0].tolist() == [True, False, True]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_corners_that_are_not_finite_admit_no_pose(value: float) -> None:
    pixels = pixels_of(STRAIGHT, *random_markers(2))
    pixels[0, 2, 1] = value
    poses = solve(STRAIGHT, pixels, np.full(2, 0.1))
    assert np.isinf(poses.squared_error[0]).all()
    assert np.isfinite(poses.squared_error[1]).all()
    alone = solve(STRAIGHT, pixels[:1], np.full(1, 0.1))
    assert np.isinf(alone.squared_error).all()


def test_whatever_the_corners_nothing_is_nan() -> None:
    rng = np.random.default_rng(8)
    for scale in (0.01, 1.0, 30.0, 300.0, 1e4):
        pixels = K[:2, 2] + rng.normal(0, scale, (2000, 4, 2))
        poses = solve(BARREL, pixels, np.full(2000, 0.1))
        for array in (poses.R, poses.p, poses.information):
            assert np.isfinite(array).all()
        assert not np.isnan(poses.squared_error).any()


def test_markers_do_not_influence_each_other() -> None:
    R, p, sizes = random_markers(20, seed=9)
    pixels = pixels_of(BARREL, R, p, sizes)
    pixels += np.random.default_rng(10).normal(0, 0.5, pixels.shape)
    together = solve(BARREL, pixels, sizes)
    for k in range(20):
        alone = solve(BARREL, pixels[k : k + 1], sizes[k : k + 1])
        np.testing.assert_allclose(alone.R[0], together.R[k], atol=1e-9)
        np.testing.assert_allclose(alone.p[0], together.p[k], atol=1e-9)
    assert len(solve(BARREL, pixels[:0], sizes[:0])) == 0


def test_the_pose_scales_with_the_marker() -> None:
    pixels = pixels_of(BARREL, *random_markers(10, seed=11))
    small, large = (solve(BARREL, pixels, np.full(10, size)) for size in (0.1, 0.3))
    np.testing.assert_allclose(large.p, 3 * small.p, rtol=1e-6)
    np.testing.assert_allclose(large.R, small.R, atol=1e-6)
    np.testing.assert_allclose(large.squared_error, small.squared_error, rtol=1e-6, atol=1e-12)
