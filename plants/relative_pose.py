"""Poses of a scene's frames: where one is as seen from another, and where one is to be shown."""

from __future__ import annotations

from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.geometry import FrameId, FramePoseVector, QueryObject
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, InputPort, LeafSystem, OutputPort


class RelativePose(LeafSystem):
    """Gives the pose of one frame of a SceneGraph in another.

    .. pydrake_system::

        name: RelativePose
        input_ports:
        - query_object
        output_ports:
        - pose

    Args:
        parent: geometry frame P.
        child: geometry frame C.
        X_CF: pose of the frame F that is asked for, in the child; identity for the child itself.

    Ports:
        query_object (input, QueryObject): SceneGraph's `query`.
        pose (output, RigidTransform): `X_PF`.
    """

    def __init__(
        self, *, parent: FrameId, child: FrameId, X_CF: RigidTransform | None = None
    ) -> None:
        super().__init__()
        self._parent = parent
        self._child = child
        self._X_CF = X_CF or RigidTransform()
        self._query_input = self.DeclareAbstractInputPort(
            "query_object", AbstractValue.Make(QueryObject())
        )
        self._pose_output = self.DeclareAbstractOutputPort(
            "pose",
            lambda: AbstractValue.Make(RigidTransform()),
            self._calc_pose,
            {self._query_input.ticket()},
        )

    def query_object_input_port(self) -> InputPort:
        """Returns the port of SceneGraph's geometry."""
        return self._query_input

    def pose_output_port(self) -> OutputPort:
        """Returns the port of the pose."""
        return self._pose_output

    def _calc_pose(self, context: Context, output: Any) -> None:
        query = self._query_input.Eval(context)
        X_WC: RigidTransform = query.GetPoseInWorld(self._child)
        X_CP = X_WC.InvertAndCompose(query.GetPoseInWorld(self._parent))
        output.set_value(X_CP.InvertAndCompose(self._X_CF))


class FramePose(LeafSystem):
    """Tells a SceneGraph where the one frame of a source is.

    .. pydrake_system::

        name: FramePose
        input_ports:
        - pose
        output_ports:
        - frame_pose

    Args:
        frame_id: the frame.

    Ports:
        pose (input, RigidTransform): `X_WF`.
        frame_pose (output, FramePoseVector): for SceneGraph's port of that source.
    """

    def __init__(self, *, frame_id: FrameId) -> None:
        super().__init__()
        self._frame_id = frame_id
        self._pose_input = self.DeclareAbstractInputPort(
            "pose", AbstractValue.Make(RigidTransform())
        )
        self._frame_pose_output = self.DeclareAbstractOutputPort(
            "frame_pose",
            lambda: AbstractValue.Make(FramePoseVector()),
            self._calc_frame_pose,
            {self._pose_input.ticket()},
        )

    def pose_input_port(self) -> InputPort:
        """Returns the port of the pose."""
        return self._pose_input

    def frame_pose_output_port(self) -> OutputPort:
        """Returns the port for SceneGraph."""
        return self._frame_pose_output

    def _calc_frame_pose(self, context: Context, output: Any) -> None:
        poses = FramePoseVector()
        poses.set_value(self._frame_id, self._pose_input.Eval(context))
        output.set_value(poses)
