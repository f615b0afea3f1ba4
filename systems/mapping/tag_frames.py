"""What a camera sees of tags, frame by frame: `cam_T_tag`, and `world_T_cam` through the anchor.

Source: Martins do Lago Reis, da Silva Ramos, "AprilTag-based Trajectory Tracking for the LIMOS
Robot", algorithm 1. There a tag has one pose; here both poses of the square travel on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import (
    Context,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
    State,
)

from systems.cameras import PinholeCamera
from systems.health import Counts
from systems.markers.layout import MarkerMap
from systems.markers.planar_pose import planar_poses
from systems.markers.pnp import cross_matrix
from systems.memo import Memo
from systems.messages import Detections, Message, PoseEstimate
from systems.periods import period
from systems.validation import require, require_positive

Array = NDArray[np.float64]

REASONS = ("unknown_id", "repeated_id", "no_pose")
_SURE = 13.8  # of the other pose's chi-square over the better one's: odds of 1000 to 1
ENOUGH = 2  # tags; a frame with fewer is of low observability


@dataclass(frozen=True, eq=False)
class TagFrame(Message):
    """The tags of one picture.

    Attributes:
        stamp: time of the picture, s; NaN when there was none yet.
        frame_id: optical frame of the camera.
        detections: of the picture, as they came.
        ids: (n,) of the tags that have poses.
        R_CT: (n, 2, 3, 3) both rotations of each, the better one first.
        p_CT: (n, 2, 3) m.
        squared_error: (n, 2) px^2, see `PlanarPoses`.
        camera_pose: `X_WC` through the anchor; not `valid` when the anchor is not in the picture.
        dropped: tags that were left out, by reason (see `REASONS`).
    """

    stamp: float = math.nan
    frame_id: str = ""
    detections: Detections = field(default_factory=Detections)
    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    R_CT: Array = field(default_factory=lambda: np.zeros((0, 2, 3, 3)))
    p_CT: Array = field(default_factory=lambda: np.zeros((0, 2, 3)))
    squared_error: Array = field(default_factory=lambda: np.zeros((0, 2)))
    camera_pose: PoseEstimate = field(default_factory=PoseEstimate)
    dropped: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def low_observability(self) -> bool:
        """Whether there are too few tags to be sure of anything."""
        return len(self) < ENOUGH

    def poses(self) -> list[tuple[int, RigidTransform]]:
        """Returns id and better `X_CT` of each tag."""
        return [
            (int(i), RigidTransform(RotationMatrix(R[0]), p[0]))
            for i, R, p in zip(self.ids, self.R_CT, self.p_CT, strict=True)
        ]


@dataclass(frozen=True, eq=False)
class FrameHistory(Message):
    """All frames so far: the last one, and what was before it. To add one copies nothing.

    Attributes:
        last: the latest frame; None at the beginning.
        before: what was before it.
        count: how many frames there are.
    """

    last: TagFrame | None = None
    before: FrameHistory | None = None
    count: int = 0

    def with_frame(self, frame: TagFrame) -> FrameHistory:
        """Returns a history with one frame more."""
        return FrameHistory(frame, self, self.count + 1)

    def frames(self) -> list[TagFrame]:
        """Returns the frames, the first one first."""
        found: list[TagFrame] = []
        node: FrameHistory | None = self
        while node is not None and node.last is not None:
            found.append(node.last)
            node = node.before
        return found[::-1]


def observe(
    detections: Detections,
    *,
    camera: PinholeCamera,
    markers: MarkerMap,
    anchor: int,
    pixel_noise: float,
) -> TagFrame:
    """Returns the poses of the tags of a picture, and the camera's through the anchor.

    Args:
        detections: of the picture.
        camera: that took it.
        markers: family and sizes of the tags; only the anchor's pose is looked at.
        anchor: id of the tag whose pose is known.
        pixel_noise: standard deviation of a corner's coordinate, px, for the covariance.
    """
    family = detections.family or markers.family.name
    known = np.array([int(i) in markers for i in detections.ids], bool)
    known &= family == markers.family.name
    _, which, count = np.unique(detections.ids, return_inverse=True, return_counts=True)
    once = count[which] == 1 if len(detections) else known
    good = detections.select(known & once)
    rays, by_ray = camera.rays(good.corners)
    sizes = np.array([markers.markers[int(i)].size for i in good.ids], float)
    poses = planar_poses(rays, by_ray, sizes)
    sound = np.isfinite(poses.squared_error[:, 0])
    ids = good.ids[sound]
    frame = TagFrame(
        stamp=detections.stamp,
        frame_id=detections.frame_id,
        detections=detections,
        ids=ids,
        R_CT=poses.R[sound],
        p_CT=poses.p[sound],
        squared_error=poses.squared_error[sound],
        dropped={
            "unknown_id": int((~known).sum()),
            "repeated_id": int((known & ~once).sum()),
            "no_pose": int((~sound).sum()),
        },
    )
    found = np.flatnonzero(ids == anchor)
    if len(found) == 0:
        return frame
    k = int(found[0])
    information = poses.information[sound][k, 0]
    X_WC, covariance = camera_through(
        markers.markers[anchor].X_WM,
        RigidTransform(RotationMatrix(frame.R_CT[k, 0]), frame.p_CT[k, 0]),
        pixel_noise**2 * np.linalg.pinv(information),
    )
    better, other = frame.squared_error[k]
    camera_pose = PoseEstimate(
        stamp=frame.stamp,
        frame_id=markers.frame,
        child_frame_id=frame.frame_id,
        pose=X_WC,
        covariance=covariance,
        reprojection_rms=math.sqrt(better / 4),
        ambiguous=bool(other - better < _SURE * pixel_noise**2),
        markers=1,
    )
    return replace(frame, camera_pose=camera_pose)


def camera_through(
    X_WT: RigidTransform, X_CT: RigidTransform, covariance: Array
) -> tuple[RigidTransform, Array]:
    """Returns `X_WC = X_WT X_CT^-1` and its covariance (6, 6), rotation first, in W.

    Args:
        X_WT: of the tag in the map.
        X_CT: of the tag in the camera.
        covariance: (6, 6) of `X_CT`, rotation first, in C.
    """
    X_WC = X_WT @ X_CT.inverse()
    R_WC = X_WC.rotation().matrix()
    # exp(w) R_CT and p + d become exp(-R_WC w) R_WC and p_WC - R_WC ([p]x w + d).
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = -R_WC
    J[3:, :3] = -R_WC @ cross_matrix(X_CT.translation())
    return X_WC, J @ covariance @ J.T


class TagFrames(LeafSystem):
    """Gives the poses of the tags in a camera's pictures, and remembers them all.

    .. pydrake_system::

        name: TagFrames
        input_ports:
        - detections
        output_ports:
        - frame
        - camera_pose
        - tags_in_view
        - history
        - counts
        - health

    Args:
        camera: that takes the pictures.
        markers: family and sizes of the tags; only the anchor's pose is looked at.
        anchor: id of the tag whose pose is known.
        rate: how often new pictures are looked for, Hz; at least the camera's.
        pixel_noise: standard deviation of a corner's coordinate, px.

    Ports:
        detections (input, Detections): of the latest picture. Tags of another family or not among
            the markers are left out, and an id that is there twice: none can be told to be right.
        frame (output, TagFrame): of the latest picture.
        camera_pose (output, PoseEstimate): `X_WC` of the latest picture, through the anchor; not
            `valid` (stamp NaN) when that is not in the picture.
        tags_in_view (output, vector of 1): how many tags of the latest picture have poses.
        history (output, FrameHistory): all frames so far.
        counts (output, vector of 3): so far: frames, those of low observability (fewer than two
            tags), those with the anchor.
        health (output, Health): tags left out, by reason (see `REASONS`).

    Source: algorithm 1 of the paper that this module names.

    Raises:
        ValueError: the anchor is not among the markers; rate or noise out of range.
    """

    def __init__(
        self,
        *,
        camera: PinholeCamera,
        markers: MarkerMap,
        anchor: int,
        rate: float,
        pixel_noise: float = 0.3,
    ) -> None:
        super().__init__()
        require_positive(rate=rate, pixel_noise=pixel_noise)
        known = ", ".join(map(str, markers.markers))
        require(anchor in markers, "anchor", anchor, f"one of the markers: {known}")
        self._arguments = {
            "camera": camera,
            "markers": markers,
            "anchor": anchor,
            "pixel_noise": pixel_noise,
        }
        self._memo = Memo(self, "tag frame")
        self._detections_input = self.DeclareAbstractInputPort(
            "detections", AbstractValue.Make(Detections())
        )
        ticket = {self._detections_input.ticket()}
        self._frame_output = self.DeclareAbstractOutputPort(
            "frame",
            lambda: AbstractValue.Make(TagFrame()),
            lambda context, output: output.set_value(self._frame(context)),
            ticket,
        )
        self._camera_pose_output = self.DeclareAbstractOutputPort(
            "camera_pose",
            lambda: AbstractValue.Make(PoseEstimate()),
            lambda context, output: output.set_value(self._frame(context).camera_pose),
            ticket,
        )
        self._tags_in_view_output = self.DeclareVectorOutputPort(
            "tags_in_view",
            1,
            lambda context, output: output.SetFromVector([len(self._frame(context))]),
            ticket,
        )
        self._history = self.DeclareAbstractState(AbstractValue.Make(FrameHistory()))
        self._history_output = self.DeclareStateOutputPort("history", self._history)
        self._so_far = self.DeclareDiscreteState(3)
        self._counts_output = self.DeclareStateOutputPort("counts", self._so_far)
        self._counts = Counts(self, *REASONS)
        # One event adds to the history and one counts, each by the stamp of what it saw last:
        # Drake does unrestricted updates before discrete ones.
        self._last_stamp = self.DeclareDiscreteState([math.nan])
        self.DeclarePeriodicUnrestrictedUpdateEvent(period(rate), 0.0, self._remember)
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._count)

    def detections_input_port(self) -> InputPort:
        """Returns the port of the detections."""
        return self._detections_input

    def frame_output_port(self) -> OutputPort:
        """Returns the port of the latest frame."""
        return self._frame_output

    def camera_pose_output_port(self) -> OutputPort:
        """Returns the port of the camera's pose through the anchor."""
        return self._camera_pose_output

    def tags_in_view_output_port(self) -> OutputPort:
        """Returns the port of the number of tags."""
        return self._tags_in_view_output

    def history_output_port(self) -> OutputPort:
        """Returns the port of all frames."""
        return self._history_output

    def counts_output_port(self) -> OutputPort:
        """Returns the port of the numbers of frames."""
        return self._counts_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of what was left out."""
        return self._counts.output_port

    def _frame(self, context: Context) -> TagFrame:
        detections = self._detections_input.Eval(context)
        if math.isnan(detections.stamp):
            return TagFrame()
        frame: TagFrame = self._memo(context, self._observe, detections)
        return frame

    def _observe(self, detections: Detections) -> TagFrame:
        return observe(detections, **self._arguments)  # type: ignore[arg-type]

    def _remember(self, context: Context, state: State) -> EventStatus:
        frame = self._frame(context)
        slot = state.get_mutable_abstract_state(int(self._history))
        history: FrameHistory = slot.get_value()
        latest = -math.inf if history.last is None else history.last.stamp
        if not frame.stamp > latest:  # none yet, the same again, or one out of order
            return EventStatus.DidNothing()
        slot.set_value(history.with_frame(frame))
        return EventStatus.Succeeded()

    def _count(self, context: Context, discrete_state: DiscreteValues) -> None:
        frame = self._frame(context)
        last = context.get_discrete_state(self._last_stamp)[0]
        if math.isnan(frame.stamp) or frame.stamp <= last:
            return
        discrete_state.set_value(self._last_stamp, [frame.stamp])
        so_far = context.get_discrete_state(self._so_far).get_value()
        more = [1, frame.low_observability, frame.camera_pose.valid]
        discrete_state.set_value(self._so_far, so_far + more)
        self._counts.add(context, discrete_state, **frame.dropped)
