from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from systems.markers.layout import Marker, MarkerMap, load_map
from systems.shell.layout import (
    check_on_shell,
    depth,
    marker_places,
    misplaced,
    shell_markers,
)

MAP = shell_markers()


def normal(marker: Marker) -> np.ndarray:
    return marker.X_WM.rotation().matrix()[:, 0]


def test_the_markers_are_where_the_paper_has_them() -> None:
    degrees = {k: tuple(np.degrees(place).round(9)) for k, place in marker_places().items()}
    assert list(degrees) == list(range(1, 26))
    assert degrees[1][0] == 90
    assert [degrees[k] for k in range(2, 6)] == [(60, yaw) for yaw in (0, 90, 180, 270)]
    assert [degrees[k] for k in range(6, 14)] == [(30, 45 * k) for k in range(8)]
    assert [degrees[k] for k in range(14, 26)] == [(0, 30 * k) for k in range(12)]


def test_family_frame_and_number() -> None:
    assert (MAP.family.name, MAP.size, MAP.frame, len(MAP)) == ("DICT_4X4_50", 0.005, "shell", 25)


@pytest.mark.parametrize(("radius", "size"), [(0.075, 0.005), (0.05, 0.008), (0.2, 0.02)])
def test_corners_lie_on_the_sphere_and_squares_have_their_size(radius: float, size: float) -> None:
    for marker in shell_markers(radius=radius, size=size):
        corners = marker.corners()
        np.testing.assert_allclose(np.linalg.norm(corners, axis=1), radius, rtol=1e-14)
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        np.testing.assert_allclose(sides, size, rtol=1e-12)


def test_the_plane_of_the_corners_is_0_083_mm_below_the_tangent_plane() -> None:
    assert depth(0.075, 0.005) == pytest.approx(0.083e-3, abs=0.5e-6)
    for marker in MAP:
        assert marker.corners() @ normal(marker) == pytest.approx(0.075 - depth(0.075, 0.005))


def test_they_stand_upright_toward_the_pole_and_the_one_there_toward_yaw_0() -> None:
    pole = np.array([0.0, 0.0, 1.0])
    for marker in MAP:
        top_left, top_right, _, bottom_left = marker.corners()
        up = top_left - bottom_left
        assert up @ (pole if marker.id > 1 else [1.0, 0.0, 0.0]) > 0
        # The viewer's right of an upright marker is the east; a mirrored one would fail here.
        assert np.cross(top_right - top_left, up) @ normal(marker) > 0
        if marker.id > 1:
            east = np.cross(pole, normal(marker))
            np.testing.assert_allclose(top_left @ east, bottom_left @ east, atol=1e-15)
            assert (top_right - top_left) @ east > 0
    np.testing.assert_allclose(
        np.mean(MAP.markers[17].corners(), axis=0), [0, 0.075 - depth(0.075, 0.005), 0], atol=1e-15
    )


def test_the_map_survives_its_file(tmp_path: Path) -> None:
    MAP.save(tmp_path / "shell.json")
    loaded = load_map(tmp_path / "shell.json")
    assert (loaded.family, loaded.size, loaded.frame) == (MAP.family, MAP.size, "shell")
    for marker in MAP:
        assert loaded.markers[marker.id].X_WM.IsNearlyEqualTo(marker.X_WM, 1e-14)
    check_on_shell(loaded, 0.075, tolerance=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"radius": 0.0}, "radius is 0.0"),
        ({"size": -0.005}, "size is -0.005"),
        ({"size": math.nan}, "size is nan"),
        ({"radius": 0.01}, "size is 0.005: must be less than 0.00366 m"),
    ],
)
def test_bad_dimensions_are_refused(arguments: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        shell_markers(**arguments)


def moved(marker_id: int, change: RigidTransform) -> MarkerMap:
    """The map with one marker moved in its own frame."""
    marker = MAP.markers[marker_id]
    markers = MAP.markers | {marker_id: replace(marker, X_WM=marker.X_WM @ change)}
    return replace(MAP, markers=markers)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (RigidTransform([0.001, 0, 0]), "marker 7 is off the shell: .* 0.999 mm outside"),
        (RigidTransform([-0.001, 0, 0]), "marker 7 is off the shell: .* 0.999 mm inside"),
        (RigidTransform([0, 0.02, 0]), "marker 7 is off the shell: .* outside"),
        # Tilted by 10 degrees: a corner sinks in by 2.5 mm sin 10.
        (RigidTransform(RollPitchYaw(0, 0, 10 * np.pi / 180), [0, 0, 0]), "marker 7 .* 0.4"),
        (RigidTransform(RollPitchYaw(0, 0, np.pi), [0, 0, 0]), "marker 7 faces the centre"),
    ],
)
def test_a_marker_off_the_shell_is_named(change: RigidTransform, message: str) -> None:
    check_on_shell(moved(7, RigidTransform()), 0.075)
    with pytest.raises(ValueError, match=message):
        check_on_shell(moved(7, change), 0.075)


