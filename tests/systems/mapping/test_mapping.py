"""Maps of circuits: near enough to the truth, or refused with the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from systems.cameras import PinholeCamera
from systems.mapping.gathering import gather
from systems.mapping.mapping import MappingParameters, TagMap, build_map, other_poses
from systems.mapping.scene import rotation_vector
from tests.mapping_world import CAMERA, SIZE, Circuit, circuit


def mapped(world: Circuit, noise: float = 0.3, seed: int = 0, **arguments: object) -> TagMap:
    """Returns the map of a circuit, tag 0 where it is in truth."""
    gathered = gather(world.detections(noise, seed), camera=CAMERA, size=SIZE)
    X = RigidTransform(RotationMatrix(world.scene.R_WT[0]), world.scene.p_WT[0])
    return build_map(gathered, anchor=0, X_W_anchor=X, **arguments)  # type: ignore[arg-type]


def error(tag_map: TagMap, world: Circuit) -> float:
    """Returns the largest error of a tag's position, m."""
    off = tag_map.adjustment.scene.p_WT - world.scene.p_WT[tag_map.ids]
    return float(np.linalg.norm(off, axis=1).max())


@pytest.mark.parametrize("seed", range(3))
def test_circuits_are_mapped_without_a_start(seed: int) -> None:
    world = circuit(seed=seed)
    tag_map = mapped(world, seed=seed)
    assert tag_map.suspects == {}
    assert tag_map.used == 1.0
    assert error(tag_map, world) < 0.12  # a chain of single poses is off by half a metre
    assert tag_map.pixel_noise == pytest.approx(0.3, rel=0.05)
    assert tag_map.chi2_per_dof() == pytest.approx(1.0, abs=0.1)
    m, free = len(tag_map.sightings), 6 * (len(tag_map.ids) - 1 + len(tag_map.stamps))
    share = 1 - free / (8 * m)  # of the noise that the fit leaves
    assert tag_map.rms() == pytest.approx(0.3 * np.sqrt(2 * share), rel=0.05)  # x and y


def test_a_flipped_tag_is_found_and_set_right() -> None:
    world = circuit(turn_deg=8.0)  # seen nearly from the front, most have two poses
    sightings = world.sightings(0.3)
    other, gain = other_poses(world.scene, sightings, 0, 0.3)
    assert gain.max() < 0  # none of the true poses is bettered
    assert gain[0] == -np.inf
    two = np.isfinite(gain)
    assert two.sum() > 5
    _, back = other_poses(other, sightings, 0, 0.3)
    np.testing.assert_allclose(back[two], -gain[two], rtol=0.2, atol=5.0)


def test_outliers_are_left_out() -> None:
    world = circuit()
    found = world.detections(0.3)
    spoiled = []
    for k, frame in enumerate(found):
        corners = frame.corners.copy()
        if k % 10 == 0 and len(corners):
            corners[0] += 30.0
        spoiled.append(type(frame)(stamp=frame.stamp, ids=frame.ids, corners=corners))
    gathered = gather(spoiled, camera=CAMERA, size=SIZE)
    X = RigidTransform(RotationMatrix(world.scene.R_WT[0]), world.scene.p_WT[0])
    tag_map = build_map(gathered, anchor=0, X_W_anchor=X)
    assert tag_map.suspects == {}
    spoiled_part = 12 / len(gathered.sightings)
    # Where a frame shows two tags, one of them spoiled, nobody can tell which.
    assert spoiled_part <= 1 - tag_map.used < spoiled_part + 0.02
    assert error(tag_map, world) < 0.12


def test_tags_that_nothing_connects_are_named() -> None:
    world = circuit()
    frames = world.detections(0.3)
    # The far side's pictures show one tag each: those are connected to nothing.
    cut = []
    for frame in frames:
        far = frame.ids >= 12
        keep = ~far if (~far).any() else np.arange(len(frame.ids)) == 0
        cut.append(frame.select(keep))
    gathered = gather(cut, camera=CAMERA, size=SIZE)
    tag_map = build_map(gathered, anchor=0)
    lonely = sorted(set(gathered.ids) - set(tag_map.ids))
    assert lonely
    assert min(lonely) >= 12
    assert tag_map.suspects["disconnected"] == (
        f"no picture connects the tags {', '.join(map(str, lonely))} to the others"
    )


