from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from systems.markers.family import family
from systems.markers.layout import (
    Marker,
    MarkerMap,
    load_map,
    map_from_json,
    marker_corners,
)


def some_map() -> MarkerMap:
    rng = np.random.default_rng(0)
    markers = {}
    for marker_id in (7, 3, 585):
        q = rng.normal(size=4)
        R = RotationMatrix(Quaternion(q / np.linalg.norm(q)))
        size = 0.25 if marker_id == 3 else 0.1651
        markers[marker_id] = Marker(marker_id, RigidTransform(R, rng.normal(size=3)), size)
    return MarkerMap(family("tag36h11"), 0.1651, markers, frame="field")


def test_the_corners_go_round_from_the_top_left_as_the_viewer_sees_them() -> None:
    # The viewer stands on the x axis, looks at the origin, z up: y is to their right.
    top_left, top_right, bottom_right, bottom_left = marker_corners(0.2)
    up, right = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    gaze = np.array([-1.0, 0.0, 0.0])
    np.testing.assert_array_equal(np.cross(gaze, up), right)
    np.testing.assert_allclose(top_right - top_left, 0.2 * right)
    np.testing.assert_allclose(bottom_right - bottom_left, 0.2 * right)
    np.testing.assert_allclose(top_left - bottom_left, 0.2 * up)
    np.testing.assert_allclose((top_left + bottom_right) / 2, 0.0)


def test_a_marker_on_a_wall_faces_into_the_room() -> None:
    # As WPILib puts it: a tag whose pose is the identity faces along x; turned by half a turn it
    # faces back along -x, and its top-left corner is then at positive y.
    marker = Marker(1, RigidTransform(RollPitchYaw(0, 0, np.pi), [3.0, 1.0, 0.5]), 0.2)
    np.testing.assert_allclose(
        marker.corners(),
        [[3.0, 1.1, 0.6], [3.0, 0.9, 0.6], [3.0, 0.9, 0.4], [3.0, 1.1, 0.4]],
        atol=1e-15,
    )


def test_corners_are_picked_by_id() -> None:
    markers = some_map()
    corners = markers.corners(np.array([585, 7, 585]))
    assert corners.shape == (3, 4, 3)
    for row, marker_id in zip(corners, (585, 7, 585), strict=True):
        np.testing.assert_array_equal(row, markers.markers[marker_id].corners())
    assert markers.corners(np.zeros(0, np.int64)).shape == (0, 4, 3)


def test_a_map_is_a_collection_of_markers() -> None:
    markers = some_map()
    assert len(markers) == 3
    assert [m.id for m in markers] == [7, 3, 585]
    assert 3 in markers
    assert 4 not in markers


def test_a_saved_map_is_read_back(tmp_path: Path) -> None:
    markers = some_map()
    path = tmp_path / "map.json"
    markers.save(path)
    again = load_map(path)
    assert (again.family, again.size, again.frame) == (markers.family, 0.1651, "field")
    assert [(m.id, m.size) for m in again] == [(m.id, m.size) for m in markers]
    for a, b in zip(again, markers, strict=True):
        assert a.X_WM.IsNearlyEqualTo(b.X_WM, 1e-14)
    assert "size" not in json.loads(path.read_text())["tags"][0]  # only where it differs


# The shape of WPILib's field files, with the two keys that this project adds in front.
WPILIB = {
    "family": "36h11",
    "size": 0.1651,
    "tags": [
        {
            "ID": 1,
            "pose": {
                "translation": {"x": 15.079471999999997, "y": 0.24587199999999998, "z": 1.355852},
                "rotation": {
                    "quaternion": {
                        "W": 0.5000000000000001,
                        "X": 0.0,
                        "Y": 0.0,
                        "Z": 0.8660254037844386,
                    }
                },
            },
        },
        {
            "ID": 3,
            "pose": {
                "translation": {"x": 16.579342, "y": 4.982717999999999, "z": 1.4511020000000001},
                "rotation": {
                    "quaternion": {"W": 6.123233995736766e-17, "X": 0.0, "Y": 0.0, "Z": 1.0}
                },
            },
        },
    ],
    "field": {"length": 16.541, "width": 8.211},
}


def test_wpilibs_shape_is_read() -> None:
    markers = map_from_json(WPILIB)
    assert markers.family.name == "tag36h11"
    assert markers.frame == "map"
    np.testing.assert_allclose(
        markers.markers[1].X_WM.translation(), [15.079472, 0.245872, 1.355852]
    )
    # Tag 1 faces 120 degrees to the left of x, tag 3 back along it.
    for marker_id, degrees in ((1, 120.0), (3, 180.0)):
        facing = markers.markers[marker_id].X_WM.rotation().matrix()[:, 0]
        angle = np.deg2rad(degrees)
        np.testing.assert_allclose(facing, [np.cos(angle), np.sin(angle), 0.0], atol=1e-12)


