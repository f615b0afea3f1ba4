"""What Meshcat and its replay are told of a robot on a shell."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.geometry import Box, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from diagrams.shell_viewer import ShellViewer, heading_interval, place_ellipse
from plants.shell import ShellParameters, pose_on_shell
from plants.snailbot import SnailBotParameters, wheel_centres
from systems.shell.angles import rotation

RATE = 20.0
BODY, SHELL = SnailBotParameters(), ShellParameters()
ESTIMATE = "view/robot/estimate"
GOOD = np.diag([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])
LOST = np.diag([10.0, 10.0, 10.0, 1.0, 1.0, 1.0])


class Replay:
    """Keeps keyframes as Meshcat's recording does."""

    def __init__(self) -> None:
        self.keys: dict[tuple[str, str], dict[int, Any]] = {}
        self.still: dict[str, RigidTransform] = {}
        self.shapes: dict[str, Any] = {}

    def SetObject(self, path: str, shape: Any, colour: Any) -> None:
        del colour
        assert path not in self.shapes, "the replay does not keep changes of shape"
        self.shapes[path] = shape

    def SetTransform(self, path: str, X: RigidTransform, t: float | None = None) -> None:
        X = RigidTransform(X.GetAsMatrix4())
        if t is None:
            self.still[path] = X
        else:
            self._key(path, "pose", X, t)

    def SetProperty(self, path: str, name: str, value: Any, t: float) -> None:
        self._key(path, name, value, t)

    def _key(self, path: str, name: str, value: Any, t: float) -> None:
        self.keys.setdefault((path, name), {})[int(t * RATE)] = value

    def at(self, path: str, name: str, t: float) -> Any:
        keys = self.keys[path, name]
        return keys[max(k for k in keys if k <= t * RATE + 0.5)]

    def visible(self, path: str, t: float) -> bool:
        keys = self.keys[path, "visible"]
        before = [k for k in keys if k <= t * RATE + 0.5]
        return bool(keys[max(before) if before else min(keys)])

    def marks(self, path: str, t: float) -> list[str]:
        prefix = f"view/robot/path of the {path}/"
        return [p for p in self.shapes if p.startswith(prefix) and self.visible(p, t)]


def angles_at(t: float) -> np.ndarray:
    return np.array([0.3, 0.5 * t, 0.2])


class Told(LeafSystem):
    """Says what it is told to at each time."""

    def __init__(self, truth: Any, covariance: Any, reference: Any) -> None:
        super().__init__()
        for name, value in (("pose", self.estimate), ("truth", truth), ("reference", reference)):
            if value is not None:
                self.DeclareAbstractOutputPort(
                    name,
                    lambda: AbstractValue.Make(RigidTransform()),
                    lambda context, output, value=value: output.set_value(
                        value(context.get_time())
                    ),
                )
        self.DeclareVectorOutputPort(
            "covariance",
            36,
            lambda context, output: output.SetFromVector(covariance(context.get_time()).ravel()),
        )

    @staticmethod
    def estimate(t: float) -> RigidTransform:
        return pose_on_shell(angles_at(t), 0.085)


def shown(
    duration: float, covariance: Any = lambda _: GOOD, truth: Any = None, reference: Any = None
) -> Replay:
    replay = Replay()
    builder = DiagramBuilder()
    told = builder.AddSystem(Told(truth, covariance, reference))
    viewer = builder.AddSystem(ShellViewer(meshcat=replay, body=BODY, shell=SHELL, rate=RATE))
    builder.Connect(told.GetOutputPort("pose"), viewer.pose_input_port())
    builder.Connect(told.GetOutputPort("covariance"), viewer.covariance_input_port())
    if truth is not None:
        builder.Connect(told.GetOutputPort("truth"), viewer.truth_input_port())
    if reference is not None:
        builder.Connect(told.GetOutputPort("reference"), viewer.reference_pose_input_port())
    diagram = builder.Build()
    replay.keys.clear()  # the recording begins when all is built
    Simulator(diagram).AdvanceTo(duration)
    return replay


# --- Numbers ---


def test_the_ellipse_is_that_of_the_tangent_plane() -> None:
    # Standing on the pole, x of B is -x of R: 2 mm along it, 1 mm across; up does not count.
    R_RB = rotation(np.array([0.0, np.pi / 2, 0.0]))
    covariance = np.diag([0.0, 0.0, 0.0, 4e-6, 1e-6, 1.0])
    a, b, direction = place_ellipse(R_RB, covariance)
    # Chi-square with two degrees of freedom is below 5.991 in 95 % of all cases.
    assert [a, b] == pytest.approx([0.002 * np.sqrt(5.991), 0.001 * np.sqrt(5.991)], rel=1e-4)
    assert np.sin(direction) == pytest.approx(0.0, abs=1e-12)
    # Turned by a right angle, it lies across.
    R_RB = rotation(np.array([np.pi / 2, np.pi / 2, 0.0]))
    assert np.cos(place_ellipse(R_RB, covariance)[2]) == pytest.approx(0.0, abs=1e-12)


def test_the_heading_is_about_the_normal() -> None:
    R_RB = rotation(np.array([0.7, 0.0, np.pi / 2]))  # on the equator, the normal is y of R
    covariance = np.diag([1.0, 0.01**2, 4.0, 9.0, 9.0, 9.0])
    assert heading_interval(R_RB, covariance) == pytest.approx(0.0196)


