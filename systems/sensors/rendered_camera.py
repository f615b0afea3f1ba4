"""A camera on Drake's renderer."""

from __future__ import annotations

import cv2
import numpy as np
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    FrameId,
    QueryObject,
    RenderCameraCore,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from systems.cameras import PinholeCamera
from systems.image_effects import ImageEffects, Lens, linear_light
from systems.sensors.mounted_camera import Image, MountedCamera


class RenderedCamera(MountedCamera):
    """Renders what a camera fixed to a body sees, then does what lens and sensor do to it.

    .. pydrake_system::

        name: RenderedCamera
        input_ports:
        - query_object
        - spatial_velocity
        - active
        output_ports:
        - image

    Args:
        camera: the calibrated camera; with distortion, a wider ideal picture is rendered and bent.
        parent_frame: geometry frame of the body that carries the camera.
        X_PC: pose of the optical frame in the body.
        renderer: name of the renderer in the SceneGraph.
        rate: pictures a second, Hz.
        latency: from the middle of the exposure to arrival, s.
        clock_error: by how much the stamps are late on the clock of all others, s; at most the
            latency.
        effects: lens, exposure and noise.
        clipping: nearest and farthest distance that is drawn, m.
        seed: of the noise, a parameter of the Context.
        name: of the noise stream.
        frame_id: of the optical frame, for the messages.

    Ports:
        query_object (input, QueryObject): SceneGraph's `query`.
        spatial_velocity (input, vector of 6): of the body in W, rotation first (rad/s, m/s); needed
            only for motion blur (exposure_samples > 1).
        active (input, vector of 1): while it is 0 no pictures are taken; may be left unconnected.
        image (output, CameraImage): uint8 grey or RGB, at `rate`, `latency` after its stamp; a
            picture of size 0 with stamp NaN before the first.

    Pixels count from the centre of the first pixel (see `systems.cameras`). The world stands still
    during an exposure; the camera moves by its body's velocity.

    Raises:
        ValueError: rate, latency, clock error, clipping or seed out of range, or a distortion that
            cannot be inverted in the picture.
    """

    def __init__(
        self,
        *,
        camera: PinholeCamera,
        parent_frame: FrameId,
        X_PC: RigidTransform,
        renderer: str,
        rate: float,
        latency: float = 0.0,
        clock_error: float = 0.0,
        effects: ImageEffects | None = None,
        clipping: tuple[float, float] = (0.01, 50.0),
        seed: int = 0,
        name: str = "camera",
        frame_id: str = "camera",
    ) -> None:
        super().__init__(
            parent_frame=parent_frame,
            X_PC=X_PC,
            rate=rate,
            latency=latency,
            clock_error=clock_error,
            effects=effects,
            clipping=clipping,
            seed=seed,
            name=name,
            frame_id=frame_id,
        )
        self._lens = Lens(camera, self._effects.supersampling)
        core = RenderCameraCore(
            renderer, self._lens.ideal.to_drake(), ClippingRange(*clipping), RigidTransform()
        )
        self._render_camera = ColorRenderCamera(core, False)

    def _picture(self, context: Context, query: QueryObject, poses: list[RigidTransform]) -> Image:
        del context
        if len(poses) == 1:
            return self._render(query, poses[0])
        total = sum(self._render(query, X_PC).astype(np.float32) for X_PC in poses)
        return np.rint(total / len(poses)).astype(np.uint8)

    def _render(self, query: QueryObject, X_PC: RigidTransform) -> Image:
        rgba = query.RenderColorImage(self._render_camera, self._parent, X_PC).data
        code = cv2.COLOR_RGBA2GRAY if self._effects.grey else cv2.COLOR_RGBA2RGB
        return self._lens(linear_light(cv2.cvtColor(rgba, code)))
