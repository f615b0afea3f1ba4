"""Detections from true poses without a picture: what a camera and a detector would have found.

The corners are projected exactly; visibility, noise and misses are modelled. Far faster
than rendering a picture and searching it: 40 to 80 times at 640x480 pixels and 100 to 180 times at
1280x960, with 16 markers and 30 solids in sight.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import FrameId, QueryObject, Role
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, InputPort, OutputPort

from systems.cameras import PinholeCamera
from systems.compiled import compiled, in_rows, packed
from systems.markers.corner_noise import corner_deviation, narrow_side_of
from systems.markers.family import Family
from systems.markers.layout import MarkerMap, marker_corners
from systems.messages import Detections
from systems.noise import NoiseStream
from systems.plumb_bob import distort
from systems.raycasting import Solids, SolidsMemo, frame_poses
from systems.sensors.sampled import SampledSensor
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

# A solid this close before a marker is the board that carries it, and hides nothing: metres, or
# part of the distance from the camera, whichever is more.
_BOARD = 1e-3
_BOARD_PART = 0.005
# Corners, centre, and corners again, to become those of the white margin.
_OUTLINE = np.concatenate([marker_corners(1.0), np.zeros((1, 3)), marker_corners(1.0)])


@dataclass
class ProjectorParameters:
    """When a marker is found, and how well.

    The defaults of `min_side_px` and `max_incidence` are where OpenCV and AprilTag 3 began to miss
    about half of the markers of families DICT_4X4_50 and tag36h11 in synthetic pictures (blur
    0.6 px, noise 2 grey levels): at a narrow side of 10 to 14 px, whatever the tilt, and beyond 80
    degrees of tilt at 80 px.

    Attributes:
        pixel_noise: standard deviation of each corner coordinate of a large marker, px.
        pixel_noise_by_side: more noise of small ones, px^2 (see `systems.markers.corner_noise`).
        min_side_px: the narrow side below which a marker is not found, px (see
            `narrow_side`).
        max_incidence: angle between the marker's normal and the line of sight beyond which it is
            not found, rad, below pi/2.
        max_range: distance beyond which it is not found, m.
        miss_probability: part of the visible markers that is missed at random.
        white_margin: how much of the white rim must be in the picture, cells.
        border_px: how far inside the picture the rim must stay, px.
    """

    pixel_noise: float = 0.3
    pixel_noise_by_side: float = 0.0
    min_side_px: float = 12.0
    max_incidence: float = 1.4
    max_range: float = math.inf
    miss_probability: float = 0.0
    white_margin: float = 1.0
    border_px: float = 0.0

    def __post_init__(self) -> None:
        require_non_negative(
            pixel_noise=self.pixel_noise,
            pixel_noise_by_side=self.pixel_noise_by_side,
            min_side_px=self.min_side_px,
            white_margin=self.white_margin,
            border_px=self.border_px,
        )
        require(self.max_range > 0, "max_range", self.max_range, "greater than 0")
        require(
            0 < self.max_incidence < np.pi / 2,
            "max_incidence",
            self.max_incidence,
            "between 0 and pi/2 (rad)",
        )
        require(
            0 <= self.miss_probability <= 1, "miss_probability", self.miss_probability, "0 to 1"
        )


@dataclass(frozen=True, eq=False)
class VisibleMarkers:
    """The markers that can be seen, without noise.

    Attributes:
        index: (m,) which of the markers.
        corners: (m, 4, 2) px, as the distorted picture shows them.
        side: (m,) narrow side, px.
        incidence: (m,) angle between the marker's normal and the line of sight, rad.
    """

    index: NDArray[np.intp]
    corners: Array
    side: Array
    incidence: Array


def visible_markers(
    *,
    camera: PinholeCamera,
    X_WC: RigidTransform,
    X_WM: Array,
    sizes: Array,
    cells: int,
    parameters: ProjectorParameters,
    solids: Solids | None = None,
) -> VisibleMarkers:
    """Projects the markers that a detector could find.

    A marker is visible when the camera is on its printed side, within the range and the incidence;
    its corners and its white margin are before the camera and in the picture; its narrow side is
    large enough; and no solid hides its corners or its centre.

    Args:
        camera: intrinsics.
        X_WC: pose of the optical frame.
        X_WM: (n, 3, 4) rotations and translations (m) of the markers.
        sizes: (n,) sides of the black squares, m.
        cells: cells along a side of the black square.
        parameters: limits.
        solids: what may stand before the markers.
    """
    n, p, pose = len(sizes), parameters, in_rows(X_WC.GetAsMatrix34(), 4)
    outline = _OUTLINE.copy()
    outline[5:] *= 1 + 2 * p.white_margin / cells
    keep, p_WQ, pixels = np.empty(n, bool), np.empty((n, 5, 3)), np.empty((n, 4, 2))
    side, distance, cosine = np.empty(n), np.empty(n), np.empty(n)
    limits = np.array(
        (
            camera.width, camera.height, camera.fold_radius, math.cos(p.max_incidence),
            p.max_range, p.min_side_px, p.border_px,
        )
    )  # fmt: skip
    _outlines(
        pose, in_rows(X_WM, 3, 4), packed(sizes), outline, *camera.matrices, limits,
        keep, p_WQ, pixels, side, distance, cosine,
    )  # fmt: skip
    if solids is not None and keep.any():
        tolerance = np.maximum(_BOARD, _BOARD_PART * distance[keep])
        hidden = solids.occluded(pose[:, 3], p_WQ[keep].reshape(-1, 3), np.repeat(tolerance, 5))
        keep[keep] = ~hidden.reshape(-1, 5).any(axis=1)
    return VisibleMarkers(np.flatnonzero(keep), pixels[keep], side[keep], np.arccos(cosine[keep]))


@compiled(
    "void(f8[:,::1], f8[:,:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[::1], f8[::1],"
    " b1[::1], f8[:,:,::1], f8[:,:,::1], f8[::1], f8[::1], f8[::1])"
)
def _outlines(
    X_WC: Array,
    X_WM: Array,
    sizes: Array,
    outline: Array,
    K: Array,
    D: Array,
    limits: Array,
    keep: NDArray[np.bool_],
    p_WQ: Array,
    pixels: Array,
    side: Array,
    distance: Array,
    cosine: Array,
) -> None:
    """Projects the markers that are in the picture if nothing hides them.

    Args:
        X_WC: (3, 4).
        X_WM: (n, 3, 4).
        sizes: (n,) m.
        outline: (9, 3) corners, centre, corners of the margin; of a marker of size 1.
        K: (3, 3) px.
        D: (5,).
        limits: width (px), height (px), radius of the distortion's fold, cosine of the incidence,
            range (m), narrow side (px), border (px).
        keep: (n,) written: which are; the rest is written for these.
        p_WQ: (n, 5, 3) written: corners and centre, m.
        pixels: (n, 4, 2) written: corners, px.
        side: (n,) written: narrow side, px.
        distance: (n,) written, m.
        cosine: (n,) written: of the incidence.
    """
    width, height, fold, least_cosine = limits[0], limits[1], limits[2], limits[3]
    max_range, min_side, border = limits[4], limits[5], limits[6]
    low = border - 0.5  # the picture's edge: pixels count from their centres
    from_camera, p_W = np.empty(3), np.empty(3)
    for n in range(len(sizes)):
        keep[n] = False
        toward, square = 0.0, 0.0
        for i in range(3):
            line = X_WC[i, 3] - X_WM[n, i, 3]
            toward += line * X_WM[n, i, 0]
            square += line * line
        far = math.sqrt(square)
        if not (toward > far * least_cosine and far <= max_range):
            continue
        inside = True
        for q in range(len(outline)):
            for i in range(3):
                p_W[i] = X_WM[n, i, 3]
                for j in range(3):
                    p_W[i] += X_WM[n, i, j] * outline[q, j] * sizes[n]
                from_camera[i] = p_W[i] - X_WC[i, 3]
            x, y, z = 0.0, 0.0, 0.0
            for i in range(3):
                x += X_WC[i, 0] * from_camera[i]
                y += X_WC[i, 1] * from_camera[i]
                z += X_WC[i, 2] * from_camera[i]
            if not (z > 0 and math.hypot(x, y) < fold * z):
                inside = False
                break
            bent_x, bent_y, _, _, _ = distort(x / z, y / z, D)
            u, v = K[0, 0] * bent_x + K[0, 2], K[1, 1] * bent_y + K[1, 2]
            if u < low or v < low or u > width - 1 - low or v > height - 1 - low:
                inside = False
                break
            if q < 5:
                p_WQ[n, q, 0], p_WQ[n, q, 1], p_WQ[n, q, 2] = p_W[0], p_W[1], p_W[2]
            if q < 4:
                pixels[n, q, 0], pixels[n, q, 1] = u, v
        if not inside:
            continue
        side[n] = narrow_side_of(pixels[n])
        distance[n], cosine[n] = far, min(toward / far, 1.0)
        keep[n] = side[n] >= min_side


def project_markers(
    *,
    camera: PinholeCamera,
    X_WC: RigidTransform,
    X_WM: Array,
    sizes: Array,
    cells: int,
    parameters: ProjectorParameters,
    random: np.random.Generator,
    solids: Solids | None = None,
) -> tuple[NDArray[np.intp], Array]:
    """Returns which markers are found and where their corners are found.

    The noise of a marker does not depend on which others are visible: numbers are drawn for all.

    Args:
        camera: see `visible_markers`, as for the others.
        X_WC: pose of the optical frame.
        X_WM: (n, 3, 4) rotations and translations (m) of the markers.
        sizes: (n,) sides of the black squares, m.
        cells: cells along a side of the black square.
        parameters: limits, noise and misses.
        random: where the noise comes from.
        solids: what may stand before the markers.

    Returns:
        (m,) index of the markers, ascending, and (m, 4, 2) px.
    """
    noise = random.standard_normal((len(sizes), 4, 2))
    found = random.random(len(sizes)) >= parameters.miss_probability
    visible = visible_markers(
        camera=camera,
        X_WC=X_WC,
        X_WM=X_WM,
        sizes=sizes,
        cells=cells,
        parameters=parameters,
        solids=solids,
    )
    deviation = corner_deviation(
        visible.corners, parameters.pixel_noise, parameters.pixel_noise_by_side
    )
    corners = visible.corners + deviation[:, None, None] * noise[visible.index]
    found = found[visible.index]
    return visible.index[found], corners[found]


@dataclass(frozen=True)
class PlacedMarker:
    """A marker that is fixed to a frame of the scene.

    Attributes:
        id: its number in the family.
        size: side of the black square, m.
        frame: what it is fixed to; `SceneGraph.world_frame_id()` for one that stays.
        X_FM: its pose there.
    """

    id: int
    size: float
    frame: FrameId
    X_FM: RigidTransform


def placed_markers(
    marker_map: MarkerMap, frame: FrameId, X_FO: RigidTransform | None = None
) -> list[PlacedMarker]:
    """Returns the markers of a map whose frame O is fixed to `frame` at X_FO (identity)."""
    X_FO = X_FO or RigidTransform()
    return [PlacedMarker(m.id, m.size, frame, X_FO @ m.X_WM) for m in marker_map]


class MarkerProjector(SampledSensor):
    """Detects markers without a picture, from the true poses of camera and markers.

    .. pydrake_system::

        name: MarkerProjector
        input_ports:
        - query_object
        - active
        output_ports:
        - detections

    Args:
        camera: intrinsics.
        parent_frame: the frame P that carries the camera.
        X_PC: pose of the camera's optical frame in P.
        markers: what there is to be seen.
        family: of all markers.
        parameters: limits, noise and misses.
        rate: pictures a second, Hz.
        latency: from the picture to the arrival of its detections, s.
        clock_error: by how much the stamps are late on the clock of all others, s; at most the
            latency.
        seed: of the noise; numeric parameter 0 of the Context, so that a study may vary it.
        name: of the noise stream; one for each camera.
        frame_id: name of the optical frame in the messages.
        occluders: the role of the geometry that hides markers. Meshes hide as their convex hulls.
        transparent_frames: frames whose geometry hides nothing, such as a concave robot around
            its camera. (A camera inside a solid looks out of it anyway.)

    Ports:
        query_object (input, QueryObject): SceneGraph's `query`.
        active (input, vector of 1): while it is 0 nothing is looked for; may be left unconnected.
        detections (output, Detections): what was found in the picture, sampled at `rate`, sent
            `latency` later; the stamp is the picture's time. `hamming` is 0. `decision_margin` is
            NaN: contrast is not simulated. Before the first arrival the stamp is NaN.

    Only the five rays to the corners and the centre are tested: a pole between them hides nothing.

    Raises:
        ValueError: an id outside the family, or a size, rate, latency, clock error or seed out of
            range.
    """

    def __init__(
        self,
        *,
        camera: PinholeCamera,
        parent_frame: FrameId,
        X_PC: RigidTransform,
        markers: Sequence[PlacedMarker],
        family: Family,
        parameters: ProjectorParameters | None = None,
        rate: float = 30.0,
        latency: float = 0.0,
        clock_error: float = 0.0,
        seed: int = 0,
        name: str = "marker_projector",
        frame_id: str = "camera_optical",
        occluders: Role = Role.kPerception,
        transparent_frames: Collection[FrameId] = (),
    ) -> None:
        super().__init__()
        for marker in markers:
            family.check_id(marker.id)
            require_positive(**{f"size of marker {marker.id}": marker.size})
        self._camera = camera
        self._parent_frame = parent_frame
        self._X_PC = X_PC
        self._family = family
        self._parameters = parameters or ProjectorParameters()
        self._frame_id = frame_id
        self._ids = np.array([marker.id for marker in markers], np.int64)
        self._sizes = np.array([marker.size for marker in markers], float)
        self._frames = list(dict.fromkeys(marker.frame for marker in markers))
        self._frame_of_marker = np.array(
            [self._frames.index(marker.frame) for marker in markers], np.intp
        )
        self._X_FM = np.array([m.X_FM.GetAsMatrix34() for m in markers]).reshape(-1, 3, 4)
        self._noise = NoiseStream(self, seed=seed, name=name)
        self._solids = SolidsMemo(self, role=occluders, exclude_frames=transparent_frames)
        self._query_input = self.DeclareAbstractInputPort(
            "query_object", AbstractValue.Make(QueryObject())
        )
        self._detections_output = self._declare_sampling(
            name="detections",
            rate=rate,
            latency=latency,
            nothing=Detections(frame_id=frame_id, family=family.name),
            clock_error=clock_error,
            switchable=True,
        )

    def query_object_input_port(self) -> InputPort:
        """Returns the port of SceneGraph's query object."""
        return self._query_input

    def detections_output_port(self) -> OutputPort:
        """Returns the port of the detections."""
        return self._detections_output

    def _measure(self, context: Context, stamp: float, index: int) -> Detections:
        query_object: Any = self._query_input.Eval(context)
        X_WF = frame_poses(query_object, self._frames)[self._frame_of_marker]
        X_WM = X_WF[:, :, :3] @ self._X_FM
        X_WM[:, :, 3] += X_WF[:, :, 3]
        found, corners = project_markers(
            camera=self._camera,
            X_WC=query_object.GetPoseInWorld(self._parent_frame) @ self._X_PC,
            X_WM=X_WM,
            sizes=self._sizes,
            cells=self._family.cells,
            parameters=self._parameters,
            random=self._noise.generator(context, index),
            solids=self._solids(context, query_object),
        )
        return Detections(
            stamp=stamp,
            frame_id=self._frame_id,
            family=self._family.name,
            ids=self._ids[found],
            corners=corners,
            hamming=np.zeros(len(found), np.int64),
            decision_margin=np.full(len(found), np.nan),
        )
