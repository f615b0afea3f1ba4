from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator

from systems.cameras import PinholeCamera
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap
from systems.markers.localizer import (
    REASONS,
    Localization,
    Localizer,
    LocalizerParameters,
    MapLocalizer,
)
from systems.messages import Detections, PoseEstimate

K = np.array([[590.0, 0.0, 322.5], [0.0, 610.0, 236.2], [0.0, 0.0, 1.0]])
CAMERA = PinholeCamera(640, 480, K, np.array([-0.28, 0.09, 1e-3, -2e-3, -0.01]))
# A camera on the body that looks ahead (x), a little upward.
R_BC = RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
X_BC = RigidTransform(
    RotationMatrix(RollPitchYaw(0.0, -0.1, 0.05)).multiply(R_BC), [0.05, 0.01, 0.12]
)
X_WB = RigidTransform(RollPitchYaw(0.02, -0.03, 0.1), [0.1, -0.05, 0.02])
NOISE = 0.3  # px


def facing(x: float, y: float, z: float, yaw: float = 0.0, pitch: float = 0.0) -> RigidTransform:
    """A marker at that place that looks back along -x, turned to the left by `yaw`."""
    return RigidTransform(RollPitchYaw(0.0, pitch, np.pi + yaw), [x, y, z])


SCENES = {
    "two on a wall near by": [facing(1.2, 0.2, 0.2), facing(1.2, -0.2, 0.3)],
    "two on a wall aslant": [facing(1.5, 0.3, 0.2, yaw=0.7), facing(1.75, 0.0, 0.3, yaw=0.7)],
    "three in a corner": [
        facing(2.0, 0.4, 0.2),
        facing(2.0, 0.0, 0.3),
        facing(1.8, -0.4, 0.3, yaw=-1.0),
    ],
    "four on a wall": [facing(1.5, y, z) for y in (-0.3, 0.3) for z in (0.15, 0.5)],
    "six about the room": [
        facing(2.0, 0.5, 0.2),
        facing(2.0, 0.0, 0.3),
        facing(2.0, -0.5, 0.3),
        facing(1.3, 0.4, 0.3, yaw=0.9),
        facing(1.3, -0.4, 0.25, yaw=-0.9),
        facing(3.0, 0.2, 0.6),
    ],
}


def map_of(markers: list[RigidTransform], size: float = 0.1) -> MarkerMap:
    return MarkerMap(
        family("DICT_4X4_50"), size, {k: Marker(k, X, size) for k, X in enumerate(markers)}
    )


def localizer(markers: MarkerMap, **parameters: Any) -> MapLocalizer:
    parameters = {"pixel_noise": NOISE} | parameters
    return MapLocalizer(
        marker_map=markers, camera=CAMERA, X_BC=X_BC, parameters=LocalizerParameters(**parameters)
    )


def pixels_of(markers: MarkerMap, body: RigidTransform = X_WB) -> np.ndarray:
    """The exact corners (n, 4, 2) px; all of them in the picture."""
    X_CW = body.multiply(X_BC).inverse()
    p_C = np.array([X_CW.multiply(marker.corners().T).T for marker in markers])
    pixels = CAMERA.project(p_C)
    assert (p_C[..., 2] > 0).all()
    assert ((pixels >= 0) & (pixels <= [CAMERA.width - 1, CAMERA.height - 1])).all()
    return pixels


def seen(pixels: np.ndarray, ids: Any = None, stamp: float = 1.0) -> Detections:
    pixels = np.asarray(pixels, float).reshape(-1, 4, 2)
    n = len(pixels)
    return Detections(
        stamp=stamp,
        ids=np.arange(n) if ids is None else np.asarray(ids, np.int64),
        corners=pixels,
        hamming=np.zeros(n, np.int64),
        decision_margin=np.full(n, 50.0),
    )


