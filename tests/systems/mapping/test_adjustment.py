"""The adjustment against dense algebra, finite differences, truth, and its own covariances."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from systems.mapping.adjustment import System, adjust
from systems.mapping.scene import Motion, Scene, motion_residuals, residuals, rotation_vector
from systems.mapping.sightings import Sightings
from systems.markers.pnp import rotation_from_vector
from tests.mapping_world import Circuit, circuit

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def world() -> Circuit:
    """A small one: dense algebra has to do it too."""
    return circuit(frames=24, tags=24)


def moved(scene: Scene, size: float, rng: np.random.Generator, anchor: int | None = 0) -> Scene:
    """Returns a scene off by about `size` (rad, m), the anchor in place."""
    tags = size * rng.standard_normal((len(scene.p_WT), 6))
    if anchor is not None:
        tags[anchor] = 0
    return scene.moved(size * rng.standard_normal((len(scene.p_CW), 6)), tags)


def motion_of(scene: Scene, rng: np.random.Generator | None = None) -> Motion:
    """Returns the scene's own motion, told with an error of 0.01 rad and 0.02 m."""
    R = scene.R_CW[:-1] @ scene.R_CW[1:].swapaxes(1, 2)
    p = scene.p_CW[:-1] - (R @ scene.p_CW[1:, :, None])[..., 0]
    n = len(R)
    if rng is not None:
        R = rotation_from_vector(0.01 * rng.standard_normal((n, 3))) @ R
        p = p + 0.02 * rng.standard_normal((n, 3))
    return Motion(R, p, np.tile(np.diag([100.0] * 3 + [50.0] * 3), (n, 1, 1)))


def test_derivatives_of_corners_are_those_of_finite_differences(world: Circuit) -> None:
    sightings = world.sightings(noise=0.5)
    scene = moved(world.scene, 0.02, np.random.default_rng(1))
    _, by_camera, by_tag = residuals(scene, sightings)
    still = np.zeros((sightings.frames, 6)), np.zeros((sightings.tags, 6))
    for k in range(6):
        for which, derivative in enumerate((by_camera, by_tag)):
            step = [part.copy() for part in still]
            step[which][:, k] = 1e-6
            ahead, _, _ = residuals(scene.moved(*step), sightings)
            step[which][:, k] = -1e-6
            behind, _, _ = residuals(scene.moved(*step), sightings)
            slope = (ahead - behind) / 2e-6
            np.testing.assert_allclose(derivative[:, :, k], slope, rtol=1e-5, atol=1e-3)


def test_derivatives_of_motion_are_those_of_finite_differences(world: Circuit) -> None:
    motion = motion_of(world.scene)
    # At the truth: what is left out of the derivative is of the size of the error.
    _, here, there = motion_residuals(world.scene, motion)
    tags = np.zeros((len(world.scene.p_WT), 6))
    n = len(world.scene.p_CW)
    for k in range(6):
        for offset, derivative in ((0, here), (1, there)):
            for camera in range(offset, n - 1 + offset, 5):
                step = np.zeros((n, 6))
                step[camera, k] = 1e-6
                ahead, _, _ = motion_residuals(world.scene.moved(step, tags), motion)
                np.testing.assert_allclose(
                    derivative[camera - offset, :, k], ahead[camera - offset] / 1e-6, atol=1e-3
                )


@pytest.mark.parametrize("with_motion", [False, True])
def test_steps_and_covariances_are_those_of_dense_algebra(
    world: Circuit, with_motion: bool
) -> None:
    rng = np.random.default_rng(2)
    sightings = world.sightings(noise=0.5)
    scene = moved(world.scene, 0.02, rng)
    motion = motion_of(world.scene, rng) if with_motion else None
    system = System(scene, sightings, motion, anchor=0, huber=np.inf)
    J, r = dense(scene, sightings, motion)
    free = np.r_[0 : 6 * sightings.frames, 6 * sightings.frames + 6 : J.shape[1]]
    H = J[:, free].T @ J[:, free]
    expected = np.linalg.solve(H, -J[:, free].T @ r)
    cameras, tags, gain = system.step(0.0)
    found = np.concatenate([cameras.ravel(), tags[1:].ravel()])
    # The block's diagonals are raised by a 1e-12th, against rounding.
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    assert gain == pytest.approx(float(r @ J[:, free] @ -expected), rel=1e-5)
    assert not tags[0].any()
    of_tags, of_cameras = system.covariances()
    covariance = np.linalg.inv(H)
    size = np.abs(covariance).max()
    for k in range(sightings.frames):
        block = slice(6 * k, 6 * k + 6)
        np.testing.assert_allclose(of_cameras[k], covariance[block, block], atol=1e-5 * size)
    for k in range(1, sightings.tags):
        block = slice(6 * (sightings.frames + k - 1), 6 * (sightings.frames + k))
        np.testing.assert_allclose(of_tags[k], covariance[block, block], atol=1e-5 * size)


