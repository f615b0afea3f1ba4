from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryInstance,
    HalfSpace,
    Mesh,
    MeshcatCone,
    ProximityProperties,
    QueryObject,
    Role,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from systems.raycasting import Solids, SolidsMemo, solids_from_inspector

MISS = np.inf
OCTAHEDRON = np.vstack([np.eye(3), -np.eye(3)]).T
CUBE = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), float).reshape(3, 8)
CUBE_OBJ = """
v -1 -1 -1
v -1 -1 1
v -1 1 -1
v -1 1 1
v 1 -1 -1
v 1 -1 1
v 1 1 -1
v 1 1 1
f 1 2 4 3
f 5 7 8 6
f 1 5 6 2
f 3 4 8 7
f 1 3 7 5
f 2 6 8 4
"""
# The letter L, extruded: its notch is at x > 0, y > 0.
L_OBJ = "".join(
    f"v {x} {y} {z}\n"
    for z in (0, 1)
    for x, y in ((-1, -1), (1, -1), (1, 0), (0, 0), (0, 1), (-1, 1))
) + (
    "f 4 3 2 1\nf 6 5 4 1\nf 7 8 9 10\nf 7 10 11 12\n"
    "f 1 2 8 7\nf 2 3 9 8\nf 3 4 10 9\nf 4 5 11 10\nf 5 6 12 11\nf 6 1 7 12\n"
)
FLAT_OBJ = "v 0 -1 -1\nv 0 1 -1\nv 0 1 1\nv 0 -1 1\nf 1 2 3\nf 1 3 4\n"


def octahedron() -> Convex:
    return Convex(points=OCTAHEDRON, label="octahedron")


def random_pose(rng: np.random.Generator, reach: float) -> RigidTransform:
    R = RotationMatrix(Quaternion(unit(rng.normal(size=4))))
    return RigidTransform(R, rng.uniform(-reach, reach, 3))


def unit(v: Sequence[float] | np.ndarray) -> np.ndarray:
    return np.asarray(v) / np.linalg.norm(v)


