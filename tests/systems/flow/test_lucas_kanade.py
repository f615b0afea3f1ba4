from __future__ import annotations

import re
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from systems.cameras import PinholeCamera
from systems.flow.lucas_kanade import (
    LucasKanadeParameters,
    PointTracker,
    corners,
    remembered,
    track,
    turned_between,
)
from systems.flow.shell import ShellView
from systems.flow.sphere_flow import SphereFlow, SphereFlowEstimator
from systems.messages import CameraImage, PointMatches, RotationIncrement
from tests.systems.flow.shell_images import on_the_equator, picture, rotation

DT = 1 / 60
RADIUS = 0.075
CAMERA = PinholeCamera.from_focal_length(320, 240, 240.5)  # half the size, the same view
VIEW = ShellView(camera=CAMERA)
PARAMETERS = LucasKanadeParameters(min_distance=4.0, window=15)


def texture(dx: float = 0.0, dy: float = 0.0, seed: int = 0) -> np.ndarray:
    """A smooth random picture, moved right by dx and down by dy px, exactly."""
    rng = np.random.default_rng(seed)
    fx, fy = rng.uniform(-0.25, 0.25, (2, 60, 1, 1))
    phase = rng.uniform(0, 2 * np.pi, (60, 1, 1))
    y, x = np.mgrid[:120, :160].astype(float)
    waves = np.cos(fx * (x - dx) + fy * (y - dy) + phase).sum(axis=0)
    return np.clip(np.rint(128 + 10 * waves), 0, 255).astype(np.uint8)


# --- The parts ---


def test_points_are_found_where_the_picture_has_moved_to() -> None:
    before, after = texture(), texture(3.3, -1.7)
    parameters = LucasKanadeParameters()
    points = corners(before, parameters)
    found, good = track(before, after, points, parameters)
    assert good.sum() > 50
    np.testing.assert_allclose(np.median((found - points)[good], axis=0), [3.3, -1.7], atol=0.02)
    apart = np.linalg.norm(points[:, None] - points, axis=2) + 99 * np.eye(len(points))
    assert apart.min() >= 7.0


def test_at_most_so_many_corners_the_surest_ones() -> None:
    all_of_them = corners(texture(), LucasKanadeParameters())
    few = corners(texture(), LucasKanadeParameters(max_points=10))
    np.testing.assert_array_equal(few, all_of_them[:10])


@pytest.mark.parametrize("decimate", [1.0, 1.5, 2.0, 3.0])
def test_corners_are_where_they_are_however_the_picture_is_reduced(decimate: float) -> None:
    image = np.full((90, 180), 60, np.uint8)
    image[36:, 72:] = 200  # one corner, between pixels (71, 35) and (72, 36)
    parameters = LucasKanadeParameters(decimate=decimate, quality=0.5, max_points=1)
    (found,) = corners(image, parameters)
    np.testing.assert_allclose(found, [71.5, 35.5], atol=decimate)


def test_of_noise_a_reduced_picture_makes_fewer_corners() -> None:
    clean = np.full((120, 160), 100.0)
    clean[40:80, 60:100] = 120.0  # its four corners, and noise all over
    noise = np.random.default_rng(3).normal(0, 1.5, clean.shape)
    image = np.clip(clean + noise, 0, 255).astype(np.uint8)
    true = np.array([[59.5, 39.5], [99.5, 39.5], [59.5, 79.5], [99.5, 79.5]])
    wrong = []
    for decimate in (1.0, 2.0):
        found = corners(image, LucasKanadeParameters(decimate=decimate))
        near = np.linalg.norm(found[:, None] - true, axis=2).min(axis=1) <= 4.0
        assert near.sum() == 4
        wrong.append(int((~near).sum()))
    assert wrong[1] < 0.1 * wrong[0]


def test_a_point_that_looks_different_now_fails_the_error_test() -> None:
    before, after = texture(), texture(1.0, 0.0)
    rng = np.random.default_rng(1)
    after[:, 80:] = rng.integers(0, 256, (120, 80))
    parameters = LucasKanadeParameters()
    points = corners(before, parameters)
    _, good = track(before, after, points, parameters)
    right = points[:, 0] > 95
    assert right.sum() > 20
    assert not good[right].any()
    assert good[points[:, 0] < 65].mean() > 0.9
    # The test of status alone would have let many of them pass.
    _, lenient = track(before, after, points, LucasKanadeParameters(max_error=255.0))
    assert lenient[right].mean() > 0.25