def error(found: RigidTransform, true: RigidTransform = X_WB) -> np.ndarray:
    """(6,) rotation vector and position of what was found from what is true, both in W."""
    turn = found.rotation().multiply(true.rotation().inverse()).ToAngleAxis()
    return np.concatenate([turn.axis() * turn.angle(), found.translation() - true.translation()])


def test_without_noise_the_pose_is_exact() -> None:
    rng = np.random.default_rng(0)
    exact = localizer(map_of(SCENES["six about the room"]))
    all_pixels = pixels_of(exact.marker_map)
    for n in range(1, 7):
        for ids in (np.sort(rng.permutation(6)[:n]) for _ in range(5)):
            found = exact.locate(seen(all_pixels[ids], ids))
            assert found.pose.markers == n
            assert (found.pose.frame_id, found.pose.child_frame_id) == ("map", "base_link")
            assert found.pose.stamp == 1.0
            np.testing.assert_allclose(error(found.pose.pose), 0.0, atol=1e-6)
            assert found.pose.reprojection_rms < 1e-5
            assert not any(found.dropped.values())


def test_without_noise_any_body_and_any_mounting_is_found() -> None:
    rng = np.random.default_rng(1)
    markers = map_of(SCENES["three in a corner"])
    for _ in range(20):
        q = rng.normal(size=4)
        X = RigidTransform(RotationMatrix(Quaternion(q / np.linalg.norm(q))), rng.normal(size=3))
        mounted = MapLocalizer(marker_map=markers, camera=CAMERA, X_BC=X, body_frame="drone")
        # The camera stays where it was, the body hangs elsewhere.
        body = X_WB.multiply(X_BC).multiply(X.inverse())
        found = mounted.locate(seen(pixels_of(markers))).pose
        assert found.child_frame_id == "drone"
        np.testing.assert_allclose(error(found.pose, body), 0.0, atol=1e-6)


def test_markers_of_other_sizes_are_taken_as_such() -> None:
    markers = map_of(SCENES["three in a corner"])
    markers.markers[1] = Marker(1, markers.markers[1].X_WM, 0.2)
    pixels = pixels_of(markers)
    for ids in ([0, 1, 2], [1]):
        found = localizer(markers).locate(seen(pixels[ids], ids)).pose
        np.testing.assert_allclose(error(found.pose), 0.0, atol=1e-6)


@pytest.mark.parametrize("scene", SCENES)
def test_the_covariance_is_that_of_the_documented_tangent(scene: str) -> None:
    # d(pose)/d(pixel) by differences, in the tangent that `PoseEstimate` documents; noise of every
    # pixel coordinate is independent.
    markers = map_of(SCENES[scene])
    exact, pixels = localizer(markers), pixels_of(markers)
    h = 1e-2
    columns = []
    for index in np.ndindex(pixels.shape):
        ends = []
        for sign in (1.0, -1.0):
            moved = pixels.copy()
            moved[index] += sign * h
            ends.append(error(exact.locate(seen(moved)).pose.pose))
        columns.append((ends[0] - ends[1]) / (2 * h))
    expected = NOISE**2 * np.array(columns).T @ np.array(columns)
    found = exact.locate(seen(pixels)).pose.covariance
    unit = np.outer(*[np.sqrt(np.diag(expected))] * 2)
    np.testing.assert_allclose(found / unit, expected / unit, atol=0.02)


