"""A turning lidar that looks at the scene: an RPLIDAR A1M8 unless told otherwise.

Figures of the A1M8 are from its datasheet: SLAMTEC, "RPLIDAR A1, introduction and datasheet, model
A1M8" (table "Measurement performance"): 0.15 to 12 m on white objects, 0 to 360 degrees, 1 degree
at 5.5 turns a second, at most 10 turns and 8000 samples a second, distance resolution below 0.5 mm
(below 1.5 m) and below 1 % of the distance (everywhere). It gives no noise, no drop-out rate, no
divergence of the beam and no limits for dark or tilted surfaces: those defaults are ours.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import FrameId, QueryObject, Role
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, EventStatus, InputPort, OutputPort, State

from systems.compiled import compiled, packed
from systems.messages import Scan, whole_nanoseconds
from systems.noise import NoiseStream
from systems.raycasting import SolidsMemo
from systems.sensors.lidar_beams import Beams, cast_beams
from systems.sensors.sampled import SampledSensor
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

_MAX_SAMPLES = 8000  # a second, of the A1M8


@dataclass
class LidarParameters:
    """What a lidar of the A1M8's kind measures, and how well.

    Attributes:
        rate: turns a second, 5.5 to 10 Hz.
        rays: in a turn, evenly spread; with the rate at most 8000 a second.
        range_min: nearest distance that it measures, m.
        range_max: farthest, of a white surface that faces it, m.
        range_noise: constant part of the standard deviation of a range, m; by default the
            resolution of 0.5 mm.
        range_noise_part: the part that grows with the range, m/m; the variances add. By default
            three standard deviations are the resolution of 1 % of the distance.
        dropout_probability: part of the rays that fail at random.
        reflectivity: of all surfaces, white being 1. A matt surface (Lambert's law) that fills the
            beam sends back light in proportion to reflectivity * cos(incidence) / range^2, so it is
            lost beyond range_max * sqrt(reflectivity * cos(incidence)).
        beam_divergence: full angle of the beam, rad.
        mixed_share: part of the beams over an edge that report a point between the two surfaces.
    """

    rate: float = 5.5
    rays: int = 360
    range_min: float = 0.15
    range_max: float = 12.0
    range_noise: float = 0.0005
    range_noise_part: float = 0.0033
    dropout_probability: float = 0.005
    reflectivity: float = 1.0
    beam_divergence: float = 0.005
    mixed_share: float = 0.5

    def __post_init__(self) -> None:
        require(5.5 <= self.rate <= 10.0, "rate", self.rate, "5.5 to 10 turns a second")
        most = int(_MAX_SAMPLES / self.rate)
        require(4 <= self.rays <= most, "rays", self.rays, f"4 to {most} at {self.rate:g} Hz")
        require_positive(range_min=self.range_min, range_max=self.range_max)
        require(self.range_min < self.range_max, "range_min", self.range_min, "less than range_max")
        require_non_negative(range_noise=self.range_noise, range_noise_part=self.range_noise_part)
        for name in ("dropout_probability", "mixed_share"):
            value = getattr(self, name)
            require(0 <= value <= 1, name, value, "0 to 1")
        require(0 < self.reflectivity <= 1, "reflectivity", self.reflectivity, "above 0, up to 1")
        widest = 2 * np.pi / self.rays
        require(
            0 < self.beam_divergence <= widest,
            "beam_divergence",
            self.beam_divergence,
            f"above 0, up to the step between rays, {widest:.4f} rad",
        )


def single(value: float) -> float:
    """Rounds to single precision, in which `sensor_msgs/LaserScan` keeps its numbers.

    The lidar gives nothing finer, so that a scan read back from a recording is the same.
    """
    return float(np.float32(value))


def turn_of(parameters: LidarParameters, *, end: float, frame_id: str) -> Scan:
    """Returns the empty scan of a turn whose last ray is measured at `end` (s).

    The first ray points backward (-pi), the others follow to the left.
    """
    n = parameters.rays
    time_increment = single(1 / (parameters.rate * n))
    return Scan(
        stamp=whole_nanoseconds(end - (n - 1) * time_increment),
        frame_id=frame_id,
        angle_min=single(-np.pi),
        angle_increment=single(2 * np.pi / n),
        time_increment=time_increment,
        range_min=single(parameters.range_min),
        range_max=single(parameters.range_max),
        ranges=np.full(n, np.nan),
    )


def incidence_cosine(ranges: Array, divergence: float) -> Array:
    """Returns the cosine of the angle between beam and surface normal, in the scan plane: (n,).

    On a plane the inverse range is a sinusoid of the ray's angle, so three ranges tell its phase:
    (r / r_right - r / r_left) / (2 sin(divergence / 2)) is the tangent of the incidence. NaN where
    one of them is inf, or where they lie on several surfaces as they may.

    Args:
        ranges: (n, 3) m, as of `Beams`.
        divergence: full angle between the outer ones, rad.
    """
    return np.array([_incidence_cosine(a, b, c, divergence) for a, b, c in ranges.tolist()])


@compiled("f8(f8, f8, f8, f8)")
def _incidence_cosine(right: float, middle: float, left: float, divergence: float) -> float:
    if not (math.isfinite(right) and math.isfinite(middle) and math.isfinite(left)):
        return math.nan
    tangent = (middle / right - middle / left) / (2 * math.sin(divergence / 2))
    return 1 / math.sqrt(1 + tangent * tangent)


def measured_ranges(
    beams: Beams, parameters: LidarParameters, random: np.random.Generator
) -> Array:
    """Returns what the lidar says of the beams: (n,) m, in single precision.

    inf where nothing is in reach; NaN where the measurement failed: at random, nearer than
    range_min, or too little light came back. A beam over an edge (its two outer rays end on
    different solids; a convex solid hides no part of itself) may report a point between them. Its
    place is drawn evenly in the inverse range, since that is what a triangulating lidar sees: the
    light of both surfaces, averaged on its detector.

    The numbers are drawn in one order and number whatever the parameters, so a study of one of them
    sees the same noise.

    Args:
        beams: what they fall on.
        parameters: limits and noise.
        random: where the noise comes from.
    """
    p = parameters
    n = len(beams.ranges)
    noise = random.standard_normal(n)
    dropped, mixed, share = random.random((3, n))
    limits = np.array(
        (
            single(p.range_min), p.range_max, single(p.range_max), p.range_noise,
            p.range_noise_part, p.dropout_probability, p.reflectivity, p.beam_divergence,
            p.mixed_share,
        )
    )  # fmt: skip
    ranges = np.empty(n)
    _measure_ranges(
        packed(beams.ranges), np.array(beams.solids), noise, dropped, mixed, share, limits, ranges
    )
    return ranges


@compiled(
    "void(f8[:,::1], i8[:,::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1])",
)
def _measure_ranges(
    beams: Array,
    solids: NDArray[np.intp],
    noise: Array,
    dropped: Array,
    mixed: Array,
    share: Array,
    limits: Array,
    ranges: Array,
) -> None:
    """Writes what the lidar says of beams (n, 3) m on solids (n, 3), by (n,) random numbers each.

    The limits are least range, range, the same in single precision, constant and growing noise,
    drop-out probability, reflectivity, divergence and share of mixed beams.
    """
    least, reach, most, noise_least, noise_part = limits[:5]
    dropout, reflectivity, divergence, mixed_share = limits[5:]
    for k in range(len(beams)):
        right, middle, left = beams[k]
        nothing = math.isinf(middle)
        cosine = 1.0
        if solids[k, 0] == solids[k, 1] == solids[k, 2]:
            cosine = _incidence_cosine(right, middle, left, divergence)
        failed = middle > reach * math.sqrt(reflectivity * cosine) or dropped[k] < dropout
        distance = middle
        finite = math.isfinite(right) and math.isfinite(middle) and math.isfinite(left)
        if solids[k, 0] != solids[k, 2] and finite and mixed[k] < mixed_share:
            distance = 1 / (share[k] / right + (1 - share[k]) / left)
        deviation = math.hypot(noise_least, 0.0 if nothing else noise_part * distance)
        distance = float(np.float32(distance + deviation * noise[k]))
        if distance < least:
            failed = True
        ranges[k] = math.inf if distance > most else distance
        if failed and not nothing:
            ranges[k] = math.nan


class Lidar(SampledSensor):
    """Turns and measures the distance of what stands around, a scan a turn.

    .. pydrake_system::

        name: Lidar
        input_ports:
        - query_object
        - spatial_velocity
        output_ports:
        - scan

    Args:
        parent_frame: geometry frame of the body that carries the lidar.
        X_PL: pose of the lidar in the body; it scans its xy-plane.
        parameters: rate, limits and noise.
        latency: from the last ray to the arrival of the scan, s.
        seed: of the noise, a parameter of the Context.
        name: of the noise stream; one for each lidar.
        frame_id: of the lidar, for the messages.
        role: of the geometry that it sees. Meshes count as their convex hulls.
        transparent_frames: frames whose geometry it looks through, such as the robot's own.

    Ports:
        query_object (input, QueryObject): SceneGraph's `query`.
        spatial_velocity (input, vector of 6): of the body in W, rotation first (rad/s, m/s).
        scan (output, Scan): the last whole turn, at the parameters' rate, `latency` after its last
            ray; the stamp is the time of the first ray. Ranges are inf where nothing is in reach
            and NaN where the measurement failed. Before the first arrival it has no rays and its
            stamp is NaN.

    The body's way during the turn is that of its velocity at the last ray, taken as steady; the
    world stands still meanwhile. The rays go round to the left, as the message lists them. A real
    A1M8 turns clockwise, seen from above: a scan taken on the move is bent the other way, as much.
    It also reports a missing and a failed measurement alike (as 0), which are told apart here.

    Raises:
        ValueError: latency or seed out of range.
    """

    def __init__(
        self,
        *,
        parent_frame: FrameId,
        X_PL: RigidTransform,
        parameters: LidarParameters | None = None,
        latency: float = 0.0,
        seed: int = 0,
        name: str = "lidar",
        frame_id: str = "lidar",
        role: Role = Role.kProximity,
        transparent_frames: Collection[FrameId] = (),
    ) -> None:
        super().__init__()
        self._parameters = parameters or LidarParameters()
        self._parent = parent_frame
        self._X_PL = X_PL
        self._frame_id = frame_id
        self._noise = NoiseStream(self, seed=seed, name=name)
        self._solids = SolidsMemo(self, role=role, exclude_frames=transparent_frames)
        self._query_input = self.DeclareAbstractInputPort(
            "query_object", AbstractValue.Make(QueryObject())
        )
        self._velocity_input = self.DeclareVectorInputPort("spatial_velocity", 6)
        self._scan_output = self._declare_sampling(
            name="scan",
            rate=self._parameters.rate,
            latency=latency,
            nothing=Scan(frame_id=frame_id),
        )

    def query_object_input_port(self) -> InputPort:
        """Returns the port of the geometry."""
        return self._query_input

    def spatial_velocity_input_port(self) -> InputPort:
        """Returns the port of the body's velocity."""
        return self._velocity_input

    def scan_output_port(self) -> OutputPort:
        """Returns the port of the scans."""
        return self._scan_output

    def _take(self, context: Context, state: State) -> EventStatus:
        if context.get_time() * self.rate < 0.5:  # at the start no turn is behind it
            return EventStatus.DidNothing()
        return super()._take(context, state)

    def _measure(self, context: Context, stamp: float, index: int) -> Scan:
        query: Any = self._query_input.Eval(context)
        X_WP = query.GetPoseInWorld(self._parent)
        velocity = self._velocity_input.Eval(context).reshape(2, 3)
        turn = turn_of(self._parameters, end=stamp, frame_id=self._frame_id)
        beams = cast_beams(
            turn,
            self._solids(context, query),
            X_WP,
            self._X_PL,
            twist=(velocity @ X_WP.rotation().matrix()).ravel(),
            divergence=self._parameters.beam_divergence,
        )
        random = self._noise.generator(context, index)
        return replace(turn, ranges=measured_ranges(beams, self._parameters, random))