def test_another_radius_is_refused_and_the_tangent_plane_let_through() -> None:
    with pytest.raises(ValueError, match=r"marker 1 is off the shell: .* 5 mm inside .* 80 mm"):
        check_on_shell(MAP, 0.08)
    check_on_shell(moved(7, RigidTransform([depth(0.075, 0.005), 0, 0])), 0.075)


def test_misplaced_markers_stay_on_the_sphere_within_the_bound_and_use_all_of_it() -> None:
    bound = math.radians(0.5)
    turns = []
    for seed in range(40):
        off = misplaced(MAP, bound=bound, seed=seed)
        assert (off.family, off.frame, list(off.markers)) == (
            MAP.family,
            "shell",
            list(MAP.markers),
        )
        check_on_shell(off, 0.075, tolerance=1e-9)
        for marker, true in zip(off, MAP, strict=True):
            R = true.X_WM.rotation().inverse() @ marker.X_WM.rotation()
            turn = R.ToAngleAxis()
            turns.append(turn.angle() * turn.axis())
    largest = np.abs(turns).max(axis=0)
    assert (largest <= bound * (1 + 1e-9)).all()
    assert (largest > 0.98 * bound).all()
    np.testing.assert_allclose(np.mean(turns, axis=0), 0.0, atol=4 * bound / math.sqrt(3 * 1000))
    np.testing.assert_allclose(np.std(turns, axis=0), bound / math.sqrt(3), rtol=0.07)


def test_a_misplaced_marker_is_shifted_as_much_as_it_is_turned() -> None:
    # A shift of 1 degree on the sphere is one of the normal by 1 degree: the origin goes with it.
    off = misplaced(MAP, bound=0.02, seed=3)
    for marker, true in zip(off, MAP, strict=True):
        p = marker.X_WM.translation()
        np.testing.assert_allclose(p / np.linalg.norm(p), normal(marker), atol=1e-12)
        assert np.linalg.norm(p) == pytest.approx(np.linalg.norm(true.X_WM.translation()))


def test_a_seed_repeats_and_markers_do_not_depend_on_each_other() -> None:
    first = misplaced(MAP, bound=0.01, seed=5)
    few = replace(MAP, markers={k: MAP.markers[k] for k in (9, 3)})
    for marker in misplaced(few, bound=0.01, seed=5):
        assert marker.X_WM.IsExactlyEqualTo(first.markers[marker.id].X_WM)
    other = misplaced(MAP, bound=0.01, seed=6)
    assert not any(m.X_WM.IsNearlyEqualTo(first.markers[m.id].X_WM, 1e-6) for m in other)
    for marker in misplaced(MAP, bound=0.0, seed=5):
        assert marker.X_WM.IsNearlyEqualTo(MAP.markers[marker.id].X_WM, 1e-14)
    with pytest.raises(ValueError, match=r"bound is -0\.1"):
        misplaced(MAP, bound=-0.1, seed=0)


def test_the_rotation_of_every_marker_is_that_of_its_place() -> None:
    for marker_id, (pitch, yaw) in marker_places().items():
        expected = RotationMatrix(RollPitchYaw(0.0, -pitch, yaw)).matrix()
        np.testing.assert_allclose(
            MAP.markers[marker_id].X_WM.rotation().matrix(), expected, atol=1e-15
        )
