from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore

from systems.cameras import PinholeCamera
from systems.markers.corner_refinement import to_ideal, to_picture
from systems.markers.detector import Detector, DetectorParameters, MarkerDetector, is_picture
from systems.markers.family import family
from systems.messages import CameraImage, Detections
from tests.recordings import listed_tags, right_and_other
from tests.synthetic import (
    Sheet,
    corner_errors,
    draw,
    expose,
    posed_homography,
    random_homography,
    random_sheets,
)

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

ENGINES = pytest.mark.parametrize("name", ["DICT_4X4_50", "tag36h11"])


def printed(name: str, marker_id: int, cell: int = 8, margin: int = 2) -> Grey:
    """The official upright image, enlarged, with pixels that all belong to one cell."""
    image = family(name).cell_image(marker_id, margin)
    return np.kron(image, np.ones((cell, cell), np.uint8))


def scene(name: str, *, seed: int = 0, **drawing: Any) -> tuple[Grey, list[Sheet]]:
    rng = np.random.default_rng(seed)
    sheets = random_sheets(rng, family(name))
    return expose(draw((480, 640), sheets, **drawing)), sheets


@pytest.mark.parametrize(
    "name",
    [
        "DICT_4X4_50", "DICT_5X5_1000", "DICT_6X6_250", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL",
        "DICT_ARUCO_MIP_36h12", "tag16h5", "tag25h9", "tag36h10", "tag36h11",
    ],
)  # fmt: skip
def test_corners_come_in_the_order_of_the_upright_image(name: str) -> None:
    detector = MarkerDetector(family=name)
    upright = printed(name, 7)
    size = len(upright)
    low, high = 2 * 8 - 0.5, size - 2 * 8 - 0.5
    corners = np.array([[low, low], [high, low], [high, high], [low, high]])
    for quarter_turns in range(4):
        found = detector.detect(np.rot90(upright, quarter_turns))
        assert found.ids.tolist() == [7]
        assert found.family == family(name).name
        np.testing.assert_allclose(found.corners[0], corners, atol=0.05)
        corners = np.stack([corners[:, 1], size - 1 - corners[:, 0]], axis=-1)


@ENGINES
def test_every_marker_is_found_where_it_is(name: str) -> None:
    results = []
    detector = MarkerDetector(family=name)
    for seed in range(4):
        image, sheets = scene(name, seed=seed)
        found = detector.detect(image, stamp=1.5, frame_id="camera")
        assert (found.stamp, found.frame_id) == (1.5, "camera")
        truth = np.stack([sheet.corners() for sheet in sheets])
        results.append((found.ids, found.corners, truth))
    result = corner_errors(results)
    assert result.found == 1.0
    assert result.std < 0.01
    assert result.shift < 0.003
    assert abs(result.grow) < 0.003


def test_unrefined_corners_are_the_engine_s_own() -> None:
    image, sheets = scene("DICT_4X4_50")
    settings = cv2.aruco.DetectorParameters()
    settings.minMarkerDistanceRate = 0.05  # as the block sets it
    engine = cv2.aruco.ArucoDetector(family("DICT_4X4_50").opencv_dictionary(), settings)
    corners, ids, _ = engine.detectMarkers(image)
    rough = MarkerDetector(
        family="DICT_4X4_50", parameters=DetectorParameters(refine=False)
    ).detect(image)
    assert rough.ids.tolist() == ids.ravel().tolist()
    np.testing.assert_array_equal(rough.corners, np.concatenate(corners))
    truth = np.stack([sheet.corners() for sheet in sheets])
    rough_errors = corner_errors([(rough.ids, rough.corners, truth)])
    assert rough_errors.grow < -0.4  # the bias that refinement removes


def test_large_boards_are_not_taken_for_their_markers() -> None:
    # OpenCV's defaults miss some of these: it merges the board's outline with the marker's.
    detector = MarkerDetector(family="DICT_4X4_50")
    plain = cv2.aruco.ArucoDetector(detector.family.opencv_dictionary())
    rng = np.random.default_rng(0)
    missed = 0
    for _ in range(40):
        H = random_homography(rng, centre=(320, 240), side=(130, 260), max_tilt=0.8)
        image = expose(draw((480, 640), [Sheet(detector.family, 7, H)], ground=110.0))
        assert detector.detect(image).ids.tolist() == [7]
        missed += plain.detectMarkers(image)[1] is None
    assert missed > 0


