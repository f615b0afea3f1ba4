from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.geometry import Box
from pydrake.math import RigidTransform, RotationMatrix

from plants.circuit import Circuit, circuit, in_view, seen_along, tag_poses
from plants.circuit_parameters import CircuitCamera, CircuitParameters
from systems.markers.layout import MarkerMap
from systems.markers.visibility import visible_markers
from systems.planners.closed_curve import ClosedCurve
from systems.raycasting import Solids

Array = NDArray[np.float64]
PLAIN = CircuitParameters()


@cache
def drawn(seed: int) -> Circuit:
    return circuit(seed)


def counted_by_angles(markers: MarkerMap, pose: Array, p: CircuitParameters) -> int:
    """Tags in view from a planar pose, by bearings and distances of their corners."""
    camera, count = p.camera, 0
    eye = np.array([*pose[:2], camera.position[2]])
    eye[:2] += camera.position[0] * np.array([math.cos(pose[2]), math.sin(pose[2])])
    across = (camera.width / 2 - camera.border_px) / camera.focal_length
    down = (camera.height / 2 - camera.border_px) / camera.focal_length
    for marker in markers:
        corners = marker.corners() - eye
        ahead = corners[:, :2] @ [math.cos(pose[2]), math.sin(pose[2])]
        left = corners[:, :2] @ [-math.sin(pose[2]), math.cos(pose[2])]
        centre = marker.X_WM.translation() - eye
        distance = float(np.linalg.norm(centre))
        incidence = math.acos(-centre @ marker.X_WM.rotation().matrix()[:, 0] / distance)
        count += bool(
            (ahead > 0).all()
            and (np.abs(left) < 1.01 * across * ahead).all()
            and (np.abs(corners[:, 2]) < 1.01 * down * ahead).all()
            and incidence <= math.radians(p.camera.max_incidence_deg)
            and distance <= p.camera.max_range
        )
    return count


@pytest.mark.parametrize("seed", range(50))
def test_what_the_installer_promises(seed: int) -> None:
    drawn_one = drawn(seed)
    route, markers, p = drawn_one.route(), drawn_one.markers, PLAIN
    assert len(markers) == 24
    assert list(markers.markers) == list(range(24))
    assert markers.family.name == "tag36h11"
    assert route.length == pytest.approx(15.0, abs=0.05)
    assert np.abs(route.curvatures).max() <= 1 / 0.8 + 1e-6
    # Two tags at least everywhere, by other means: bearings and distances. It knows of no boards
    # that hide others, and of no least size, so it counts at least as many.
    seen = seen_along(route, markers, p)
    assert seen.sum(axis=2).min() >= 2
    # No tag is up for nothing: each is in view along half a metre, robot askew or not.
    assert seen.all(axis=1).sum(axis=0).min() >= 0.5 / 0.05
    for s in np.linspace(0.013, route.length, 37):
        position, heading = route.at(s)
        assert counted_by_angles(markers, np.array([*position, heading]), p) >= 2
    # No board is nearer to the route than it may be, whole boards are above the ground.
    half = p.board() / 2
    for marker in markers:
        X = marker.X_WM
        edge = np.linspace(-half, half, 9)[:, None] * X.rotation().matrix()[:2, 1]
        assert route.distances(X.translation()[:2] + edge).min() >= p.clearance - 1e-3
        assert X.translation()[2] >= half
        assert X.rotation().matrix()[2] == pytest.approx([0, 0, 1], abs=1e-12)
        # Turned by about 35 degrees toward the route from looking straight against the travel.
        s = route.nearest(X.translation()[:2])
        normal = X.rotation().matrix()[:2, 0]
        _, heading = route.at(s)
        ahead = np.array([math.cos(heading), math.sin(heading)])
        turn = math.degrees(math.acos(np.clip(-normal @ ahead, -1, 1)))
        # A tag beside a bend is nearer to a place some way on.
        assert 10 < turn < 60
        toward = route.positions[round(s / route.length * len(route.s)) % len(route.s)]
        assert normal @ (toward - X.translation()[:2]) > 0
    # The anchor is in view at the start.
    assert seen[0, :, 0].all()


def test_a_seed_is_a_circuit() -> None:
    again, other = circuit(3), drawn(4)
    np.testing.assert_array_equal(again.points, drawn(3).points)
    for marker, same in zip(again.markers, drawn(3).markers, strict=True):
        assert marker.X_WM.IsExactlyEqualTo(same.X_WM)
    assert not np.array_equal(drawn(3).points, other.points)
    turns = {bool(np.sign(drawn(seed).route().curvatures.mean()) > 0) for seed in range(8)}
    assert turns == {True, False}  # some go clockwise


