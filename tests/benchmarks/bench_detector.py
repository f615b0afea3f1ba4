"""How exact the detector's corners are, what it takes for markers, and what it costs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
from apriltag import apriltag
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from systems.cameras import PinholeCamera
from systems.markers.detector import MarkerDetector
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap, marker_corners
from tests.benchmarks.table import Row, show
from tests.recordings import FOLDER
from tests.rendering import Studio
from tests.synthetic import (
    CornerErrors,
    Sheet,
    corner_errors,
    draw,
    expose,
    jagged,
    posed_homography,
    random_sheets,
)

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]
Find = Callable[[Grey], tuple[NDArray[np.int64], Array]]
Pictures = list[tuple[Grey, Array]]  # and the true corners of the markers 0, 1, ...

ARUCO, APRILTAG = "DICT_4X4_50", "tag36h11"
REFINEMENTS = {"NONE": 0, "SUBPIX": 1, "CONTOUR": 2, "APRILTAG": 3}  # cv2.aruco.CORNER_REFINE_*


def rows() -> Iterator[Row]:
    """Yields the measurements."""
    cv2.setNumThreads(1)
    drawn = "corners (px), anti-aliased, side 30-70 px, tilt to 60 deg"
    yield from corner_rows(drawn, synthetic, std=0.05, bias=0.02)
    noisy = "the same with noise of 5 grey levels"
    yield from corner_rows(noisy, lambda name: synthetic(name, noise=5.0), std=0.05, bias=0.02)
    blurred = "the same, out of focus (1.5 px)"
    yield from corner_rows(blurred, lambda name: synthetic(name, blur=1.5))
    small = "the same, side 15-30 px"
    yield from corner_rows(small, lambda name: synthetic(name, side=(15.0, 30.0), pitch=80))
    without = "the same without anti-aliasing"
    yield from corner_rows(without, lambda name: synthetic(name, smooth=False), std=0.2, bias=0.02)
    rendered = "the same by Drake's renderer (VTK)"
    yield from corner_rows(rendered, drake_pictures, std=0.2, bias=0.02)
    yield from found_rows()
    yield from clutter_rows()
    yield from speed_rows()


def found_rows() -> Iterator[Row]:
    """How many markers the block finds beside OpenCV with its defaults."""
    for side, pitch in (((12.0, 16.0), 80), ((16.0, 24.0), 80), ((24.0, 40.0), 80)):
        for blur, contrast in ((0.0, 1.0), (1.0, 1.0), (1.5, 0.5), (2.0, 0.25)):
            rng = np.random.default_rng(7)
            found, placed = np.zeros(2, int), 0
            block, engine = MarkerDetector(family=ARUCO), opencv_engine(0)
            for _ in range(8):
                sheets = random_sheets(rng, family(ARUCO), side=side, pitch=pitch)[:50]
                picture = 128 + contrast * (draw((480, 640), sheets, blur=blur) - 128)
                image = expose(picture * np.linspace(0.5, 1.0, 640), noise=4.0, rng=rng)
                there = range(len(sheets))
                for k, ids in enumerate((block.detect(image).ids, engine(image)[0])):
                    found[k] += len(set(ids.tolist()) & set(there))
                placed += len(sheets)
            ours, theirs = found / placed
            what = (
                f"found, side {side[0]:g}-{side[1]:g} px, blur {blur:g} px, contrast {contrast:g}"
            )
            yield Row(what, f"{ours:.0%}", "", None, f"OpenCV: {theirs:.0%}")


def corner_rows(
    what: str,
    pictures_of: Callable[[str], Pictures],
    std: float | None = None,
    bias: float | None = None,
) -> Iterator[Row]:
    """The block's corner errors beside its engines' own, on the same pictures."""
    for name in (ARUCO, APRILTAG):
        pictures = pictures_of(name)
        ours = errors_of(MarkerDetector(family=name), pictures)
        reached, goal = None, ""
        if std is not None and bias is not None:
            reached = ours.std <= std and ours.shift <= bias and abs(ours.grow) <= bias
            goal = f"std {std}, shift and grow {bias}"
        if name == APRILTAG:
            peers = {"AprilTag 3": apriltag_engine()}
        else:
            peers = {f"OpenCV {label}": opencv_engine(k) for label, k in REFINEMENTS.items()}
        table = [f"{label}: {text(errors_of(peer, pictures))}" for label, peer in peers.items()]
        yield Row(f"{what}, {name}", text(ours), goal, reached, "\n".join(table))


def errors_of(detector: MarkerDetector | Find, pictures: Pictures) -> CornerErrors:
    """Runs a detector over pictures; peers' false detections are left out."""
    results = []
    for image, truth in pictures:
        if isinstance(detector, MarkerDetector):
            found = detector.detect(image)
            ids, corners = found.ids, found.corners
        else:
            ids, corners = detector(image)
        real = [
            k
            for k, (i, c) in enumerate(zip(ids, corners, strict=True))
            if i < len(truth) and np.abs(c.mean(axis=0) - truth[i].mean(axis=0)).max() < 10
        ]
        results.append((ids[real], corners[real], truth))
    return corner_errors(results)


