from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context
from scipy.spatial.transform import Rotation

from systems.messages import PoseEstimate
from systems.sensors.pose_outliers import PoseOutliers

RATE = 60.0
ANGLE = math.radians(8.0)


def estimate(stamp: float) -> PoseEstimate:
    X = RigidTransform(RollPitchYaw(0.3, -0.2, 1.0), [0.03, -0.05, 0.05])
    return PoseEstimate(stamp, "shell", "base_link", X, np.diag(np.arange(1.0, 7.0)), markers=1)


def told(block: PoseOutliers, context: Context, given: PoseEstimate) -> PoseEstimate:
    block.pose_input_port().FixValue(context, AbstractValue.Make(given))
    found = block.told_output_port().Eval(context)
    assert isinstance(found, PoseEstimate)
    return found


def turns(n: int, offset: float = 0.0, **arguments: Any) -> np.ndarray:
    """(n, 3) by how much each pose is turned: a rotation vector in the parent frame."""
    block = PoseOutliers(**({"probability": 0.2, "angle": ANGLE} | arguments))
    context = block.CreateDefaultContext()
    found = []
    for k in range(n):
        given = estimate(k / RATE + offset)
        out = told(block, context, given)
        turn = out.pose.rotation().matrix() @ given.pose.rotation().matrix().T
        # The place turns with it.
        np.testing.assert_allclose(
            out.pose.translation(), turn @ given.pose.translation(), atol=1e-12
        )
        assert out.covariance is given.covariance
        assert (out.stamp, out.frame_id, out.child_frame_id) == (given.stamp, "shell", "base_link")
        found.append(Rotation.from_matrix(turn).as_rotvec())
    return np.array(found)


def test_its_share_of_poses_is_turned_by_its_angle_about_any_axis() -> None:
    found = turns(2000)
    angles = np.linalg.norm(found, axis=1)
    wrong = angles > 1e-9
    np.testing.assert_allclose(angles[wrong], ANGLE, rtol=1e-9)
    assert wrong.mean() == pytest.approx(0.2, abs=0.03)  # three standard deviations
    axes = found[wrong] / ANGLE
    np.testing.assert_allclose(axes.mean(axis=0), 0.0, atol=0.1)
    np.testing.assert_allclose(np.cov(axes.T), np.eye(3) / 3, atol=0.06)


def test_it_is_the_stamp_that_decides() -> None:
    found = turns(300, seed=4)
    np.testing.assert_array_equal(found, turns(300, seed=4))
    # A clock that is a little off changes nothing, nor does one that begins before zero.
    np.testing.assert_allclose(found, turns(300, offset=3e-3, seed=4), atol=1e-12)
    assert np.isfinite(turns(10, offset=-0.05)).all()
    assert not np.array_equal(found, turns(300, seed=5))
    assert not np.array_equal(found, turns(300, seed=4, name="another"))


def test_what_is_not_turned_passes_as_it_is() -> None:
    block = PoseOutliers(probability=0.0, angle=ANGLE)
    context = block.CreateDefaultContext()
    given = estimate(1.0)
    assert told(block, context, given) is given
    always = PoseOutliers(probability=1.0, angle=ANGLE)
    context = always.CreateDefaultContext()
    nothing = PoseEstimate()
    assert told(always, context, nothing) is nothing
    assert told(always, context, given) is not given


def test_each_pose_is_counted_once() -> None:
    block = PoseOutliers(probability=0.3, angle=ANGLE, rate=RATE)
    simulator = Simulator(block)
    context = simulator.get_mutable_context()
    expected = 0
    for k in range(200):
        given = estimate(k // 2 / RATE)  # each stays for two looks
        expected += told(block, context, given) is not given and k % 2 == 0
        simulator.AdvanceTo((k + 0.5) / RATE)
    assert block.health_output_port().Eval(context).counts == {"turned": expected}
    assert expected > 10


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"probability": -0.1}, "probability is -0.1: must be 0 to 1"),
        ({"angle": -1.0}, "angle is -1.0"),
        ({"angle": math.inf}, "angle is inf"),
        ({"rate": 0.0}, "rate is 0.0"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PoseOutliers(**({"probability": 0.5, "angle": ANGLE} | arguments))
