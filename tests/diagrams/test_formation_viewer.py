"""What the replay is told of a formation: whose turn it is, its triangles, its estimates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator

from diagrams.formation_viewer import FormationViewer, dashes
from systems.formation.triangles import next_vertex
from systems.planners.formation_course import FormationMove
from systems.planners.formation_lattice import strip
from tests.diagrams.test_surroundings_viewer import Replay

RATE = 20.0  # that of `Replay`
STAND = strip(4, 1.5)
BEACONS = np.array([2, 3, 0])
TARGET = next_vertex(STAND[BEACONS])
FIRST = FormationMove(
    stamp=0.5,
    status="moving",
    number=1,
    mover=1,
    beacons=BEACONS,
    target=TARGET,
    points=np.array([[1.1, 0.65], [1.9, 0.65], TARGET]),
)
ROOT = "view/moves/1"


class Stage(Replay):
    """Also keeps the shapes, and answers whether an object and all above it are visible."""

    def __init__(self) -> None:
        super().__init__()
        self.shapes: dict[str, Any] = {}
        self.poses: dict[str, Any] = {}

    def SetObject(self, path: str, shape: Any, colour: Any) -> None:
        del colour
        self.shapes[path] = shape

    def SetTransform(self, path: str, X: Any, t: float | None = None) -> None:
        if t is None:
            self.poses[path] = X
        else:
            super().SetTransform(path, X, t)

    def SetProperty(self, path: str, name: str, value: Any, t: float | None = None) -> None:
        if t is not None:
            super().SetProperty(path, name, value, t)

    def shown(self, path: str, t: float) -> bool:
        parts = path.split("/")
        above = ["/".join(parts[: k + 1]) for k in range(len(parts))]
        return all(self.visible(name, t) for name in above if (name, "visible") in self.keys)

    def named(self, start: str) -> list[str]:
        return [name for name in self.shapes if name.startswith(start)]


class Show:
    """A formation of four that is told what to show."""

    def __init__(self, *, estimated: bool = True, truth: bool = True) -> None:
        self.stage = Stage()
        self.viewer = FormationViewer(
            meshcat=self.stage,  # type: ignore[arg-type]  # what it uses of Meshcat
            robots=4,
            destination=np.array([5.0, 0.6]),
            rate=RATE,
        )
        self.simulator = Simulator(self.viewer)
        self.context = self.simulator.get_mutable_context()
        self.fix("move", AbstractValue.Make(FormationMove()))
        self.fix("moving", np.zeros(4))
        self.fix("record", np.zeros(10))
        self.fix("positions", STAND.ravel())
        if estimated:
            self.fix("poses", np.column_stack([STAND, np.zeros(4)]).ravel())
            self.fix("covariance", (1e-6 * np.eye(12)).ravel())
        if truth:
            for k, place in enumerate(STAND):
                self.fix(f"truth_{k}", np.array([*place, 0.0]))

    def fix(self, port: str, value: Any) -> None:
        self.viewer.GetInputPort(port).FixValue(self.context, value)

    def to(self, t: float) -> None:
        self.simulator.AdvanceTo(t)

    def one_move(self) -> Stage:
        """From 0.5 s on robot 2 moves, at 2 s it is there, from 3 s on all is over."""
        self.to(0.48)
        self.fix("move", AbstractValue.Make(FIRST))
        self.fix("moving", np.array([0.0, 1.0, 0.0, 0.0]))
        for t in np.arange(0.5, 2.0, 0.05):
            place = STAND[1] + (t - 0.5) / 1.5 * (TARGET - STAND[1])
            self.fix("truth_1", np.array([*place, 0.1]))
            self.to(t + 0.03)
        self.fix("moving", np.zeros(4))
        self.fix("record", np.array([1, 1, *BEACONS, *TARGET, 1.0, 0.0, 0.0]))
        self.to(3.0 - 0.02)
        self.fix("move", AbstractValue.Make(FormationMove(status="reached", number=1)))
        self.to(4.0)
        return self.stage


@pytest.fixture(scope="module")
def stage() -> Stage:
    return Show().one_move()


def test_the_mark_is_over_the_robot_that_moves_while_it_does(stage: Stage) -> None:
    arrow = "view/robot2/turn/arrow"
    assert [stage.shown(arrow, t) for t in (0.3, 0.6, 1.9, 2.2)] == [False, True, True, False]
    x, y, _ = stage.place("view/robot2/turn", 1.25)
    np.testing.assert_allclose([x, y], (STAND[1] + TARGET) / 2, atol=0.06)
    for k in (1, 3, 4):
        assert not any(stage.shown(f"view/robot{k}/turn/arrow", t) for t in (0.3, 1.0, 3.5))


def test_the_triangles_and_the_path_are_there_for_the_move(stage: Stage) -> None:
    parts = ("beacons", "sides to build", "path", "centre points", "vertex")
    for part in parts:
        names = stage.named(f"{ROOT}/{part}")
        assert names, part
        for name in names:
            assert [stage.shown(name, t) for t in (0.3, 0.7, 2.9, 3.2)] == [
                False,
                True,
                True,
                False,
            ]
            assert (name, "place") not in stage.keys  # what never moves never glides
    assert len(stage.named(f"{ROOT}/centre points")) == 2
    np.testing.assert_allclose(stage.poses[f"{ROOT}/vertex"].translation()[:2], TARGET)


def test_the_lines_of_the_triangle_join_its_beacons(stage: Stage) -> None:
    for k, (a, b) in enumerate([(0, 2), (2, 3), (3, 0)]):
        name = f"{ROOT}/beacons/{k}"
        half = stage.shapes[name].width() / 2
        ends = stage.poses[name].multiply(np.array([[-half, half], [0, 0], [0, 0]]))[:2].T
        found = {tuple(np.round(end, 3)) for end in ends}
        assert found == {tuple(np.round(STAND[robot], 3)) for robot in (a, b)}


def test_sides_that_were_built_stay(stage: Stage) -> None:
    names = stage.named("view/built/1/")
    assert len(names) == 2
    for name in names:
        assert [stage.shown(name, t) for t in (1.9, 2.2, 3.9)] == [False, True, True]
        assert stage.shapes[name].width() == pytest.approx(1.5, abs=0.01)


def test_a_side_that_was_not_built_is_not_drawn() -> None:
    show = Show()
    show.fix("record", np.array([1, 1, *BEACONS, *TARGET, -1.0, 0.0, 0.0]))
    show.to(1.0)
    assert not show.stage.named("view/built")


def test_marks_appear_where_the_robot_has_come(stage: Stage) -> None:
    marks = stage.named("view/true way of robot2/")
    places = np.array([stage.poses[name].translation()[:2] for name in marks])
    way = float(np.linalg.norm(TARGET - STAND[1]))
    assert len(marks) == pytest.approx(way / 0.10, abs=2)
    assert (np.diff(places[:, 0]) > 0).all()
    assert not stage.shown(marks[-1], 1.0)
    assert stage.shown(marks[-1], 2.5)
    assert not stage.named("view/true way of robot1/")
    assert not stage.named("view/estimated way")


def test_ways_are_the_estimate_s_where_nobody_knows_the_truth() -> None:
    show = Show(truth=False)
    show.to(0.2)
    moved = STAND.copy()
    moved[1, 0] += 0.5
    show.fix("positions", moved.ravel())
    show.to(0.4)
    (mark,) = show.stage.named("view/estimated way")
    np.testing.assert_allclose(show.stage.poses[mark].translation()[:2], moved[1])


def scale(stage: Stage, part: str, t: float) -> NDArray[np.float64]:
    keys = stage.keys[f"view/robot1/estimate/{part}/disc", "scale"]
    return np.array(keys[max(k for k in keys if k <= t * RATE)])


def test_ellipses_are_of_95_percent_once_and_ten_times_as_large() -> None:
    show = Show()
    P = 1e-6 * np.eye(12)
    P[0, 0], P[1, 1] = 0.02**2, 0.005**2
    show.fix("covariance", P.ravel())
    show.to(0.2)
    axes = np.sqrt(5.9915) * np.array([0.02, 0.005])  # chi-square, 2, 95 %
    np.testing.assert_allclose(scale(show.stage, "ellipse", 0.2)[:2], axes, rtol=0.03)
    np.testing.assert_allclose(scale(show.stage, "ten times", 0.2)[:2], 10 * axes, rtol=0.03)
    assert show.stage.shown("view/robot1/estimate/ten times/disc", 0.2)
    show.fix("covariance", (0.05**2 * np.eye(12)).ravel())
    show.to(0.4)
    assert show.stage.shown("view/robot1/estimate/ellipse/disc", 0.4)
    assert not show.stage.shown("view/robot1/estimate/ten times/disc", 0.4)


def test_millimetres_can_be_seen() -> None:
    show = Show()
    show.fix("covariance", (1e-8 * np.eye(12)).ravel())
    show.to(0.1)
    np.testing.assert_allclose(scale(show.stage, "ellipse", 0.1)[:2], 0.004)


def test_nobody_is_shown_where_nothing_is_known_and_none_glides_there() -> None:
    show = Show()
    show.to(0.5)
    P = 1e-6 * np.eye(12)
    P[3, 3] = 1e4
    show.fix("covariance", P.ravel())
    show.to(5.0)
    poses = np.column_stack([STAND, np.zeros(4)])
    poses[1, :2] = TARGET
    show.fix("poses", poses.ravel())
    show.fix("covariance", (1e-6 * np.eye(12)).ravel())
    show.to(6.0)
    pin, stage = "view/robot2/estimate", show.stage
    assert [stage.shown(f"{pin}/pin", t) for t in (0.3, 2.0, 4.9, 5.2)] == [
        True,
        False,
        False,
        True,
    ]
    np.testing.assert_allclose(stage.place(pin, 4.9)[:2], STAND[1], atol=1e-3)
    np.testing.assert_allclose(stage.place(pin, 5.1)[:2], TARGET, atol=1e-3)


def test_without_estimator_pins_stand_where_the_robots_are_believed_to_be() -> None:
    show = Show(estimated=False)
    show.to(0.2)
    stage = show.stage
    np.testing.assert_allclose(stage.place("view/robot4/estimate", 0.2)[:2], STAND[3], atol=1e-3)
    assert stage.shown("view/robot4/estimate/pin", 0.2)
    for part in ("needle", "ellipse/disc", "ten times/disc"):
        assert not stage.shown(f"view/robot4/estimate/{part}", 0.2)


def test_what_stands_is_not_sent_again() -> None:
    show = Show()
    show.to(0.5)
    sent = show.stage.calls
    show.to(5.0)
    assert show.stage.calls == sent


def test_dashes_end_where_the_line_does() -> None:
    found = dashes(np.zeros(2), np.array([0.0, 1.0]), 0.4)
    np.testing.assert_allclose(
        [(a[1], b[1]) for a, b in found], [(0.0, 0.2), (0.4, 0.6), (0.8, 1.0)]
    )
    ((a, b),) = dashes(np.ones(2), np.ones(2), 0.4)
    np.testing.assert_allclose([a, b], 1.0)


def test_nonsense_is_refused() -> None:
    stage: Any = Stage()
    with pytest.raises(ValueError, match="robots is 0"):
        FormationViewer(meshcat=stage, robots=0, destination=np.zeros(2), rate=10.0)
    with pytest.raises(ValueError, match="destination is"):
        FormationViewer(meshcat=stage, robots=4, destination=np.full(2, np.nan), rate=10.0)