def test_a_point_that_has_left_the_picture_fails_the_status_test() -> None:
    before, after = texture(), texture(60.0, 0.0)
    parameters = LucasKanadeParameters(max_error=255.0)
    points = corners(before, parameters)
    moved = points + np.array([60.0, 0.0])
    _, good = track(before, after, points, parameters, moved)
    assert not good[moved[:, 0] > 175].any()
    assert good[moved[:, 0] < 150].mean() > 0.9


def test_a_prediction_finds_what_is_beyond_the_pyramid() -> None:
    before, after = texture(), texture(31.5, 0.0)
    parameters = LucasKanadeParameters(levels=0, predicted_levels=0)
    points = corners(before, parameters)
    points = points[(points[:, 0] > 15) & (points[:, 0] < 110)]
    results = []
    for predicted in (None, points + np.array([30.0, 1.0]), np.full_like(points, np.nan)):
        found, good = track(before, after, points, parameters, predicted)
        right = np.linalg.norm(found - points - [31.5, 0.0], axis=1) < 0.5
        results.append((good & right).mean())
    assert results[0] < 0.1
    assert results[1] > 0.9
    assert results[2] == results[0]  # without a saying it starts where they were


def test_an_even_picture_has_no_corners_and_no_tracks() -> None:
    even = np.full((120, 160), 90, np.uint8)
    points = corners(even, LucasKanadeParameters())
    assert points.shape == (0, 2)
    found, good = track(even, even, points, LucasKanadeParameters())
    assert found.shape == (0, 2)
    assert good.shape == (0,)


def test_the_history_integrates_the_rate() -> None:
    history = np.full((20, 4), np.nan)
    assert turned_between(history, 0.0, 0.1) is None
    for k in range(30):  # more than it holds
        # The rate is 1 rad/s until 0.2 s, then 3 rad/s, about z.
        history = remembered(history, 0.01 * k, np.array([0.0, 0.5, 1.0 if k <= 20 else 3.0]))
    assert np.isfinite(history).all()

    def turned(start: float, end: float) -> list[float]:
        w = turned_between(history, start, end)
        assert w is not None
        return w.tolist()

    assert turned(0.12, 0.16) == pytest.approx([0.0, 0.02, 0.04])
    assert turned(0.155, 0.165) == pytest.approx([0.0, 0.005, 0.01])
    assert turned(0.19, 0.22) == pytest.approx([0.0, 0.015, 0.01 + 0.06])
    assert turned(0.27, 0.30) == pytest.approx([0.0, 0.015, 0.09])  # the last third held
    assert turned_between(history, 0.28, 0.32) is None  # it covers a quarter
    assert turned_between(history, 0.0, 0.05) is None


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"max_points": 0}, "max_points is 0: must be 1 or greater"),
        ({"quality": 1.0}, "quality is 1.0: must be between 0 and 1"),
        ({"decimate": 0.5}, "decimate is 0.5: must be 1 or greater"),
        ({"window": 20}, "window is 20: must be odd, 5 or greater"),
        ({"levels": -1}, "levels is -1: must be 0 to 8"),
        ({"predicted_levels": 9}, "predicted_levels is 9: must be 0 to 8"),
        ({"max_error": 0.0}, "max_error is 0.0: must be greater than 0"),
    ],
)
def test_bad_parameters_are_refused(bad: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        LucasKanadeParameters(**bad)


def test_a_processing_time_of_a_period_is_refused() -> None:
    with pytest.raises(ValueError, match=r"processing_time is 0\.02: must be 0 to less than"):
        PointTracker(view=VIEW, processing_time=0.02)


# --- Along the steel ---

SPEEDS = np.minimum(0.012 * np.arange(13), 0.12)  # m/s, between one picture and the next


def increment(k: int) -> np.ndarray:
    """Rotation from picture k to the next."""
    return np.array([0.0, SPEEDS[k] * DT / RADIUS, 0.001])


@cache
def frames() -> list[CameraImage]:
    R_RB = on_the_equator(0.3)
    pictures = []
    for k in range(len(SPEEDS) + 1):
        data = picture(R_RB, camera=CAMERA, noise=1.5, seed=k, supersampling=3)
        pictures.append(CameraImage(round(k * DT, 9), "eye", data))
        if k < len(SPEEDS):
            R_RB = R_RB @ rotation(increment(k))
    return pictures


class Drive(LeafSystem):
    """Sends the pictures as they are taken, and a gyro that is 5 % off and sometimes fails."""

    def __init__(self) -> None:
        super().__init__()
        self.DeclareAbstractOutputPort(
            "image",
            lambda: AbstractValue.Make(CameraImage()),
            lambda context, output: output.set_value(frames()[self._index(context)]),
            {self.time_ticket()},
        )
        self.DeclareVectorOutputPort("imu", 6, self._imu, {self.time_ticket()})

    @staticmethod
    def _index(context: Any) -> int:
        return int(context.get_time() / DT + 1e-6)

    def _imu(self, context: Any, output: Any) -> None:
        sample = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.81])
        sample[:3] = 1.05 * increment(min(self._index(context), len(SPEEDS) - 1)) / DT
        if round(context.get_time() * 300) % 7 == 3:
            sample[1] = np.nan
        output.SetFromVector(sample)


