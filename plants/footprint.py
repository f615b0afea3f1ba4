"""The ground that a model covers, seen from above: what of it can touch an obstacle."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
from pydrake.geometry import (
    Cylinder,
    FrameId,
    GeometryId,
    Role,
    SceneGraphInspector,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, ModelInstanceIndex

from plants.planar_shapes import PlanarShapes

_UPRIGHT = 1 - 1e-9  # cosine of the tilt up to which a solid counts as upright


def footprint(
    plant: MultibodyPlant, inspector: SceneGraphInspector, model: ModelInstanceIndex
) -> PlanarShapes:
    """Returns the footprint of a model's collision geometry in the frame of its `base_link`.

    Spheres and upright cylinders become discs, all else the rectangle around its bounding box.
    Parts that lie within one of the others are left out. Joints stand as in the plant's default
    context.

    Args:
        plant: the model, finalized, registered with a SceneGraph.
        inspector: of that SceneGraph.
        model: the model instance.

    Raises:
        ValueError: the model has no collision geometry, or an unbounded one.
    """
    context = plant.CreateDefaultContext()
    base = plant.GetBodyByName("base_link", model)
    X_BW = plant.EvalBodyPoseInWorld(context, base).inverse()
    poses: dict[FrameId, RigidTransform] = {}
    for index in plant.GetBodyIndices(model):
        body = plant.get_body(BodyIndex(index))
        frame = plant.GetBodyFrameIdOrThrow(body.index())
        poses[frame] = X_BW @ plant.EvalBodyPoseInWorld(context, body)
    parts = [
        _part(inspector, geometry, poses[inspector.GetFrameId(geometry)])
        for geometry in inspector.GetAllGeometryIds(Role.kProximity)
        if inspector.GetFrameId(geometry) in poses
    ]
    if not parts:
        name = plant.GetModelInstanceName(model)
        raise ValueError(f"model {name!r} has no collision geometry: it has no footprint")
    kept: list[int] = []
    for k in range(len(parts)):
        others = [*kept, *range(k + 1, len(parts))]
        if not any(_within(parts[k], parts[other]) for other in others):
            kept.append(k)
    return PlanarShapes.joined(parts[k] for k in kept)


def _part(
    inspector: SceneGraphInspector, geometry: GeometryId, X_BF: RigidTransform
) -> PlanarShapes:
    shape = inspector.GetShape(geometry)
    X_BG = X_BF @ inspector.GetPoseInFrame(geometry)
    upright = abs(X_BG.rotation().matrix()[2, 2]) >= _UPRIGHT
    if isinstance(shape, Sphere) or (isinstance(shape, Cylinder) and upright):
        centre = X_BG.translation()[:2]
        return PlanarShapes(
            centres=[centre], headings=[0.0], sizes=[[0.0, 0.0]], radii=[shape.radius()]
        )
    box = inspector.GetObbInGeometryFrame(geometry)
    if box is None:
        raise ValueError(
            f"collision geometry {inspector.GetName(geometry)!r} is unbounded: it has no footprint"
        )
    X_BBox = X_BG @ box.pose()
    x_axis = X_BBox.rotation().matrix()[:, 0]
    # A tilted box: the rectangle along base_link's axes around its corners.
    lies = abs(X_BBox.rotation().matrix()[2, 2]) >= _UPRIGHT
    heading = math.atan2(x_axis[1], x_axis[0]) if lies else 0.0
    corners = np.array(list(product((-1, 1), repeat=3))) * box.half_width()
    c, s = math.cos(heading), math.sin(heading)
    local = X_BBox.multiply(corners.T)[:2].T @ np.array([[c, -s], [s, c]])
    low, high = local.min(axis=0), local.max(axis=0)
    middle = np.array([[c, -s], [s, c]]) @ (low + high) / 2
    return PlanarShapes(centres=[middle], headings=[heading], sizes=[high - low], radii=[0.0])


def _within(inner: PlanarShapes, outer: PlanarShapes) -> bool:
    """Whether one shape lies within another, which is convex: then all of its corners do."""
    corners = outer.distances_from(inner.corners()[0])
    return bool((corners + inner.radii <= 1e-9).all())