@ENGINES
def test_decimation_reaches_the_engine(name: str) -> None:
    image, sheets = scene(name, seed=2)
    whole = MarkerDetector(family=name).detect(image)
    parameters = DetectorParameters(decimate=4.0)
    reduced = MarkerDetector(family=name, parameters=parameters).detect(image)
    assert 0 < len(reduced) < len(whole) == len(sheets)
    for marker_id, corners in zip(reduced.ids, reduced.corners, strict=True):
        # Starts from a picture a quarter the size end in the same corners.
        np.testing.assert_allclose(corners, sheets[marker_id].corners(), atol=0.1)


@pytest.mark.parametrize("decimate", [1.5, 2.0, 3.0])
def test_large_markers_are_found_in_a_smaller_picture_up_to_its_border(decimate: float) -> None:
    small = MarkerDetector(
        family="DICT_4X4_50", parameters=DetectorParameters(decimate=decimate, refine=False)
    )
    upright = printed("DICT_4X4_50", 7, cell=20, margin=1)
    size = len(upright)
    for left, top in ((0, 0), (640 - size, 480 - size), (201, 143)):
        image = np.full((480, 640), 128, np.uint8)
        image[top : top + size, left : left + size] = upright
        found = small.detect(image)
        assert found.ids.tolist() == [7]
        # The engine's quadrangles lie half a pixel inside, of its own picture; no other shift.
        low, high = np.array([left, top]) + 19.5, np.array([left, top]) + size - 20.5
        corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
        np.testing.assert_allclose(found.corners[0], corners, atol=1.2 * decimate)
        np.testing.assert_allclose(
            found.corners[0].mean(axis=0), corners.mean(axis=0), atol=0.3 * decimate
        )


def test_a_picture_is_not_reduced_below_what_an_engine_takes() -> None:
    parameters = DetectorParameters(decimate=1000.0)
    detector = MarkerDetector(family="DICT_4X4_50", parameters=parameters)
    assert len(detector.detect(printed("DICT_4X4_50", 7))) == 0


def with_flipped_cell(name: str, marker_id: int) -> Grey:
    cells = family(name).cell_image(marker_id, 2).copy()
    cells[4, 4] = 255 - cells[4, 4]
    return np.kron(cells, np.ones((8, 8), np.uint8))


@pytest.mark.parametrize(
    ("name", "allowed", "found"),
    [
        ("DICT_6X6_250", 1, 1),
        ("DICT_6X6_250", 0, 0),
        ("tag36h11", 1, 1),
        ("tag36h11", 0, 0),
        # Of 50 codes of 16 bits, one in twenty random patterns is a bit or less away: none of
        # the one bit that the family could correct is given away.
        ("DICT_4X4_50", 1, 0),
        ("DICT_4X4_50", 5, 0),
    ],
)
def test_a_wrong_bit_is_counted_and_allowed_or_not(name: str, allowed: int, found: int) -> None:
    parameters = DetectorParameters(hamming_max=allowed)
    detector = MarkerDetector(family=name, parameters=parameters)
    assert detector.detect(printed(name, 9)).hamming.tolist() == [0]
    assert detector.detect(with_flipped_cell(name, 9)).hamming.tolist() == [1] * found