def drive(*connected: str) -> tuple[list[RotationIncrement], dict[str, int]]:
    """What sphere flow makes of the tracker's matches, and the tracker's health."""
    builder = DiagramBuilder()
    source = builder.AddSystem(Drive())
    tracker = builder.AddSystem(PointTracker(view=VIEW, parameters=PARAMETERS))
    flow = builder.AddSystem(SphereFlow(estimator=SphereFlowEstimator(view=VIEW)))
    builder.Connect(source.GetOutputPort("image"), tracker.image_input_port())
    builder.Connect(tracker.matches_output_port(), flow.matches_input_port())
    if "imu" in connected:
        builder.Connect(source.GetOutputPort("imu"), tracker.imu_input_port())
    if "increment" in connected:
        builder.Connect(flow.increment_output_port(), tracker.increment_input_port())
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    sent = []
    for k in range(1, len(SPEEDS) + 1):
        simulator.AdvanceTo(k * DT + 0.006)
        mine = flow.GetMyContextFromRoot(context)
        sent.append(flow.increment_output_port().Eval(mine))
    mine = tracker.GetMyContextFromRoot(context)
    return sent, dict(tracker.health_output_port().Eval(mine).counts)


@pytest.mark.parametrize("by", ["imu", "increment"])
def test_with_a_prediction_it_follows_past_the_pitch_of_the_holes(by: str) -> None:
    sent, health = drive(by)
    for k, found in enumerate(sent):
        assert found.stamp == frames()[k + 1].stamp
        assert found.previous_stamp == frames()[k].stamp
        error = found.rotation - increment(k)
        assert abs(error[1]) < max(0.01 * increment(k)[1], 2e-5)
        assert abs(error[0]) < 5e-5
        assert abs(error[2]) < 5e-4
    assert (health.pop("bad_imu") > 5) == (by == "imu")
    assert not any(health.values())


def test_without_one_it_does_not() -> None:
    sent, _ = drive()
    share = [found.rotation[1] / increment(k)[1] for k, found in enumerate(sent) if k]
    assert share[1] == pytest.approx(1.0, abs=0.01)  # at 24 mm/s
    assert share[-1] < 0.5  # at 120 mm/s


class Counter(LeafSystem):
    """A picture a period without pictures' cost, and events of a millisecond beside it."""

    def __init__(self) -> None:
        super().__init__()
        even = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
        self.DeclareAbstractOutputPort(
            "image",
            lambda: AbstractValue.Make(CameraImage()),
            lambda context, output: output.set_value(
                CameraImage(DT * int(context.get_time() / DT + 1e-6), "eye", even)
            ),
            {self.time_ticket()},
        )
        self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(0.001, 0.0, lambda *_: None)


@pytest.mark.parametrize("processing_time", [0.005, 1 / 300, 0.002])
def test_no_picture_is_left_out_beside_other_events(processing_time: float) -> None:
    builder = DiagramBuilder()
    source = builder.AddSystem(Counter())
    nearer = LucasKanadeParameters(max_interval=DT / 2)  # every one is a gap
    tracker = builder.AddSystem(
        PointTracker(view=VIEW, parameters=nearer, processing_time=processing_time)
    )
    builder.Connect(source.GetOutputPort("image"), tracker.image_input_port())
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(30.0)
    context = tracker.GetMyContextFromRoot(simulator.get_context())
    assert tracker.health_output_port().Eval(context).counts["gap"] == 30 * 60 - 1