def test_a_quaternion_is_normalised_within_its_tolerance() -> None:
    content = changed(lambda m: quaternion(m).update(W=0.5003))
    R = map_from_json(content).markers[1].X_WM.rotation().matrix()
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)


def changed(change: Callable[[Any], Any]) -> Any:
    content = copy.deepcopy(WPILIB)
    change(content)
    return content


def pose(content: Any, k: int = 0) -> Any:
    return content["tags"][k]["pose"]


def quaternion(content: Any) -> Any:
    return pose(content)["rotation"]["quaternion"]


TRANSLATION = r"tags\[0\]\.pose \(ID 1\)\.translation"
QUATERNION = r"tags\[0\]\.pose \(ID 1\)\.rotation\.quaternion"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.pop("family"), "the marker map lacks the key 'family'"),
        (lambda m: m.pop("size"), "the marker map lacks the key 'size'"),
        (lambda m: m.pop("tags"), "the marker map lacks the key 'tags'"),
        (lambda m: m.update(sise=1), "the marker map has the unknown key 'sise': .*'size'"),
        (lambda m: m.update(family="36h12"), "family is '36h12': unknown; did you mean 'tag36h11'"),
        (lambda m: m.update(family=3), "family is 3: must be a name"),
        (lambda m: m.update(size=0), "size is 0: must be greater than 0"),
        (lambda m: m.update(size=float("nan")), "size is nan: must be a finite number"),
        (lambda m: m.update(size="10 cm"), "size is '10 cm': must be a finite number"),
        (lambda m: m.update(size=True), "size is True: must be a finite number"),
        (lambda m: m.update(frame=3), "frame is 3: must be a name"),
        (lambda m: m.update(tags={}), "tags is {}: must be a list"),
        (lambda m: m["tags"].append(7), r"tags\[2\] is 7: must be an object"),
        (lambda m: m["tags"][1].update(ID=1), r"tags\[1\]\.ID is 1: there is a tag of that ID"),
        (lambda m: m["tags"][1].update(ID=587), r"tags\[1\]\.id is 587: tag36h11 has the ids 0"),
        (lambda m: m["tags"][1].update(ID=-1), r"tags\[1\]\.id is -1"),
        (lambda m: m["tags"][1].update(ID=1.5), r"tags\[1\]\.ID is 1.5: must be a whole number"),
        (lambda m: m["tags"][1].update(ID=True), r"tags\[1\]\.ID is True: must be a whole number"),
        (lambda m: m["tags"][1].pop("ID"), r"tags\[1\] lacks the key 'ID'"),
        (lambda m: m["tags"][1].update(id=3), r"tags\[1\] has the unknown key 'id': .*'ID'"),
        (
            lambda m: m["tags"][1].update(size=-1),
            r"tags\[1\]\.size \(ID 3\) is -1: must be greater",
        ),
        (
            lambda m: m["tags"][0].update(pose=[]),
            r"tags\[0\]\.pose \(ID 1\) is \[\]: must be an obj",
        ),
        (lambda m: pose(m).pop("rotation"), r"tags\[0\]\.pose \(ID 1\) lacks the key 'rotation'"),
        (lambda m: pose(m)["translation"].pop("z"), TRANSLATION + " lacks the key 'z'"),
        (lambda m: pose(m)["translation"].update(y="b"), TRANSLATION + r"\.y is 'b': must be a"),
        (lambda m: quaternion(m).pop("W"), QUATERNION + " lacks the key 'W'"),
        (lambda m: quaternion(m).update(w=1), QUATERNION + " has the unknown key 'w'"),
        (lambda m: quaternion(m).update(W=0.51), QUATERNION + " is of length 1.00504: must be of"),
        (lambda m: quaternion(m).update(W=0, Z=0), QUATERNION + " is of length 0: must be of len"),
        (lambda m: quaternion(m).update(W=float("inf")), QUATERNION + r"\.W is inf: must be a fin"),
        (lambda m: quaternion(m).update(W=None), QUATERNION + r"\.W is None: must be a finite"),
    ],
)
def test_what_is_wrong_is_refused_by_name(
    change: Callable[[Any], Any], message: str, tmp_path: Path
) -> None:
    content = changed(change)
    with pytest.raises(ValueError, match=message):
        map_from_json(content)
    path = tmp_path / "garage.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=rf"marker map .*garage\.json: .*{message}"):
        load_map(path)


def test_a_file_that_is_no_map_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"marker map .*lost\.json: No such file"):
        load_map(tmp_path / "lost.json")
    for name, content in (("text", b"# markers\n"), ("picture", b"\x89PNG\r\n\xff")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=rf"marker map .*{name} is not JSON"):
            load_map(tmp_path / name)
    (tmp_path / "list.json").write_text("[1, 2]")
    with pytest.raises(ValueError, match=r"the marker map is \[1, 2\]: must be an object with"):
        load_map(tmp_path / "list.json")