S2 = np.sqrt(2)
KNOWN = [
    # A box of half sizes 1, 2, 3 about the origin.
    (Box(2, 4, 6), (-5, 0, 0), (1, 0, 0), 4.0),
    (Box(2, 4, 6), (0, -5, 0), (0, 1, 0), 3.0),
    (Box(2, 4, 6), (0, 0, 5), (0, 0, -1), 2.0),
    (Box(2, 4, 6), (-5, 1.999, -2.999), (1, 0, 0), 4.0),
    (Box(2, 4, 6), (-5, 2.001, 0), (1, 0, 0), MISS),
    (Box(2, 4, 6), (-5, 0, 0), (-1, 0, 0), MISS),  # behind
    (Box(2, 4, 6), (0.5, 1, -2), (1, 0, 0), MISS),  # from inside
    (Box(2, 4, 6), (-3, -2, 0), (1, 1, 0), 2 * S2),
    (Box(2, 4, 6), (-3, 1, 0), (1, 1, 0), MISS),  # passes the edge
    (Sphere(1), (-5, 0, 0), (1, 0, 0), 4.0),
    (Sphere(1), (-5, 0.6, 0), (1, 0, 0), 4.2),
    (Sphere(1), (-5, 0.999999, 0), (1, 0, 0), 5 - np.sqrt(1 - 0.999999**2)),
    (Sphere(1), (-5, 1.000001, 0), (1, 0, 0), MISS),
    (Sphere(1), (0.5, 0.2, 0), (1, 0, 0), MISS),
    (Sphere(1), (5, 0, 0), (1, 0, 0), MISS),
    (Sphere(0), (-5, 0, 0), (1, 0, 0), MISS),
    (Ellipsoid(1, 2, 3), (-5, 0, 0), (1, 0, 0), 4.0),
    (Ellipsoid(1, 2, 3), (0, -5, 0), (0, 1, 0), 3.0),
    (Ellipsoid(1, 2, 3), (0, 0, 5), (0, 0, -1), 2.0),
    (Ellipsoid(1, 2, 3), (-5, 1.2, 0), (1, 0, 0), 4.2),
    (Ellipsoid(1, 2, 3), (-5, 0, 3.001), (1, 0, 0), MISS),
    (Ellipsoid(1, 2, 3), (0, 1.9, 0), (0, 1, 0), MISS),
    (Cylinder(1, 2), (-5, 0.6, 0.5), (1, 0, 0), 4.2),
    (Cylinder(1, 2), (0.3, 0.4, 5), (0, 0, -1), 4.0),  # through the cap, along the axis
    (Cylinder(1, 2), (1.1, 0, 5), (0, 0, -1), MISS),
    (Cylinder(1, 2), (-5, 0, 1.001), (1, 0, 0), MISS),
    (Cylinder(1, 2), (-1.5, 0, 2), (1, 0, -1), S2),  # slanting, through the cap
    (Cylinder(1, 2), (-3, 0, 2), (1, 0, -1), 2 * S2),  # slanting, through the side
    (Cylinder(1, 2), (0, 0, 0.9), (0, 0, 1), MISS),
    (Capsule(1, 2), (-5, 0.6, 0.5), (1, 0, 0), 4.2),
    (Capsule(1, 2), (0.6, 0, 5), (0, 0, -1), 3.2),  # through the upper cap
    (Capsule(1, 2), (0.6, 0, -5), (0, 0, 1), 3.2),  # through the lower cap
    (Capsule(1, 2), (-5, 0, 1.6), (1, 0, 0), 4.2),
    (Capsule(1, 2), (-5, 0, 2.001), (1, 0, 0), MISS),
    (Capsule(1, 2), (0, 0, 1.9), (1, 0, 0), MISS),  # from inside the upper cap
    (Capsule(1, 2), (0, 0, 0), (0, 0, 1), MISS),
    (Capsule(1, 2), (1.2, 0, 5), (0, 0, -1), MISS),
    (HalfSpace(), (3, 4, 2), (0, 0, -1), 2.0),
    (HalfSpace(), (3, 4, 2), (1, 0, -1), 2 * S2),
    (HalfSpace(), (3, 4, 2), (1, 0, 0), MISS),
    (HalfSpace(), (3, 4, 2), (0, 0, 1), MISS),
    (HalfSpace(), (3, 4, -2), (0, 0, -1), MISS),
    (HalfSpace(), (3, 4, -2), (0, 0, 1), MISS),
    (octahedron(), (-5, 0.25, 0.25), (1, 0, 0), 4.5),
    (octahedron(), (0, 0, 5), (0, 0, -1), 4.0),
    (octahedron(), (-5, 0.6, 0.6), (1, 0, 0), MISS),
    (octahedron(), (0.1, 0.1, 0.1), (1, 0, 0), MISS),
    (octahedron(), (5, 0, 0), (1, 0, 0), MISS),
    (Convex(points=CUBE, label="cube"), (-5, 0.5, 0.5), (1, 0, 0), 4.0),
    (Convex(points=CUBE, label="cube"), (-5, 1.5, 0.5), (1, 0, 0), MISS),  # along a face
]


@pytest.mark.parametrize(("shape", "origin", "direction", "expected"), KNOWN)
def test_known_distances(
    shape: Shape,
    origin: tuple[float, float, float],
    direction: tuple[float, float, float],
    expected: float,
) -> None:
    rng = np.random.default_rng(1)
    for X_WS in [RigidTransform(), *(random_pose(rng, 20.0) for _ in range(20))]:
        o = X_WS.multiply(np.array(origin, float))
        d = X_WS.rotation().multiply(unit(direction))
        # A turned ray is parallel to a plane only up to rounding: it may meet it very far away.
        distance = Solids([shape], [X_WS]).first_hit(o, d[None], 1e6)
        np.testing.assert_allclose(distance, [expected], rtol=0, atol=1e-8)


def test_range_limits_each_ray() -> None:
    solids = Solids([Box(2, 2, 2)], [RigidTransform()])
    origins = np.tile([-5.0, 0.0, 0.0], (3, 1))
    directions = np.tile([1.0, 0.0, 0.0], (3, 1))
    assert solids.first_hit(origins, directions, 3.99).tolist() == [MISS] * 3
    assert solids.first_hit(origins, directions, 4.01).tolist() == [4.0] * 3
    limits = np.array([3.99, 4.01, -1.0])
    assert solids.first_hit(origins, directions, limits).tolist() == [MISS, 4.0, MISS]


def test_rays_with_a_short_range_start_far_apart() -> None:
    places = np.array([[0.0, 0, 0], [100.0, 0, 0], [-70.0, 30.0, 0]])
    lift = np.array([0.0, 0.0, 2.0])
    solids = Solids([Sphere(0.5)] * 3, [RigidTransform(place + lift) for place in places])
    up = np.tile([0.0, 0.0, 1.0], (3, 1))
    np.testing.assert_allclose(solids.first_hit(places, up, 1.6), 1.5)


