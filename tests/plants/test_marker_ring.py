"""Markers on the four sides of a robot, and what other robots' cameras make of them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from diagrams.schema import Place, convert
from diagrams.station import RobotParameters, Station
from diagrams.world import TagList, WorldParameters
from plants.marker_ring import MarkerRing

FOCAL, CENTRE = 500.0, 322.4  # px, of vga.yaml, which is slightly distorted


def test_each_marker_faces_away_from_the_robot() -> None:
    ring = MarkerRing(size=0.1, distance=0.2, height=0.3)
    for k, (X_BM, size) in enumerate(ring.markers()):
        assert size == 0.1
        outward = [math.cos(k * math.pi / 2), math.sin(k * math.pi / 2), 0.0]
        np.testing.assert_allclose(X_BM.rotation().matrix()[:, 0], outward, atol=1e-12)
        np.testing.assert_allclose(X_BM.rotation().matrix()[:, 2], [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose(
            X_BM.translation(), np.array([*(0.2 * np.array(outward[:2])), 0.3])
        )


def test_a_size_of_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="size is 0"):
        MarkerRing(size=0.0)


def test_markers_may_be_off_their_places() -> None:
    """By 3 mm outward, 2 mm to the left of who looks along the marker's axis, and 1 % larger."""
    off = [[0.0, 0.0, 0.0], [0.003, 0.002, 0.01], [0.0, 0.0, 0.0], [0.0, -0.002, 0.0]]
    ring = MarkerRing(size=0.1, distance=0.2, height=0.3, misplaced=off)
    (front, size), (left, larger), _, (right, _) = ring.markers()
    assert (size, larger) == (0.1, pytest.approx(0.101))
    np.testing.assert_allclose(front.translation(), [0.2, 0.0, 0.3])
    np.testing.assert_allclose(left.translation(), [-0.002, 0.203, 0.3], atol=1e-15)
    np.testing.assert_allclose(right.translation(), [-0.002, -0.2, 0.3], atol=1e-15)


@pytest.mark.parametrize("off", [[], [[0.0] * 3] * 3, [[0.0] * 2] * 4, [[0.0, 0.0, -1.0]] * 4])
def test_misplacements_of_another_shape_are_refused(off: list[list[float]]) -> None:
    with pytest.raises(ValueError, match=r"misplaced is .* for each of front, left, back, right"):
        MarkerRing(misplaced=off)


def robot(x: float, y: float, heading: float) -> RobotParameters:
    camera = {"type": "camera", "calibration": "vga.yaml", "position": [0.0, 0.0, 0.4]}
    plain = {
        "body": {"type": "differential_drive", "ring": {}},
        "drive": "wheel_servo",
        "start": {"x": x, "y": y, "heading_deg": heading},
        "sensors": {"camera": camera},
    }
    parameters: RobotParameters = convert(plain, RobotParameters, Place())
    return parameters


def looked(robots: dict[str, RobotParameters], sight: str) -> tuple[Station, Context]:
    """Robots that stand and look, after two pictures."""
    station = Station(
        world=WorldParameters(markers=TagList("36h11", 0.16, [])),
        robots=robots,
        sight=sight,
        time_step=0.01,
    )
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    for name in robots:
        station.GetInputPort(f"{name}.drive.command").FixValue(context, [0.0, 0.0])
    simulator.AdvanceTo(0.2)
    return station, context


@pytest.fixture(scope="module", params=["projected", "rendered"])
def seen(request: pytest.FixtureRequest) -> dict[str, Any]:
    """What three robots see of each other: b and c stand before a, c turned by 90 degrees."""
    robots = {"a": robot(0, 0, 0), "b": robot(2, 0, 180), "c": robot(2, 1.0, 90)}
    station, context = looked(robots, request.param)
    return {n: station.GetOutputPort(f"{n}.camera.detections").Eval(context) for n in "abc"}


def test_robots_see_the_others_markers_by_their_ids(seen: dict[str, Any]) -> None:
    # b (ids 4 to 7) faces a; of c (8 to 11), which heads to the left, a sees left side and back.
    assert set(seen["a"].ids) == {4, 9, 10}
    assert set(seen["b"].ids) == {0}
    assert set(seen["c"].ids) == set()


def test_they_are_where_they_should_be(seen: dict[str, Any]) -> None:
    where = {int(i): c.mean(axis=0) for i, c in zip(seen["a"].ids, seen["a"].corners, strict=True)}
    assert where[4][0] == pytest.approx(CENTRE, abs=1.5)
    assert where[9][0] == pytest.approx(CENTRE - FOCAL * 1.0 / 1.85, abs=8)


def test_a_camera_that_looks_aside_sees_all_on_the_other_side() -> None:
    """2 degrees to the left shift a marker straight ahead by f tan 2 to the right."""
    centres, mountings = [], []
    for aside in (0.0, 2.0):
        looks = robot(0, 0, 0)
        camera = looks.sensors["camera"].changed(yaw_error_deg=aside)
        robots = {"a": replace(looks, sensors={"camera": camera}), "b": robot(2, 0, 180)}
        station, context = looked(robots, "projected")
        found = station.GetOutputPort("a.camera.detections").Eval(context)
        centres.append(found.corners[list(found.ids).index(4)].mean(axis=0))
        _, mounted = station.static_messages["/tf_static"]
        mountings.append(mounted.transforms[0].transform.rotation)
    shift = FOCAL * math.tan(math.radians(2.0))
    assert centres[1][0] - centres[0][0] == pytest.approx(shift, abs=1.0)
    assert mountings[0] == mountings[1]  # what is recorded is what is believed
