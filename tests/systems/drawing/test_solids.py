from __future__ import annotations

import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    MeshcatCone,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from systems.cameras import PinholeCamera
from systems.drawing.coverage import CoverageSheet
from systems.drawing.layers import Drawing, paint
from systems.drawing.order import paint_order
from systems.drawing.solids import draw_solid, polyhedron
from systems.raycasting import Solids

CAMERA = PinholeCamera(96, 72, np.array([[80.0, 0, 46.2], [0, 82.0, 36.9], [0, 0, 1]]))
BARREL = PinholeCamera(96, 72, CAMERA.K, np.array([-0.2, 0.04, 1e-3, -2e-3, 0.0]))
TETRAHEDRON = np.array([[0.0, 0, 0], [0.4, 0, 0], [0, 0.3, 0], [0, 0, 0.5]]).T
SHAPES = {
    "box": (Box(0.3, 0.5, 0.2), 0.3 * 0.5 * 0.2),
    "cylinder": (Cylinder(0.2, 0.5), np.pi * 0.2**2 * 0.5),
    "sphere": (Sphere(0.25), 4 / 3 * np.pi * 0.25**3),
    "ellipsoid": (Ellipsoid(0.1, 0.2, 0.3), 4 / 3 * np.pi * 0.1 * 0.2 * 0.3),
    "capsule": (Capsule(0.1, 0.4), np.pi * 0.1**2 * (0.4 + 4 / 3 * 0.1)),
    "hull": (Convex(TETRAHEDRON, "hull"), 0.4 * 0.3 * 0.5 / 6),
}


def picture(camera: PinholeCamera, drawings: list[Drawing]) -> np.ndarray:
    canvas = np.zeros((camera.height, camera.width, 1), np.float32)
    paint(canvas, [drawings[k] for k in paint_order(drawings)], CoverageSheet())
    return canvas[:, :, 0]


def solid(camera: PinholeCamera, shape: Shape, X: RigidTransform, level: float) -> Drawing | None:
    body = polyhedron(shape)
    assert body is not None
    return draw_solid(camera, body, X.GetAsMatrix34(), np.full((len(body.faces), 1), level))


