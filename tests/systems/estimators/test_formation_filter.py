"""The block: pictures and who moves in, poses out; the same as the estimator without Drake."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from systems.estimators.formation_filter import FormationFilter
from systems.estimators.formation_filter_parameters import FormationFilterParameters
from systems.messages import Detections
from tests.formation_world import CAMERA, FormationWorld, vertex

CAMERAS = ("front_camera", "rear_camera")


class Run:
    """A block beside a world, advanced by tenths of a second."""

    def __init__(self, world: FormationWorld, **changes: Any) -> None:
        self.world = world
        self.block = FormationFilter(
            start_poses=world.nominal, camera=CAMERA, parameters=world.parameters(**changes)
        )
        self.simulator = Simulator(self.block)
        self.context = self.simulator.get_mutable_context()
        self.say(np.zeros(world.robots))
        self.show(math.nan)

    def say(self, moving: np.ndarray) -> None:
        self.block.moving_input_port().FixValue(self.context, moving)

    def show(self, stamp: float) -> None:
        for k in range(self.world.robots):
            for c, name in enumerate(CAMERAS):
                found = Detections() if math.isnan(stamp) else self.world.detections(k, c, stamp)
                self.block.detections_input_port(k, name).FixValue(self.context, found)

    def advance(self, ticks: int, *, blind: bool = False) -> None:
        for _ in range(ticks):
            now = self.context.get_time()
            if not blind:
                self.show(now + 0.05)
            self.simulator.AdvanceTo(now + 0.1)

    def poses(self) -> np.ndarray:
        return self.block.poses_output_port().Eval(self.context).copy()

    def covariance(self) -> np.ndarray:
        size = 3 * self.world.robots
        return self.block.covariance_output_port().Eval(self.context).reshape(size, size).copy()

    def counts(self) -> dict[str, int]:
        return dict(self.block.health_output_port().Eval(self.context).counts)

    def errors(self) -> np.ndarray:
        difference = self.poses() - self.world.poses.ravel()
        difference[2::3] = np.remainder(difference[2::3] + math.pi, 2 * math.pi) - math.pi
        return difference


def test_one_move_with_pictures() -> None:
    run = Run(FormationWorld(seed=4, corner_noise=0.3))
    run.advance(3)
    start = run.covariance()
    run.say(np.array([1.0, 0.0, 0.0, 0.0]))
    run.advance(1, blind=True)
    moving = run.covariance()
    assert moving[0, 0] > 100.0
    np.testing.assert_allclose(moving[3:, 3:], start[3:, 3:], rtol=0.3, atol=1e-6)
    target = vertex(4)
    run.world.put(0, target + 0.1 * np.array([math.cos(target[2]), math.sin(target[2]), 0.0]))
    run.advance(2)
    run.say(np.zeros(4))
    run.advance(8)
    errors, P = run.errors(), run.covariance()
    assert np.hypot(*errors[:2]) < 0.02
    assert errors @ np.linalg.solve(P, errors) < 32.9  # 99.9 % of chi-square with 12
    assert math.sqrt(P[0, 0]) < 0.02
    nis, placed = run.block.nis_output_port().Eval(run.context)
    assert placed == 1
    assert 0.0 < nis < 5.0
    counts = run.counts()
    assert counts["accepted"] > 20
    assert counts["unplaced"] == counts["unknown_marker"] == counts["bad_corners"] == 0


def test_a_picture_counts_once() -> None:
    run = Run(FormationWorld(corner_noise=0.3))
    run.show(0.05)
    run.advance(2, blind=True)
    first, poses = run.counts()["accepted"], run.poses()
    run.advance(5, blind=True)
    assert run.counts()["accepted"] == first > 0
    np.testing.assert_array_equal(run.poses(), poses)


def test_nothing_seen_leaves_the_start() -> None:
    run = Run(FormationWorld())
    run.advance(5, blind=True)
    np.testing.assert_allclose(run.poses(), run.world.nominal.ravel())
    deviations = np.tile([0.003, 0.003, 0.01], 4)
    np.testing.assert_allclose(run.covariance(), np.diag(deviations**2), atol=1e-15)
    assert not any(run.counts().values())


def test_moving_that_is_not_finite_leaves_it_as_it_was() -> None:
    run = Run(FormationWorld())
    run.say(np.array([math.nan, 0.0, 0.0, 0.0]))
    run.advance(3, blind=True)
    assert run.counts()["bad_moving"] == 3
    assert run.covariance()[0, 0] < 1e-4
    run.say(np.array([1.0, 0.0, 0.0, 0.0]))
    run.advance(2, blind=True)
    run.say(np.array([math.nan, 0.0, 0.0, 0.0]))
    run.advance(2, blind=True)
    assert run.covariance()[0, 0] > 100.0


def test_garbled_pictures_are_counted() -> None:
    run = Run(FormationWorld())
    found = run.world.detections(3, 1, 0.05)
    corners = np.full_like(found.corners, np.nan)
    spoilt = Detections(stamp=0.05, ids=found.ids, corners=corners)
    run.block.detections_input_port(3, "rear_camera").FixValue(run.context, spoilt)
    run.advance(2, blind=True)
    assert run.counts()["bad_corners"] == len(found) > 0
    np.testing.assert_allclose(run.poses(), run.world.nominal.ravel())


def test_yaw_errors_are_told_with_their_deviations() -> None:
    run = Run(FormationWorld(corner_noise=0.3))
    run.advance(3)
    errors, deviations = run.block.yaw_errors(run.context)
    assert errors.shape == deviations.shape == (4, 2)
    assert (deviations > 0).all()
    assert (deviations <= 0.006 * (1 + 1e-9)).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start_poses": np.zeros((1, 3))}, "start_poses is .* two robots or more"),
        ({"start_poses": np.zeros(3)}, "start_poses is .* two robots or more"),
        ({"start_poses": np.full((4, 3), np.nan)}, "start_poses is .* finite"),
        ({"cameras": {}}, "cameras is .* one camera or more"),
        ({"cameras": {"front_camera": math.inf}}, "cameras is .* finite yaws"),
        ({"rate": 0.0}, "rate is 0.0: must be greater than 0"),
    ],
)
def test_nonsense_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FormationFilter(**{"start_poses": np.zeros((4, 3)), "camera": CAMERA, **arguments})


@pytest.mark.parametrize(
    "field",
    ["marker_size", "bearing_floor", "range_floor", "start_position_noise", "gate", "memory"],
)
def test_parameters_that_must_be_above_zero(field: str) -> None:
    with pytest.raises(ValueError, match=f"{field} is 0.0: must be greater than 0"):
        FormationFilterParameters(**{field: 0.0})


@pytest.mark.parametrize(
    "field", ["marker_offset", "pixel_noise", "corner_floor", "yaw_error", "settle_time"]
)
def test_parameters_that_may_be_zero(field: str) -> None:
    FormationFilterParameters(**{field: 0.0})
    with pytest.raises(ValueError, match=f"{field} is -1.0: must be 0 or greater"):
        FormationFilterParameters(**{field: -1.0})
