from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from systems.flow.mean_flow import MeanFlow, rotational_flow, surface_velocity
from systems.flow.shell import ShellView, ShellViewParameters
from systems.messages import PointMatches
from tests.systems.flow.shell_images import CAMERA, rotation

DT = 1 / 60
RADIUS, HEIGHT, F = 0.075, 0.010, 481.0
VIEW = ShellView(camera=CAMERA)


def seen(
    w_B: np.ndarray, width: float = 10.0, centre: tuple[float, float] = (0, 0)
) -> PointMatches:
    """Points around a place of the picture while the body turns at w_B (rad/s) over the shell."""
    x, y = np.meshgrid(*[np.linspace(-width, width, 9)] * 2)
    before = np.stack([x.ravel(), y.ravel()], axis=1) + CAMERA.K[:2, 2] + centre
    points = VIEW.back_project(before) @ rotation(w_B * DT).matrix()
    p_C = (points - VIEW.X_SC.translation()) @ VIEW.X_SC.rotation().matrix()
    return PointMatches(DT, 0.0, "", before, CAMERA.project(p_C))


def test_the_rotational_flow_is_that_of_a_turning_camera() -> None:
    # Independently: far points in the axes of a camera that has turned by w dt.
    rng = np.random.default_rng(2)
    rays = np.concatenate([rng.uniform(-0.6, 0.6, (40, 2)), np.ones((40, 1))], axis=1)
    w, dt = np.array([0.4, -0.3, 0.8]), 1e-6
    after = rays @ rotation(w * dt).matrix()
    finite = (after[:, :2] / after[:, 2:] - rays[:, :2]) / dt
    np.testing.assert_allclose(rotational_flow(rays[:, :2], w), finite, atol=1e-5)


@pytest.mark.parametrize("gyro", [True, False], ids=["corrected", "plain"])
def test_around_the_middle_of_the_picture_the_velocity_is_right(gyro: bool) -> None:
    # By hand: forward r w_y, left -r w_x.
    for w in ([0.0, 0.4, 0.0], [-0.3, 0.0, 0.0], [0.2, 0.1, 0.0]):
        w_B = np.array(w)
        velocity = surface_velocity(seen(w_B), VIEW, w_B if gyro else None)
        expected = RADIUS * np.array([w_B[1], -w_B[0]])
        np.testing.assert_allclose(velocity, expected, atol=1e-3 * np.abs(expected).max())


def test_turning_on_the_spot_is_no_velocity_once_it_is_corrected() -> None:
    w_B = np.array([0.0, 0.0, 1.0])
    beside = seen(w_B, centre=(200.0, 0.0))  # all points to the right
    plain = surface_velocity(beside, VIEW)
    # By hand: as the robot turns left, a point 200 px to the right falls back by 200 w dt px.
    np.testing.assert_allclose(plain, [200 * HEIGHT / F, 0.0], atol=1e-4)
    corrected = surface_velocity(beside, VIEW, w_B)
    assert np.abs(corrected).max() < 0.02 * np.abs(plain).max()


def test_a_tilted_camera_tells_in_the_robots_axes() -> None:
    # Turned about its axis by 90 degrees, the top of the picture to the left.
    turned = ShellView(
        camera=CAMERA, parameters=ShellViewParameters(camera_tilt=[0.0, 0.0, np.pi / 2])
    )
    before = CAMERA.K[:2, 2] + np.zeros((3, 2))
    after = before + np.array([0.0, 1.0])  # what is seen goes down: the robot goes where the top is
    velocity = surface_velocity(PointMatches(1.0, 0.0, "", before, after), turned)
    np.testing.assert_allclose(velocity, [0.0, HEIGHT / F], atol=1e-12)


def test_without_usable_matches_it_is_zero() -> None:
    one = np.full((1, 2), 100.0)
    for bad in (
        PointMatches(),
        PointMatches(1.0, 0.9),
        PointMatches(1.0, 1.0, "", one, one + 1),
        PointMatches(1.0, np.nan, "", one, one + 1),
        PointMatches(1.0, 0.9, "", one, one * np.nan),
        PointMatches(1.0, 0.9, "", one, one * 1e300),
        PointMatches(1.0, 0.9, "", one, np.zeros((2, 2))),
    ):
        assert surface_velocity(bad, VIEW, np.ones(3)).tolist() == [0.0, 0.0]


def test_the_block_goes_on_without_a_gyro_and_counts() -> None:
    block = MeanFlow(view=VIEW, rate=60.0)
    simulator = Simulator(block)
    context = simulator.get_mutable_context()
    w_B = np.array([0.1, 0.4, 0.3])
    good = seen(w_B, centre=(150.0, 30.0))
    block.matches_input_port().FixValue(context, good)
    output, health = block.velocity_output_port(), block.health_output_port()
    plain, corrected = surface_velocity(good, VIEW), surface_velocity(good, VIEW, w_B)
    assert np.abs(plain - corrected).max() > 5e-4
    np.testing.assert_array_equal(output.Eval(context), plain)
    block.imu_input_port().FixValue(context, [*w_B, 0.0, 0.0, 9.81])
    np.testing.assert_array_equal(output.Eval(context), corrected)
    simulator.AdvanceTo(0.05)
    assert not any(health.Eval(context).counts.values())

    block.imu_input_port().FixValue(context, [0.0, np.nan, 0.0, 0.0, 0.0, 9.81])
    current = good.current.copy()
    current[:5] = np.nan
    bad = PointMatches(2.0, 2.0 - DT, "", good.previous, current)
    block.matches_input_port().FixValue(context, bad)
    np.testing.assert_array_equal(output.Eval(context), surface_velocity(bad, VIEW))
    simulator.AdvanceTo(0.1)
    block.matches_input_port().FixValue(context, PointMatches(3.0, 2.9))
    assert output.Eval(context).tolist() == [0.0, 0.0]
    simulator.AdvanceTo(0.15)
    assert health.Eval(context).counts == {"bad_imu": 2, "bad_point": 5, "no_flow": 1}