@ENGINES
def test_faint_and_small_markers_are_left_out_on_demand(name: str) -> None:
    image = printed(name, 2)
    faint = (image // 8 + 100).astype(np.uint8)
    found = MarkerDetector(family=name).detect(faint)
    assert len(found) == 1
    limit = float(found.decision_margin[0])
    for margin, count in ((limit - 1, 1), (limit + 1, 0)):
        parameters = DetectorParameters(min_decision_margin=margin)
        assert len(MarkerDetector(family=name, parameters=parameters).detect(faint)) == count
    side = 8 * family(name).cells
    for min_side, count in ((side - 1, 1), (side + 1, 0)):
        parameters = DetectorParameters(min_side=min_side)
        assert len(MarkerDetector(family=name, parameters=parameters).detect(image)) == count


def test_noise_below_the_least_contrast_is_no_print_and_small_markers_stay() -> None:
    noise = np.random.default_rng(5).normal(0.0, 2.0, (480, 640))
    picture = np.full((480, 640), 180.0)
    upright = printed("tag36h11", 7, cell=2, margin=1)  # a side of 16 px
    picture[100:120, 200:220] = upright * 0.6 + 30
    faint = printed("tag36h11", 8, cell=4, margin=1)
    picture[300:340, 300:340] = 172 + faint * (20 / 255)
    picture = np.clip(np.rint(picture + noise), 0, 255).astype(np.uint8)
    found = {}
    for contrast in (5.0, 15.0, 40.0):
        parameters = DetectorParameters(min_contrast=contrast, min_decision_margin=0.0)
        detector = MarkerDetector(family="tag36h11", parameters=parameters)
        found[contrast] = detector.detect(picture)
    assert set(found[5.0].ids) == {7, 8}
    assert set(found[15.0].ids) == {7, 8}
    assert set(found[40.0].ids) == {7}  # the other one's print differs by 20 levels
    corners = [f.corners[f.ids.tolist().index(7)] for f in (found[5.0], found[40.0])]
    np.testing.assert_allclose(corners[0], corners[1], atol=0.01)


def clutter() -> list[Grey]:
    """Pictures without a marker in which engines see some: noise, gravel, checkers, letters."""
    rng = np.random.default_rng(3)
    pictures = []
    for _ in range(4):
        noise = rng.integers(0, 256, (480, 640)).astype(np.uint8)
        pictures.append(noise)
        for sigma in (1, 2, 4, 8):
            smooth = cv2.GaussianBlur(noise.astype(np.float32), (0, 0), sigma)
            smooth = cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX)
            pictures.append(smooth.astype(np.uint8))
            pictures.append(np.where(smooth > 128, 220, 30).astype(np.uint8))
        for size in (3, 5, 8, 13):
            blocks = rng.integers(0, 2, (480 // size + 1, 640 // size + 1)).astype(np.uint8)
            pictures.append(
                np.kron(blocks * np.uint8(190) + np.uint8(30), np.ones((size, size), np.uint8))
            )
        y, x = np.mgrid[:480, :640]
        angle = rng.uniform(0, np.pi)
        u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        for size in (10, 20, 40):
            odd = (np.floor(u / size) + np.floor(v / size)) % 2
            pictures.append(np.where(odd > 0, 220, 30).astype(np.uint8))
        page = np.full((480, 640), 240, np.uint8)
        for line in range(20, 480, int(rng.integers(14, 40))):
            text = "".join(rng.choice(list("ABCDEFGHKLMNOPQRSTUVWXYZ0123456789#@&%$"), 60))
            font, size = int(rng.integers(0, 8)), float(rng.uniform(0.35, 1.5))
            cv2.putText(page, text, (5, line), font, size, 0, int(rng.integers(1, 4)), cv2.LINE_AA)
        pictures.append(page)
    return pictures


@pytest.mark.parametrize("name", ["DICT_4X4_50", "tag16h5", "tag36h11"])
def test_clutter_holds_no_marker(name: str) -> None:
    detector = MarkerDetector(family=name)
    proposed = 0
    for picture in clutter():
        proposed += len(detector._engine.find(picture)[0])
        assert len(detector.detect(picture)) == 0
    if name == "tag16h5":
        assert proposed > 10  # what the second look at the cells is for


def test_one_id_in_two_places_is_two_markers() -> None:
    image = np.hstack([printed("DICT_4X4_50", 5), printed("DICT_4X4_50", 5)])
    found = MarkerDetector(family="DICT_4X4_50").detect(image)
    assert found.ids.tolist() == [5, 5]
    assert abs(found.corners[0, 0, 0] - found.corners[1, 0, 0]) == pytest.approx(
        image.shape[1] / 2, abs=0.01
    )


def test_one_marker_found_twice_is_one_and_the_surer_one() -> None:
    class Twice:
        def __init__(self, engine: Any) -> None:
            self.engine = engine

        def find(self, grey: Grey) -> tuple[NDArray[np.int64], Array]:
            ids, corners = self.engine.find(grey)
            worse = corners + np.array([5.0, 0.0])
            return np.repeat(ids, 2), np.concatenate(
                [worse[:1], corners[:1], worse[1:], corners[1:]]
            )

    detector = MarkerDetector(
        family="DICT_4X4_50", parameters=DetectorParameters(refine=False, rim_errors_max=0.4)
    )
    image = np.hstack([printed("DICT_4X4_50", 5, 16), printed("DICT_4X4_50", 6, 16)])
    image = cv2.GaussianBlur(image, (0, 0), 3.0)  # so that a cell is clearest at its centre
    single = detector.detect(image)
    assert len(single) == 2
    detector._engine = Twice(detector._engine)
    found = detector.detect(image)
    assert sorted(found.ids.tolist()) == [5, 6]
    np.testing.assert_array_equal(np.sort(found.corners.ravel()), np.sort(single.corners.ravel()))


@ENGINES
def test_a_distorting_lens_does_not_move_corners(name: str) -> None:
    camera = PinholeCamera(
        640, 480, np.array([[420.0, 0, 319.5], [0, 420.0, 239.5], [0, 0, 1]]),
        np.array([-0.3, 0.08, 0.0, 0.0]),
    )  # fmt: skip
    sheets = []
    for x, y in ((75, 75), (565, 75), (75, 405), (565, 405)):
        centre = tuple(to_ideal(np.array([x, y], float), camera))
        H = posed_homography(centre=centre, side=95, turn=x, tilt=0.5, tilt_axis=y)
        sheets.append(Sheet(family(name), len(sheets), H))
    image = expose(draw((480, 640), sheets, warp=lambda points: to_picture(points, camera)))
    found = MarkerDetector(family=name, camera=camera).detect(image)
    truth = to_picture(np.stack([sheet.corners() for sheet in sheets]), camera)
    result = corner_errors([(found.ids, found.corners, truth)])
    assert result.found == 1.0
    assert result.worst < 0.03


@ENGINES
def test_colour_strides_and_write_protection_make_no_difference(name: str) -> None:
    image, _ = scene(name)
    detector = MarkerDetector(family=name)
    expected = detector.detect(image)
    strided = np.zeros((960, 1280), np.uint8)[::2, ::2]
    strided[:] = image
    colour = np.repeat(image[..., None], 3, axis=2)
    frozen = image.copy()
    frozen.setflags(write=False)
    for same in (strided, np.asfortranarray(image), colour, frozen):
        found = detector.detect(same)
        np.testing.assert_array_equal(found.ids, expected.ids)
        np.testing.assert_array_equal(found.corners, expected.corners)


def test_a_colour_picture_is_rgb() -> None:
    mask = printed("DICT_4X4_50", 1) == 0
    yellow_on_white = np.full((*mask.shape, 3), 200, np.uint8)
    yellow_on_white[mask] = (200, 200, 40)
    detector = MarkerDetector(family="DICT_4X4_50")
    in_blue = detector.detect(yellow_on_white).decision_margin[0]
    in_red = detector.detect(yellow_on_white[..., ::-1]).decision_margin[0]
    assert in_red / in_blue == pytest.approx(0.299 / 0.114, rel=0.1)  # weights of luma, BT.601


@ENGINES
@pytest.mark.parametrize(
    "shape", [(1, 1), (1, 500), (500, 1), (8, 8), (13, 11), (12, 12, 3), (40, 30)]
)
def test_tiny_and_empty_pictures_hold_nothing(name: str, shape: tuple[int, ...]) -> None:
    detector = MarkerDetector(family=name)
    for picture in (
        np.zeros(shape, np.uint8),
        np.full(shape, 255, np.uint8),
        np.random.default_rng(1).integers(0, 256, shape).astype(np.uint8),
    ):
        found = detector.detect(picture)
        assert len(found) == 0
        assert found.corners.shape == (0, 4, 2)


@ENGINES
def test_markers_cut_by_the_rim_give_finite_corners_inside_reach(name: str) -> None:
    detector = MarkerDetector(family=name)
    image = printed(name, 3, 12)
    for cut in range(0, 60, 3):
        found = detector.detect(image[cut // 2 :, cut:])
        assert np.isfinite(found.corners).all()
        for corners in found.corners:
            np.testing.assert_allclose(corners[2], found_corner(name, cut), atol=0.6)


def found_corner(name: str, cut: int) -> tuple[float, float]:
    far = 12 * (family(name).cells + 2) - 0.5
    return far - cut, far - cut // 2


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros((0, 0), np.uint8),
        np.zeros((10, 0), np.uint8),
        np.zeros((40, 40)),
        np.zeros((40, 40), np.int8),
        np.zeros((40, 40, 4), np.uint8),
        np.zeros((40, 40, 1), np.uint8),
        np.zeros(40, np.uint8),
        [[1, 2], [3, 4]],
        None,
    ],
)
def test_what_is_no_picture_is_refused(bad: Any) -> None:
    assert not is_picture(bad)
    with pytest.raises(ValueError, match=r"image is .* must be uint8"):
        MarkerDetector(family="DICT_4X4_50").detect(bad)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("hamming_max", -1),
        ("hamming_max", 0.5),
        ("rim_errors_max", 0.5),
        ("rim_errors_max", -0.1),
        ("min_decision_margin", -1.0),
        ("min_decision_margin", float("nan")),
        ("min_side", -1.0),
        ("decimate", 0.5),
        ("decimate", float("inf")),
        ("blur", -0.1),
        ("min_contrast", 4.0),
        ("min_contrast", float("nan")),
    ],
)
def test_nonsense_parameters_are_refused_by_name(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is {re.escape(repr(value))}"):
        DetectorParameters(**{field: value})


def test_unknown_families_are_refused_with_the_nearest_name() -> None:
    with pytest.raises(ValueError, match="tag36h11"):
        MarkerDetector(family="tag36h12")


def block(detector: MarkerDetector | None = None) -> Detector:
    return Detector(detector=detector or MarkerDetector(family="DICT_4X4_50"), rate=10.0)


def evaluate(system: Detector, context: Any) -> Detections:
    return system.detections_output_port().Eval(context)


def show(system: Detector, context: Any, data: Any, stamp: float) -> None:
    image = CameraImage(stamp=stamp, frame_id="eye", data=data)
    system.image_input_port().FixValue(context, AbstractValue.Make(image))


def test_block_says_what_its_picture_shows() -> None:
    system = block()
    context = system.CreateDefaultContext()
    show(system, context, printed("DICT_4X4_50", 12), 0.25)
    found = evaluate(system, context)
    assert found.ids.tolist() == [12]
    assert (found.stamp, found.frame_id, found.family) == (0.25, "eye", "DICT_4X4_50")


@pytest.mark.parametrize(
    ("data", "stamp"),
    [
        (np.zeros((0, 0), np.uint8), np.nan),
        (np.zeros((0, 0), np.uint8), 1.0),
        (np.zeros((50, 50)), 1.0),
        (printed("DICT_4X4_50", 12), np.nan),
    ],
    ids=["nothing_yet", "no_pixels", "floats", "no_stamp"],
)
def test_block_says_nothing_without_a_picture(data: Any, stamp: float) -> None:
    system = block()
    context = system.CreateDefaultContext()
    show(system, context, data, stamp)
    found = evaluate(system, context)
    assert len(found) == 0
    assert np.isnan(found.stamp)
    assert (found.frame_id, found.family) == ("eye", "DICT_4X4_50")


def counting(detector: MarkerDetector) -> Callable[[], int]:
    calls = []
    find = detector._engine.find

    class Counted:
        def find(self, grey: Grey) -> tuple[NDArray[np.int64], Array]:
            calls.append(1)
            return find(grey)

    detector._engine = Counted()
    return lambda: len(calls)


def test_block_looks_at_each_picture_once() -> None:
    detector = MarkerDetector(family="DICT_4X4_50")
    calls = counting(detector)
    system = block(detector)
    context = system.CreateDefaultContext()
    picture = CameraImage(stamp=1.0, data=printed("DICT_4X4_50", 12))
    system.image_input_port().FixValue(context, AbstractValue.Make(picture))
    first = evaluate(system, context)
    # The same message, sent again: whatever made Drake ask again, the answer stands.
    system.image_input_port().FixValue(context, AbstractValue.Make(picture))
    context.SetTime(3.0)
    assert evaluate(system, context) is first
    assert calls() == 1
    show(system, context, printed("DICT_4X4_50", 13), 2.0)
    assert evaluate(system, context).ids.tolist() == [13]
    assert calls() == 2


def test_contexts_do_not_share_pictures() -> None:
    system = block()
    contexts = [system.CreateDefaultContext() for _ in range(2)]
    for marker_id, context in enumerate(contexts):
        show(system, context, printed("DICT_4X4_50", marker_id), 1.0)
    assert [evaluate(system, context).ids.tolist() for context in contexts] == [[0], [1]]


def test_block_counts_each_bad_picture_once() -> None:
    system = block()
    simulator = Simulator(system)
    context = simulator.get_mutable_context()

    def bad_pictures() -> int:
        return system.health_output_port().Eval(context).counts["bad_image"]

    bad = np.zeros((50, 50), np.float32)
    show(system, context, np.zeros((0, 0), np.uint8), np.nan)
    simulator.AdvanceTo(0.5)
    assert bad_pictures() == 0  # nothing yet is not bad
    for stamp, expected in ((0.5, 1), (0.5, 1), (0.9, 2)):
        show(system, context, bad, stamp)
        simulator.AdvanceTo(context.get_time() + 0.35)
        assert bad_pictures() == expected
    show(system, context, printed("DICT_4X4_50", 4), 2.0)
    simulator.AdvanceTo(context.get_time() + 0.35)
    assert bad_pictures() == 2
    assert evaluate(system, context).ids.tolist() == [4]


def test_block_refuses_a_rate_that_is_not_positive() -> None:
    with pytest.raises(ValueError, match="rate is 0"):
        Detector(detector=MarkerDetector(family="DICT_4X4_50"), rate=0)


@pytest.mark.recording
def test_photographs_of_apriltags(recordings: Path) -> None:
    detector = MarkerDetector(family="tag36h11")
    listed = right = 0
    for path in sorted((recordings / "apriltag_photos").glob("*.jpg")):
        tags = listed_tags(path.with_suffix(".txt"))
        listed += len(tags)
        picture = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        found = detector.detect(picture)
        seen, other = right_and_other(found.ids, found.corners, tags)
        right += seen
        assert other == 0, path.name
        for marker_id, corners in zip(found.ids, found.corners, strict=True):
            same = [c for i, c in tags if i == marker_id]  # an id may be there twice
            rough = min(same, key=lambda c: np.linalg.norm(c.mean(axis=0) - corners.mean(axis=0)))
            assert np.median(np.abs(rough[:, None] - corners).max(axis=-1).min(axis=1)) < 1.5
        # The mirrored picture has no tag of the family.
        assert len(detector.detect(picture[:, ::-1])) == 0
    assert listed == 47
    assert right >= 46


@pytest.mark.recording
def test_recording_of_a_real_camera(recordings: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    with Reader(recordings / "aruco_camera" / "aruco_images.bag") as bag:
        messages = [
            store.deserialize_ros1(raw, connection.msgtype)
            for connection, _, raw in bag.messages()
            if connection.msgtype.endswith("CompressedImage")
        ]
    assert len(messages) == 1
    picture = cv2.imdecode(np.asarray(messages[0].data), cv2.IMREAD_COLOR)[..., ::-1]
    found = MarkerDetector(family="DICT_5X5_1000").detect(picture)
    # All that a person sees: two on the wall, one and four on the board.
    assert sorted(found.ids.tolist()) == [100, 103, 106, 107, 110, 111, 112]
    assert found.hamming.max() == 0
    seen = dict(zip(found.ids.tolist(), found.corners.mean(axis=1).round(-1).tolist(), strict=True))
    assert seen[100] == [640, 70]
    assert seen[110] == [1000, 370]
    for name in ("DICT_4X4_50", "DICT_4X4_1000", "DICT_6X6_250", "tag16h5", "tag36h11"):
        assert len(MarkerDetector(family=name).detect(picture)) == 0
