"""Poses along a chain: where the last robot is on the first shell, and how surely.

Each robot stands on the shell of the one below it and estimates its pose there. Composed, with the
places of the shells on their carriers, the estimates tell the last robot's pose on the first shell.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, InputPort, LeafSystem, OutputPort

from systems.markers.pnp import cross_matrix
from systems.messages import PoseEstimate, whole_nanoseconds
from systems.shell.angles import SHELL_FRAME
from systems.validation import require, require_non_negative

Array = NDArray[np.float64]


def compose(
    X_AB: RigidTransform, P_AB: Array, X_BC: RigidTransform, P_BC: Array
) -> tuple[RigidTransform, Array]:
    """Returns a pose in a pose, and its covariance.

    To first order: of errors (phi, d) of each, R_true = exp([phi]x) R and p_true = p + d, follows

        phi_AC = phi_AB + R_AB phi_BC
        d_AC = d_AB - [R_AB p_BC]x phi_AB + R_AB d_BC

    Source: Barfoot, Furgale, "Associating uncertainty with three-dimensional poses for use in
    estimation problems", IEEE T-RO 30, 2014, of compounding poses, to second order. Their error is
    a twist, with d - phi x p in place of our d; their adjoint becomes the above.

    Args:
        X_AB: pose of B in A.
        P_AB: (6, 6), rotation first: a small rotation vector in A (rad), then the position (m).
        X_BC: pose of C in B.
        P_BC: (6, 6), the same in B. The errors of the two are independent.

    Returns:
        `X_AC`, and its covariance (6, 6) in A.
    """
    R = X_AB.rotation().matrix()
    J = np.eye(6)
    J[3:, :3] = -cross_matrix(R @ X_BC.translation())
    turned = np.kron(np.eye(2), R)
    P = J @ P_AB @ J.T + turned @ P_BC @ turned.T
    return X_AB @ X_BC, (P + P.T) / 2


def _turning_about_origin(X_BR: RigidTransform) -> Array:
    """Returns the covariance (6, 6) of a pose that turns about B's x and y, with variances of 1."""
    G = np.vstack([np.eye(3), -cross_matrix(X_BR.translation())])[:, :2]
    return np.asarray(G @ G.T)


class PoseChain(LeafSystem):
    """Composes the poses of robots, each on the shell of the one below it, with their covariances.

    .. pydrake_system::

        name: PoseChain
        input_ports:
        - "pose_{k}"
        - "covariance_{k}"
        output_ports:
        - pose
        - covariance
        - estimate

    Args:
        mounts: `X_BR` of the shell on each robot but the last, in the order of the chain, known:
            n - 1 of them. An empty list for a single robot, whose pose is passed on.
        rock: standard deviation of a carrier's tilt about its x and about its y axis, rad: of its
            upper body B, whose pose is estimated, against its chassis, which carries the shell.
        frame_id: name of the first shell's frame in `estimate`.
        child_frame_id: name of the last robot's.

    Ports:
        pose_{k} (input, RigidTransform): `X_RB` of the k-th robot on the shell it stands on, that
            of the (k-1)-th.
        covariance_{k} (input, vector of 36): its covariance (6, 6), row by row: rotation first, a
            small rotation vector in that shell's frame (rad), then the position (m).
        pose (output, RigidTransform): of the last robot in the first shell's frame. What is not
            finite in an input is not in the outputs either.
        covariance (output, vector of 36): its covariance, in the first shell's frame.
        estimate (output, PoseEstimate): the two as one message, stamped with the present.

    The errors of the links count as independent: each robot has sensors, markers and steel of its
    own. So does the rock, of which an estimator's error tells little. To first order, see
    `compose`.

    Raises:
        ValueError: a mount that is not finite, or a negative rock.
    """

    def __init__(
        self,
        *,
        mounts: Sequence[RigidTransform],
        rock: float = 0.0,
        frame_id: str = SHELL_FRAME,
        child_frame_id: str = "base_link",
    ) -> None:
        super().__init__()
        for mount in mounts:
            matrix = mount.GetAsMatrix34()
            require(bool(np.isfinite(matrix).all()), "mounts", matrix.tolist(), "finite")
        require_non_negative(rock=rock)
        # B tilts about its own origin: the shell on the chassis turns the other way about it.
        self._mounts = [(X_BR, rock**2 * _turning_about_origin(X_BR)) for X_BR in mounts]
        self._frame_id = frame_id
        self._child_frame_id = child_frame_id
        self._inputs = [
            (
                self.DeclareAbstractInputPort(
                    f"pose_{k + 1}", AbstractValue.Make(RigidTransform())
                ),
                self.DeclareVectorInputPort(f"covariance_{k + 1}", 36),
            )
            for k in range(len(self._mounts) + 1)
        ]
        poses = {pose.ticket() for pose, _ in self._inputs}
        both = poses | {covariance.ticket() for _, covariance in self._inputs}
        self._pose_output = self.DeclareAbstractOutputPort(
            "pose", lambda: AbstractValue.Make(RigidTransform()), self._calc_pose, poses
        )
        self._covariance_output = self.DeclareVectorOutputPort(
            "covariance", 36, self._calc_covariance, both
        )
        self._estimate_output = self.DeclareAbstractOutputPort(
            "estimate",
            lambda: AbstractValue.Make(PoseEstimate()),
            self._calc_estimate,
            both | {self.time_ticket()},
        )

    def pose_input_port(self, k: int) -> InputPort:
        """Returns the port of the k-th robot's pose, k from 1."""
        return self._inputs[k - 1][0]

    def covariance_input_port(self, k: int) -> InputPort:
        """Returns the port of that pose's covariance."""
        return self._inputs[k - 1][1]

    def pose_output_port(self) -> OutputPort:
        """Returns the port of the last robot's pose on the first shell."""
        return self._pose_output

    def covariance_output_port(self) -> OutputPort:
        """Returns the port of its covariance."""
        return self._covariance_output

    def estimate_output_port(self) -> OutputPort:
        """Returns the port of both as one message."""
        return self._estimate_output

    def _composed(self, context: Context) -> tuple[RigidTransform, Array]:
        links = [
            (pose.Eval(context), covariance.Eval(context).reshape(6, 6))
            for pose, covariance in self._inputs
        ]
        X, P = links[0]
        for (X_BR, P_BR), (X_RB, P_RB) in zip(self._mounts, links[1:], strict=True):
            X, P = compose(X, P, X_BR, P_BR)
            X, P = compose(X, P, X_RB, P_RB)
        return X, P

    def _calc_pose(self, context: Context, output: Any) -> None:
        X, *others = (pose.Eval(context) for pose, _ in self._inputs)
        for (X_BR, _), X_RB in zip(self._mounts, others, strict=True):
            X = X @ X_BR @ X_RB
        output.set_value(X)

    def _calc_covariance(self, context: Context, output: Any) -> None:
        output.SetFromVector(self._composed(context)[1].ravel())

    def _calc_estimate(self, context: Context, output: Any) -> None:
        X, P = self._composed(context)
        output.set_value(
            PoseEstimate(
                stamp=whole_nanoseconds(context.get_time()),
                frame_id=self._frame_id,
                child_frame_id=self._child_frame_id,
                pose=RigidTransform(X),  # a message is kept, what Eval gives is not
                covariance=P,
            )
        )
