"""Calibrated cameras: intrinsics, plumb-bob distortion, camera files, and the half-pixel rule.

Pixels count from the centre of the first pixel, as OpenCV does. Drake's `CameraInfo` counts from
the corner of the first pixel: a point at `K p` by `CameraInfo` shows at `K p - 0.5`. The half pixel
is added in `PinholeCamera.to_drake` and nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.sensors import CameraInfo
from ruamel.yaml import YAML, YAMLError

from systems.compiled import in_rows
from systems.plumb_bob import distort_all, find_rays, project_all
from systems.validation import require

Array = NDArray[np.float64]

_RADTAN = ("radtan", "plumb_bob", "none")  # names of our distortion model in files of Kalibr's


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """A calibrated camera with plumb-bob (Brown-Conrady) distortion, in OpenCV's convention.

    Attributes:
        width: px.
        height: px.
        K: (3, 3) camera matrix, px; the principal point counts from the first pixel's centre.
        D: (5,) distortion k1, k2, p1, p2, k3, as OpenCV and ROS (`plumb_bob`) order them.

    Raises:
        ValueError: an attribute of the wrong shape, not finite, or out of range.
    """

    width: int
    height: int
    K: Array
    D: Array = field(default_factory=lambda: np.zeros(5))

    def __post_init__(self) -> None:
        require(self.width > 0, "width", self.width, "greater than 0")
        require(self.height > 0, "height", self.height, "greater than 0")
        K = np.array(self.K, float)
        D = np.asarray(self.D, float).ravel()
        require(K.size == 9, "K", K.tolist(), "9 numbers, row by row")
        K = K.reshape(3, 3)
        require(bool(np.isfinite(K).all()), "K", K.tolist(), "finite")
        require(K[0, 0] > 0 and K[1, 1] > 0, "K", K.tolist(), "of positive focal length")
        require(
            K[0, 1] == 0 and K[1, 0] == 0 and (K[2] == [0, 0, 1]).all(),
            "K",
            K.tolist(),
            "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
        )
        require(D.size in (0, 4, 5), "D", D.tolist(), "4 or 5 numbers (k1, k2, p1, p2, k3)")
        require(bool(np.isfinite(D).all()), "D", D.tolist(), "finite")
        D = np.concatenate([D, np.zeros(5 - D.size)])
        for array in (K, D):
            array.setflags(write=False)
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "D", D)

    @staticmethod
    def from_focal_length(width: int, height: int, focal_length: float) -> PinholeCamera:
        """Returns an undistorted camera with square pixels, its principal point in the centre.

        Args:
            width: px.
            height: px.
            focal_length: px.
        """
        K = np.array(
            [
                [focal_length, 0.0, (width - 1) / 2],
                [0.0, focal_length, (height - 1) / 2],
                [0.0, 0.0, 1.0],
            ]
        )
        return PinholeCamera(width, height, K)

    @property
    def distorted(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return bool(self.D.any())

    @cached_property
    def matrices(self) -> tuple[Array, Array]:
        """K (3, 3) and D (5,) for compiled code, which takes none that are read-only."""
        return self.K.copy(), self.D.copy()

    @cached_property
    def fold_radius(self) -> float:
        """How far from the axis (x/z, y/z) the distortion model holds; infinite for everywhere.

        There its radial polynomial turns round and folds what lies beyond back into the picture.
        """
        k1, k2, _, _, k3 = self.D
        roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])  # of the slope, in the squared radius
        folds = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        return float(np.sqrt(folds.min(initial=np.inf)))

    def project(self, p_C: Array) -> Array:
        """Projects points.

        Args:
            p_C: (..., 3) m, in the optical frame (z forward, x right, y down), z > 0.

        Returns:
            (..., 2) px.
        """
        normalised = p_C[..., :2] / p_C[..., 2:]
        if self.distorted:
            normalised = self._distort(normalised)[0]
        return normalised * self.K[[0, 1], [0, 1]] + self.K[:2, 2]

    def project_with_jacobian(self, p_C: Array) -> tuple[Array, Array]:
        """Projects points and differentiates the pixels by the points.

        Args:
            p_C: (..., 3) m, in the optical frame, z > 0.

        Returns:
            (..., 2) px, and (..., 2, 3) px/m.
        """
        points = in_rows(p_C, 3)
        pixels, jacobian = np.empty((len(points), 2)), np.empty((len(points), 2, 3))
        project_all(points, *self.matrices, pixels, jacobian)
        return pixels.reshape(*p_C.shape[:-1], 2), jacobian.reshape(*p_C.shape[:-1], 2, 3)

    def undistort(self, pixels: Array) -> Array:
        """Returns the rays (..., 2) x/z, y/z of pixels (see `rays`)."""
        return self.rays(pixels)[0]

    def rays(self, pixels: Array) -> tuple[Array, Array]:
        """Inverts projection and distortion, and says how pixels follow rays there.

        Args:
            pixels: (..., 2) px, in the distorted picture.

        Returns:
            (..., 2) coordinates x/z, y/z in the optical frame, NaN where the distortion model
            cannot be inverted (a pixel beyond the model's fold); and (..., 2, 2) the derivative of
            the pixels by them, px.
        """
        flat = in_rows(pixels, 2)
        rays, by_ray = np.empty(flat.shape), np.empty((len(flat), 2, 2))
        find_rays(flat, *self.matrices, self.fold_radius, rays, by_ray)
        return rays.reshape(pixels.shape), by_ray.reshape(*pixels.shape, 2)

    def _distort(self, normalised: Array) -> tuple[Array, Array]:
        """Applies plumb-bob distortion to (..., 2); also returns its (..., 2, 2) derivative."""
        flat = in_rows(normalised, 2)
        distorted, jacobian = np.empty(flat.shape), np.empty((len(flat), 2, 2))
        distort_all(flat, self.matrices[1], distorted, jacobian)
        return distorted.reshape(normalised.shape), jacobian.reshape(*normalised.shape, 2)

    def to_drake(self) -> CameraInfo:
        """Returns Drake's `CameraInfo` of the undistorted camera; the half pixel is added here."""
        return CameraInfo(
            self.width,
            self.height,
            self.K[0, 0],
            self.K[1, 1],
            self.K[0, 2] + 0.5,
            self.K[1, 2] + 0.5,
        )

    def scaled(self, factor: float) -> PinholeCamera:
        """Returns the camera whose picture is this one's, enlarged by `factor` along each side."""
        K = self.K.copy()
        K[:2] *= factor
        K[:2, 2] += (factor - 1) / 2  # pixel centres: (u + 1/2) factor - 1/2
        return PinholeCamera(round(self.width * factor), round(self.height * factor), K, self.D)

    def save(self, path: Path) -> None:
        """Writes the camera file (YAML: width, height, K, D)."""
        content = {
            "width": self.width,
            "height": self.height,
            "K": [float(k) for k in self.K.ravel()],
            "D": [float(d) for d in self.D],
        }
        yaml = YAML(typ="safe", pure=True)
        yaml.default_flow_style = None
        yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
        with path.open("w") as file:
            yaml.dump(content, file)


def load_camera(path: Path) -> PinholeCamera:
    """Reads a camera file.

    Three forms are accepted: ours (`width`, `height`, `K`, `D`), the one that ROS's camera
    calibration writes (`image_width`, `image_height`, `camera_matrix.data`,
    `distortion_coefficients.data`, `distortion_model: plumb_bob`), and the one of Kalibr and
    TagSLAM (`cam0: {camera_model: pinhole, intrinsics, distortion_model: radtan,
    distortion_coeffs, resolution}`). Of several cameras in such a file one is named behind a
    colon: `cameras.yaml:cam1`.

    Raises:
        ValueError: the file is missing, no YAML, lacks a key, has an unknown one, or a value is
            out of range; the message names the file and the key.
    """
    name = ""
    if not path.exists() and ":" in path.name:
        stem, _, name = path.name.rpartition(":")
        path = path.with_name(stem)
    try:
        content = YAML(typ="safe", pure=True).load(path.read_text())
    except OSError as error:
        raise ValueError(f"camera file {path}: {error.strerror}") from error
    except (YAMLError, UnicodeDecodeError) as error:
        line = str(error).splitlines()[0]
        raise ValueError(f"camera file {path} is not YAML: {line}") from error
    try:
        if _is_kalibr(content):
            return _camera_from_kalibr(content, name)
        require(not name, "camera", name, "left out: the file holds one, without a name")
        return camera_from_mapping(content)
    except ValueError as error:
        raise ValueError(f"camera file {path}: {error}") from error


def _is_kalibr(content: Any) -> bool:
    return isinstance(content, dict) and any(
        isinstance(value, dict) and "camera_model" in value for value in content.values()
    )


def _camera_from_kalibr(content: dict[str, Any], name: str) -> PinholeCamera:
    """Returns a camera of a file of Kalibr's.

    Format: https://github.com/ethz-asl/kalibr/wiki/yaml-formats; TagSLAM's own is the same with
    OpenCV's names of the models.
    """
    cameras = {k: v for k, v in content.items() if isinstance(v, dict) and "camera_model" in v}
    names = ", ".join(map(str, cameras))
    require(bool(name) or len(cameras) == 1, "cameras", names, "one: name it, as in FILE:cam0")
    require(not name or name in cameras, "camera", name, f"one of {names}")
    name, entry = (name, cameras[name]) if name else next(iter(cameras.items()))
    for key in ("intrinsics", "resolution", "distortion_model", "distortion_coeffs"):
        if key not in entry:
            raise ValueError(f"{name} lacks the key {key!r}")
    require(entry["camera_model"] == "pinhole", f"{name}.camera_model", entry["camera_model"],
            "pinhole: no other is modelled")  # fmt: skip
    model = entry["distortion_model"]
    require(model in _RADTAN, f"{name}.distortion_model", model,
            f"{', '.join(_RADTAN)}: no other is modelled")  # fmt: skip
    numbers = {}
    for key, count in (("intrinsics", 4), ("resolution", 2)):
        value = entry[key]
        sound = isinstance(value, list) and len(value) == count
        require(sound, f"{name}.{key}", value, f"a list of {count} numbers")
        numbers[key] = value
    fx, fy, cx, cy = numbers["intrinsics"]
    coefficients = [] if model == "none" else entry["distortion_coeffs"]
    return camera_from_mapping(
        {
            "width": numbers["resolution"][0],
            "height": numbers["resolution"][1],
            "K": [fx, 0, cx, 0, fy, cy, 0, 0, 1],
            "D": coefficients,
        }
    )


def camera_from_mapping(content: Any) -> PinholeCamera:
    """Returns the camera that a camera file's content describes (see `load_camera`)."""
    if not isinstance(content, dict):
        raise ValueError("must be a mapping with the keys width, height, K, D")
    if "image_width" in content:  # as ROS writes it
        model = content.get("distortion_model", "plumb_bob")
        require(model == "plumb_bob", "distortion_model", model, "plumb_bob")
        matrices = {}
        for name in ("camera_matrix", "distortion_coefficients"):
            matrix: Any = content.get(name)
            sound = isinstance(matrix, dict) and "data" in matrix
            require(sound, name, matrix, "a mapping with data")
            matrices[name] = matrix["data"]
        content = {
            "width": content["image_width"],
            "height": content.get("image_height"),
            "K": matrices["camera_matrix"],
            "D": matrices["distortion_coefficients"],
        }
    unknown = sorted(set(content) - {"width", "height", "K", "D"})
    require(not unknown, "key", ", ".join(map(str, unknown)), "one of width, height, K, D")
    for name in ("width", "height"):
        value = content.get(name)
        whole = isinstance(value, int) and not isinstance(value, bool)
        require(whole and value > 0, name, value, "a whole number of pixels")
    numbers = {}
    for name in ("K", "D"):
        try:
            numbers[name] = np.array(content.get(name, []), float).ravel()
        except (TypeError, ValueError):
            raise ValueError(
                f"{name} is {content.get(name)!r}: must be a list of numbers"
            ) from None
    return PinholeCamera(content["width"], content["height"], numbers["K"], numbers["D"])