@pytest.mark.parametrize("scene", SCENES)
def test_a_joint_pose_is_better_than_any_single_and_as_good_as_it_says(scene: str) -> None:
    markers = map_of(SCENES[scene])
    joint, pixels = localizer(markers), pixels_of(markers)
    rng = np.random.default_rng(2)
    draws = 120
    nees, errors = [], []
    singles: list[list[np.ndarray]] = [[] for _ in markers]
    for _ in range(draws):
        noisy = pixels + rng.normal(0, NOISE, pixels.shape)
        found = joint.locate(seen(noisy))
        assert found.pose.markers == len(markers)
        e = error(found.pose.pose)
        errors.append(e)
        nees.append(e @ np.linalg.solve(found.pose.covariance, e) / 6)
        for k, own in enumerate(singles):
            own.append(error(joint.locate(seen(noisy[k], [k])).pose.pose))
    # The mean of 120 draws of chi-square / 6 has a standard deviation of 0.05.
    assert 0.8 < np.mean(nees) < 1.25
    for part in (slice(0, 3), slice(3, 6), slice(2, 3)):  # rotation, position, heading
        rms = np.sqrt(np.mean(np.square(errors)[:, part].sum(axis=1)))
        best = min(np.sqrt(np.mean(np.square(own)[:, part].sum(axis=1))) for own in singles)
        assert rms < best


def single(tilt: float, axis: float = 0.0, distance: float = 1.0) -> MarkerMap:
    """One marker straight before the camera, tilted about an axis in its plane."""
    X_WC = X_WB.multiply(X_BC)
    turn = RigidTransform(RollPitchYaw(axis, 0.0, 0.0), np.zeros(3))
    X_CM = RigidTransform(R_BC.inverse(), [0.0, 0.0, distance]).multiply(
        RigidTransform(RollPitchYaw(0.0, 0.0, np.pi), np.zeros(3))
    )
    lean = RigidTransform(RollPitchYaw(0.0, 0.0, tilt), np.zeros(3))
    return map_of([X_WC @ X_CM @ turn @ lean @ turn.inverse()])


def test_near_to_frontal_what_is_accepted_is_near_the_cramer_rao_bound() -> None:
    rng = np.random.default_rng(3)
    squares, bounds, tilts = [], [], []
    for _ in range(40):
        tilt = np.deg2rad(rng.uniform(0.0, 25.0))
        markers = single(tilt, rng.uniform(0, 2 * np.pi))
        one, pixels = localizer(markers), pixels_of(markers)
        exact = one.locate(seen(pixels)).pose
        np.testing.assert_allclose(error(exact.pose), 0.0, atol=1e-5)
        for _ in range(20):
            found = one.locate(seen(pixels + rng.normal(0, NOISE, pixels.shape)))
            if not found.pose.ambiguous:
                squares.append((error(found.pose.pose)[:3] ** 2).sum())
                bounds.append(np.trace(exact.covariance[:3, :3]))
                tilts.append(tilt)
    # Little is accepted below 10 degrees, much beyond 15.
    share = np.histogram(tilts, np.deg2rad([0, 5, 10, 15, 25]))[0]
    assert share[0] < share[1] < share[2] < share[3]
    assert len(squares) > 200
    assert np.sqrt(np.mean(squares)) < 1.2 * np.sqrt(np.mean(bounds))


def test_a_tilted_marker_has_a_heading_of_less_than_a_degree() -> None:
    rng = np.random.default_rng(4)
    for tilt in (30.0, 45.0, 60.0):
        # Tilted about the vertical, which is where heading comes from.
        markers = single(np.deg2rad(tilt))
        one, pixels = localizer(markers), pixels_of(markers)
        headings = []
        for _ in range(100):
            found = one.locate(seen(pixels + rng.normal(0, NOISE, pixels.shape)))
            assert not found.pose.ambiguous
            headings.append(error(found.pose.pose)[2])
        assert np.rad2deg(np.sqrt(np.mean(np.square(headings)))) < 1.0


def test_both_solutions_of_a_small_marker_travel_on() -> None:
    # 30 px at 25 degrees: the wrong solution often has the smaller error.
    rng = np.random.default_rng(5)
    markers = single(np.deg2rad(25.0), distance=2.0)
    one, pixels = localizer(markers), pixels_of(markers)
    wrong_first = 0
    for _ in range(100):
        found = one.locate(seen(pixels + rng.normal(0, NOISE, pixels.shape)))
        assert found.pose.ambiguous
        assert found.alternative.ambiguous
        assert found.alternative.stamp == found.pose.stamp
        assert found.pose.reprojection_rms <= found.alternative.reprojection_rms
        off = [np.linalg.norm(error(e.pose)[:3]) for e in (found.pose, found.alternative)]
        assert min(off) < np.deg2rad(15)
        wrong_first += off[0] > off[1]
    assert 5 < wrong_first < 45


