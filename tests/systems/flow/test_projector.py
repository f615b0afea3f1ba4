from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem

from systems.flow.projector import FlowProjector, FlowProjectorParameters, project_flow
from systems.flow.shell import ShellView
from systems.flow.sphere_flow import SphereFlowEstimator
from systems.messages import PointMatches
from tests.systems.flow.shell_images import CAMERA, on_the_equator, rotation

DT = 1 / 60
RADIUS = 0.075
VIEW = ShellView(camera=CAMERA)
W = np.array([0.3, 1.2, -0.5])  # rad/s


def pose(t: float) -> RigidTransform:
    """The camera of a body that turns steadily over the shell."""
    R_RB = on_the_equator(0.3) @ rotation(W * t)
    return RigidTransform(R_RB, np.zeros(3)) @ VIEW.X_SC


def flow(seed: int = 0, **parameters: Any) -> tuple[np.ndarray, np.ndarray]:
    return project_flow(
        camera=CAMERA,
        radius=RADIUS,
        X_RC_before=pose(0.0),
        X_RC=pose(DT),
        parameters=FlowProjectorParameters(**parameters),
        random=np.random.default_rng(seed),
    )


EXACT = {"pixel_noise": 0.0, "point_dropout": 0.0}


def test_without_noise_the_points_are_one_point_of_the_shell_in_both_pictures() -> None:
    before, after = flow(**EXACT)
    for pixel, again in zip(before[:20], after[:20], strict=True):
        # Independently: walk along the ray until it is in the shell.
        ray = np.array([*((pixel - CAMERA.K[:2, 2]) / 481.0), 1.0])
        X_RC = pose(0.0).GetAsMatrix34()
        low, high = 0.0, 0.02
        for _ in range(60):
            middle = (low + high) / 2
            inside = np.linalg.norm(X_RC @ [*(middle * ray), 1.0]) < RADIUS
            low, high = (low, middle) if inside else (middle, high)
        p_C = pose(DT).inverse().multiply(X_RC @ [*(low * ray), 1.0])
        np.testing.assert_allclose(p_C[:2] / p_C[2] * 481.0 + CAMERA.K[:2, 2], again, atol=1e-6)


def test_sphere_flow_finds_the_motion_and_no_wrong_one() -> None:
    found = SphereFlowEstimator(view=VIEW).fit(PointMatches(DT, 0.0, "", *flow(**EXACT)))
    np.testing.assert_allclose(found.increment.rotation, W * DT, atol=1e-10)


def test_noise_scale_and_losses_are_as_stated() -> None:
    exact = {"points": 20_000, "point_dropout": 0.0}
    before, true = flow(**exact, pixel_noise=0.0)
    _, long = flow(**exact, pixel_noise=0.0, scale_error=0.02)
    near = min(len(long), len(true)) // 2
    same = np.isclose(np.linalg.norm(long[:near] - true[:near], axis=1), 0, atol=5)
    ratio = (long[:near] - before[:near])[same] / (true[:near] - before[:near])[same]
    assert np.median(ratio) == pytest.approx(1.02, abs=1e-6)

    noisy_before, noisy = flow(**exact, pixel_noise=0.3)
    again = ShellView(camera=CAMERA).turned(noisy_before, W * DT)
    assert np.nanstd(noisy - again) == pytest.approx(0.3, rel=0.03)

    kept = len(flow(points=20_000, pixel_noise=0.0, point_dropout=0.25)[0]) / len(before)
    assert kept == pytest.approx(0.75, abs=0.01)

    _, wrong = flow(**exact, pixel_noise=0.0, outlier_share=0.2)
    away = np.linalg.norm(wrong - VIEW.turned(_, W * DT), axis=1) > 1e-6
    assert away.mean() == pytest.approx(0.2, abs=0.02)

    lost = [len(flow(seed, picture_dropout=0.3)[0]) == 0 for seed in range(500)]
    assert np.mean(lost) == pytest.approx(0.3, abs=0.06)