def test_a_wrong_camera_is_suspected() -> None:
    world = circuit()
    wrong = PinholeCamera.from_focal_length(640, 480, 600.0)
    gathered = gather(world.detections(0.3), camera=wrong, size=SIZE)
    tag_map = build_map(gathered, anchor=0, parameters=MappingParameters(pixel_noise=0.3))
    assert {"residuals", "outliers", "chi2"} & tag_map.suspects.keys()
    assert any("camera" in reason for reason in tag_map.suspects.values())


def test_the_anchor_must_have_been_seen() -> None:
    gathered = gather(circuit().detections(0.3), camera=CAMERA, size=SIZE)
    with pytest.raises(ValueError, match="anchor is 99: must be one of the tags that were seen: 0"):
        build_map(gathered, anchor=99)


def test_without_an_anchor_the_most_seen_tag_is_the_origin() -> None:
    gathered = gather(circuit().detections(0.3), camera=CAMERA, size=SIZE)
    tag_map = build_map(gathered)
    most = int(gathered.ids[np.argmax(gathered.sightings_of())])
    place = int(np.flatnonzero(tag_map.ids == most)[0])
    np.testing.assert_array_equal(tag_map.adjustment.scene.p_WT[place], 0)
    np.testing.assert_array_equal(tag_map.adjustment.scene.R_WT[place], np.eye(3))


def known(world: Circuit, *tags: int) -> dict[int, RigidTransform]:
    """Returns the true poses of some tags."""
    scene = world.scene
    return {k: RigidTransform(RotationMatrix(scene.R_WT[k]), scene.p_WT[k]) for k in tags}


def test_known_tags_stay_and_the_others_are_added_to_them() -> None:
    world = circuit()
    gathered = gather(world.detections(0.3), camera=CAMERA, size=SIZE)
    half = known(world, *range(0, 24, 2))
    tag_map = build_map(gathered, known=half | {500: RigidTransform()})  # one that is not there
    assert tag_map.suspects == {}
    assert tag_map.held.tolist() == list(range(0, 24, 2))
    np.testing.assert_array_equal(tag_map.adjustment.scene.p_WT[::2], world.scene.p_WT[::2])
    assert not tag_map.adjustment.tag_covariance[::2].any()
    assert error(tag_map, world) < 0.02  # no way is long from what is known
    assert tag_map.chi2_per_dof() == pytest.approx(1.0, abs=0.1)


def test_against_a_whole_map_only_cameras_are_found() -> None:
    world = circuit()
    gathered = gather(world.detections(0.3), camera=CAMERA, size=SIZE)
    tag_map = build_map(gathered, known=known(world, *range(24)))
    assert tag_map.suspects == {}
    scene, P = tag_map.adjustment.scene, tag_map.adjustment.camera_covariance
    error = np.concatenate(
        [
            rotation_vector(scene.R_CW @ world.scene.R_CW.swapaxes(1, 2)),
            scene.p_CW - world.scene.p_CW,
        ],
        axis=1,
    )
    nees = (error * np.linalg.solve(P, error[..., None])[..., 0]).sum(axis=1) / 6
    assert nees.mean() == pytest.approx(1.0, abs=0.15)


def test_corners_in_another_order_are_refused() -> None:
    turned = [replace(d, corners=d.corners[:, ::-1]) for d in circuit().detections(0.3)]
    gathered = gather(turned, camera=CAMERA, size=SIZE)
    with pytest.raises(ValueError, match=r"corners is .*: must be in the order top-left, top-ri"):
        build_map(gathered)


@pytest.mark.parametrize("ids", [[7], [7, 8]])
def test_few_tags_are_a_map_too(ids: list[int]) -> None:
    world = circuit()
    found = [d.select(np.isin(d.ids, ids)) for d in world.detections(0.3)]
    tag_map = build_map(gather(found, camera=CAMERA, size=SIZE), anchor=7)
    assert tag_map.ids.tolist() == ids
    distance = np.linalg.norm(np.diff(tag_map.adjustment.scene.p_WT, axis=0), axis=1)
    true = np.linalg.norm(np.diff(world.scene.p_WT[ids], axis=0), axis=1)
    np.testing.assert_allclose(distance, true, atol=0.05)


def test_known_tags_must_be_among_those_seen() -> None:
    gathered = gather(circuit().detections(0.3), camera=CAMERA, size=SIZE)
    with pytest.raises(ValueError, match="known tags is '77, 80': must be in part among the tags"):
        build_map(gathered, known={77: RigidTransform(), 80: RigidTransform()})
    with pytest.raises(ValueError, match="anchor is 3: must be left out"):
        build_map(gathered, anchor=3, known={3: RigidTransform()})
