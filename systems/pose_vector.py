"""Poses as plain vectors, for what takes no other: logs, multiplexers, recordings."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, InputPort, LeafSystem, OutputPort

Array = NDArray[np.float64]


def pose_to_vector(X_PC: RigidTransform) -> Array:
    """Returns [w, x, y, z of the unit quaternion, x, y, z (m)] of a pose."""
    return np.concatenate([X_PC.rotation().ToQuaternion().wxyz(), X_PC.translation()])


def pose_from_vector(vector: Array) -> RigidTransform:
    """Returns the pose of [w, x, y, z of the quaternion, x, y, z (m)]; it is made of unit norm."""
    q = np.asarray(vector[:4], float)
    return RigidTransform(RotationMatrix(Quaternion(q / np.linalg.norm(q))), vector[4:7])


def rotations_of(vectors: Array) -> Array:
    """Returns the rotations (n, 3, 3) of many such vectors (n, 7)."""
    w, x, y, z = (vectors[:, k] for k in range(4))
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    stacked = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return np.asarray(stacked / (w * w + x * x + y * y + z * z)[:, None, None])


class PoseToVector(LeafSystem):
    """Gives a pose as seven numbers.

    .. pydrake_system::

        name: PoseToVector
        input_ports:
        - pose
        output_ports:
        - vector

    Ports:
        pose (input, RigidTransform): any.
        vector (output, vector of 7): its unit quaternion w, x, y, z, then its place x, y, z (m).
    """

    def __init__(self) -> None:
        super().__init__()
        self._pose_input = self.DeclareAbstractInputPort(
            "pose", AbstractValue.Make(RigidTransform())
        )
        self._vector_output = self.DeclareVectorOutputPort(
            "vector", 7, self._calc_vector, {self._pose_input.ticket()}
        )

    def pose_input_port(self) -> InputPort:
        """Returns the port of the pose."""
        return self._pose_input

    def vector_output_port(self) -> OutputPort:
        """Returns the port of the vector."""
        return self._vector_output

    def _calc_vector(self, context: Context, output: Any) -> None:
        output.SetFromVector(pose_to_vector(self._pose_input.Eval(context)))


class PoseFromVector(LeafSystem):
    """Makes a pose of seven numbers.

    .. pydrake_system::

        name: PoseFromVector
        input_ports:
        - vector
        output_ports:
        - pose

    Ports:
        vector (input, vector of 7): a quaternion w, x, y, z, then a place x, y, z (m).
        pose (output, RigidTransform): of the quaternion made of unit norm.
    """

    def __init__(self) -> None:
        super().__init__()
        self._vector_input = self.DeclareVectorInputPort("vector", 7)
        self._pose_output = self.DeclareAbstractOutputPort(
            "pose",
            lambda: AbstractValue.Make(RigidTransform()),
            lambda context, output: output.set_value(
                pose_from_vector(self._vector_input.Eval(context))
            ),
            {self._vector_input.ticket()},
        )

    def vector_input_port(self) -> InputPort:
        """Returns the port of the vector."""
        return self._vector_input

    def pose_output_port(self) -> OutputPort:
        """Returns the port of the pose."""
        return self._pose_output
