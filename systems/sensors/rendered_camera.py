"""A camera on Drake's renderer."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    FrameId,
    QueryObject,
    RenderCameraCore,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, InputPort, OutputPort

from systems.cameras import PinholeCamera
from systems.image_effects import ImageEffects, Lens, expose, linear_light
from systems.markers.pnp import rotation_from_vector
from systems.messages import CameraImage
from systems.noise import NoiseStream
from systems.sensors.sampled import SampledSensor
from systems.validation import require

Image = NDArray[np.uint8]


class RenderedCamera(SampledSensor):
    """Renders what a camera fixed to a body sees, then does what lens and sensor do to it.

    .. pydrake_system::

        name: RenderedCamera
        input_ports:
        - query_object
        - spatial_velocity
        output_ports:
        - image

    Args:
        camera: the calibrated camera; with distortion, a wider ideal picture is rendered and bent.
        parent_frame: geometry frame of the body that carries the camera.
        X_PC: pose of the optical frame in the body.
        renderer: name of the renderer in the SceneGraph.
        rate: pictures a second, Hz.
        latency: from the middle of the exposure to arrival, s.
        effects: lens, exposure and noise.
        clipping: nearest and farthest distance that is drawn, m.
        seed: of the noise, a parameter of the Context.
        name: of the noise stream.
        frame_id: of the optical frame, for the messages.

    Ports:
        query_object (input, QueryObject): SceneGraph's `query`.
        spatial_velocity (input, vector of 6): of the body in W, rotation first (rad/s, m/s); needed
            only for motion blur (exposure_samples > 1).
        image (output, CameraImage): uint8 grey or RGB, at `rate`, `latency` after its stamp; a
            picture of size 0 with stamp NaN before the first.

    Pixels count from the centre of the first pixel (see `systems.cameras`). The world stands still
    during an exposure; the camera moves by its body's velocity.

    Raises:
        ValueError: rate, latency, clipping or seed out of range, or a distortion that cannot be
            inverted in the picture.
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
        effects: ImageEffects | None = None,
        clipping: tuple[float, float] = (0.01, 50.0),
        seed: int = 0,
        name: str = "camera",
        frame_id: str = "camera",
    ) -> None:
        super().__init__()
        near, far = clipping
        sound = 0 < near < far and math.isfinite(far)
        require(sound, "clipping", clipping, "two distances in metres, 0 < near < far")
        self._effects = effects or ImageEffects()
        self._lens = Lens(camera, self._effects.supersampling)
        self._parent = parent_frame
        self._X_PC = X_PC
        self._frame_id = frame_id
        core = RenderCameraCore(
            renderer, self._lens.ideal.to_drake(), ClippingRange(*clipping), RigidTransform()
        )
        self._render_camera = ColorRenderCamera(core, False)
        self._noise = NoiseStream(self, seed=seed, name=name)
        self._query_input = self.DeclareAbstractInputPort(
            "query_object", AbstractValue.Make(QueryObject())
        )
        self._velocity_input = self.DeclareVectorInputPort("spatial_velocity", 6)
        self._image_output = self._declare_sampling(
            name="image", rate=rate, latency=latency, nothing=CameraImage(frame_id=frame_id)
        )

    def query_object_input_port(self) -> InputPort:
        """Returns the port of the geometry."""
        return self._query_input

    def spatial_velocity_input_port(self) -> InputPort:
        """Returns the port of the body's velocity."""
        return self._velocity_input

    def image_output_port(self) -> OutputPort:
        """Returns the port of the pictures."""
        return self._image_output

    def _measure(self, context: Context, stamp: float, index: int) -> CameraImage:
        query = self._query_input.Eval(context)
        if self._effects.exposure_samples > 1:
            image = self._moving(context, query)
        else:
            image = self._render(query, self._X_PC)
        image = expose(image, self._effects, self._noise.generator(context, index))
        return CameraImage(stamp=stamp, frame_id=self._frame_id, data=image)

    def _render(self, query: QueryObject, X_PC: RigidTransform) -> Image:
        rgba = query.RenderColorImage(self._render_camera, self._parent, X_PC).data
        code = cv2.COLOR_RGBA2GRAY if self._effects.grey else cv2.COLOR_RGBA2RGB
        return self._lens(linear_light(cv2.cvtColor(rgba, code)))

    def _moving(self, context: Context, query: QueryObject) -> Image:
        """Averages pictures over an exposure whose middle is now."""
        velocity = self._velocity_input.Eval(context)
        R_WP = query.GetPoseInWorld(self._parent).rotation().matrix()
        w_P, v_P = R_WP.T @ velocity[:3], R_WP.T @ velocity[3:]
        n = self._effects.exposure_samples
        total: NDArray[np.float32] | None = None
        for k in range(n):
            dt = self._effects.exposure * ((k + 0.5) / n - 0.5)
            # The body's pose dt from now, in the body now.
            X_PP = RigidTransform(RotationMatrix(rotation_from_vector(w_P * dt)), v_P * dt)
            image = self._render(query, X_PP.multiply(self._X_PC)).astype(np.float32)
            total = image if total is None else total + image
        assert total is not None
        return np.rint(total / n).astype(np.uint8)