def dense(scene: Scene, sightings: Sightings, motion: Motion | None) -> tuple[Array, Array]:
    """Returns the whole Jacobian and residuals, cameras first."""
    r, by_camera, by_tag = residuals(scene, sightings)
    m, frames = len(sightings), sightings.frames
    J = np.zeros((8 * m, 6 * (frames + sightings.tags)))
    for k in range(m):
        rows = slice(8 * k, 8 * k + 8)
        camera, tag = 6 * sightings.frame[k], 6 * (frames + sightings.tag[k])
        J[rows, camera : camera + 6], J[rows, tag : tag + 6] = by_camera[k], by_tag[k]
    r = r.ravel()
    if motion is not None:
        e, here, there = motion_residuals(scene, motion)
        more = np.zeros((6 * (frames - 1), J.shape[1]))
        for k in range(frames - 1):
            more[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = here[k]
            more[6 * k : 6 * k + 6, 6 * k + 6 : 6 * k + 12] = there[k]
        J, r = np.vstack([J, more]), np.concatenate([r, e.ravel()])
    return J, r


def test_without_noise_the_truth_is_found() -> None:
    world = circuit(frames=60)
    start = moved(world.scene, 0.03, np.random.default_rng(3))
    found = adjust(start, world.sightings(), anchor=0, tolerance=1e-12)
    assert found.converged
    np.testing.assert_allclose(found.scene.p_WT, world.scene.p_WT, atol=1e-6)
    np.testing.assert_allclose(found.scene.positions(), world.scene.positions(), atol=1e-6)
    assert found.squared.sum() < 1e-8


@pytest.mark.parametrize("with_motion", [False, True])
def test_errors_are_as_large_as_the_covariances_say(with_motion: bool) -> None:
    world = circuit(frames=40)
    noise, of_tags, of_cameras, chi2 = 0.3, [], [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        sightings = world.sightings(noise, seed)
        motion = motion_of(world.scene, rng) if with_motion else None
        found = adjust(world.scene, sightings, anchor=0, pixel_noise=noise, motion=motion)
        errors = tangent(found.scene.R_WT, world.scene.R_WT, found.scene.p_WT - world.scene.p_WT)
        of_tags += [nees(e, C) for e, C in zip(errors[1:], found.tag_covariance[1:], strict=True)]
        errors = tangent(found.scene.R_CW, world.scene.R_CW, found.scene.p_CW - world.scene.p_CW)
        of_cameras += [nees(e, C) for e, C in zip(errors, found.camera_covariance, strict=True)]
        degrees = 8 * len(sightings) - 6 * (sightings.frames + sightings.tags - 1)
        degrees += 6 * len(found.squared_motion)
        chi2.append((found.squared.sum() + found.squared_motion.sum()) / degrees)
    # Tags share their errors along the circuit: a run is worth few draws of the 6 numbers.
    assert np.mean(of_tags) == pytest.approx(1.0, abs=0.35)
    assert np.mean(of_cameras) == pytest.approx(1.0, abs=0.35)
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.03)


def tangent(R: Array, R_true: Array, p: Array) -> Array:
    """Returns errors (n, 6), rotation first."""
    return np.concatenate([rotation_vector(R @ R_true.swapaxes(1, 2)), p], axis=1)


def nees(error: Array, covariance: Array) -> float:
    """Returns the squared error in units of its covariance, by dimension."""
    return float(error @ np.linalg.solve(covariance, error) / len(error))


def test_a_tag_that_was_misread_pulls_little() -> None:
    world = circuit(frames=60)
    sightings = world.sightings(0.3)
    rays = sightings.rays.copy()
    rays[::40] += 0.1  # 48 px
    spoiled = Sightings(
        sightings.frame, sightings.tag, rays, sightings.by_ray, sightings.sizes, sightings.frames
    )
    robust = adjust(world.scene, spoiled, anchor=0, pixel_noise=0.3)
    plain = adjust(world.scene, spoiled, anchor=0, pixel_noise=0.3, huber=np.inf)
    off = [np.abs(a.scene.p_WT - world.scene.p_WT).max() for a in (robust, plain)]
    assert off[0] < 0.1 < 0.3 < off[1]


def test_motion_over_left_out_frames_is_the_product_with_its_uncertainty(world: Circuit) -> None:
    motion = motion_of(world.scene)
    some = motion.over(np.array([0, 3, 4]))
    scene = world.scene
    for k, (i, j) in enumerate(((0, 3), (3, 4))):
        R = scene.R_CW[i] @ scene.R_CW[j].T
        np.testing.assert_allclose(some.R[k], R, atol=1e-9)
        np.testing.assert_allclose(some.p[k], scene.p_CW[i] - R @ scene.p_CW[j], atol=1e-9)
    np.testing.assert_allclose(some.root[1].T @ some.root[1], motion.root[3].T @ motion.root[3])
    rng = np.random.default_rng(4)
    draws = []
    for _ in range(4000):
        noisy = motion_of(scene, rng)
        p = noisy.p[0] + noisy.R[0] @ (noisy.p[1] + noisy.R[1] @ noisy.p[2])
        turn = rotation_vector((noisy.R[0] @ noisy.R[1] @ noisy.R[2] @ some.R[0].T)[None])[0]
        draws.append([*turn, *(p - some.p[0])])
    covariance = np.linalg.inv(some.root[0].T @ some.root[0])
    np.testing.assert_allclose(
        np.cov(np.transpose(draws)), covariance, atol=0.06 * covariance.max()
    )


def test_rotation_vectors_undo_the_exponential() -> None:
    rng = np.random.default_rng(5)
    w = rng.standard_normal((200, 3))
    w *= (rng.uniform(0, 3.1, 200) / np.linalg.norm(w, axis=1))[:, None]
    w[0], w[1] = 0, (1e-12, 0, 0)
    np.testing.assert_allclose(rotation_vector(rotation_from_vector(w)), w, atol=1e-9)