def test_all_points_are_in_the_picture() -> None:
    previous, current = flow(points=5000, pixel_noise=2.0)
    for pixels in (previous, current):
        assert (pixels >= -0.5).all()
        assert (pixels <= [639.5, 479.5]).all()
    # And fill it: the shell passes by downward.
    assert previous.min(axis=0).max() < 20
    assert (current.max(axis=0) > [620, 460]).all()


def test_a_camera_that_looks_past_the_shell_finds_nothing() -> None:
    away = RigidTransform(RotationMatrix(), [0.0, 0.0, 0.085])  # z forward: up
    before, after = project_flow(
        camera=CAMERA, radius=RADIUS, X_RC_before=away, X_RC=away,
        parameters=FlowProjectorParameters(), random=np.random.default_rng(0),
    )  # fmt: skip
    assert before.shape == after.shape == (0, 2)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"points": 0}, "points is 0: must be 1 or greater"),
        ({"pixel_noise": -0.1}, "pixel_noise is -0.1: must be 0 or greater"),
        ({"scale_error": np.nan}, "scale_error is nan: must be between -1 and 1"),
        ({"outlier_share": 1.5}, "outlier_share is 1.5: must be 0 to 1"),
    ],
)
def test_bad_parameters_are_refused(bad: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        FlowProjectorParameters(**bad)


# --- The block ---


class Orbit(LeafSystem):
    def __init__(self) -> None:
        super().__init__()
        self.DeclareAbstractOutputPort(
            "pose",
            lambda: AbstractValue.Make(RigidTransform()),
            lambda context, output: output.set_value(pose(context.get_time())),
            {self.time_ticket()},
        )


def run(duration: float, seed: int | None = None, **arguments: Any) -> list[PointMatches]:
    """The matches as they change, looked at every millisecond."""
    builder = DiagramBuilder()
    orbit = builder.AddSystem(Orbit())
    projector = builder.AddSystem(FlowProjector(camera=CAMERA, frame_id="eye", **arguments))
    builder.Connect(orbit.GetOutputPort("pose"), projector.pose_input_port())
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    context: Context = projector.GetMyMutableContextFromRoot(root)
    if seed is not None:
        context.get_mutable_numeric_parameter(0).SetFrom(BasicVector([float(seed)]))
    sent: list[PointMatches] = []
    for k in range(round(duration * 1000) + 1):
        simulator.AdvanceTo(k * 1e-3)
        message = projector.matches_output_port().Eval(context)
        if not sent or message is not sent[-1]:
            sent.append(message)
    return sent


def test_the_block_compares_each_picture_with_the_last_one() -> None:
    sent = [m for m in run(0.101) if not np.isnan(m.stamp)]
    assert len(sent) == 6
    for k, message in enumerate(sent, 1):
        assert message.stamp == pytest.approx(k * DT, abs=1e-9)
        assert message.previous_stamp == pytest.approx((k - 1) * DT, abs=1e-9)
        assert message.frame_id == "eye"
        found = SphereFlowEstimator(view=VIEW).fit(message).increment
        error = found.rotation - W * DT
        assert error @ np.linalg.solve(found.covariance, error) < 25


def test_it_arrives_late_under_its_own_time() -> None:
    prompt, late = run(0.1), run(0.15, latency=0.03)
    prompt, late = ([m for m in s if not np.isnan(m.stamp)] for s in (prompt, late))
    for a, b in zip(prompt, late, strict=False):
        assert a.stamp == b.stamp
        np.testing.assert_array_equal(a.current, b.current)
    wrong = [m for m in run(0.15, latency=0.03, clock_error=0.02) if not np.isnan(m.stamp)]
    for told, true in zip(wrong, late, strict=True):  # only the stamps are others
        assert told.stamp == pytest.approx(true.stamp + 0.02, abs=1e-9)
        assert told.previous_stamp == pytest.approx(true.previous_stamp + 0.02, abs=1e-9)
        np.testing.assert_array_equal(told.current, true.current)
    assert len(run(0.045, latency=0.03)) <= 2  # the second picture's are still under way
    assert all(np.isnan(m.stamp) for m in run(0.045, latency=0.03))


def test_a_seed_repeats_and_another_differs() -> None:
    a, b, c = (run(0.02, seed)[-1].current for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert a.shape != c.shape or not np.array_equal(a, c)