# --- Bad pictures ---


class Bench:
    """A tracker whose inputs are set by hand, a picture a period."""

    def __init__(self, *, gyro: bool = False) -> None:
        self.block = PointTracker(view=VIEW, parameters=PARAMETERS)
        self.simulator = Simulator(self.block)
        self.context = self.simulator.get_mutable_context()
        self.k = 0
        if gyro:
            rate = increment(5) / DT
            self.block.imu_input_port().FixValue(self.context, [*rate, 0.0, 0.0, 9.81])

    def show(self, data: np.ndarray, stamp: float | None = None) -> PointMatches:
        stamp = self.k * DT if stamp is None else stamp
        self.block.image_input_port().FixValue(self.context, CameraImage(stamp, "eye", data))
        self.simulator.AdvanceTo((self.k + 0.9) * DT)
        self.k += 1
        return self.block.matches_output_port().Eval(self.context)

    @property
    def counted(self) -> dict[str, int]:
        counts = self.block.health_output_port().Eval(self.context).counts
        return {reason: n for reason, n in counts.items() if n}


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros((0, 0), np.uint8),
        np.zeros((480, 640), np.uint8),
        np.zeros((240, 320), np.float32),
        np.zeros((240, 320, 4), np.uint8),
    ],
    ids=["empty", "another size", "no bytes", "four colours"],
)
def test_a_bad_picture_is_counted_and_the_next_compared_with_the_last_good_one(
    bad: np.ndarray,
) -> None:
    bench = Bench()
    bench.show(frames()[1].data)
    assert np.isnan(bench.show(bad).stamp)
    assert bench.counted == {"bad_image": 1}
    matches = bench.show(frames()[2].data)
    assert (matches.previous_stamp, matches.stamp) == (0.0, 2 * DT)
    assert len(matches) > 50
    assert bench.counted == {"bad_image": 1}


def test_colour_is_looked_at_in_grey() -> None:
    grey, colour = Bench(), Bench()
    for k in (1, 2):
        one = grey.show(frames()[k].data)
        other = colour.show(cv2.cvtColor(frames()[k].data, cv2.COLOR_GRAY2RGB))
    np.testing.assert_array_equal(one.current, other.current)
    assert len(one) > 50


def test_pictures_far_apart_or_out_of_order_are_not_compared() -> None:
    bench = Bench()
    bench.show(frames()[1].data, 1.0)
    assert np.isnan(bench.show(frames()[2].data, 1.2).stamp)
    assert np.isnan(bench.show(frames()[3].data, 1.1).stamp)
    assert bench.counted == {"gap": 2}
    assert bench.show(frames()[4].data, 1.12).previous_stamp == 1.1


def test_an_even_picture_gives_no_matches() -> None:
    bench = Bench()
    bench.show(frames()[1].data)
    matches = bench.show(np.full((240, 320), 128, np.uint8))
    assert np.isnan(matches.stamp)
    assert len(matches) == 0
    assert bench.counted == {"no_points": 1}


def test_a_frozen_picture_is_noticed_when_the_gyro_turns_and_only_then() -> None:
    turning, resting = Bench(gyro=True), Bench()
    for bench in (turning, resting):
        bench.show(frames()[5].data)
        bench.show(frames()[5].data)
    assert turning.counted == {"frozen": 1}
    assert not resting.counted
    assert len(turning.show(frames()[6].data)) > 50


def test_a_gyro_of_nan_leaves_plain_tracking() -> None:
    bench = Bench()
    bench.block.imu_input_port().FixValue(bench.context, [np.nan] * 6)
    bench.show(frames()[1].data)
    assert len(bench.show(frames()[2].data)) > 50
    assert bench.counted.keys() == {"bad_imu"}


def test_an_increment_that_is_not_one_predicts_nothing() -> None:
    shown = []
    for last in (None, RotationIncrement(), RotationIncrement(0.0, 0.0, "", np.ones(3)),
                 RotationIncrement(0.0, -DT, "", np.full(3, np.nan)),
                 RotationIncrement(-5.0, -5.0 - DT, "", np.ones(3))):  # fmt: skip
        bench = Bench()
        if last is not None:
            bench.block.increment_input_port().FixValue(bench.context, AbstractValue.Make(last))
        bench.show(frames()[1].data)
        shown.append(bench.show(frames()[2].data).current)
    for other in shown[1:]:
        np.testing.assert_array_equal(other, shown[0])
