"""Matches from true motion without a picture: what camera and point tracker would have found."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, EventStatus, InputPort, OutputPort, State

from systems.cameras import PinholeCamera
from systems.compiled import compiled, in_rows
from systems.flow.shell import meet_sphere, see
from systems.messages import PointMatches
from systems.noise import NoiseStream
from systems.plumb_bob import find_rays
from systems.sensors.sampled import SampledSensor
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]


@dataclass
class FlowProjectorParameters:
    """How many points are found again, and how well.

    Attributes:
        points: that are looked for in each picture.
        pixel_noise: standard deviation of a match, each coordinate, px.
        scale_error: all displacements are too long by this part; -0.02 for 2 % too short.
        point_dropout: part of the points that is lost at random.
        outlier_share: part of the matches that is wrong.
        outlier_px: standard deviation of a wrong one, px.
        picture_dropout: part of the pictures that gives no match at all.
    """

    points: int = 200
    pixel_noise: float = 0.1
    scale_error: float = 0.0
    point_dropout: float = 0.1
    outlier_share: float = 0.0
    outlier_px: float = 20.0
    picture_dropout: float = 0.0

    def __post_init__(self) -> None:
        require(self.points >= 1, "points", self.points, "1 or greater")
        require_non_negative(pixel_noise=self.pixel_noise, outlier_px=self.outlier_px)
        sound = math.isfinite(self.scale_error) and abs(self.scale_error) < 1
        require(sound, "scale_error", self.scale_error, "between -1 and 1")
        for name in ("point_dropout", "outlier_share", "picture_dropout"):
            value = getattr(self, name)
            require(0 <= value <= 1, name, value, "0 to 1")


def project_flow(
    *,
    camera: PinholeCamera,
    radius: float,
    X_RC_before: RigidTransform,
    X_RC: RigidTransform,
    parameters: FlowProjectorParameters,
    random: np.random.Generator,
) -> tuple[Array, Array]:
    """Returns what a tracker would find of points of a shell in two pictures.

    The points lie evenly in the earlier picture, anew each time, as corners that are looked for
    anew. Those that leave the picture, or the shell, are not found again.

    Args:
        camera: intrinsics.
        radius: of the shell, m.
        X_RC_before: pose of the optical frame at the earlier picture; R has its origin in the
            shell's centre.
        X_RC: at the later one.
        parameters: number, noise and losses.
        random: where they come from.

    Returns:
        (n, 2) px in the earlier picture, and (n, 2) px in the later one.
    """
    p, n = parameters, parameters.points
    places = random.random(1 + 2 * n)
    noise = random.standard_normal((n, 2))
    wrong = random.random(n)
    outliers = random.standard_normal((n, 2))
    dropped = random.random(n)
    if places[0] < p.picture_dropout:
        return np.empty((0, 2)), np.empty((0, 2))
    previous, current = np.empty((n, 2)), np.empty((n, 2))
    options = np.array(
        (p.pixel_noise, p.outlier_share, p.outlier_px, p.scale_error, p.point_dropout)
    )
    count = _match(
        float(camera.width), float(camera.height), *camera.matrices, camera.fold_radius,
        in_rows(X_RC_before.GetAsMatrix34(), 4), in_rows(X_RC.GetAsMatrix34(), 4), radius,
        options, places[1:], noise, wrong, outliers, dropped, previous, current,
    )  # fmt: skip
    return previous[:count], current[:count]


@compiled(
    "i8(f8, f8, f8[:,::1], f8[::1], f8, f8[:,::1], f8[:,::1], f8, f8[::1], f8[::1], f8[:,::1],"
    " f8[::1], f8[:,::1], f8[::1], f8[:,::1], f8[:,::1])"
)
def _match(
    width: float,
    height: float,
    K: Array,
    D: Array,
    fold_radius: float,
    before: Array,
    now: Array,
    radius: float,
    options: Array,
    places: Array,
    noise: Array,
    wrong: Array,
    outliers: Array,
    dropped: Array,
    previous: Array,
    current: Array,
) -> int:
    """Writes the matches of n points and returns how many they are.

    Args:
        width: of the picture, px.
        height: px.
        K: (3, 3) px.
        D: (5,).
        fold_radius: see `PinholeCamera`.
        before: (3, 4) pose of the optical frame in R.
        now: (3, 4).
        radius: m.
        options: noise (px), share and deviation (px) of outliers, scale error, share of losses.
        places: (2 n,) 0 to 1, where in the picture the points are.
        noise: (n, 2) of standard deviation 1.
        wrong: (n,) 0 to 1, which are outliers.
        outliers: (n, 2) of standard deviation 1.
        dropped: (n,) 0 to 1, which are lost.
        previous: (n, 2) the first of them written, px.
        current: (n, 2) the first of them written, px.
    """
    n = len(wrong)
    pixels, seen = np.empty((n, 2)), np.empty((n, 2))
    rays, by_ray, points = np.empty((n, 2)), np.empty((n, 2, 2)), np.empty((n, 3))
    for k in range(n):
        pixels[k, 0], pixels[k, 1] = places[2 * k] * width - 0.5, places[2 * k + 1] * height - 0.5
    find_rays(pixels, K, D, fold_radius, rays, by_ray)
    meet_sphere(rays, before[:, :3].copy(), before[:, 3].copy(), radius, points)
    see(points, now[:, :3].copy(), now[:, 3].copy(), K, D, fold_radius, seen)
    count = 0
    for k in range(n):
        if dropped[k] < options[4]:
            continue
        beyond = options[2] if wrong[k] < options[1] else 0.0
        u, v = pixels[k, 0], pixels[k, 1]
        x = u + (1 + options[3]) * (seen[k, 0] - u) + options[0] * noise[k, 0]
        y = v + (1 + options[3]) * (seen[k, 1] - v) + options[0] * noise[k, 1]
        x, y = x + beyond * outliers[k, 0], y + beyond * outliers[k, 1]
        if x >= -0.5 and y >= -0.5 and x <= width - 0.5 and y <= height - 0.5:  # NaN is not
            previous[count, 0], previous[count, 1] = u, v
            current[count, 0], current[count, 1] = x, y
            count += 1
    return count


class FlowProjector(SampledSensor):
    """Matches points of a spherical shell without a picture, from the camera's true motion.

    .. pydrake_system::

        name: FlowProjector
        input_ports:
        - pose
        output_ports:
        - matches

    Args:
        camera: intrinsics.
        radius: of the shell, m.
        parameters: number of points, noise, scale error and losses.
        rate: pictures a second, Hz.
        latency: from a picture to the arrival of its matches, s.
        clock_error: by how much the stamps are late on the clock of all others, s; at most the
            latency.
        seed: of the noise, a parameter of the Context.
        name: of the noise stream.
        frame_id: name of the optical frame in the messages.

    Ports:
        pose (input, RigidTransform): `X_RC`, of the camera's true optical frame; R has its origin
            in the shell's centre and turns with the shell.
        matches (output, PointMatches): of the last two pictures, sampled at `rate`, sent `latency`
            later; the stamp is the later picture's time by its clock, NaN before the second.
            Without a match (the camera looks past the shell, or the picture is lost) it has none.

    Raises:
        ValueError: radius, rate, latency, clock error or seed out of range.
    """

    def __init__(
        self,
        *,
        camera: PinholeCamera,
        radius: float = 0.075,
        parameters: FlowProjectorParameters | None = None,
        rate: float = 60.0,
        latency: float = 0.0,
        clock_error: float = 0.0,
        seed: int = 0,
        name: str = "flow_projector",
        frame_id: str = "camera_optical",
    ) -> None:
        super().__init__()
        require_positive(radius=radius)
        self._camera = camera
        self._radius = radius
        self._parameters = parameters or FlowProjectorParameters()
        self._frame_id = frame_id
        self._noise = NoiseStream(self, seed=seed, name=name)
        self._pose_input = self.DeclareAbstractInputPort(
            "pose", AbstractValue.Make(RigidTransform())
        )
        # Stamp, and rotation and position of the camera, row by row, at the last picture.
        self._last = self.DeclareDiscreteState(np.append(math.nan, np.eye(3, 4)))
        self._matches_output = self._declare_sampling(
            name="matches",
            rate=rate,
            latency=latency,
            nothing=PointMatches(frame_id=frame_id),
            clock_error=clock_error,
        )

    def pose_input_port(self) -> InputPort:
        """Returns the port of the camera's pose."""
        return self._pose_input

    def matches_output_port(self) -> OutputPort:
        """Returns the port of the matches."""
        return self._matches_output

    def _measure(self, context: Context, stamp: float, index: int) -> PointMatches:
        last = context.get_discrete_state(self._last).get_value()
        if math.isnan(last[0]):
            return PointMatches(frame_id=self._frame_id)
        previous, current = project_flow(
            camera=self._camera,
            radius=self._radius,
            X_RC_before=RigidTransform.MakeUnchecked(last[1:].reshape(3, 4)),
            X_RC=self._pose_input.Eval(context),
            parameters=self._parameters,
            random=self._noise.generator(context, index),
        )
        return PointMatches(stamp, float(last[0]), self._frame_id, previous, current)

    def _take(self, context: Context, state: State) -> EventStatus:
        status = super()._take(context, state)
        X_RC: RigidTransform = self._pose_input.Eval(context)
        last = state.get_mutable_discrete_state().get_mutable_value(self._last)
        last[0] = self._stamp(context.get_time())
        last[1:] = X_RC.GetAsMatrix34().ravel()
        return status
