"""Plain solids: convex bodies in the colours of the scene, lit from above.

Round shapes are drawn as polyhedra of the same cross section; meshes as their convex hulls, as
Drake's contact queries have them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box as BoxShape
from pydrake.geometry import Capsule, Convex, Cylinder, Ellipsoid, HalfSpace, Mesh, Shape, Sphere

from systems.cameras import PinholeCamera
from systems.drawing.coverage import Edges
from systems.drawing.layers import NEAREST, Drawing, Layer, box_of, projected_edges
from systems.solid_shapes import describe
from systems.validation import require

Array = NDArray[np.float64]

_SIDES = 36  # of a round shape
_RINGS = 18  # of a ball, from pole to pole
_ENDLESS = 1e3  # m, half the side of the square that stands for an endless plane


@dataclass(frozen=True, eq=False)
class Polyhedron:
    """A convex body; its faces' corners run counter-clockwise as seen from outside.

    Attributes:
        vertices: (v, 3) m.
        faces: indices of the corners, a tuple for each face.
        normals: (f, 3) outward, of unit length.
    """

    vertices: Array
    faces: tuple[tuple[int, ...], ...]
    normals: Array

    @cached_property
    def first_corners(self) -> NDArray[np.intp]:
        """Index of one corner of each face, (f,)."""
        return np.array([face[0] for face in self.faces])


def polyhedron(shape: Shape) -> Polyhedron | None:
    """Returns the body of a shape; None for a flat or empty one.

    Raises:
        ValueError: a shape of another kind.
    """
    if describe(shape) is None:
        return None
    if isinstance(shape, BoxShape):
        half = np.asarray(shape.size()) / 2
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        return _with_normals(corners * half, quads)
    if isinstance(shape, Cylinder):
        r, h = shape.radius(), shape.length() / 2
        return _revolved([(0.0, -h), (r, -h), (r, h), (0.0, h)])
    if isinstance(shape, Sphere | Ellipsoid):
        if isinstance(shape, Sphere):
            scale = np.full(3, shape.radius())
        else:
            scale = np.array([shape.a(), shape.b(), shape.c()])
        ball = _revolved(_arc(0.0, -np.pi / 2, np.pi / 2, _RINGS))
        return _with_normals(ball.vertices * scale, ball.faces)
    if isinstance(shape, Capsule):
        r, h = shape.radius(), shape.length() / 2 / shape.radius()
        low, high = _arc(-h, -np.pi / 2, 0.0, _RINGS // 2), _arc(h, 0.0, np.pi / 2, _RINGS // 2)
        body = _revolved(low + high)
        return Polyhedron(body.vertices * r, body.faces, body.normals)
    if isinstance(shape, HalfSpace):
        e = _ENDLESS
        square = np.array([[-e, -e, 0.0], [e, -e, 0.0], [e, e, 0.0], [-e, e, 0.0]])
        return _with_normals(square, ((0, 1, 2, 3),))
    require(isinstance(shape, Convex | Mesh), "shape", shape, "a shape that Drake draws")
    assert isinstance(shape, Convex | Mesh)
    mesh = shape.GetConvexHull()
    vertices = np.array([mesh.vertex(i) for i in range(mesh.num_vertices())])
    faces = []
    for i in range(mesh.num_faces()):
        face = mesh.element(i)
        faces.append(tuple(int(face.vertex(k)) for k in range(face.num_vertices())))
    return _with_normals(vertices, tuple(faces))


def _arc(height: float, first: float, last: float, parts: int) -> list[tuple[float, float]]:
    angles = np.linspace(first, last, parts + 1)
    return [(float(np.cos(a)), height + float(np.sin(a))) for a in angles]


def _revolved(profile: list[tuple[float, float]]) -> Polyhedron:
    """Returns what a profile (radius, z), from the bottom up, encloses when turned about z."""
    n = _SIDES
    turn = 2 * np.pi / n * np.arange(n)
    grow = np.sqrt(turn[1] / np.sin(turn[1]))  # as many corners' polygon has the circle's area
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1) * grow
    vertices = np.concatenate([np.column_stack([r * ring, np.full(n, z)]) for r, z in profile])
    faces: list[tuple[int, ...]] = []
    for k in range(len(profile) - 1):
        (r0, _), (r1, _) = profile[k], profile[k + 1]
        low, high = k * n, (k + 1) * n
        if r0 < 1e-12 and abs(profile[k + 1][1] - profile[k][1]) < 1e-12:
            faces.append(tuple(range(high + n - 1, high - 1, -1)))
        elif r1 < 1e-12 and abs(profile[k + 1][1] - profile[k][1]) < 1e-12:
            faces.append(tuple(range(low, low + n)))
        else:
            for i in range(n):
                j = (i + 1) % n
                corners = [low + i, low + j, high + j, high + i]
                if r0 < 1e-12:
                    corners.remove(low + j)
                if r1 < 1e-12:
                    corners.remove(high + j)
                faces.append(tuple(corners))
    return _with_normals(vertices, tuple(faces))


def _with_normals(vertices: Array, faces: tuple[tuple[int, ...], ...]) -> Polyhedron:
    normals = []
    for face in faces:
        corners = vertices[list(face)]
        area = np.cross(corners - corners[0], np.roll(corners - corners[0], -1, axis=0)).sum(axis=0)
        normals.append(area / np.linalg.norm(area))
    return Polyhedron(vertices, faces, np.array(normals))


def draw_solid(
    camera: PinholeCamera, body: Polyhedron, X_CS: Array, lights: Array
) -> Drawing | None:
    """Draws a plain solid.

    Args:
        camera: calibrated camera.
        body: the solid.
        X_CS: (3, 4) rotation and translation (m) of its frame in the optical frame.
        lights: (f, c) grey levels of its faces, a column for each channel.

    Returns:
        The drawing; None when nothing of it can be seen, as from within.
    """
    vertices = body.vertices @ X_CS[:, :3].T + X_CS[:, 3]
    normals = body.normals @ X_CS[:, :3].T
    heights = (normals * vertices[body.first_corners]).sum(axis=1)
    planes = view_planes(camera)
    whole = bool((vertices @ planes.T >= NEAREST).all())
    starts, ends, owners = [], [], []
    for f in np.flatnonzero(heights < 0):
        corners = vertices[list(body.faces[f])]
        if not whole:
            corners = clip_polygon(corners, planes)
            if len(corners) < 3:
                continue
        corners = corners[::-1]  # clockwise, as the camera sees the outside
        starts.append(corners)
        ends.append(corners[[*range(1, len(corners)), 0]])
        owners.append(np.full(len(corners), f))
    if not starts:
        return None
    start, end, owner = np.concatenate(starts), np.concatenate(ends), np.concatenate(owners)
    cover = projected_edges(camera, start, end, np.ones(len(start)))
    box = box_of(camera, cover)
    if box.empty:
        return None
    owner = np.repeat(owner, len(cover.weight) // len(start))
    light = tuple(Edges(cover.start, cover.end, level[owner]) for level in lights.T)
    return Drawing((Layer(box, cover, light),), points=vertices, normals=normals, heights=heights)


@lru_cache(maxsize=64)
def border_rays(camera: PinholeCamera) -> Array:
    """Returns rays (n, 2) x/z, y/z all along the picture's border, just outside."""
    u = np.linspace(-1.0, camera.width, 33)
    v = np.linspace(-1.0, camera.height, 33)
    border = [np.stack([u, np.full(33, y)], axis=1) for y in (v[0], v[-1])]
    border += [np.stack([np.full(33, x), v], axis=1) for x in (u[0], u[-1])]
    return camera.undistort(np.concatenate(border))