def test_a_flat_group_far_away_has_two_solutions_too() -> None:
    # One marker's idea of the pose differs more from the other's than SAME_POSE: the second minimum
    # of the pair has to be found all the same.
    rng = np.random.default_rng(6)
    wall = single(np.deg2rad(20.0), distance=3.0).markers[0].X_WM
    markers = map_of([wall @ RigidTransform([0.0, y, 0.0]) for y in (-0.1, 0.1)])
    pair, pixels = localizer(markers), pixels_of(markers)
    two = 0
    for _ in range(100):
        found = pair.locate(seen(pixels + rng.normal(0, NOISE, pixels.shape)))
        off = [np.linalg.norm(error(e.pose)[:3]) for e in (found.pose, found.alternative)]
        two += found.alternative.valid
        # A wrong one that is taken for sure is what harms a filter.
        assert found.pose.ambiguous or off[0] < np.deg2rad(12)
        assert min(off) < np.deg2rad(12)
    assert two > 90


@pytest.mark.parametrize("moved", [0, 1, 2])
@pytest.mark.parametrize("shift", [[0.0, 0.1, 0.0], [0.0, 0.0, -0.05], [-0.3, 0.0, 0.0]])
def test_a_marker_that_was_moved_is_left_out(moved: int, shift: list[float]) -> None:
    surveyed = map_of(SCENES["three in a corner"], size=0.15)
    real = map_of(SCENES["three in a corner"], size=0.15)
    X_WM = real.markers[moved].X_WM
    real.markers[moved] = Marker(
        moved, RigidTransform(X_WM.rotation(), X_WM.translation() + shift), 0.15
    )
    pixels = pixels_of(real)
    for seed in range(5):
        noise = np.random.default_rng(seed).normal(0, NOISE, pixels.shape)
        found = localizer(surveyed).locate(seen(pixels + noise))
        assert found.dropped["outlier"] == 1
        assert found.pose.markers == 2
        e = error(found.pose.pose)
        assert e @ np.linalg.solve(found.pose.covariance, e) < 30  # 6 degrees of freedom
        assert found.pose.reprojection_rms < 1.0


def test_two_of_six_that_were_moved_are_left_out() -> None:
    surveyed, real = (map_of(SCENES["six about the room"]) for _ in range(2))
    for k, shift in ((0, [0.0, 0.15, 0.0]), (4, [0.0, 0.0, 0.1])):
        X_WM = surveyed.markers[k].X_WM
        moved = RigidTransform(X_WM.rotation(), X_WM.translation() + shift)
        real.markers[k] = Marker(k, moved, 0.1)
    found = localizer(surveyed).locate(seen(pixels_of(real)))
    assert dropped(found) == {"outlier": 2}
    assert found.pose.markers == 4
    np.testing.assert_allclose(error(found.pose.pose), 0.0, atol=1e-5)


def test_two_markers_that_contradict_each_other_give_no_pose() -> None:
    surveyed = map_of(SCENES["two on a wall near by"])
    real = map_of([facing(1.2, 0.2, 0.2), facing(1.2, -0.35, 0.3)])
    found = localizer(surveyed).locate(seen(pixels_of(real)))
    assert not found.pose.valid
    assert not found.alternative.valid
    assert {k: n for k, n in found.dropped.items() if n} == {"inconsistent": 1}


def dropped(found: Localization) -> dict[str, int]:
    assert set(found.dropped) == set(REASONS)
    return {reason: n for reason, n in found.dropped.items() if n}


