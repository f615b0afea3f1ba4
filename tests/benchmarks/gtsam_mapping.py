"""The peer of our adjustment: GTSAM with a `CustomFactor` written in Python for each sighting.

The same unknowns, residuals, noise and robust cost as `systems.mapping.adjustment`, from the same
start. GTSAM is needed for this and for tests alone.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.mapping.scene import Scene
from systems.mapping.sightings import Sightings
from systems.markers.layout import marker_corners

Array = NDArray[np.float64]


class Solved(NamedTuple):
    """What GTSAM made of it.

    Attributes:
        scene: where cameras and tags are.
        cost: as `systems.mapping.adjustment` counts it: twice GTSAM's error.
        seconds: of the optimiser alone.
        iterations: of Levenberg and Marquardt.
    """

    scene: Scene
    cost: float
    seconds: float
    iterations: int


def solve(
    scene: Scene,
    sightings: Sightings,
    *,
    anchor: int,
    pixel_noise: float,
    huber: float = 6.0,
    tolerance: float = 1e-5,
) -> Solved:
    """Adjusts with GTSAM.

    Args:
        scene: to start from.
        sightings: of tags in frames.
        anchor: number of the tag that stays.
        pixel_noise: of a corner's coordinate, px.
        huber: see `systems.mapping.adjustment.adjust`.
        tolerance: a step that lowers the error by less than this part of it is the last (1e-5 is
            GTSAM's own default).

    Raises:
        ModuleNotFoundError: GTSAM is not installed.
    """
    import gtsam

    camera_key, tag_key = gtsam.symbol_shorthand.C, gtsam.symbol_shorthand.T
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(huber),
        gtsam.noiseModel.Isotropic.Sigma(8, pixel_noise),
    )
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(len(sightings)):
        corners = marker_corners(float(sightings.sizes[sightings.tag[k]]))
        keys = [camera_key(int(sightings.frame[k])), tag_key(int(sightings.tag[k]))]
        error = _error(corners, sightings.rays[k], sightings.by_ray[k])
        graph.add(gtsam.CustomFactor(noise, keys, error))
    X_WA = gtsam.Pose3(gtsam.Rot3(scene.R_WT[anchor]), scene.p_WT[anchor])
    graph.add(gtsam.NonlinearEqualityPose3(tag_key(anchor), X_WA))
    # Cameras as X_CW, as ours are: their tangent differs, what is found does not.
    for k in np.unique(sightings.frame).tolist():
        values.insert(camera_key(k), gtsam.Pose3(gtsam.Rot3(scene.R_CW[k]), scene.p_CW[k]))
    for k in np.unique(np.append(sightings.tag, anchor)).tolist():
        values.insert(tag_key(k), gtsam.Pose3(gtsam.Rot3(scene.R_WT[k]), scene.p_WT[k]))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(tolerance)
    parameters.setMaxIterations(100)
    started = time.perf_counter()
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    result = optimizer.optimize()
    seconds = time.perf_counter() - started
    R_CW, p_CW = scene.R_CW.copy(), scene.p_CW.copy()
    R_WT, p_WT = scene.R_WT.copy(), scene.p_WT.copy()
    for k in np.unique(sightings.frame).tolist():
        X = result.atPose3(camera_key(k))
        R_CW[k], p_CW[k] = X.rotation().matrix(), X.translation()
    for k in np.unique(sightings.tag).tolist():
        X = result.atPose3(tag_key(k))
        R_WT[k], p_WT[k] = X.rotation().matrix(), X.translation()
    found = Scene(R_CW, p_CW, R_WT, p_WT)
    return Solved(found, 2 * optimizer.error(), seconds, optimizer.iterations())


def _error(corners: Array, rays: Array, by_ray: Array) -> Any:
    """Returns a factor's error function of one sighting, with its derivatives.

    GTSAM's tangent of a pose is [rotation, translation], both in the pose's own (child) frame.
    """
    arm_T = _cross(-corners)  # (4, 3, 3): how a corner moves with the tag's rotation

    def error(this: Any, values: Any, jacobians: list[Array] | None) -> Array:
        keys = this.keys()
        X_CW, X_WT = values.atPose3(keys[0]), values.atPose3(keys[1])
        R_CW, R_WT = X_CW.rotation().matrix(), X_WT.rotation().matrix()
        p_W = corners @ R_WT.T + X_WT.translation()
        p_C = p_W @ R_CW.T + X_CW.translation()
        ray = p_C[:, :2] / p_C[:, 2:]
        if jacobians is not None:
            by_p_C = np.empty((4, 2, 3))
            by_p_C[:, :, :2] = by_ray
            by_p_C[:, :, 2] = -(by_ray @ ray[:, :, None])[:, :, 0]
            by_p_C /= p_C[:, 2, None, None]
            by_p_W = by_p_C @ R_CW
            by_tag = by_p_W @ R_WT
            jacobians[0] = np.concatenate([by_p_W @ _cross(-p_W), by_p_W], axis=2).reshape(8, 6)
            jacobians[1] = np.concatenate([by_tag @ arm_T, by_tag], axis=2).reshape(8, 6)
        residual: Array = (by_ray @ (ray - rays)[:, :, None]).reshape(8)
        return residual

    return error


def _cross(v: Array) -> Array:
    """Returns the matrices (n, 3, 3) of v x, of (n, 3)."""
    M = np.zeros((len(v), 3, 3))
    M[:, 0, 1], M[:, 0, 2], M[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return M - M.swapaxes(1, 2)