def test_the_nearest_of_several_solids_is_hit_and_one_around_the_ray_is_not_seen() -> None:
    shapes = [Sphere(30), Box(1, 1, 1), Cylinder(1, 1), HalfSpace()]
    poses = [
        RigidTransform([0.0, 0.0, z]) if z is not None else RigidTransform()
        for z in (0.0, 6.0, 3.0, -9.0)
    ]
    solids = Solids(shapes, poses)
    origins = np.array([[0, 0, 10], [0, 0, 4], [0, 0, 0], [0, 0, 50]], float)
    down = np.tile([0.0, 0.0, -1.0], (4, 1))
    np.testing.assert_allclose(solids.first_hit(origins, down), [3.5, 0.5, 9.0, 20.0], atol=1e-12)


def test_a_mesh_counts_as_its_convex_hull(tmp_path: Path) -> None:
    (tmp_path / "l.obj").write_text(L_OBJ)
    solids = Solids([Mesh(str(tmp_path / "l.obj"))], [RigidTransform()])
    # The hull cuts the notch from (1, 0) to (0, 1): entered at x + y = 1.
    distance = solids.first_hit(np.array([5.0, 5.0, 0.5]), unit((-1, -1, 0))[None])
    np.testing.assert_allclose(distance, [4.5 * S2], atol=1e-9)