@lru_cache(maxsize=64)
def view_planes(camera: PinholeCamera) -> Array:
    """Returns planes that hold all that a camera sees: (n, 3) inward normals through its centre.

    The first is the camera's own; with a distorted lens there are four more, since a model of
    distortion holds no farther than the picture.
    """
    ahead = [[0.0, 0.0, 1.0]]
    if camera.distorted:
        rays = border_rays(camera)
        (left, top), (right, bottom) = rays.min(axis=0), rays.max(axis=0)
        ahead += [[1.0, 0.0, -left], [-1.0, 0.0, right], [0.0, 1.0, -top], [0.0, -1.0, bottom]]
    return np.array(ahead)


def clip_polygon(corners: Array, planes: Array) -> Array:
    """Cuts off what is behind planes through the origin (Sutherland and Hodgman, 1974).

    Args:
        corners: (n, 3) m, of a convex polygon.
        planes: (m, 3) inward normals.

    Returns:
        (k, 3) corners of what is left, in the same sense.
    """
    for normal in planes:
        if len(corners) == 0:
            break
        heights = (corners @ normal - NEAREST).tolist()
        if min(heights) >= 0:
            continue
        kept: list[Array] = []
        for k, h in enumerate(heights):
            p, q, g = corners[k - 1], corners[k], heights[k - 1]  # from the one before to this
            if (h >= 0) != (g >= 0):
                kept.append(p + (q - p) * (g / (g - h)))
            if h >= 0:
                kept.append(q)
        corners = np.array(kept).reshape(-1, 3)
    return corners
