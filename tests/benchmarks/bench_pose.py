"""How well poses are known from markers: a single one rendered, several together, and the speed."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from systems.angles import planar_pose, spatial_pose, wrap
from systems.cameras import PinholeCamera, load_camera
from systems.image_effects import ImageEffects
from systems.markers.detector import MarkerDetector
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap, marker_corners
from systems.markers.localizer import LocalizerParameters, MapLocalizer
from systems.markers.planar_pose import planar_poses
from systems.markers.pnp import refine
from systems.messages import Detections
from tests.benchmarks.table import Row, show
from tests.rendering import Studio

Array = NDArray[np.float64]

CAMERAS = Path(__file__).resolve().parents[2] / "diagrams" / "cameras"
X_BC = RigidTransform(
    RotationMatrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])),
    [0.115, 0.0, 0.12],
)
EFFECTS = ImageEffects(shot_noise=2.0, read_noise=1.0, focus_blur=0.5)
# Fitted to what the detector shows on pictures of Drake's renderer; a test holds them together.
NOISE = LocalizerParameters(pixel_noise=0.018, pixel_noise_by_side=1.05)
SIZE = 0.10  # m


def rows() -> Iterator[Row]:
    """Yields the measurements."""
    camera = load_camera(CAMERAS / "vga.yaml")
    yield from heading_rows(camera)
    yield from joint_rows(camera)
    yield speed_row(camera)


def heading_rows(camera: PinholeCamera, draws: int = 300) -> Iterator[Row]:
    """Visual heading of a robot at rest, by one 10 cm marker at 1 to 1.5 m, rendered."""
    kind = family("DICT_4X4_50")
    at_origin = MarkerMap(kind, SIZE, {7: Marker(7, RigidTransform(), SIZE)})
    wall = RigidTransform([-0.02, 0.0, 0.0])
    studio = Studio(markers=at_origin, camera=camera, effects=EFFECTS, wall=wall)
    detector = MarkerDetector(family=kind, camera=camera)
    for low, high in ((0, 5), (5, 10), (10, 15), (15, 20), (20, 30), (30, 60)):
        errors, bounds, accepted, corner_errors = [], [], [], []
        rng = np.random.default_rng(low)
        for pose, marker in heading_draws(rng, low, high, draws):
            X_WC = spatial_pose(pose) @ X_BC
            found = detector.detect(studio.picture(marker.X_WM.inverse() @ X_WC, rng), stamp=0.0)
            true_corners = camera.project(X_WC.inverse().multiply(marker.corners().T).T)
            if len(found) != 1:
                continue
            corner_errors.append(found.corners[0] - true_corners)
            localizer = MapLocalizer(
                marker_map=MarkerMap(kind, SIZE, {7: marker}), camera=camera, X_BC=X_BC,
                parameters=NOISE,
            )  # fmt: skip
            found_pose = localizer.locate(found).pose
            errors.append(wrap(planar_pose(found_pose.pose)[2] - pose[2]))
            accepted.append(not found_pose.ambiguous)
            bounds.append(heading_bound(camera, marker, X_WC))
        noise = float(np.std(corner_errors))
        bound = np.degrees(noise * np.sqrt(np.mean(np.square(bounds))))
        mask = np.array(accepted, bool)
        everything = np.degrees(_rms(np.array(errors)))
        taken = np.degrees(_rms(np.array(errors)[mask])) if mask.any() else np.nan
        taken_bound = np.degrees(noise * _rms(np.array(bounds)[mask])) if mask.any() else np.nan
        share = (
            f"{mask.mean():.0%} accepted of {len(mask)}, bound {bound:.2f}, all {everything:.2f}"
        )
        what = f"heading by one marker, tilt {low}-{high} deg"
        if low >= 30:
            yield Row(what, f"{taken:.2f} deg RMS ({share})", "< 1 deg", bool(taken < 1.0))
        else:
            reached = None if not mask.any() else bool(taken <= 1.2 * taken_bound)
            value = f"{taken:.2f} deg RMS, {taken / taken_bound:.2f} x bound ({share})"
            yield Row(what, value, "<= 1.2 x Cramer-Rao bound", reached)


def heading_draws(
    rng: np.random.Generator, low: float, high: float, draws: int
) -> Iterator[tuple[Array, Marker]]:
    """Yields robot poses and markers that face them but for a tilt of low to high degrees."""
    for _ in range(draws):
        distance, tilt = rng.uniform(1.0, 1.5), np.radians(rng.uniform(low, high))
        across = rng.uniform(0, 2 * np.pi) if high <= 30 else rng.choice([0.0, np.pi])
        axis = np.array([0.0, np.sin(across), np.cos(across)])
        bearing = rng.uniform(-0.3, 0.3)
        p = np.array([distance * np.cos(bearing), distance * np.sin(bearing), 0.12])
        facing = RollPitchYaw(0.0, 0.0, np.pi + bearing).ToRotationMatrix()
        X = RigidTransform(facing @ _rotation(axis * tilt), p + X_BC.translation())
        yield np.array([0.0, 0.0, rng.uniform(-0.02, 0.02)]), Marker(7, X, SIZE)


def heading_bound(camera: PinholeCamera, marker: Marker, X_WC: RigidTransform) -> float:
    """Returns the Cramer-Rao bound of the heading for corner noise of 1 px, rad."""
    X_CW = X_WC.inverse()
    p_C = X_CW.multiply(marker.corners().T).T
    rays, by_ray = camera.rays(camera.project(p_C))
    solution = refine(
        X_CW.rotation().matrix()[None], X_CW.translation()[None], marker.corners(), rays, by_ray,
        iterations=0,
    )  # fmt: skip
    covariance = np.linalg.inv(solution.information[0])
    up_C = X_CW.rotation().matrix()[:, 2]  # the world's z in the optical frame
    return float(np.sqrt(up_C @ covariance[:3, :3] @ up_C))


def joint_rows(camera: PinholeCamera, scenes: int = 12, draws: int = 100) -> Iterator[Row]:
    """Joint pose of all visible markers against the best single one, with noise on the corners."""
    rng = np.random.default_rng(7)
    noise = 0.2
    ratios, consistency = [], []
    for scene in range(scenes):
        markers = _scene(rng, count=2 + scene % 5)
        pose = np.array([0.0, rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1)])
        X_CW = (spatial_pose(pose) @ X_BC).inverse()
        ids = np.array([marker.id for marker in markers])
        points = X_CW.multiply(markers.corners(ids).reshape(-1, 3).T).T
        corners = camera.project(points).reshape(-1, 4, 2)
        errors: dict[str, list[Array]] = {"all": [], **{str(i): [] for i in ids}}
        normalised = []
        for _ in range(draws):
            noisy = corners + noise * rng.standard_normal(corners.shape)
            zeros = np.zeros(len(ids))
            seen = Detections(0.0, "", "", ids, noisy, zeros.astype(int), zeros)
            for name in errors:
                localizer = MapLocalizer(
                    marker_map=markers, camera=camera, X_BC=X_BC,
                    parameters=LocalizerParameters(pixel_noise=noise),
                )  # fmt: skip
                view = seen if name == "all" else seen.select(ids == int(name))
                found = localizer.locate(view).pose
                if not found.valid or (name == "all" and found.ambiguous):
                    continue
                error = _tangent(found.pose, spatial_pose(pose))
                errors[name].append(error)
                if name == "all":
                    normalised.append(error @ np.linalg.solve(found.covariance, error) / 6)
        single = min(_rms(np.array(e)[:, 3:]) for n, e in errors.items() if n != "all" and e)
        ratios.append(_rms(np.array(errors["all"])[:, 3:]) / single)
        consistency.append(np.mean(normalised))
    yield Row(
        f"joint pose of 2-6 markers, {scenes} scenes x {draws}: position RMS / best single's",
        f"{min(ratios):.2f} to {max(ratios):.2f}", "< 1 in every scene", max(ratios) < 1,
    )  # fmt: skip
    yield Row(
        "the same: NEES per dimension",
        f"{min(consistency):.2f} to {max(consistency):.2f}, mean {np.mean(consistency):.2f}",
        "mean 0.8 to 1.25", bool(0.8 <= np.mean(consistency) <= 1.25),
    )  # fmt: skip


def speed_row(camera: PinholeCamera) -> Row:
    """Both refined poses of four markers, against OpenCV's."""
    rng = np.random.default_rng(3)
    corners = []
    for k in range(4):
        X = RigidTransform(RollPitchYaw(0.0, 0.1 * k, np.pi + 0.4), [1.2, 0.15 * k - 0.2, 0.1])
        corners.append(camera.project((X_BC.inverse() @ X).multiply(marker_corners(0.1).T).T))
    pixels = np.array(corners) + 0.2 * rng.standard_normal((4, 4, 2))
    model = marker_corners(0.1)[:, [1, 2, 0]]

    def ours() -> None:
        planar_poses(*camera.rays(pixels), np.full(4, 0.1))

    def theirs() -> None:
        for quad in pixels:
            _, rotations, translations, _ = cv2.solvePnPGeneric(
                model, quad, camera.K, camera.D, flags=cv2.SOLVEPNP_IPPE_SQUARE
            )
            for r, t in zip(rotations, translations, strict=True):
                cv2.solvePnPRefineLM(model, quad, camera.K, camera.D, r, t)

    a, b = _interleaved(ours, theirs)
    return Row("both refined poses of 4 markers", f"{a * 1e3:.2f} ms, {a / b:.2f} x OpenCV's",
               peers=f"OpenCV IPPE + LM: {b * 1e3:.2f} ms")  # fmt: skip


