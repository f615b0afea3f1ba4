from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

from systems.pose_vector import (
    PoseFromVector,
    PoseToVector,
    pose_from_vector,
    pose_to_vector,
    rotations_of,
)


def poses(count: int, seed: int = 0) -> list[RigidTransform]:
    """Random ones, and half turns about each axis, where the quaternion's w is 0."""
    random = np.random.default_rng(seed)
    turns = [RotationMatrix(R) for R in Rotation.random(count, rng=random).as_matrix()]
    turns += [RotationMatrix(np.diag(d)) for d in ((1.0, -1, -1), (-1.0, 1, -1), (-1.0, -1, 1))]
    return [RigidTransform(R, random.normal(size=3)) for R in turns]


def test_a_quarter_turn_about_z_by_hand() -> None:
    pose = RigidTransform(RollPitchYaw(0.0, 0.0, math.pi / 2), [1.0, 2.0, 3.0])
    half = math.sqrt(0.5)
    np.testing.assert_allclose(pose_to_vector(pose), [half, 0, 0, half, 1, 2, 3], atol=1e-15)


def test_a_pose_goes_there_and_back() -> None:
    for pose in poses(50):
        vector = pose_to_vector(pose)
        assert np.linalg.norm(vector[:4]) == pytest.approx(1.0, abs=1e-14)
        assert pose_from_vector(vector).IsNearlyEqualTo(pose, 1e-14)


@pytest.mark.parametrize("factor", [0.5, 3.0, -1.0])
def test_a_quaternion_of_any_length_and_sign_is_the_same_rotation(factor: float) -> None:
    # A recording keeps rounded numbers, and q and -q are one rotation.
    for pose in poses(10, seed=1):
        vector = pose_to_vector(pose)
        vector[:4] *= factor
        assert pose_from_vector(vector).IsNearlyEqualTo(pose, 1e-13)
        found = rotations_of(vector[None])[0]
        np.testing.assert_allclose(found, pose.rotation().matrix(), atol=1e-13)


def test_the_rotations_of_many_are_those_of_another_library() -> None:
    vectors = np.array([pose_to_vector(pose) for pose in poses(50, seed=2)])
    expected = Rotation.from_quat(vectors[:, :4], scalar_first=True).as_matrix()
    np.testing.assert_allclose(rotations_of(vectors), expected, atol=1e-14)
    assert rotations_of(np.zeros((0, 7))).shape == (0, 3, 3)


def test_one_block_undoes_the_other() -> None:
    builder = DiagramBuilder()
    there, back = builder.AddSystem(PoseToVector()), builder.AddSystem(PoseFromVector())
    builder.Connect(there.vector_output_port(), back.vector_input_port())
    builder.ExportInput(there.pose_input_port(), "pose")
    builder.ExportOutput(there.vector_output_port(), "vector")
    builder.ExportOutput(back.pose_output_port(), "pose")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    # The second value tells whether either output was cached for good.
    for pose in poses(2, seed=3):
        diagram.GetInputPort("pose").FixValue(context, AbstractValue.Make(pose))
        vector = diagram.GetOutputPort("vector").Eval(context)
        np.testing.assert_array_equal(vector, pose_to_vector(pose))
        assert diagram.GetOutputPort("pose").Eval(context).IsNearlyEqualTo(pose, 1e-14)