def cast(
    camera: PinholeCamera, shapes: list[Shape], poses: list[RigidTransform], levels: list[float]
) -> np.ndarray:
    """The same by casting 8x8 rays a pixel."""
    n = 8
    large = camera.scaled(n)
    v, u = np.mgrid[0 : large.height, 0 : large.width]
    rays = large.undistort(np.stack([u, v], axis=-1).reshape(-1, 2).astype(float))
    rays = np.column_stack([rays, np.ones(len(rays))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    _, hit = Solids(shapes, poses).first_hits(np.zeros(3), rays)
    grey = np.append(levels, 0.0)[hit]
    return grey.reshape(camera.height, n, camera.width, n).mean(axis=(1, 3))


@pytest.mark.parametrize("name", SHAPES)
def test_bodies_are_closed_and_of_the_right_volume(name: str) -> None:
    shape, volume = SHAPES[name]
    body = polyhedron(shape)
    assert body is not None
    directed = [
        (tuple(body.vertices[a].round(9)), tuple(body.vertices[b].round(9)))
        for face in body.faces
        for a, b in zip(face, face[1:] + face[:1], strict=True)
    ]
    directed = [(a, b) for a, b in directed if a != b]
    assert len(set(directed)) == len(directed)
    assert {(b, a) for a, b in directed} == set(directed)
    total = 0.0
    for face, normal in zip(body.faces, body.normals, strict=True):
        corners = body.vertices[list(face)]
        area = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0) @ normal / 2
        assert area > 0  # counter-clockwise from outside
        assert ((body.vertices - corners[0]) @ normal).max() < 1e-9  # and convex
        total += area * (corners[0] @ normal) / 3
    assert total == pytest.approx(volume, rel=0.01)


@pytest.mark.parametrize("camera", [CAMERA, BARREL])
@pytest.mark.parametrize("name", SHAPES)
def test_they_cover_what_rays_hit(name: str, camera: PinholeCamera) -> None:
    shape, _ = SHAPES[name]
    X_CS = RigidTransform(RollPitchYaw(0.5, 0.8, -0.4), [0.1, -0.05, 1.0])
    drawing = solid(camera, shape, X_CS, 200.0)
    assert drawing is not None
    expected = cast(camera, [shape], [X_CS], [200.0])
    error = np.abs(picture(camera, [drawing]) - expected)
    # Rays tell a share to 1 of 16 along an edge; polyhedra miss round outlines by up to 0.2 px.
    assert error.max() < (14.0 if name in ("box", "hull") else 40.0)
    assert error.mean() < 0.5


def test_one_that_reaches_behind_the_camera_is_cut_off() -> None:
    for camera in (CAMERA, BARREL):
        wall = Box(6.0, 0.1, 6.0)
        X = RigidTransform(RollPitchYaw(0, 0, 0.2), [0.3, 0.5, 0.0])
        drawing = solid(camera, wall, X, 200.0)
        assert drawing is not None
        error = np.abs(picture(camera, [drawing]) - cast(camera, [wall], [X], [200.0]))
        assert error.max() < 14.0


def test_the_horizon_is_where_it_is() -> None:
    # Ground 0.3 m below a level camera: its horizon passes through the principal point.
    down = RotationMatrix(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    drawing = solid(CAMERA, HalfSpace(), RigidTransform(down, [0, 0.3, 0]), 100.0)
    assert drawing is not None
    image = picture(CAMERA, [drawing])
    np.testing.assert_allclose(image[38:], 100.0, atol=1e-3)
    assert image[:36].max() < 1e-3
    above = (image[:, 40] / 100).sum()  # pixels of ground, and so the row where it begins
    assert CAMERA.height - 0.5 - above == pytest.approx(36.9, abs=0.05)  # the plane ends at 1 km


def test_from_within_nothing_is_seen() -> None:
    assert solid(CAMERA, Box(2, 2, 2), RigidTransform(), 200.0) is None
    assert solid(CAMERA, Box(2, 2, 2), RigidTransform([0, 0, -5.0]), 200.0) is None


def test_faces_have_their_own_light() -> None:
    body = polyhedron(Box(0.2, 0.2, 0.2))
    assert body is not None
    X = RigidTransform(RollPitchYaw(0.0, np.pi / 4, 0.0), [0, 0, 1.0])
    levels = np.where(body.normals[:, 0] > 0.5, 180.0, 60.0)[:, None]
    drawing = draw_solid(CAMERA, body, X.GetAsMatrix34(), levels)
    assert drawing is not None
    image = picture(CAMERA, [drawing])
    # The face whose normal is the body's x, turned to (1, 0, -1) / sqrt 2, is on the right.
    assert image[36, 50] == pytest.approx(180.0, abs=1e-3)
    assert image[36, 42] == pytest.approx(60.0, abs=1e-3)


@pytest.mark.parametrize("seed", range(6))
def test_what_is_nearer_hides_what_is_farther(seed: int) -> None:
    # Boxes strewn apart from each other, and a long wall whose middle is nearer than what stands
    # before its end: distances of the middles would put that behind it.
    rng = np.random.default_rng(seed)
    shapes: list[Shape] = [Box(4.0, 1.0, 0.02)]
    poses = [RigidTransform(RollPitchYaw(0, -1.1, 0), [-0.5, 0, 1.5])]
    for k in range(5):
        shapes.append(Box(*rng.uniform(0.05, 0.14, 3)))
        spot = [0.25 * k - 0.5, rng.uniform(-0.15, 0.15), rng.uniform(0.6, 0.9)]
        poses.append(RigidTransform(RollPitchYaw(*rng.uniform(-1, 1, 3)), spot))
    levels = [40.0, 80.0, 120.0, 160.0, 200.0, 240.0]
    drawings = [
        drawing
        for shape, pose, level in zip(shapes, poses, levels, strict=True)
        if (drawing := solid(CAMERA, shape, pose, level)) is not None
    ]
    drawings = [drawings[k] for k in rng.permutation(len(drawings))]
    wrong = np.abs(picture(CAMERA, drawings) - cast(CAMERA, shapes, poses, levels)) > 20
    assert wrong.sum() < 5


def test_unknown_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"shape is .*: must be"):
        polyhedron(MeshcatCone(1.0, 1.0, 1.0))
