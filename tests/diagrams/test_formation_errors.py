"""Robots of a formation that are not quite as they are said to be, and an estimator that knows it.

The signs are those of the estimator's model: what it finds of the cameras is what was drawn.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from diagrams.formation_errors import PRESETS, FormationErrors
from diagrams.run import Run, simulate
from diagrams.scenario import load_scenario
from systems.estimators.formation_filter_parameters import FormationFilterParameters

Array = NDArray[np.float64]

DEG = math.pi / 180
TWO_MOVES = {"sight": "projected", "dynamics": "kinematic", "destination": [3.75, 0.65]}
SEEDS = range(4)
ALL = FormationErrors(0.01, 2.0, 1.0, 0.002, 0.03)


def scenario(**overrides: Any) -> Any:
    return load_scenario("formation", {"sight": "projected", **overrides})


def drawn(**overrides: Any) -> dict[str, Array]:
    """What is wrong with each robot: (N, .) by the names of `FormationErrors`."""
    found = scenario(**overrides)
    poses = found.start_poses()
    robots = [robot for _, robot in sorted(found.station_robots().items(), key=_number)]
    starts = np.array([robot.start.pose() for robot in robots]) - poses
    cameras = ("front_camera", "rear_camera")
    yaws = [[robot.sensors[c].build().yaw_error_deg for c in cameras] for robot in robots]
    off = np.array([robot.body.build().ring.misplaced for robot in robots])
    return {
        "start_position": starts[:, :2],
        "start_heading_deg": starts[:, 2:] / DEG,
        "camera_yaw_deg": np.array(yaws),
        "marker_position": off[..., :2].reshape(len(off), -1),
        "marker_size": off[..., 2],
    }


def _number(item: tuple[str, Any]) -> int:
    return int(item[0].removeprefix("robot"))


def plain(errors: FormationErrors) -> dict[str, float]:
    return dict(vars(errors))


# --- What is drawn ---


def test_errors_are_as_large_as_asked() -> None:
    """400 robots: the standard deviation of n numbers is known to 1 / sqrt(2 n)."""
    robots = [drawn(seed=seed, robots=20, errors=plain(ALL)) for seed in range(20)]
    for name, deviation in vars(ALL).items():
        numbers = np.concatenate([each[name].ravel() for each in robots])
        assert numbers.std() == pytest.approx(deviation, rel=4 / math.sqrt(2 * len(numbers))), name
        assert abs(numbers.mean()) < 4 * deviation / math.sqrt(len(numbers)), name


def test_no_two_of_them_are_the_same() -> None:
    found = drawn(robots=6, errors=plain(ALL))
    numbers = np.concatenate([found[name].ravel() / size for name, size in vars(ALL).items()])
    assert len(np.unique(numbers.round(9))) == len(numbers)


def test_more_robots_change_nothing_of_the_others() -> None:
    few, many = (drawn(robots=n, errors="base", seed=3) for n in (4, 12))
    for name, numbers in few.items():
        np.testing.assert_allclose(many[name][:4], numbers, atol=1e-12)
    other = drawn(robots=4, errors="base", seed=4)
    assert all((numbers != other[name]).all() for name, numbers in few.items())


def test_each_error_is_wrong_alone() -> None:
    for name in vars(ALL):
        found = drawn(errors={name: 0.01})
        for other, numbers in found.items():
            assert (np.abs(numbers) > 1e-12).any() == (other == name), (name, other)


def test_a_ring_that_was_measured_stays_measured() -> None:
    measured = [[0.001, 0.0, 0.0]] * 4
    off = {"errors": {"marker_position": 0.002}}
    without, found = drawn(**off), drawn(**off, **{"robot.body.ring.misplaced": measured})
    difference = found["marker_position"] - without["marker_position"]
    np.testing.assert_allclose(difference, [[0.001, 0.0] * 4] * 4, atol=1e-12)


# --- Who is told ---


def test_estimator_and_controller_expect_what_is_wrong() -> None:
    found = scenario(errors="harsh")
    told, noise = found.estimator.arguments["parameters"], found.controller.arguments["noise"]
    assert told.start_position_noise == 0.01
    assert told.start_heading_noise == pytest.approx(2 * DEG)
    assert told.yaw_error == noise.yaw_std == pytest.approx(1 * DEG)
    assert told.bearing_floor == pytest.approx(0.002 / 1.5)
    assert told.range_floor == pytest.approx(0.01, rel=0.01)


def test_an_estimator_that_is_told_nothing_allows_for_the_base_errors() -> None:
    own = FormationFilterParameters(marker_size=0.1)
    for name, deviation in PRESETS["base"].for_estimator(1.5).items():
        assert getattr(own, name) == pytest.approx(deviation, rel=0.06), name
    none, base = (scenario(errors=name).estimator for name in ("none", "base"))
    assert none.arguments["parameters"].yaw_error == base.arguments["parameters"].yaw_error


def test_what_the_user_says_of_them_holds() -> None:
    overrides = {"estimator.yaw_error": 0.001, "controller.noise": {"yaw_std": 0.002}}
    found = scenario(errors="harsh", **overrides)
    assert found.estimator.arguments["parameters"].yaw_error == 0.001
    assert found.estimator.arguments["parameters"].start_position_noise == 0.01
    assert found.controller.arguments["noise"].yaw_std == 0.002


def test_who_has_nothing_to_be_told_is_left_alone() -> None:
    found = scenario(errors="harsh", controller="algorithm1", estimator="none")
    assert found.estimator is None
    assert "noise" not in found.controller.arguments


@pytest.mark.parametrize(
    ("errors", "message"),
    [
        ("bad", "errors is 'bad': must be one of none, base, harsh"),
        ({"marker_size": -0.1}, "errors.marker_size is -0.1: must be 0 or greater"),
        ({"marker_pos": 0.1}, "errors.marker_pos: unknown key; did you mean 'marker_position'?"),
    ],
)
def test_errors_that_are_none_are_refused(errors: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message.replace("?", r"\?")):
        scenario(errors=errors)


# --- What the estimator makes of it ---


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    """Two moves of robots with the base errors, some seeds."""
    base = TWO_MOVES | {"errors": "base"}
    return [simulate(load_scenario("formation", base | {"seed": seed})) for seed in SEEDS]


def test_it_is_as_wrong_as_it_says(runs: list[Run]) -> None:
    """NEES of 12 numbers a run: over the runs, 1 +- 0.2, were they normal."""
    nees = [run.report["metrics"]["nees_mean"] for run in runs]
    assert [run.report["outcome"] for run in runs] == ["reached"] * len(runs)
    assert 0.4 < np.mean(nees) < 1.8


def test_it_is_too_sure_when_it_is_not_told() -> None:
    """The wrong answer: robots taken for placed to 0.3 mm, cameras for straight to 0.03 degrees."""
    sure = {"estimator.start_position_noise": 3e-4, "estimator.yaw_error": 6e-4}
    run = simulate(load_scenario("formation", TWO_MOVES | {"errors": "base"} | sure))
    assert run.report["metrics"]["nees_mean"] > 5.0


def test_it_finds_where_the_cameras_look(runs: list[Run]) -> None:
    """Of robot 3, which has stood in the middle: its front camera against its rear one.

    Both alike would be a robot that is turned; of the others one camera has hardly seen anybody.
    """
    aside, wrong = [], []
    for run in runs:
        truth = drawn(seed=run.report["seed"], errors="base")["camera_yaw_deg"][2] * DEG
        mission: Any = run.mission
        block = mission.diagram.GetSubsystemByName("estimator")
        found, _ = block.yaw_errors(block.GetMyContextFromRoot(run.context))
        aside.append(truth[0] - truth[1])
        wrong.append(found[2, 0] - found[2, 1] - aside[-1])
    assert np.sqrt(np.mean(np.square(wrong))) < 0.002  # a standard deviation of 0.0011 by itself
    assert np.sqrt(np.mean(np.square(aside))) > 0.004