def test_the_drawn_ellipse_covers_as_much_as_it_says() -> None:
    rng = np.random.default_rng(8)
    R_RB = rotation(np.array([0.4, 0.6, -1.1]))
    root = rng.normal(size=(6, 6))
    covariance = 1e-6 * root @ root.T
    a, b, direction = place_ellipse(R_RB, covariance)
    errors = rng.multivariate_normal(np.zeros(6), covariance, 20000)[:, 3:] @ R_RB[:, :2]
    c, s = np.cos(direction), np.sin(direction)
    along, across = errors @ [c, s], errors @ [-s, c]
    assert ((along / a) ** 2 + (across / b) ** 2 < 1).mean() == pytest.approx(0.95, abs=0.005)


# --- The replay ---


def test_the_ghost_is_the_robot_and_stands_where_the_estimate_has_it() -> None:
    replay = shown(1.0)
    for t in (0.0, 0.5, 1.0):
        found = replay.at(ESTIMATE, "pose", t)
        assert found.IsNearlyEqualTo(Told.estimate(t), 1e-9)
    # Every frame has its key.
    assert sorted(replay.keys[ESTIMATE, "pose"]) == list(range(21))
    wheels = [replay.still[f"{ESTIMATE}/ghost/wheel_{k}"].translation() for k in range(6)]
    np.testing.assert_allclose(wheels, wheel_centres(BODY, SHELL))
    box = replay.shapes[f"{ESTIMATE}/ghost/chassis"]
    np.testing.assert_allclose(box.size(), [BODY.length, BODY.width, BODY.height])
    assert replay.still[f"{ESTIMATE}/ghost/chassis"].translation()[2] == BODY.height / 2


def test_ellipse_and_needles_are_ten_times_as_large_as_they_are() -> None:
    replay = shown(0.2)
    above = f"{ESTIMATE}/covariance"
    size = replay.at(f"{above}/ellipse/disc", "scale", 0.1)
    assert size == pytest.approx([10 * 0.001 * np.sqrt(5.991)] * 2 + [1.0], rel=1e-4)
    for side, sign in (("left", 1), ("right", -1)):
        x_axis = replay.at(f"{above}/{side}", "pose", 0.1).rotation().matrix()[:, 0]
        angle = sign * 10 * 1.96 * 0.01
        np.testing.assert_allclose(x_axis, [np.cos(angle), np.sin(angle), 0.0], atol=1e-9)
    assert replay.still[above].translation()[2] > BODY.height  # not inside the robot


def test_what_is_not_known_is_not_shown() -> None:
    def covariance(t: float) -> np.ndarray:
        if 1.0 < t < 1.3:
            return np.full((6, 6), np.nan)
        return GOOD if 0.5 < t < 2.0 else LOST

    replay = shown(2.5, covariance)
    seen = {t: replay.visible(ESTIMATE, t) for t in (0.0, 0.4, 0.6, 0.9, 1.1, 1.4, 1.9, 2.1, 2.5)}
    assert [t for t, visible in seen.items() if visible] == [0.6, 0.9, 1.4, 1.9]
    # When it comes back it is at its new place at once.
    first = min(k for k in replay.keys[ESTIMATE, "pose"] if k > 1.2 * RATE)
    assert replay.visible(ESTIMATE, first / RATE)
    assert not replay.visible(ESTIMATE, (first - 1) / RATE)


def test_the_paths_are_marked_where_they_went_when_they_were_there() -> None:
    def truth(t: float) -> RigidTransform:
        return pose_on_shell(angles_at(t) + np.array([0.0, 0.0, 0.1]), 0.085)

    replay = shown(3.0, truth=truth)
    for path, expected in (("truth", truth), ("estimate", Told.estimate)):
        assert len(replay.marks(path, 0.0)) == 1
        # 0.5 rad/s, a mark every 0.08 rad, or at the frame thereafter.
        assert 6 <= len(replay.marks(path, 1.5)) <= 10
        assert 12 <= len(replay.marks(path, 3.0)) <= 19
        way = np.array([expected(t).translation() for t in np.arange(0, 3.01, 0.05)])
        for mark in replay.marks(path, 3.0):
            place = replay.still[mark].translation()
            assert np.linalg.norm(place) == pytest.approx(SHELL.radius)
            assert np.linalg.norm(way * SHELL.radius / 0.085 - place, axis=1).min() < 1e-9
    # Told apart by their shapes.
    assert {type(replay.shapes[m]) for m in replay.marks("truth", 3.0)} == {Sphere}
    assert {type(replay.shapes[m]) for m in replay.marks("estimate", 3.0)} == {Box}


def test_a_place_is_marked_once() -> None:
    # Twice around leaves as many marks as once.
    once, twice = shown(4 * np.pi), shown(8 * np.pi)
    marks = len(once.marks("estimate", 4 * np.pi))
    assert marks > 60
    assert len(twice.marks("estimate", 8 * np.pi)) <= marks + 1


def test_all_moves_with_the_shell() -> None:
    def reference(t: float) -> RigidTransform:
        return RigidTransform(RollPitchYaw(0.1, 0.2, t), [t, 0.0, 0.3])

    replay = shown(1.0, reference=reference, truth=Told.estimate)
    assert replay.at("view/robot", "pose", 0.5).IsNearlyEqualTo(reference(0.5), 1e-9)
    assert all(path.startswith("view/robot/") for path in replay.shapes)
    assert ("view/robot", "pose") not in shown(0.2).keys


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rate": 0.0}, "rate is 0.0: must be greater than 0"),
        ({"magnification": -1.0}, "magnification is -1.0: must be greater than 0"),
        ({"shell": ShellParameters(radius=0.03)}, "radius is 0.03: must be at least"),
    ],
)
def test_nonsense_is_refused(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {
        "meshcat": Replay(),
        "body": BODY,
        "shell": SHELL,
        "rate": RATE,
    } | change
    with pytest.raises(ValueError, match=message):
        ShellViewer(**arguments)
