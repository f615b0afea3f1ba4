"""Ultrasonic range finders around a robot: HC-SR04s unless told otherwise.

Figures of the HC-SR04 are from its user guide (Elec Freaks, "Ultrasonic Ranging Module HC-SR04"):
0.02 to 4 m, resolution 3 mm, angle of measurement 15 degrees, a cycle of at least 60 ms. It gives
no noise beyond the resolution and no rate of lost echoes: those defaults are ours.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import FrameId, QueryObject, Role
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, InputPort, OutputPort

from systems.messages import Scan
from systems.noise import NoiseStream
from systems.raycasting import Solids, SolidsMemo
from systems.sensors.lidar import single
from systems.sensors.sampled import SampledSensor
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]


@dataclass
class UltrasonicParameters:
    """How many range finders there are, and how well they measure.

    Attributes:
        rate: cycles a second, in each of which all of them measure, Hz.
        sensors: how many, evenly around the robot; the first looks ahead, the others follow to the
            left.
        offset: of their faces from the middle, m; ranges count from the faces.
        half_angle: from the axis of a cone to its edge, rad.
        rings: of rays in a cone, besides the axis; the more, the thinner are the posts that none
            of them misses.
        range_min: nearest distance that is measured, m.
        range_max: farthest, m.
        range_noise: constant part of the standard deviation of a range, m.
        range_noise_part: the part that grows with the range, m/m; the variances add.
        resolution: ranges are told in steps of it, m; 0 for no steps.
        dropout_probability: part of the echoes that are lost: then there seems to be nothing.
    """

    rate: float = 10.0
    sensors: int = 8
    offset: float = 0.1
    half_angle: float = math.radians(7.5)
    rings: int = 3
    range_min: float = 0.02
    range_max: float = 4.0
    range_noise: float = 0.003
    range_noise_part: float = 0.003
    resolution: float = 0.003
    dropout_probability: float = 0.01

    def __post_init__(self) -> None:
        require_positive(rate=self.rate, range_min=self.range_min, range_max=self.range_max)
        require(self.range_min < self.range_max, "range_min", self.range_min, "less than range_max")
        require(1 <= self.sensors <= 64, "sensors", self.sensors, "1 to 64")
        require(1 <= self.rings <= 16, "rings", self.rings, "1 to 16")
        require(
            0 < self.half_angle < math.pi / 4, "half_angle", self.half_angle, "between 0 and pi / 4"
        )
        require_non_negative(
            offset=self.offset,
            range_noise=self.range_noise,
            range_noise_part=self.range_noise_part,
            resolution=self.resolution,
        )
        chance = self.dropout_probability
        require(0 <= chance <= 1, "dropout_probability", chance, "0 to 1")


def cone_rays(half_angle: float, rings: int) -> Array:
    """Returns the directions (1 + 3 rings (rings + 1), 3) of a cone about x: 6 k on the k-th ring.

    Args:
        half_angle: of the cone, whose edge is the last ring, rad.
        rings: besides the axis.
    """
    rays = [np.array([[1.0, 0.0, 0.0]])]
    for k in range(1, rings + 1):
        tilt = half_angle * k / rings
        # The first of a ring points to the left, so that the cone reaches its edge in the plane.
        turn = 2 * np.pi * np.arange(6 * k) / (6 * k)
        ring = np.stack([np.ones(6 * k), np.cos(turn), np.sin(turn)], axis=-1)
        rays.append(ring * [np.cos(tilt), np.sin(tilt), np.sin(tilt)])
    return np.concatenate(rays)


def true_ranges(solids: Solids, X_WU: RigidTransform, parameters: UltrasonicParameters) -> Array:
    """Returns the distance of the nearest surface in the cone of each range finder.

    Args:
        solids: what sends an echo.
        X_WU: pose of the middle of the range finders: x ahead, y left.
        parameters: how they are arranged.

    Returns:
        (n,) m from the faces; inf where nothing is within range_max.
    """
    p = parameters
    angles = 2 * np.pi * np.arange(p.sensors) / p.sensors
    c, s = np.cos(angles), np.sin(angles)
    zero = np.zeros_like(c)
    turns = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1], axis=-1).reshape(-1, 3, 3)
    R = X_WU.rotation().matrix() @ turns
    rays = cone_rays(p.half_angle, p.rings)
    directions = np.einsum("nij,kj->nki", R, rays)
    faces = X_WU.translation() + p.offset * R[:, :, 0]
    origins = np.repeat(faces, len(rays), axis=0)
    ranges = solids.first_hit(origins, directions.reshape(-1, 3), p.range_max)
    return np.asarray(ranges.reshape(p.sensors, -1).min(axis=1))


def measured_ranges(
    ranges: Array, parameters: UltrasonicParameters, random: np.random.Generator
) -> Array:
    """Returns what the range finders say: (n,) m in single precision; inf where nothing is heard.

    What is nearer than range_min is told as range_min: the echo comes while the sensor still rings.
    """
    p = parameters
    noise, dropped = random.standard_normal(len(ranges)), random.random(len(ranges))
    heard = np.isfinite(ranges) & (dropped >= p.dropout_probability)
    told = np.where(heard, ranges, 0.0)
    told = told + np.hypot(p.range_noise, p.range_noise_part * told) * noise
    if p.resolution > 0:
        told = np.rint(told / p.resolution) * p.resolution
    heard &= told <= p.range_max
    told = np.maximum(told, p.range_min).astype(np.float32).astype(float)
    return np.where(heard, told, np.inf)


class UltrasonicRing(SampledSensor):
    """Measures how near something stands, in wide cones around a robot.

    .. pydrake_system::

        name: UltrasonicRing
        input_ports:
        - query_object
        output_ports:
        - scan

    Args:
        parent_frame: geometry frame of the body that carries them.
        X_PU: pose of their middle in the body: x ahead, y left.
        parameters: arrangement, limits and noise.
        latency: from the measurement to its arrival, s.
        seed: of the noise, a parameter of the Context.
        name: of the noise stream; one for each robot.
        frame_id: of their middle, for the messages.
        role: of the geometry that sends echoes. Meshes count as their convex hulls.
        transparent_frames: frames whose geometry is not heard, such as the robot's own.

    Ports:
        query_object (input, QueryObject): SceneGraph's `query`.
        scan (output, Scan): at the parameters' rate; ray i is the axis of range finder i, and its
            range that of the nearest surface anywhere in the cone, from the face, which is the
            parameters' `offset` from the scan's frame. inf where nothing is heard. Before the first
            arrival it has no rays and its stamp is NaN.

    All measure at once and do not hear each other. A surface echoes whatever its tilt; a real one
    that is smooth and tilted by more than the cone's half angle reflects the sound away.

    Raises:
        ValueError: latency or seed out of range.
    """

    def __init__(
        self,
        *,
        parent_frame: FrameId,
        X_PU: RigidTransform,
        parameters: UltrasonicParameters | None = None,
        latency: float = 0.0,
        seed: int = 0,
        name: str = "ultrasonic",
        frame_id: str = "ultrasonic",
        role: Role = Role.kProximity,
        transparent_frames: Collection[FrameId] = (),
    ) -> None:
        super().__init__()
        self._parameters = parameters or UltrasonicParameters()
        self._parent = parent_frame
        self._X_PU = X_PU
        self._frame_id = frame_id
        self._noise = NoiseStream(self, seed=seed, name=name)
        self._solids = SolidsMemo(self, role=role, exclude_frames=transparent_frames)
        self._query_input = self.DeclareAbstractInputPort(
            "query_object", AbstractValue.Make(QueryObject())
        )
        self._scan_output = self._declare_sampling(
            name="scan",
            rate=self._parameters.rate,
            latency=latency,
            nothing=Scan(frame_id=frame_id),
        )

    def query_object_input_port(self) -> InputPort:
        """Returns the port of the geometry."""
        return self._query_input

    def scan_output_port(self) -> OutputPort:
        """Returns the port of the ranges."""
        return self._scan_output

    def _measure(self, context: Context, stamp: float, index: int) -> Scan:
        p = self._parameters
        query: Any = self._query_input.Eval(context)
        X_WU = query.GetPoseInWorld(self._parent) @ self._X_PU
        ranges = true_ranges(self._solids(context, query), X_WU, p)
        return Scan(
            stamp=stamp,
            frame_id=self._frame_id,
            angle_min=0.0,
            angle_increment=single(2 * math.pi / p.sensors),
            time_increment=0.0,
            range_min=single(p.range_min),
            range_max=single(p.range_max),
            ranges=measured_ranges(ranges, p, self._noise.generator(context, index)),
        )
