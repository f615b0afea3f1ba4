"""`tagtrail detect`: finds markers in pictures, writes a table and annotated pictures."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix

from diagrams.schema import ScenarioError
from diagrams.sources import Picture, pictures
from systems.cameras import PinholeCamera, load_camera
from systems.markers.detector import MarkerDetector
from systems.markers.family import family as family_by_name
from systems.markers.planar_pose import planar_poses
from systems.messages import Detections
from systems.validation import require_positive

_log = logging.getLogger(__name__)

MAX_PICTURES = 200  # annotated ones; the table has all


def detect(
    source: Path,
    *,
    family: str,
    size: float | None,
    camera: Path | None,
    out: Path,
    progress: Callable[[float, float], None] | None = None,
) -> list[tuple[str, str, str]]:
    """Finds markers and writes `detections.json` and annotated pictures (PNG) into `out`.

    `detections.json` is a list with one entry a marker: `image`, `stamp`, `id`, `corners` (4 x 2
    px, top-left first, clockwise, from the centre of the first pixel), `hamming`,
    `decision_margin`; with `size` and a camera also `poses`: both solutions of the marker in the
    optical frame, the better one first, with `translation`, `quaternion` (w, x, y, z) and
    `reprojection_rms_px`.

    Args:
        source: picture, folder, video or recording.
        family: marker family.
        size: side of the black square, m; None gives no poses.
        camera: camera file; None takes the recording's own.
        out: folder of the results.
        progress: called with the pictures done and the whole (inf: unknown).

    Returns:
        (picture, number of markers, ids) for each picture.

    Raises:
        ValueError: bad input, in one line.
    """
    kind = family_by_name(family)
    if size is not None:
        require_positive(size=size)
    given = load_camera(camera) if camera is not None else None
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ScenarioError(f"--out {out}: {error.strerror}") from error
    if _folder(out) == _folder(source):
        raise ScenarioError(f"--out {out}: holds the pictures, which annotated ones would replace")
    detectors: dict[PinholeCamera | None, MarkerDetector] = {}  # a recording may have many cameras
    rows: list[dict[str, Any]] = []
    summary: list[tuple[str, str, str]] = []
    for count, picture in enumerate(pictures(source)):
        model = given or picture.camera
        _check_size(model, picture, camera)
        if size is not None and model is None and count == 0:
            _log.warning(f"no poses: no --camera is given, and {picture.name} brings none")
        if model not in detectors:
            detectors[model] = MarkerDetector(family=kind, camera=model)
        found = detectors[model].detect(picture.image, picture.stamp)
        rows += _rows(picture, found, size, model)
        summary.append((picture.name, str(len(found)), " ".join(map(str, sorted(found.ids)))))
        if count < MAX_PICTURES:
            _write_picture(out / _as_png(picture.name), annotate(picture.image, found))
        if progress is not None:
            progress(count + 1, math.inf)
    lines = ",\n".join(json.dumps(row) for row in rows)  # a marker a line
    (out / "detections.json").write_text(f"[\n{lines}\n]\n")
    return summary


def annotate(image: NDArray[np.uint8], found: Detections) -> NDArray[np.uint8]:
    """Returns the picture with each marker's outline, its id, and a dot at its top-left corner.

    Args:
        image: uint8 grey or RGB.
        found: its markers.

    Returns:
        uint8 RGB.
    """
    canvas = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
    canvas = canvas.copy()
    shift = 4  # bits behind the point: corners are drawn to 1/16 px
    thickness = max(1, round(max(image.shape[:2]) / 800))
    for marker_id, corners in zip(found.ids, found.corners, strict=True):
        points = np.rint(corners * 2**shift).astype(np.int32)
        side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min())
        for colour, extra in (((0, 0, 0), 2), ((0, 255, 0), 0)):
            cv2.polylines(
                canvas, [points], True, colour, thickness + extra, cv2.LINE_AA, shift=shift
            )
        cv2.circle(
            canvas, points[0].tolist(), max(2, round(side / 12)) * 2**shift, (255, 60, 0), -1,
            cv2.LINE_AA, shift,
        )  # fmt: skip
        text, scale = str(int(marker_id)), max(0.4, side / 60)
        (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thickness)
        middle = corners.mean(axis=0)
        x, y = round(middle[0] - width / 2), round(middle[1] + height / 2)
        for colour, extra in (((0, 0, 0), 3), ((255, 255, 0), 0)):
            cv2.putText(
                canvas, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, colour,
                thickness + extra, cv2.LINE_AA,
            )  # fmt: skip
    return canvas


def _rows(
    picture: Picture, found: Detections, size: float | None, camera: PinholeCamera | None
) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = [
        {
            "image": picture.name,
            "stamp": picture.stamp,
            "id": int(marker_id),
            "corners": corners.round(4).tolist(),
            "hamming": int(hamming),
            "decision_margin": round(float(margin), 2),
        }
        for marker_id, corners, hamming, margin in zip(
            found.ids, found.corners, found.hamming, found.decision_margin, strict=True
        )
    ]
    if size is None or camera is None or not rows:
        return rows
    poses = planar_poses(*camera.rays(found.corners), np.full(len(found), size))
    rms = np.sqrt(poses.squared_error / 4)
    for k, row in enumerate(rows):
        row["poses"] = [
            {
                "translation": poses.p[k, s].round(6).tolist(),
                "quaternion": _quaternion(poses.R[k, s]),
                "reprojection_rms_px": round(float(rms[k, s]), 4),
            }
            for s in range(2)
            if np.isfinite(rms[k, s])
        ]
    return rows


def _folder(path: Path) -> Path:
    """Returns the folder that a path is, or lies in."""
    return (path if path.is_dir() else path.parent).resolve()


def _as_png(name: str) -> str:
    """Returns a picture's name as that of a PNG; those of a.jpg and a.png differ."""
    return name if name.endswith(".png") else f"{name}.png"


def _quaternion(R: NDArray[np.float64]) -> list[float]:
    q: Quaternion = RotationMatrix.ProjectToRotationMatrix(R).ToQuaternion()
    return [round(float(value), 8) for value in q.wxyz()]


def _check_size(camera: PinholeCamera | None, picture: Picture, file: Path | None) -> None:
    height, width = picture.image.shape[:2]
    if camera is not None and (camera.width, camera.height) != (width, height):
        what = f"camera file {file}" if file else "the recording's CameraInfo"
        raise ScenarioError(
            f"{what} is for pictures of {camera.width}x{camera.height}: {picture.name} is "
            f"{width}x{height}"
        )


def _write_picture(path: Path, image: NDArray[np.uint8]) -> None:
    _, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise ScenarioError(f"--out {path}: {error.strerror}") from error
