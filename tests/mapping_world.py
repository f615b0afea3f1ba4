"""A circuit with tags beside it, for the tests of mapping: the truth, and what a camera sees."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plants.circuit import tag_poses
from systems.cameras import PinholeCamera
from systems.mapping.scene import Scene
from systems.mapping.sightings import Sightings
from systems.markers.layout import marker_corners
from systems.messages import Detections

Array = NDArray[np.float64]

CAMERA = PinholeCamera.from_focal_length(640, 480, 480.0)
SIZE = 0.18


@dataclass(frozen=True, eq=False)
class Circuit:
    """The truth.

    Attributes:
        scene: cameras and tags.
        corners: (frames, tags, 4, 2) px, NaN where a tag is not in the picture.
    """

    scene: Scene
    corners: Array

    def detections(self, noise: float, seed: int = 0, rate: float = 10.0) -> list[Detections]:
        """Returns what is seen in each frame, with noise (px); ids are the tags' numbers."""
        noisy = self.corners + noise * np.random.default_rng(seed).standard_normal(
            self.corners.shape
        )
        found = []
        for k, corners in enumerate(noisy):
            ids = np.flatnonzero(np.isfinite(corners).all(axis=(1, 2)))
            none = np.zeros(len(ids))
            found.append(
                Detections(
                    stamp=k / rate,
                    ids=ids,
                    corners=corners[ids],
                    hamming=none.astype(np.int64),
                    decision_margin=none,
                )
            )
        return found

    def sightings(self, noise: float = 0.0, seed: int = 0) -> Sightings:
        """Returns the same as sightings."""
        found = self.detections(noise, seed)
        frame = np.repeat(np.arange(len(found)), [len(d) for d in found])
        tag = np.concatenate([d.ids for d in found])
        rays, by_ray = CAMERA.rays(np.concatenate([d.corners for d in found]))
        tags = len(self.scene.p_WT)
        return Sightings(frame, tag, rays, by_ray, np.full(tags, SIZE), len(found))


def circuit(frames: int = 120, tags: int = 24, turn_deg: float = 35.0, seed: int = 0) -> Circuit:
    """Returns an oval of about 15 m with tags outside it, turned away from facing the route.

    Tag 0 has its true pose in any case: it is the anchor of most tests.
    """
    rng = np.random.default_rng(seed)

    def oval(a: Array) -> tuple[Array, Array]:
        place = np.stack([2.9 * np.cos(a), 1.8 * np.sin(a), 0 * a], axis=-1)
        ahead = np.stack([-2.9 * np.sin(a), 1.8 * np.cos(a), 0 * a], axis=-1)
        return place, ahead / np.linalg.norm(ahead, axis=-1, keepdims=True)

    place, ahead = oval(np.linspace(0, 2 * math.pi, frames, endpoint=False))
    up = np.array([0.0, 0.0, 1.0])
    right = np.cross(ahead, up)
    R_WC = np.stack([right, np.broadcast_to(-up, right.shape), ahead], axis=2)
    R_CW = R_WC.swapaxes(1, 2)
    p_CW = -(R_CW @ (place + 0.2 * up)[..., None])[..., 0]

    where, along = oval(np.linspace(0, 2 * math.pi, tags, endpoint=False))
    R_WT, p_WT = tag_poses(
        where[:, :2],
        np.arctan2(along[:, 1], along[:, 0]),
        across=rng.uniform(0.4, 0.9, tags),  # outward: the route turns left
        heights=rng.uniform(0.15, 0.45, tags),
        turns=np.full(tags, np.radians(turn_deg)),
    )
    scene = Scene(R_CW, p_CW, R_WT, p_WT)
    return Circuit(scene, _images(scene))


def _images(scene: Scene) -> Array:
    corners_W = marker_corners(SIZE) @ scene.R_WT.swapaxes(1, 2) + scene.p_WT[:, None]
    p_C = np.einsum("fij,tcj->ftci", scene.R_CW, corners_W) + scene.p_CW[:, None, None]
    ahead = (p_C[..., 2] > 0.1).all(axis=-1)
    p_C[~ahead] = (0.0, 0.0, 1.0)
    pixels = CAMERA.project(p_C)
    inside = ((pixels > 2) & (pixels < (CAMERA.width - 3, CAMERA.height - 3))).all(axis=(2, 3))
    sight = scene.positions()[:, None] - scene.p_WT
    distance = np.linalg.norm(sight, axis=2)
    facing = (sight * scene.R_WT[:, :, 0]).sum(axis=2) / distance > math.cos(math.radians(70))
    side = np.linalg.norm(pixels - pixels[:, :, [1, 2, 3, 0]], axis=-1).min(axis=-1)
    pixels[~(ahead & inside & facing & (side > 14) & (distance < 4.0))] = np.nan
    return pixels