def test_what_cannot_be_used_is_dropped_and_counted() -> None:
    markers = map_of(SCENES["three in a corner"])
    three, pixels = localizer(markers), pixels_of(markers)

    def locate(ids: Any = None, **corners: np.ndarray) -> Localization:
        changed = pixels.copy()
        for name, value in corners.items():
            changed[int(name[1:])] = value
        return three.locate(seen(changed, ids))

    centre = pixels[0].mean(axis=0)
    cases = {
        "bad_corners": [
            locate(_0=np.where(np.arange(8).reshape(4, 2) == 3, np.nan, pixels[0])),
            locate(_0=np.where(np.arange(8).reshape(4, 2) == 3, np.inf, pixels[0])),
            locate(_0=pixels[0, [0, 2, 1, 3]]),  # crossed
            locate(_0=pixels[0, ::-1]),  # seen through the wall
            locate(_0=[*pixels[0, :2], (pixels[0, 1] + pixels[0, 3]) / 2, pixels[0, 3]]),
            locate(_0=pixels[0] + 5000.0),  # where no ray leads through this lens
        ],
        "too_small": [locate(_0=centre + 0.1 * (pixels[0] - centre)), locate(_0=centre)],
        "unknown_id": [locate([9, 1, 2]), locate([-1, 1, 2])],
    }
    for reason, founds in cases.items():
        for found in founds:
            assert dropped(found) == {reason: 1}
            assert found.pose.markers == 2
            np.testing.assert_allclose(error(found.pose.pose), 0.0, atol=1e-5)
    # Two of one id: neither can be told to be the real one.
    found = locate([0, 1, 1])
    assert dropped(found) == {"repeated_id": 2}
    assert found.pose.markers == 1
    np.testing.assert_allclose(error(found.pose.pose), 0.0, atol=1e-5)


def test_without_a_usable_marker_there_is_no_pose() -> None:
    markers = map_of(SCENES["two on a wall near by"])
    two, pixels = localizer(markers), pixels_of(markers)
    for detections, counts in (
        (seen(pixels[:0]), {}),
        (seen(pixels, [7, 8]), {"unknown_id": 2}),
        (replace(seen(pixels), family="tag36h11"), {"unknown_id": 2}),
        (seen(pixels[:, ::-1]), {"bad_corners": 2}),
        (seen(pixels[:1, ::-1]), {"bad_corners": 1}),
    ):
        found = two.locate(detections)
        assert not found.pose.valid
        assert not found.alternative.valid
        assert found.pose.frame_id == "map"
        assert dropped(found) == counts
    nowhere = localizer(map_of([]))
    assert dropped(nowhere.locate(seen(pixels))) == {"unknown_id": 2}


def test_a_marker_that_is_left_alone_counts_as_single() -> None:
    # Its second solution must not get lost because another marker was dropped.
    markers = map_of([single(np.deg2rad(4.0), distance=1.5).markers[0].X_WM, facing(1.2, 0.4, 0.3)])
    two, pixels = localizer(markers), pixels_of(markers)
    pixels[0] += np.random.default_rng(7).normal(0, NOISE, (4, 2))
    alone = two.locate(seen(pixels[0], [0]))
    assert alone.pose.ambiguous
    left = two.locate(seen([pixels[0], pixels[1, ::-1]]))
    assert left.pose.ambiguous
    np.testing.assert_allclose(
        left.alternative.pose.GetAsMatrix34(), alone.alternative.pose.GetAsMatrix34(), atol=1e-9
    )


def test_the_best_alone_is_the_largest() -> None:
    markers = map_of(SCENES["three in a corner"])
    markers.markers[1] = Marker(1, markers.markers[1].X_WM, 0.2)
    pixels = pixels_of(markers)
    pixels += np.random.default_rng(8).normal(0, NOISE, pixels.shape)
    best = localizer(markers, use="best").locate(seen(pixels))
    assert best.pose.markers == 1
    alone = localizer(markers).locate(seen(pixels[1], [1]))
    np.testing.assert_allclose(
        best.pose.pose.GetAsMatrix34(), alone.pose.pose.GetAsMatrix34(), atol=1e-9
    )


