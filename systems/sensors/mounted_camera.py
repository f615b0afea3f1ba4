"""What cameras that make pictures of a scene share: mounting, exposure, sampling."""

from __future__ import annotations

import math
from abc import abstractmethod

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import FrameId, QueryObject
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, InputPort, OutputPort

from systems.image_effects import ImageEffects, expose
from systems.markers.pnp import rotation_from_vector
from systems.messages import CameraImage
from systems.noise import NoiseStream
from systems.sensors.sampled import SampledSensor
from systems.validation import require

Image = NDArray[np.uint8]


class MountedCamera(SampledSensor):
    """Base of the cameras fixed to a body: a subclass implements `_picture`.

    It has the inputs `query_object`, `spatial_velocity` and `active` and the output `image`.

    Args:
        parent_frame: geometry frame of the body that carries the camera.
        X_PC: pose of the optical frame in the body.
        rate: pictures a second, Hz.
        latency: from the middle of the exposure to arrival, s.
        clock_error: by how much the stamps are late on the clock of all others, s; at most the
            latency.
        effects: lens, exposure and noise.
        clipping: nearest and farthest distance that are seen, m.
        seed: of the noise, a parameter of the Context.
        name: of the noise stream.
        frame_id: of the optical frame, for the messages.

    Raises:
        ValueError: rate, latency, clock error, clipping or seed out of range.
    """

    def __init__(
        self,
        *,
        parent_frame: FrameId,
        X_PC: RigidTransform,
        rate: float,
        latency: float,
        clock_error: float,
        effects: ImageEffects | None,
        clipping: tuple[float, float],
        seed: int,
        name: str,
        frame_id: str,
    ) -> None:
        super().__init__()
        near, far = clipping
        sound = 0 < near < far and math.isfinite(far)
        require(sound, "clipping", clipping, "two distances in metres, 0 < near < far")
        self._effects = effects or ImageEffects()
        self._parent = parent_frame
        self._X_PC = X_PC
        self._frame_id = frame_id
        self._noise = NoiseStream(self, seed=seed, name=name)
        self._query_input = self.DeclareAbstractInputPort(
            "query_object", AbstractValue.Make(QueryObject())
        )
        self._velocity_input = self.DeclareVectorInputPort("spatial_velocity", 6)
        self._image_output = self._declare_sampling(
            name="image",
            rate=rate,
            latency=latency,
            nothing=CameraImage(frame_id=frame_id),
            clock_error=clock_error,
            switchable=True,
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

    @abstractmethod
    def _picture(self, context: Context, query: QueryObject, poses: list[RigidTransform]) -> Image:
        """Returns the mean of what is seen from poses `X_PC`, before focus, gain and noise."""

    def _measure(self, context: Context, stamp: float, index: int) -> CameraImage:
        query = self._query_input.Eval(context)
        image = self._picture(context, query, self._poses(context, query))
        image = expose(image, self._effects, self._noise.generator(context, index))
        return CameraImage(stamp=stamp, frame_id=self._frame_id, data=image)

    def _poses(self, context: Context, query: QueryObject) -> list[RigidTransform]:
        """Returns `X_PC` during an exposure whose middle is now, in the body as it is now."""
        n = self._effects.exposure_samples
        if n == 1:
            return [self._X_PC]
        velocity = self._velocity_input.Eval(context)
        R_PW = query.GetPoseInWorld(self._parent).rotation().matrix().T
        w_P, v_P = R_PW @ velocity[:3], R_PW @ velocity[3:]
        times = self._effects.exposure * ((np.arange(n) + 0.5) / n - 0.5)
        return [
            RigidTransform(RotationMatrix(rotation_from_vector(w_P * dt)), v_P * dt) @ self._X_PC
            for dt in times
        ]
