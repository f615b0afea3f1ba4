"""A circuit with tags, and a robot that slips, sees and turns on it: for the tests of replay.

Robot, gyro, camera and what is measured know nothing of the blocks under test.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
    State,
)
from pydrake.systems.primitives import LogVectorOutput

from systems.angles import spatial_pose, wrap
from systems.cameras import PinholeCamera
from systems.estimators.planar_ekf import PlanarEkf, PlanarEkfParameters
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap
from systems.markers.localizer import Localizer, MapLocalizer
from systems.markers.projector import ProjectorParameters, project_markers
from systems.messages import Detections
from systems.planners.route import Route

Array = NDArray[np.float64]

RATE = 100.0  # Hz, of robot and gyro
CONTROL = 20.0  # Hz
CAMERA = PinholeCamera.from_focal_length(640, 480, 480.0)
X_BC = RigidTransform(
    RotationMatrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])),
    [0.1, 0.0, 0.2],
)
WANDER, WANDER_TIME = 0.5, 1.0  # of the slip: standard deviation by its mean, correlation time, s
_TICKS = 20000  # of which noise is at hand
FAMILY = family("36h11")


@dataclass(frozen=True, eq=False)
class Circuit:
    """A closed route and the tags beside it."""

    route: Route
    tags: MarkerMap


def circuit(seed: int = 0, *, length: float = 15.0, tags: int = 24, speed: float = 0.5) -> Circuit:
    """An uneven oval with tags outside it that look against the route, turned toward it."""
    rng = np.random.default_rng(seed)
    a = np.linspace(0, 2 * math.pi, 4000, endpoint=False)
    z = 2.9 * np.cos(a) + 1.8j * np.sin(a)
    for k in (2, 3):
        wave = rng.uniform(-1, 1) * np.cos(k * a) + rng.uniform(-1, 1) * np.sin(k * a)
        z *= 1 + 0.16 / k * wave
    if seed % 2:
        z = z.conj()  # to the right
    z *= length / np.abs(np.diff(z, append=z[:1])).sum()
    run = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(z, append=z[:1])))])
    around = np.append(z, z[0])

    def at(s: Array) -> Array:
        s = s % run[-1]
        return np.interp(s, run, around.real) + 1j * np.interp(s, run, around.imag)

    def ahead(s: Array) -> Array:
        along = at(s + 0.02) - at(s - 0.02)
        return along / np.abs(along)

    n = round(run[-1] / speed / 0.05)
    s = run[-1] / n * np.arange(n)
    theta = np.unwrap(np.angle(ahead(s)))
    turned = np.angle(ahead(s + 0.05) / ahead(s - 0.05))
    place = at(s)
    v = run[-1] / n / 0.05
    route = Route(
        0.05 * np.arange(n), place.real, place.imag, theta, np.full(n, v), turned / 0.1 * v,
        closed=True,
    )  # fmt: skip
    outside = -1.0 if seed % 2 == 0 else 1.0
    spot = run[-1] / tags * np.arange(tags) + rng.uniform(-0.1, 0.1, tags)
    away, height = rng.uniform(0.5, 0.9, tags), rng.uniform(0.15, 0.45, tags)
    where = at(spot) + outside * 1j * ahead(spot) * away
    normal = -ahead(spot) * np.exp(1j * outside * math.radians(35.0))
    sizes = rng.uniform(0.16, 0.2, tags)
    markers = {
        k: Marker(
            k,
            RigidTransform(
                RotationMatrix.MakeZRotation(float(np.angle(normal[k]))),
                [where[k].real, where[k].imag, height[k]],
            ),
            float(sizes[k]),
        )
        for k in range(tags)
    }
    return Circuit(route, MarkerMap(FAMILY, 0.18, markers))


@dataclass(frozen=True)
class Truth:
    """What is wrong with the robot, and when it does not see.

    Attributes:
        slip: part of speed and turn rate that is lost on average; it wanders by half of that.
        yaw_noise: what each control step turns besides, rad/s.
        gyro_noise: rad/s/sqrt(Hz).
        gyro_bias: rad/s.
        gyro: whether there is one that works.
        pixel_noise: px.
        latency: of the camera, s.
        blind: from when to when nothing is seen, s.
        moved: when and by how much [x, y, theta] it is put elsewhere.
    """

    slip: float = 0.05
    yaw_noise: float = 0.1
    gyro_noise: float = 8.7e-5
    gyro_bias: float = 0.01
    gyro: bool = True
    pixel_noise: float = 0.3
    latency: float = 0.05
    blind: tuple[float, float] = (math.inf, math.inf)
    moved: tuple[float, tuple[float, float, float]] = (math.inf, (0.0, 0.0, 0.0))


class SlippingRobot(LeafSystem):
    """Drives almost as it is told; its gyro feels how it turns in fact."""

    def __init__(self, truth: Truth, start: Array, seed: int) -> None:
        super().__init__()
        self._truth = truth
        rng = np.random.default_rng([seed, 1])
        self._mine = rng.standard_normal((_TICKS, 2))
        self._steps = rng.standard_normal(_TICKS)
        self._command_input = self.DeclareVectorInputPort("command", 2)
        self._pose = self.DeclareDiscreteState(start)
        self._yaw_rate = self.DeclareDiscreteState(1)
        self._wander = self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(1 / RATE, 0.0, self._move)
        self.DeclareStateOutputPort("pose", self._pose)
        self.DeclareVectorOutputPort("imu", 6, self._calc_imu)

    def _move(self, context: Context, discrete_state: DiscreteValues) -> None:
        t, dt = self._truth, 1 / RATE
        k = round(context.get_time() * RATE)
        mine, step = self._mine[k], self._steps[int(k * CONTROL / RATE)]
        wander = float(context.get_discrete_state(self._wander)[0])
        fades = dt / WANDER_TIME
        wander += -wander * fades + math.sqrt(2 * fades) * mine[0]  # of deviation 1
        left = 1 - t.slip * (1 + WANDER * wander)
        v, omega = left * self._command_input.Eval(context)
        omega += t.yaw_noise * step
        x, y, theta = context.get_discrete_state(self._pose).get_value()
        if k / RATE == t.moved[0]:
            x, y, theta = np.array([x, y, theta]) + t.moved[1]
        middle = theta + omega * dt / 2
        discrete_state.set_value(
            self._pose,
            [x + v * dt * math.cos(middle), y + v * dt * math.sin(middle), theta + omega * dt],
        )
        felt = omega + t.gyro_bias + t.gyro_noise * math.sqrt(RATE) * mine[1]
        felt = felt if t.gyro else math.nan
        discrete_state.set_value(self._yaw_rate, [felt])
        discrete_state.set_value(self._wander, [wander])

    def _calc_imu(self, context: Context, output: Any) -> None:
        output.SetFromVector(
            [0.0, 0.0, context.get_discrete_state(self._yaw_rate)[0], 0.0, 0.0, 9.81]
        )


class Eye(LeafSystem):
    """Takes a picture every tenth of a second and tells of it a little later."""

    def __init__(self, truth: Truth, tags: MarkerMap, seed: int) -> None:
        super().__init__()
        self._truth, self._seed = truth, seed
        self._ids = np.array([tag.id for tag in tags])
        self._sizes = np.array([tag.size for tag in tags])
        self._X_WM = np.array([tag.X_WM.GetAsMatrix34() for tag in tags])
        self._pose_input = self.DeclareVectorInputPort("pose", 3)
        nothing = AbstractValue.Make(Detections())
        self._taken = self.DeclareAbstractState(nothing)
        self._told = self.DeclareAbstractState(nothing)
        # At the robot's ticks: a period of its own would be off them by rounding.
        self.DeclarePeriodicUnrestrictedUpdateEvent(1 / RATE, 0.0, self._look)
        self.DeclareStateOutputPort("detections", self._told)

    def _look(self, context: Context, state: State) -> None:
        tick, latency = round(context.get_time() * RATE), round(self._truth.latency * RATE)
        now = tick / RATE
        if tick % 10 == 0 and not self._truth.blind[0] <= now < self._truth.blind[1]:
            taken = self._picture(self._pose_input.Eval(context), now)
            state.get_mutable_abstract_state(int(self._taken)).set_value(taken)
        if (tick - latency) % 10 == 0:
            taken = state.get_abstract_state(int(self._taken)).get_value()
            state.get_mutable_abstract_state(int(self._told)).set_value(taken)

    def _picture(self, pose: Array, now: float) -> Detections:
        found, corners = project_markers(
            camera=CAMERA,
            X_WC=spatial_pose(pose) @ X_BC,
            X_WM=self._X_WM,
            sizes=self._sizes,
            cells=FAMILY.cells,
            parameters=ProjectorParameters(pixel_noise=self._truth.pixel_noise),
            random=np.random.default_rng([self._seed, 3, round(10 * now)]),
        )
        return Detections(
            stamp=now,
            family=FAMILY.name,
            ids=self._ids[found],
            corners=corners,
            hamming=np.zeros(len(found), np.int64),
            decision_margin=np.full(len(found), np.nan),
        )


def ekf_parameters(slip: float = 0.05, yaw_noise: float = 0.1) -> PlanarEkfParameters:
    """The filter of a robot that is known to slip about as much, and to do nothing else.

    How much it slips in the mean it learns; how far and how fast that wanders it is told. Of the
    ticks every fifth begins with another yaw rate. What a real robot does besides, and
    `SlippingRobot` does not, is zero: noise of distance, side and turn, and errors of the gyro's
    scale.
    """
    return PlanarEkfParameters(
        speed_noise=0.0,
        slip_noise=0.0,
        side_noise=0.0,
        turn_noise=0.0,
        scale_walk=0.0,
        scale_wander=slip * WANDER,
        scale_wander_time=WANDER_TIME,
        gyro_bias_std=Truth.gyro_bias,
        gyro_bias_walk=0.0,
        gyro_scale_std=0.0,
        gyro_scale_walk=0.0,
        gyro_delay=0.0,
        yaw_rate_change=yaw_noise * math.sqrt(2 * CONTROL / RATE),
        stamp_noise=0.0,
    )


@dataclass(frozen=True, eq=False)
class Drive:
    """What happened, at each tick.

    Attributes:
        t: (n,) s.
        pose: (n, 3) in truth.
        estimate: (n, 3).
        covariance: (n, 3, 3).
        command: (n, 2).
        nis: of each picture, by degrees of freedom.
        context: at the end.
        diagram: that drove.
        parts: its blocks by name.
    """

    t: Array
    pose: Array
    estimate: Array
    covariance: Array
    command: Array
    nis: Array
    context: Context
    diagram: Diagram
    parts: dict[str, LeafSystem] = field(default_factory=dict)

    def cross_track(self, route: Route, after: float = 0.0, every: int = 1) -> Array:
        """How far the true robot was left of the route, m, at each tick or some."""
        offsets, near = [], None
        for pose in self.pose[self.t >= after][::every]:
            place = route.closest(pose, near=near, window=1.0)
            near = place.time
            offsets.append(math.copysign(place.distance, place.offset))
        return np.array(offsets)

    def errors(self) -> Array:
        """Estimate minus truth, heading wrapped, while there was an estimate."""
        e = self.estimate - self.pose
        e[:, 2] = wrap(e[:, 2])
        return e[self.known]

    @property
    def known(self) -> NDArray[np.bool_]:
        return np.asarray(self.covariance[:, 0, 0] < 1e6)

    def nees(self) -> Array:
        """By dimension: 1 is right."""
        e, P = self.errors(), self.covariance[self.known]
        return np.einsum("ni,ni->n", e, np.linalg.solve(P, e[..., None])[..., 0]) / 3


def replay(
    world: Circuit,
    tracker: LeafSystem,
    *,
    localizer: MapLocalizer | None = None,
    ekf: PlanarEkfParameters | None = None,
    truth: Truth | None = None,
    seed: int = 0,
    duration: float | None = None,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    wire: Callable[[DiagramBuilder, dict[str, LeafSystem]], Any] | None = None,
) -> Drive:
    """Lets a tracker replay a route once by default, by what the camera sees.

    Args:
        world: route and tags.
        tracker: with the ports of `PathTracker`.
        localizer: what turns detections to poses; by default with the true map.
        ekf: parameters of the filter; by default what fits the truth.
        truth: of the robot.
        seed: of all noise.
        duration: s; one lap at the pace of the route, and the slip's share more.
        start: where it begins, off the route's beginning, [ahead, left, turn].
        wire: gets the builder and the parts by name, and returns what commands the robot.
    """
    truth = truth or Truth()
    ekf = ekf or ekf_parameters(truth.slip, truth.yaw_noise)
    localizer = localizer or MapLocalizer(marker_map=world.tags, camera=CAMERA, X_BC=X_BC)
    first = world.route.poses_at(0.0)
    c, s = math.cos(first[2]), math.sin(first[2])
    off = [c * start[0] - s * start[1], s * start[0] + c * start[1], start[2]]
    builder = DiagramBuilder()
    parts: dict[str, LeafSystem] = {
        "robot": SlippingRobot(truth, first + off, seed),
        "eye": Eye(truth, world.tags, seed),
        "localizer": Localizer(localizer=localizer, rate=10.0),
        "ekf": PlanarEkf(parameters=ekf, rate=RATE),
        "tracker": tracker,
    }
    for part in parts.values():
        builder.AddSystem(part)

    def connect(source: str, port: str, sink: str, to: str = "") -> None:
        builder.Connect(
            parts[source].GetOutputPort(port), parts[sink].GetInputPort(to or port)
        )  # fmt: skip

    commander = wire(builder, parts) if wire else tracker
    command = commander.GetOutputPort("command")
    builder.Connect(command, parts["robot"].GetInputPort("command"))
    builder.Connect(command, parts["ekf"].GetInputPort("command"))
    if commander is not tracker:
        builder.Connect(command, tracker.GetInputPort("sent"))
    connect("robot", "pose", "eye")
    connect("robot", "imu", "ekf")
    connect("eye", "detections", "localizer")
    connect("localizer", "pose", "ekf", "marker_pose")
    connect("localizer", "alternative", "ekf", "marker_alternative")
    connect("ekf", "pose", "tracker")
    connect("ekf", "covariance", "tracker")
    outputs = [("robot", "pose"), ("ekf", "pose"), ("ekf", "covariance"), ("ekf", "nis")]
    ports = [*(parts[name].GetOutputPort(port) for name, port in outputs), command]
    sinks = [LogVectorOutput(port, builder, 1 / RATE) for port in ports]
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(duration or world.route.duration * (1 + truth.slip / 2) + 0.5)
    root = simulator.get_context()
    pose, estimate, covariance, nis, commands = (
        sink.FindLog(root).data().T.copy() for sink in sinks
    )
    t = sinks[0].FindLog(root).sample_times().copy()
    new = np.flatnonzero(np.diff(nis[:, 1]) > 0) + 1
    return Drive(
        t, pose, estimate, covariance.reshape(-1, 3, 3), commands, nis[new, 0], root, diagram, parts
    )
