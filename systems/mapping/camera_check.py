"""Whether the camera file, and the sizes of tags, are those of the recording.

A focal length that is a few per cent wrong leaves residuals that nobody would notice, and a map
that is wrong by as much. So once the map is there, the focal length, the distortion's first radial
term, and the sizes of tags where known tags give a scale, are set free together with all poses.
What moves by more than its uncertainty and by more than is harmless was told wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from systems.cameras import PinholeCamera
from systems.mapping.adjustment import CHUNK, System, adjust, robust_cost, summed
from systems.mapping.mapping import TagMap
from systems.mapping.scene import Scene, residuals
from systems.mapping.sightings import Sightings
from systems.markers.layout import marker_corners

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_HUBER = 6.0
_ITERATIONS = 25
_SIGMAS = 6.0
_FACTORS = (0.5, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4, 2.0)  # of focal lengths that are tried
_FITS = 0.5  # of the misfit, at most, is left where one of them is right
_LEFT = 1.0  # px, of corners that the right camera explains, at most
_EXPLAINS = 0.1  # of the cost, at least, goes where something was told wrong
_HARMLESS = 0.01  # of the focal length, and of sizes
_HARMLESS_PX = 2.5  # of the distortion, RMS over the corners: lenses are not quite as modelled
_LAST_DAMPING = 1e12
_LONGEST = 0.3  # step of a value
_FIXED = 1e30  # information of what is not free


@dataclass(frozen=True, eq=False)
class Freed:
    """What a recording says itself of what it was told; each a value and its standard deviation.

    Attributes:
        focal: true focal length by the camera's.
        radial: true k1 minus the camera's.
        radial_px: what that moves the seen corners by, RMS, px.
        new_size: true size of new tags by the given one; (1, inf) without known tags.
        known_size: the same of known tags.
        explained: part of the robust cost that freeing all this takes away.
        left: what is left of it, as the RMS distance of a corner, px.
    """

    focal: tuple[float, float]
    radial: tuple[float, float]
    radial_px: float
    new_size: tuple[float, float]
    known_size: tuple[float, float]
    explained: float
    left: float


def free_camera(
    scene: Scene,
    sightings: Sightings,
    camera: PinholeCamera,
    *,
    held: Indices,
    pixel_noise: float,
    sizes: bool = False,
) -> Freed:
    """Adjusts all, camera and (where known tags give a scale) sizes included.

    Args:
        scene: adjusted with the camera as it was told.
        sightings: in it, outliers too: a wrong camera makes some.
        camera: that the sightings were made with.
        held: numbers of the tags that stay.
        pixel_noise: of a corner's coordinate, px.
        sizes: whether to free the sizes: with one anchor alone they are a matter of scale.
    """
    is_held = np.isin(np.arange(sightings.tags), held)
    free = np.array([True, True, sizes and not is_held.all(), sizes])
    model = _Model(sightings, camera, is_held, pixel_noise)
    values = np.zeros(4)
    # What odometry held, which has no part in this, is not to look like the camera's fault.
    scene = adjust(scene, sightings, anchor=held, pixel_noise=pixel_noise, covariances=False).scene
    seen = model.sightings(values)
    system = System(scene, seen, None, held, _HUBER)
    before, damping = system.cost, 1.0
    for _ in range(_ITERATIONS):
        cameras, tags, step, gain, _ = _step(
            system, scene, model.derivatives(scene, seen, values), free, damping
        )
        if not gain > 1e-6 * (1 + system.cost) or damping > _LAST_DAMPING:
            break
        moved, trial = scene.moved(cameras, tags), values + np.clip(step, -_LONGEST, _LONGEST)
        other_seen = model.sightings(trial)
        other = System(moved, other_seen, None, held, _HUBER)
        if len(other_seen) >= len(seen) and other.cost < system.cost:
            scene, seen, values, system = moved, other_seen, trial, other
            damping *= 0.1
        else:
            damping *= 10.0
    J = model.derivatives(scene, seen, values)
    *_, information = _step(system, scene, J, free, 0.0)
    deviation = np.where(free, np.sqrt(np.diagonal(np.linalg.inv(information))), np.inf).tolist()
    lens = model.camera(values)
    radius = np.hypot(seen.rays[..., 0], seen.rays[..., 1])
    moved_px = values[1] * radius**3 * np.sqrt(lens.K[0, 0] * lens.K[1, 1])
    return Freed(
        (float(np.exp(values[0])), deviation[0]),
        (float(values[1]), deviation[1]),
        float(np.sqrt((moved_px**2).mean())),
        (float(np.exp(values[2])), deviation[2]),
        (float(np.exp(values[3])), deviation[3]),
        1 - system.cost / max(before, 1e-300),
        float(np.sqrt(system.cost / (4 * max(len(seen), 1)))) * pixel_noise,
    )


def suspect_camera(
    tag_map: TagMap,
    camera: PinholeCamera,
    *,
    remap: Callable[[PinholeCamera], TagMap],
    sizes: bool = False,
) -> tuple[Freed, dict[str, str]]:
    """Returns what it looks like, and what was told wrong: reason to a line that says so.

    Args:
        tag_map: as the camera has it.
        camera: as it was told.
        remap: maps the recording, or a part of it, with another camera. A focal length that is far
            off spoils the start, so a map that does not fit is tried with others.
        sizes: whether known tags give a scale.
    """
    scale = 1.0
    if {"residuals", "outliers", "flip"} & tag_map.suspects.keys():
        trials = {1.0: remap(camera)}
        for factor in _FACTORS:
            K = camera.K.copy()
            K[[0, 1], [0, 1]] *= factor
            trials[factor] = remap(replace(camera, K=K))
        scale = min(trials, key=lambda factor: _misfit(trials[factor]))
        if _misfit(trials[scale]) < _FITS * _misfit(trials[1.0]):
            tag_map = trials[scale]
        else:
            scale = 1.0
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= scale
    freed = free_camera(
        tag_map.adjustment.scene,
        tag_map.all_sightings,
        replace(camera, K=K),
        held=tag_map.held,
        pixel_noise=tag_map.pixel_noise,
        sizes=sizes,
    )
    freed = replace(freed, focal=(freed.focal[0] * scale, freed.focal[1]))
    bad = {"residuals", "outliers"} & tag_map.suspects.keys()
    if scale == 1.0 and freed.explained < (1 - _FITS if bad else _EXPLAINS):
        return freed, {}
    if freed.left > _LEFT:  # something else is wrong, and the camera would be blamed for it
        return freed, {}
    return freed, doubts(freed, camera)


def _misfit(tag_map: TagMap) -> float:
    """Returns the mean robust cost of a sighting, of outliers too, for noise of 1 px."""
    cost = robust_cost(tag_map.adjustment.scene, tag_map.all_sightings, 1.0)
    return float(cost.sum()) / max(len(tag_map.all_sightings), 1)


def doubts(freed: Freed, camera: PinholeCamera) -> dict[str, str]:
    """Returns what is off by more than is harmless: reason to a line."""
    found: dict[str, str] = {}
    if _off(freed.focal):
        f = np.sqrt(camera.K[0, 0] * camera.K[1, 1])
        found["focal_length"] = (
            f"the focal length looks like {freed.focal[0] * f:.0f} px, the camera says {f:.0f}"
        )
    k1, deviation = freed.radial
    if freed.radial_px > _HARMLESS_PX and abs(k1) > _SIGMAS * deviation:
        found["distortion"] = (
            f"the distortion's k1 looks like {camera.D[0] + k1:.3f}, the camera says "
            f"{camera.D[0]:.3f}"
        )
    for name, what, value in (
        ("new_size", "the new tags", freed.new_size),
        ("known_size", "the map's tags", freed.known_size),
    ):
        if _off(value):
            found[name] = f"{what} look {value[0]:.2f} times as large as they are said to be"
    return found


def _off(value: tuple[float, float]) -> bool:
    change = abs(np.log(value[0]))
    return bool(change > _HARMLESS and change > _SIGMAS * value[1])


class _Model:
    """Sightings as they would be with other values: log focal length, k1, log sizes."""

    def __init__(
        self,
        sightings: Sightings,
        camera: PinholeCamera,
        is_held: NDArray[np.bool_],
        pixel_noise: float,
    ) -> None:
        ahead = np.ones((*sightings.rays.shape[:2], 1))
        self._pixels = camera.project(np.concatenate([sightings.rays, ahead], axis=2))
        self._given, self._camera = sightings, camera
        self._is_held, self._noise = is_held, pixel_noise

    def camera(self, values: Array) -> PinholeCamera:
        K, D = self._camera.K.copy(), self._camera.D.copy()
        K[[0, 1], [0, 1]] *= np.exp(values[0])
        D[0] += values[1]
        return replace(self._camera, K=K, D=D)

    def sightings(self, values: Array) -> Sightings:
        """Returns those that the camera can explain, in units of the noise."""
        rays, by_ray = self.camera(values).rays(self._pixels)
        scale = np.exp(np.where(self._is_held, values[3], values[2]))
        seen = replace(
            self._given,
            rays=rays,
            by_ray=by_ray / self._noise,
            sizes=self._given.sizes * scale,
        )
        return seen.select(np.asarray(np.isfinite(rays).all(axis=(1, 2))))

    def derivatives(self, scene: Scene, seen: Sightings, values: Array) -> Array:
        """Returns (m, 8, 4) how the corners' images follow the values, in units of the noise."""
        lens, m = self.camera(values), len(seen)
        focal = lens.K[[0, 1], [0, 1]] / self._noise
        ahead = np.ones((m, 4, 1))
        from_centre = lens.project(np.concatenate([seen.rays, ahead], axis=2)) - lens.K[:2, 2]
        squared = (seen.rays**2).sum(axis=-1, keepdims=True)
        J = np.zeros((m, 8, 4))
        J[..., 0] = (from_centre / self._noise).reshape(m, 8)
        J[..., 1] = (focal * seen.rays * squared).reshape(m, 8)
        arm_W = marker_corners(1.0) * seen.sizes[seen.tag][:, None, None]
        arm_W = arm_W @ scene.R_WT[seen.tag].swapaxes(1, 2)
        _, _, by_tag = residuals(scene, seen)
        larger = (by_tag.reshape(m, 4, 2, 6)[..., 3:] @ arm_W[..., None])[..., 0].reshape(m, 8)
        is_held = self._is_held[seen.tag][:, None]
        J[..., 2], J[..., 3] = np.where(is_held, 0.0, larger), np.where(is_held, larger, 0.0)
        return J