def test_what_is_seen_is_what_the_projector_sees() -> None:
    """Pose by pose, boards in the way and all, with the simulated camera's own function."""
    hidden = 0
    for seed in range(6):
        one = drawn(seed)
        route, markers = one.route(), one.markers
        seen = seen_along(route, markers, PLAIN)
        boards = Solids(
            [Box(0.003, PLAIN.board(), PLAIN.board()) for _ in markers],
            [m.X_WM @ RigidTransform([-0.002, 0.0, 0.0]) for m in markers],
        )
        for k in range(seed, len(seen), 6):
            position, heading = route.at(k * route.length / len(seen))
            X_WB = RigidTransform(RotationMatrix.MakeZRotation(float(heading)), [*position, 0.0])
            for solids in (boards, None):
                found = visible_markers(
                    camera=PLAIN.camera.model(),
                    X_WC=X_WB @ PLAIN.camera.mounting(),
                    X_WM=np.array([m.X_WM.GetAsMatrix34() for m in markers]),
                    sizes=np.array([m.size for m in markers]),
                    cells=markers.family.cells,
                    parameters=PLAIN.camera.limits(),
                    solids=solids,
                )
                if solids is boards:
                    assert found.index.tolist() == np.flatnonzero(seen[k, 0]).tolist()
                else:
                    hidden += len(found.index) - int(seen[k, 0].sum())
    assert hidden > 0  # or the test would not notice a check for boards left out


def test_fewer_tags_in_view_show() -> None:
    one = drawn(1)
    few = MarkerMap(one.markers.family, 0.18, {k: one.markers.markers[k] for k in range(0, 24, 4)})
    assert in_view(one.route(), few, PLAIN).min() < 2


def test_the_sway_is_looked_at() -> None:
    one = drawn(1)
    seen = seen_along(one.route(), one.markers, PLAIN).sum(axis=2)
    assert (seen[:, 1:].min(axis=1) < seen[:, 0]).any()


def test_tags_beside_a_straight_route_by_hand() -> None:
    # Along x: one to the right, one to the left, both turned by 30 degrees toward the route.
    R, p = tag_poses(
        [[1.0, 0.0], [2.0, 0.0]], [0.0, 0.0], across=[0.5, -0.6], heights=[0.2, 0.3],
        turns=np.radians([30.0, 30.0]),
    )  # fmt: skip
    np.testing.assert_allclose(p, [[1.0, -0.5, 0.2], [2.0, 0.6, 0.3]])
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    np.testing.assert_allclose(R[0, :, 0], [-c, s, 0.0], atol=1e-12)
    np.testing.assert_allclose(R[1, :, 0], [-c, -s, 0.0], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)


def test_the_installer_s_camera() -> None:
    camera = CircuitCamera(pitch_deg=10.0)
    # What lies 10 degrees below the horizon ahead is in the middle of the picture.
    X_BC = camera.mounting()
    point = np.array([0.1 + math.cos(math.radians(10)), 0.0, 0.18 - math.sin(math.radians(10))])
    pixel = camera.model().project(X_BC.inverse() @ point)
    np.testing.assert_allclose(pixel, [319.5, 239.5], atol=1e-9)
    # Its x axis is to the robot's right, the picture is not tilted.
    np.testing.assert_allclose(X_BC.rotation().matrix()[:, 0], [0.0, -1.0, 0.0], atol=1e-12)


def test_too_much_is_refused() -> None:
    with pytest.raises(ValueError, match=r"none of 60 of 15 m with 24 tags has 2 in view"):
        circuit(0, CircuitParameters(clearance=1.5))


@pytest.mark.parametrize(
    ("field", "value", "allowed"),
    [
        ("length", 0.0, "greater than 0"),
        ("waviness", 1.0, "below 1"),
        ("tags", 0, "1 or more"),
        ("tags", 5000, "at most 587"),
        ("offset", [0.5], "least, greatest"),
        ("offset", [0.9, 0.5], "least, greatest"),
        ("height", [0.05, 0.4], "whole board"),
        ("inside_share", 1.5, "0 to 1"),
        ("clearance", -0.1, "0 or greater"),
        ("turn_deg", math.nan, "-180 to 180"),
        ("in_view", -1, "0 or more"),
    ],
)
def test_nonsense_is_refused(field: str, value: object, allowed: str) -> None:
    with pytest.raises(ValueError, match=rf"{field} is .*{allowed}"):
        CircuitParameters(**{field: value})  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [[0.1, 0.2], [0.1, math.nan, 0.2]])
def test_a_camera_nowhere_is_refused(value: list[float]) -> None:
    with pytest.raises(ValueError, match="position is"):
        CircuitCamera(position=value)


def test_the_start_is_on_the_route() -> None:
    for seed in range(4):
        one = drawn(seed)
        x, y, theta = one.start()
        np.testing.assert_allclose([x, y], one.points[0])
        ahead = ClosedCurve(one.points).at(0.01)[0] - one.points[0]
        assert math.atan2(ahead[1], ahead[0]) == pytest.approx(theta, abs=0.02)