def text(errors: CornerErrors) -> str:
    """One line of figures."""
    return (
        f"std {errors.std:.4f} shift {errors.shift:.3f} grow {errors.grow:+.3f} "
        f"worst {errors.worst:.2f} ({errors.found:.0%} found)"
    )


def opencv_engine(refinement: int, error_correction: float = 0.6) -> Find:
    """OpenCV's ArUco detector with that corner refinement and otherwise its defaults."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = refinement
    parameters.errorCorrectionRate = error_correction
    engine = cv2.aruco.ArucoDetector(family(ARUCO).opencv_dictionary(), parameters)

    def find(image: Grey) -> tuple[NDArray[np.int64], Array]:
        corners, ids, _ = engine.detectMarkers(image)
        if ids is None:
            return np.zeros(0, np.int64), np.zeros((0, 4, 2))
        return ids.ravel().astype(np.int64), np.concatenate(corners).astype(float)

    return find


def apriltag_engine() -> Find:
    """AprilTag 3 at full resolution, its half pixel taken off."""
    engine = apriltag(APRILTAG, threads=1, decimate=1.0, maxhamming=1)

    def find(image: Grey) -> tuple[NDArray[np.int64], Array]:
        tags = engine.detect(image)
        corners = np.array([tag["lb-rb-rt-lt"][::-1] for tag in tags]).reshape(-1, 4, 2)
        return np.array([tag["id"] for tag in tags], np.int64), corners - 0.5

    return find


def synthetic(
    name: str,
    *,
    noise: float = 0.0,
    blur: float = 0.0,
    smooth: bool = True,
    count: int = 6,
    **sheets: Any,
) -> Pictures:
    """Markers drawn with exact pixels (or, not smooth, by sampling pixel centres)."""
    rng = np.random.default_rng(1)
    pictures = []
    for _ in range(count):
        placed = random_sheets(rng, family(name), **sheets)
        if smooth:
            image = expose(draw((480, 640), placed, blur=blur), noise=noise, rng=rng)
        else:
            image = jagged((480, 640), placed)
        pictures.append((image, np.stack([sheet.corners() for sheet in placed])))
    return pictures


def drake_pictures(name: str, count: int = 60) -> Pictures:
    """One board in each picture, rendered without supersampling, noise or blur."""
    camera = PinholeCamera.from_focal_length(240, 200, 600.0)
    size = 0.16
    board = Marker(id=0, X_WM=RigidTransform(), size=size)
    studio = Studio(markers=MarkerMap(family(name), size, {0: board}), camera=camera)
    facing = np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])  # marker frame to optical frame
    rng = np.random.default_rng(2)
    pictures = []
    for _ in range(count):
        axis = rng.uniform(0, 2 * np.pi)
        tilt = rng.uniform(0, np.pi / 3) * np.array([np.cos(axis), np.sin(axis), 0.0])
        lean, _ = cv2.Rodrigues(tilt)
        spin, _ = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(0, 2 * np.pi)]))
        z = camera.K[0, 0] * size / rng.uniform(30, 70)
        x, y = rng.uniform(-0.5, 0.5, 2) * z / camera.K[0, 0]
        X_CM = RigidTransform(RotationMatrix(lean @ spin @ facing), [x, y, z])
        truth = camera.project(X_CM.multiply(marker_corners(size).T).T)
        pictures.append((studio.picture(X_CM.inverse(), rng), truth[None]))
    return pictures


def clutter_rows() -> Iterator[Row]:
    """What is taken for a marker where there is none: noise, gravel, checkers."""
    rng = np.random.default_rng(4)
    pictures = []
    for _ in range(8):
        noise = rng.integers(0, 256, (480, 640)).astype(np.uint8)
        gravel = cv2.GaussianBlur(noise.astype(np.float32), (0, 0), 2.0)
        gravel = cv2.normalize(gravel, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
        blocks = rng.integers(0, 2, (60, 80)).astype(np.uint8) * np.uint8(255)
        pictures += [noise, gravel, np.kron(blocks, np.ones((8, 8), np.uint8))]
    for name in (ARUCO, "tag16h5"):
        detector = MarkerDetector(family=name)
        ours = sum(len(detector.detect(picture)) for picture in pictures)
        if name == ARUCO:
            find = opencv_engine(0)
            theirs = f"OpenCV: {sum(len(find(picture)[0]) for picture in pictures)}"
        else:
            engine = apriltag(name, threads=1, decimate=1.0)
            theirs = f"AprilTag 3: {sum(len(engine.detect(picture)) for picture in pictures)}"
        what = f"false markers in {len(pictures)} pictures of clutter, {name}"
        yield Row(what, str(ours), "0", ours == 0, theirs)


def speed_rows() -> Iterator[Row]:
    """The block's time in units of its bare engine's, one thread, runs interleaved."""
    photographs = [
        cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        for path in sorted((FOLDER / "apriltag_photos").glob("*.jpg"))
    ]
    what = f"{len(photographs)} photographs, 799x533, 47 tags"
    if not photographs:
        rng = np.random.default_rng(5)
        sheets = random_sheets(rng, family(APRILTAG), side=(15.0, 30.0), pitch=120)
        ground = cv2.GaussianBlur(rng.uniform(0, 255, (533, 799)), (0, 0), 1.0)
        photographs = [expose(draw((533, 799), sheets, ground=ground), noise=2.0, rng=rng)]
        what = f"799x533 before gravel, {len(sheets)} tags (the photographs are not there)"
    block, engine = MarkerDetector(family=APRILTAG), apriltag_engine()
    yield ratio_row(
        f"time of the block / bare AprilTag 3, {what}",
        lambda: [block.detect(picture) for picture in photographs],
        lambda: [engine(picture) for picture in photographs],
        repeats=20,
    )

    sheets = [
        Sheet(
            family(ARUCO),
            k,
            posed_homography(
                centre=(160.3 + 320 * (k % 2), 120.2 + 240 * (k // 2)), side=80, turn=0.2, tilt=0.3
            ),
        )
        for k in range(4)
    ]
    rng = np.random.default_rng(6)
    image = expose(draw((480, 640), sheets), noise=2.0, rng=rng)
    aruco = MarkerDetector(family=ARUCO)
    for label, bare in (
        ("with its defaults", opencv_engine(0)),
        ("with the block's parameters", aruco_engine_of_the_block()),
    ):
        yield ratio_row(
            f"time of the block / bare OpenCV {label}, 640x480, 4 tags",
            lambda: aruco.detect(image),
            lambda bare=bare: bare(image),
            repeats=300,
        )


def aruco_engine_of_the_block() -> Find:
    """OpenCV's detector as the block sets it up, and nothing after it."""
    return MarkerDetector(family=ARUCO)._engine.find


def ratio_row(what: str, block: Callable[[], Any], bare: Callable[[], Any], repeats: int) -> Row:
    """Times two functions in turn."""
    times = np.empty((repeats, 2))
    for k in range(repeats):
        for j, run in enumerate((block, bare)):
            start = time.perf_counter()
            run()
            times[k, j] = time.perf_counter() - start
    least, middle = times.min(axis=0), np.median(times, axis=0)
    ratio = least[0] / least[1]
    figures = f"{ratio:.2f} (minima), {middle[0] / middle[1]:.2f} (medians)"
    return Row(what, figures, "1.15", ratio <= 1.15, f"bare: {1e3 * least[1]:.2f} ms")


if __name__ == "__main__":
    show("Detector", rows())