def _interleaved(*functions: object, repeats: int = 60) -> list[float]:
    best = [np.inf] * len(functions)
    for _ in range(repeats):
        for k, function in enumerate(functions):
            started = time.perf_counter()
            function()  # type: ignore[operator]
            best[k] = min(best[k], time.perf_counter() - started)
    return best


def _scene(rng: np.random.Generator, count: int) -> MarkerMap:
    markers = {}
    for k in range(count):
        y = (k - (count - 1) / 2) * 0.32
        R = RollPitchYaw(0.0, 0.0, np.pi + rng.uniform(-0.7, 0.7))
        p = [1.7 + rng.uniform(-0.3, 0.3), y, 0.2 + rng.uniform(-0.12, 0.12)]
        markers[k] = Marker(k, RigidTransform(R, p), 0.12)
    return MarkerMap(family("DICT_4X4_50"), 0.12, markers)


def _tangent(X: RigidTransform, X_true: RigidTransform) -> Array:
    """Returns the error in the covariance's tangent: rotation vector in W, then position."""
    turn = (X.rotation() @ X_true.rotation().inverse()).ToAngleAxis()
    return np.concatenate([turn.axis() * turn.angle(), X.translation() - X_true.translation()])


def _rotation(w: Array) -> RotationMatrix:
    R, _ = cv2.Rodrigues(w)
    return RotationMatrix.ProjectToRotationMatrix(R)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    show("Poses from markers", rows())