@pytest.mark.filterwarnings("error")
def test_whatever_is_seen_the_answer_is_finite_or_none() -> None:
    rng = np.random.default_rng(9)
    markers = map_of(SCENES["three in a corner"])
    three, pixels = localizer(markers, min_side=0.0), pixels_of(markers)
    some = 0
    for k in range(600):
        n = int(rng.integers(1, 4))
        if k % 2:
            corners = pixels[:n] + rng.normal(0, 10 ** rng.uniform(-1, 2.5), (n, 4, 2))
        else:
            corners = K[:2, 2] + rng.normal(0, 10 ** rng.uniform(-3, 4), (n, 4, 2))
        found = three.locate(seen(corners))
        for estimate in (found.pose, found.alternative):
            if estimate.valid:
                some += 1
                assert np.isfinite(estimate.covariance).all()
                assert (np.diag(estimate.covariance) > 0).all()
                values = np.linalg.eigvalsh(estimate.covariance)
                assert values[0] > -1e-12 * values[-1]
                assert np.isfinite(estimate.pose.GetAsMatrix34()).all()
                assert estimate.pose.rotation().IsValid()
                assert estimate.reprojection_rms <= 2.0
    assert some > 100


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("pixel_noise", 0.0),
        ("pixel_noise", math.nan),
        ("use", "some"),
        ("min_side", -1.0),
        ("max_reprojection", 0.0),
        ("ambiguity_ratio", math.inf),
    ],
)
def test_nonsense_is_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value!r}: must be "):
        LocalizerParameters(**{field: value})


def test_the_block_sends_what_the_latest_picture_says() -> None:
    markers = map_of(SCENES["three in a corner"])
    pixels = pixels_of(markers)
    block = Localizer(localizer=localizer(markers), rate=30.0)
    context = block.CreateDefaultContext()

    def outputs(detections: Detections) -> list[Any]:
        block.detections_input_port().FixValue(context, detections)
        return [
            port.Eval(context)
            for port in (block.pose_output_port(), block.alternative_output_port())
        ]

    pose, alternative = outputs(Detections())
    assert not pose.valid
    assert not alternative.valid
    pose, alternative = outputs(seen(pixels, stamp=2.5))
    assert pose.stamp == 2.5
    np.testing.assert_allclose(error(pose.pose), 0.0, atol=1e-6)
    again, _ = outputs(seen(pixels[:1], stamp=2.6))
    assert again.stamp == 2.6
    assert again.markers == 1
    assert not outputs(seen(pixels[:0], stamp=2.7))[0].valid


def test_the_block_counts_each_picture_once() -> None:
    markers = map_of(SCENES["three in a corner"])
    pixels = pixels_of(markers)
    block = Localizer(localizer=localizer(markers), rate=100.0)
    simulator = Simulator(block)
    context = simulator.get_mutable_context()
    calls = []
    algorithm = block._localizer
    original = algorithm.locate
    algorithm.locate = lambda d: calls.append(d) or original(d)  # type: ignore[method-assign]
    sent = [
        Detections(),
        seen(pixels, [9, 1, 2], stamp=0.1),
        seen(pixels, [0, 9, 8], stamp=0.2),
        seen(pixels[:0], stamp=0.3),
    ]
    for k, detections in enumerate(sent):
        block.detections_input_port().FixValue(context, detections)
        simulator.AdvanceTo(0.1 * (k + 1) - 0.005)
        assert isinstance(block.pose_output_port().Eval(context), PoseEstimate)
    counts = block.health_output_port().Eval(context).counts
    assert counts == {reason: 3 * (reason == "unknown_id") for reason in REASONS}
    assert len(calls) == len({id(d) for d in calls})  # none was solved twice