def _step(
    system: System, scene: Scene, J: Array, free: NDArray[np.bool_], damping: float
) -> tuple[Array, Array, Array, float, Array]:
    """Returns the steps of cameras, tags and values, the gain that they promise, and what is known.

    The last is the information of the values alone, (4, 4).
    """
    s, t = system.sightings, len(system.free)
    r, by_camera, by_tag = residuals(scene, s)
    squared = (r * r).sum(axis=1)
    weight = np.minimum(1.0, _HUBER / np.sqrt(np.maximum(squared, 1e-300)))
    r[~np.isfinite(squared)] = 0.0
    J = J * (weight[:, None, None] * free)
    with_cameras = summed(by_camera.swapaxes(1, 2) @ J, s.frame, s.frames)  # (frames, 6, 4)
    with_tags = summed(by_tag.swapaxes(1, 2) @ J, s.tag, s.tags)[system.free].reshape(6 * t, 4)
    own = np.einsum("mki,mkj->ij", J, J / np.maximum(weight, 1e-12)[:, None, None])
    own += np.diag(np.where(free, damping, _FIXED))
    right = -np.einsum("mki,mk->i", J, r)
    gradient = -right
    inverse, before, S, b = system.factor(damping)
    reduced = inverse @ with_cameras
    for start, Y in zip(range(0, s.frames, CHUNK), system.chunks(inverse, before), strict=True):
        W, V = Y.reshape(-1, Y.shape[2]), reduced[start : start + len(Y)].reshape(-1, 4)
        with_tags -= W[:, :-1].T @ V
        own -= V.T @ V
        right -= V.T @ W[:, -1]
    back = np.linalg.solve(S, with_tags) if t else with_tags
    information = own - with_tags.T @ back
    values = np.linalg.solve(information, right - back.T @ b)
    tags = np.zeros((s.tags, 6))
    if t:
        tags[system.free] = np.linalg.solve(S, b - with_tags @ values).reshape(-1, 6)
    cameras = system.back_substituted(inverse, before, tags)
    cameras -= (inverse.swapaxes(1, 2) @ (reduced @ values)[..., None])[..., 0]
    gain = -float(
        (system.g_cameras * cameras).sum() + (system.g_tags * tags).sum() + gradient @ values
    )
    return cameras, tags, values, gain, information