def test_a_mesh_is_scaled(tmp_path: Path) -> None:
    (tmp_path / "cube.obj").write_text(CUBE_OBJ)
    mesh = Mesh(str(tmp_path / "cube.obj"), scale3=[2.0, -0.5, 1.0])
    solids = Solids([mesh], [RigidTransform()])
    rays = np.array([[-1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
    np.testing.assert_allclose(solids.first_hit(-5 * rays, rays), [3.0, 4.5, 4.0], atol=1e-9)


def test_a_flat_decal_is_never_hit(tmp_path: Path) -> None:
    (tmp_path / "flat.obj").write_text(FLAT_OBJ)
    decal = Mesh(str(tmp_path / "flat.obj"))
    solids = Solids([decal, Box(2, 2, 2)], [RigidTransform(), RigidTransform([3.0, 0.0, 0.0])])
    assert len(solids) == 1
    assert solids.first_hit(np.array([-5.0, 0, 0]), np.array([[1.0, 0, 0]])).tolist() == [7.0]
    # Poses go by the constructor's lists, decals included.
    X = np.tile(np.eye(3, 4), (2, 1, 1))
    X[1, 0, 3] = 10.0
    moved = solids.carried(X)
    assert moved.first_hit(np.array([-5.0, 0, 0]), np.array([[1.0, 0, 0]])).tolist() == [17.0]


def test_nothing_to_hit_and_no_rays() -> None:
    ray = np.array([[1.0, 0.0, 0.0]])
    assert Solids([], []).first_hit(np.zeros(3), ray).tolist() == [MISS]
    assert Solids([], []).occluded(np.zeros(3), ray).tolist() == [False]
    solids = Solids([Sphere(1)], [RigidTransform()])
    assert solids.first_hit(np.zeros((0, 3)), np.zeros((0, 3))).shape == (0,)
    assert solids.occluded(np.zeros(3), np.zeros((0, 3))).shape == (0,)


def test_refuses_what_it_cannot_cast_against() -> None:
    with pytest.raises(ValueError, match=r"MeshcatCone.*must be Box"):
        Solids([MeshcatCone(1.0)], [RigidTransform()])
    with pytest.raises(ValueError, match="poses is 0: must be 1"):
        Solids([Sphere(1)], [])


def random_shapes(rng: np.random.Generator, n: int, folder: Path) -> list[Shape]:
    (folder / "cube.obj").write_text(CUBE_OBJ)
    makers = [
        lambda: Box(*rng.uniform(0.1, 2, 3)),
        lambda: Sphere(rng.uniform(0.1, 1)),
        lambda: Cylinder(*rng.uniform(0.1, 1.5, 2)),
        lambda: Capsule(*rng.uniform(0.1, 1, 2)),
        lambda: Ellipsoid(*rng.uniform(0.2, 1, 3)),
        lambda: Convex(points=rng.normal(size=(3, 12)) * 0.6, label="blob"),
        lambda: Mesh(str(folder / "cube.obj"), scale=rng.uniform(0.2, 0.8)),
    ]
    return [makers[i % len(makers)]() for i in range(n)]


@pytest.mark.parametrize("seed", range(5))
def test_agrees_with_sphere_tracing_on_drakes_signed_distance(seed: int, tmp_path: Path) -> None:
    """An independent caster: step along the ray by Drake's distance until it vanishes.

    Without ellipsoids, to which Drake's distance is good to 1e-4 m only.
    """
    rng = np.random.default_rng(seed)
    shapes = [s for s in random_shapes(rng, 35, tmp_path) if not isinstance(s, Ellipsoid)]
    poses = [*(random_pose(rng, 4.0) for _ in shapes), RigidTransform([0.0, 0.0, -3.0])]
    shapes.append(HalfSpace())
    scene_graph = SceneGraph()
    source = scene_graph.RegisterSource("test")
    for i, (shape, pose) in enumerate(zip(shapes, poses, strict=True)):
        instance = GeometryInstance(pose, shape, f"solid {i}")
        instance.set_proximity_properties(ProximityProperties())
        scene_graph.RegisterAnchoredGeometry(source, instance)
    query = scene_graph.get_query_output_port().Eval(scene_graph.CreateDefaultContext())
    solids = solids_from_inspector(scene_graph.model_inspector(), role=Role.kProximity).pose(query)

    n, reach = 150, 15.0
    origins = rng.uniform(-5, 5, (n, 3))
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distances = solids.first_hit(origins, directions, reach)
    inside, hits = 0, 0
    for o, d, distance in zip(origins, directions, distances, strict=True):
        around = {s.id_G for s in query.ComputeSignedDistanceToPoint(o) if s.distance <= 0}
        inside += bool(around)

        def gap(t: float, o: np.ndarray = o, d: np.ndarray = d, around: set = around) -> float:
            signed = query.ComputeSignedDistanceToPoint(o + t * d)
            return min(s.distance for s in signed if s.id_G not in around)

        t = 0.0
        while t < reach and (step := gap(t)) > 1e-10:
            t += step
        if t >= reach:
            assert distance == MISS
        else:
            hits += 1
            assert distance == pytest.approx(t, abs=1e-6)
    assert hits > 50
    assert inside > 5


def test_ellipsoids_are_hit_where_their_equation_says() -> None:
    rng = np.random.default_rng(2)
    hits = 0
    for _ in range(50):
        axes = rng.uniform(0.2, 2.0, 3)
        X_WS = random_pose(rng, 3.0)
        directions = rng.normal(size=(40, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origins = X_WS.translation() + 5 * directions
        directions = X_WS.translation() + rng.uniform(-2, 2, (40, 3)) - origins
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        distances = Solids([Ellipsoid(*axes)], [X_WS]).first_hit(origins, directions)
        for o, d, distance in zip(origins, directions, distances, strict=True):
            # The line in the ellipsoid's frame: |(p + t v) / axes|^2 = 1 is quadratic in t.
            p = X_WS.inverse().multiply(o) / axes
            v = X_WS.rotation().inverse().multiply(d) / axes
            roots = np.roots([v @ v, 2 * p @ v, p @ p - 1])
            if np.iscomplex(roots).any():
                assert distance == MISS
            else:
                hits += 1
                assert distance == pytest.approx(roots.min(), abs=1e-7)
    assert 500 < hits < 1900


def test_all_at_once_equals_one_at_a_time(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    shapes = random_shapes(rng, 50, tmp_path)
    poses = [random_pose(rng, 3.0) for _ in shapes]
    origins = rng.uniform(-3, 3, (100, 3))
    directions = rng.normal(size=(100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    together = Solids(shapes, poses).first_hit(origins, directions, 8.0)
    singles = [Solids([s], [X]) for s, X in zip(shapes, poses, strict=True)]
    apart = np.min(
        [
            [solid.first_hit(o, d[None], 8.0)[0] for o, d in zip(origins, directions, strict=True)]
            for solid in singles
        ],
        axis=0,
    )
    assert np.isfinite(apart).sum() > 30
    np.testing.assert_allclose(together, apart, atol=1e-9)


def fan(n: int) -> np.ndarray:
    angles = np.linspace(-np.pi, np.pi, n, endpoint=False)
    return np.column_stack([np.cos(angles), np.sin(angles), np.zeros(n)])


@pytest.mark.parametrize("tilt", [0.0, 1e-4, 0.3, np.pi / 2])
@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_a_fan_equals_its_rays_one_at_a_time(tilt: float, spread: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    shapes = [*random_shapes(rng, 60, tmp_path), HalfSpace()]
    poses = [random_pose(rng, 5.0) for _ in shapes[:-1]] + [RigidTransform([0.0, 0.0, -4.0])]
    directions = fan(200) @ RotationMatrix.MakeYRotation(tilt).matrix().T
    rng.shuffle(directions)
    origins = np.array([0.4, -0.2, 0.1]) + spread * rng.uniform(-1, 1, (200, 3))
    if spread == 0:
        origins = origins[:1]
    solids = Solids(shapes, poses)
    together = solids.first_hit(origins, directions, 9.0)
    apart = [
        solids.first_hit(o, d[None], 9.0)[0]
        for o, d in zip(np.broadcast_to(origins, (200, 3)), directions, strict=True)
    ]
    assert np.isfinite(apart).sum() > 50
    np.testing.assert_allclose(together, apart, atol=1e-9)


def test_a_solid_is_seen_across_the_seam_of_the_azimuths() -> None:
    # Straight behind, where -pi meets pi; around the origin's height; and one around the origin.
    behind = RigidTransform([-3.0, 0.0, 0.0])
    distances = Solids([Box(2, 2, 2)], [behind]).first_hit(np.zeros(3), fan(8))
    np.testing.assert_allclose(distances, [2.0] + [MISS] * 7)
    # The corners are at 153 degrees either way: 27 degrees to each side of -x.
    hit = np.isfinite(Solids([Box(2, 2, 2)], [behind]).first_hit(np.zeros(3), fan(360)))
    assert hit.sum() == 53
    assert hit[:27].all()
    assert hit[-26:].all()
    lid = Solids([Box(2, 2, 2)], [RigidTransform([0.2, 0.1, 3.0])])
    up = np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [-0.5, 0.0, 1.0], [0.0, 0.0, -1.0]])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    np.testing.assert_allclose(
        lid.first_hit(np.zeros(3), up), [2.0, 2 / up[1, 2], MISS, MISS], atol=1e-12
    )


def test_it_is_said_which_solid_is_hit(tmp_path: Path) -> None:
    # Numbers go by the constructor's lists, whatever is sorted inside and left out.
    (tmp_path / "flat.obj").write_text(FLAT_OBJ)
    shapes = [
        octahedron(),
        Mesh(str(tmp_path / "flat.obj")),
        Sphere(1),
        Capsule(1, 1),
        Box(2, 2, 2),
    ]
    places = [[5.0, 0, 0], [2.0, 0, 0], [0, 5.0, 0], [-5.0, 0, 0], [0, -5.0, 0]]
    solids = Solids(shapes, [RigidTransform(np.array(p)) for p in places])
    directions = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0]])
    distances, entered = solids.first_hits(np.zeros(3), directions, 4.5)
    np.testing.assert_allclose(distances, [4.0, 4.0, 4.0, 4.0, MISS])
    assert entered.tolist() == [0, 2, 3, 4, -1]
    _, entered = solids.first_hits(np.zeros(3), directions, 3.9)
    assert entered.tolist() == [-1] * 5
    # The nearer of two on one ray.
    two = Solids([Box(1, 1, 1), Sphere(1)], [RigidTransform([z, 0.0, 0.0]) for z in (6.0, 3.0)])
    assert two.first_hits(np.zeros(3), directions[:1])[1].tolist() == [1]


def test_keeps_its_digits_far_from_the_worlds_origin(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    shapes = random_shapes(rng, 35, tmp_path)
    poses = [random_pose(rng, 5.0) for _ in shapes]
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    here = Solids(shapes, poses).first_hit(np.zeros(3), directions)
    shift = np.array([6378137.0, -2e6, 3e5])
    there = Solids(shapes, [RigidTransform(shift) @ X for X in poses]).first_hit(shift, directions)
    assert np.isfinite(here).sum() > 50
    np.testing.assert_allclose(there, here, atol=1e-6)


def test_carried_solids_equal_those_built_in_place(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    shapes = random_shapes(rng, 35, tmp_path)
    X_FS = [random_pose(rng, 2.0) for _ in shapes]
    X_WF = [random_pose(rng, 4.0) for _ in shapes]
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origin = np.array([1.0, 2.0, 3.0])
    at_rest = Solids(shapes, X_FS)
    before = at_rest.first_hit(origin, directions)
    carried = at_rest.carried(np.array([X.GetAsMatrix34() for X in X_WF]))
    built = Solids(shapes, [A @ B for A, B in zip(X_WF, X_FS, strict=True)])
    expected = built.first_hit(origin, directions)
    assert np.isfinite(expected).sum() > 50
    np.testing.assert_allclose(carried.first_hit(origin, directions), expected, atol=1e-9)
    np.testing.assert_array_equal(at_rest.first_hit(origin, directions), before)


def test_occlusion() -> None:
    solids = Solids([Box(1, 1, 1)], [RigidTransform([5.0, 0.0, 0.0])])
    targets = np.array(
        [
            [10.0, 0, 0],  # behind the box
            [10.0, 3, 0],  # beside it
            [4.0, 0, 0],  # before it
            [4.5, 0, 0],  # on its face
            [4.52, 0, 0],  # 2 cm inside
            [-10.0, 0, 0],  # the other way
            [0.0, 0, 0],  # at the origin itself
        ]
    )
    expected = [True, False, False, False, False, False, False]
    assert solids.occluded(np.zeros(3), targets, 0.021).tolist() == expected
    expected[4] = True
    assert solids.occluded(np.zeros(3), targets, 0.019).tolist() == expected
    tolerance = np.array([6.0, 0, 0, 1e-6, 0.021, 0, 0])
    assert not solids.occluded(np.zeros(3), targets, tolerance).any()
    assert not solids.occluded(np.array([5.0, 0.0, 0.0]), targets, 1e-3).any()  # from inside


class Caster(LeafSystem):
    """Casts one ray along x at every evaluation."""

    def __init__(self) -> None:
        super().__init__()
        query_input = self.DeclareAbstractInputPort("query", AbstractValue.Make(QueryObject()))
        solids = SolidsMemo(self, role=Role.kPerception)

        def calc(context, output):
            posed = solids(context, query_input.Eval(context))
            output[0] = posed.first_hit(np.zeros(3), np.array([[1.0, 0.0, 0.0]]))[0]

        self.DeclareVectorOutputPort("distance", 1, calc)


def test_a_scene_of_roles_and_moving_frames() -> None:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    body = plant.AddRigidBody("body", SpatialInertia(1.0, np.zeros(3), UnitInertia(1, 1, 1)))
    red = np.array([1.0, 0.0, 0.0, 1.0])
    plant.RegisterVisualGeometry(
        body, RigidTransform([0.0, 0.0, 1.0]), Box(0.2, 0.2, 0.2), "board", red
    )
    plant.RegisterCollisionGeometry(
        body, RigidTransform(), Sphere(0.5), "bumper", CoulombFriction(1.0, 1.0)
    )
    wall = RigidTransform([10.0, 0.0, 0.0])
    plant.RegisterVisualGeometry(plant.world_body(), wall, Box(2, 9, 9), "wall", red)
    plant.Finalize()
    caster = builder.AddSystem(Caster())
    builder.Connect(scene_graph.get_query_output_port(), caster.GetInputPort("query"))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant_context = plant.GetMyMutableContextFromRoot(context)
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    inspector = scene_graph.model_inspector()
    frame = plant.GetBodyFrameIdOrThrow(body.index())
    ray = np.array([[1.0, 0.0, 0.0]])

    visible = solids_from_inspector(inspector)
    solid = solids_from_inspector(inspector, role=Role.kProximity)
    others = solids_from_inspector(inspector, exclude_frames=[frame])
    port = caster.GetOutputPort("distance")
    for x, seen_at, felt_at in ((3.0, 2.9, 2.5), (-3.0, 9.0, MISS), (5.0, 4.9, 4.5)):
        plant.SetFreeBodyPose(plant_context, body, RigidTransform([x, 0.0, -1.0]))
        assert visible.pose(query).first_hit(np.zeros(3), ray)[0] == pytest.approx(seen_at)
        height = np.array([0.0, 0.0, -1.0])
        assert solid.pose(query).first_hit(height, ray)[0] == pytest.approx(felt_at)
        assert others.pose(query).first_hit(np.zeros(3), ray)[0] == pytest.approx(9.0)
        distance = port.Eval(caster.GetMyContextFromRoot(context))
        assert distance == pytest.approx(seen_at)

    # A copy of the context has the body elsewhere; each sees its own.
    other = context.Clone()
    plant.SetFreeBodyPose(
        plant.GetMyMutableContextFromRoot(other), body, RigidTransform([7.0, 0.0, -1.0])
    )
    assert port.Eval(caster.GetMyContextFromRoot(other)) == pytest.approx(6.9)
    assert port.Eval(caster.GetMyContextFromRoot(context)) == pytest.approx(4.9)
