"""A formation of robots that take turns along a strip of triangles, and what they see: no Drake.

What they see is written apart from the estimator's model: points in space through the pinhole.
`travel` lets the estimator say where the robots are, so that its errors come back in the next move.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from systems.cameras import PinholeCamera
from systems.estimators.formation_belief import Belief, FormationEstimator, Look
from systems.estimators.formation_filter_parameters import FormationFilterParameters
from systems.estimators.formation_model import measure
from systems.messages import Detections

Array = NDArray[np.float64]

CAMERA = PinholeCamera.from_focal_length(640, 480, 485.0)
SIDE, SIZE, OFFSET = 1.5, 0.16, 0.15  # m
FRONT_AND_REAR = np.array([0.0, math.pi])
AROUND = np.array([0.0, math.pi, math.pi / 2, -math.pi / 2])
FARTHEST = 4.0  # m
NARROWEST = 12.0  # px
STEEPEST = 1.4  # rad


def vertex(k: int) -> Array:
    """The k-th vertex of the strip; robots go to it looking back at the third before it."""
    upper = k % 2 == 0
    heading = math.radians(30.0 if upper else -30.0)
    return np.array([SIDE / 2 * k, SIDE * math.sqrt(0.75) * upper, heading])


@dataclass(eq=False)
class FormationWorld:
    """True poses, yaw errors, and sights.

    Attributes:
        robots: how many; robot k starts at vertex k, as if it had come there.
        seed: of all that is random.
        camera_yaws: see the estimator.
        start_noise: [position (m), heading (rad)] of the start.
        yaw_error: of the cameras, rad.
        corner_noise: px.
        lasting: [bearing (rad), distance (relative)] errors that stay while both robots stand.
        blocked: robots that nobody sees.
    """

    robots: int = 4
    seed: int = 0
    camera_yaws: Array = field(default_factory=lambda: FRONT_AND_REAR)
    start_noise: tuple[float, float] = (0.003, 0.01)
    yaw_error: float = 0.006
    corner_noise: float = 0.0
    lasting: tuple[float, float] = (0.0, 0.0)
    blocked: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        self.random = np.random.default_rng(self.seed)
        self.nominal = np.array([vertex(k) for k in range(self.robots)])
        deviations = [self.start_noise[0], self.start_noise[0], self.start_noise[1]]
        self.poses = self.nominal + deviations * self.random.standard_normal((self.robots, 3))
        shape = (self.robots, len(self.camera_yaws))
        self.yaw_errors = self.yaw_error * self.random.standard_normal(shape)
        self.epochs = list(range(self.robots))
        self.places = list(self.poses.copy())  # all that ever were, by epoch
        self.errors: dict[tuple[int, int, int, int], Array] = {}
        self.sources: dict[tuple[int, int, int, int], int] = {}  # who saw it, likewise

    def put(self, robot: int, pose: Array) -> None:
        """Moves a robot."""
        self.poses[robot] = pose
        self.epochs[robot] = len(self.places)
        self.places.append(pose.copy())

    def sights(self, observer: int, camera: int) -> tuple[NDArray[np.int64], Array]:
        """Returns the ids (n,) of the markers in view and their true corners in C (n, 4, 3)."""
        x, y, theta = self.poses[observer]
        axis = theta + self.camera_yaws[camera] + self.yaw_errors[observer, camera]
        forward = np.array([math.cos(axis), math.sin(axis)])
        right = np.array([math.sin(axis), -math.cos(axis)])
        ids, corners = [], []
        for target in range(self.robots):
            if target == observer or target in self.blocked:
                continue
            if (self.poses[target, :2] - [x, y]) @ forward < 0.2:
                continue
            for side in range(4):
                out = self.poses[target, 2] + side * math.pi / 2
                normal = np.array([math.cos(out), math.sin(out)])
                # To the right as one looks at the marker.
                along = np.array([-normal[1], normal[0]])
                centre = self.poses[target, :2] + OFFSET * normal - [x, y]
                distance = float(np.hypot(*centre))
                steep = math.acos(float(np.clip(-centre @ normal / distance, -1, 1)))
                narrow = 485 * SIZE * math.cos(steep) / distance
                if distance > FARTHEST or steep > STEEPEST or narrow < NARROWEST:
                    continue
                points = []
                for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                    p = centre + u * SIZE / 2 * along
                    points.append([p @ right, v * SIZE / 2, p @ forward])
                p_C = np.array(points)
                if (p_C[:, 2] < 0.2).any() or (np.abs(p_C[:, 0] / p_C[:, 2]) * 485 > 319).any():
                    continue
                ids.append(4 * target + side)
                corners.append(p_C)
        return np.array(ids, np.int64), np.array(corners).reshape(-1, 4, 3)

    def detections(self, observer: int, camera: int, stamp: float) -> Detections:
        """Returns what the camera's detector finds."""
        ids, corners = self.sights(observer, camera)
        pixels = CAMERA.project(corners)
        pixels = pixels + self.corner_noise * self.random.standard_normal(pixels.shape)
        return Detections(
            stamp=stamp,
            ids=ids,
            corners=pixels,
            hamming=np.zeros(len(ids), np.int64),
            decision_margin=np.full(len(ids), 50.0),
        )

    def values(self, observer: int, camera: int) -> tuple[NDArray[np.int64], Array]:
        """Returns ids (n,), and bearings and logarithms of distances with lasting errors (n, 2)."""
        ids, corners = self.sights(observer, camera)
        middle = corners.mean(axis=1)
        true = np.column_stack(
            [-np.arctan2(middle[:, 0], middle[:, 2]), np.log(np.hypot(middle[:, 0], middle[:, 2]))]
        ).reshape(-1, 2)
        for n, marker in enumerate(ids):
            key = (self.epochs[observer], camera, self.epochs[marker // 4], int(marker % 4))
            if key not in self.errors:
                self.errors[key] = self.lasting * self.random.standard_normal(2)
                self.sources[key] = observer
            true[n] += self.errors[key]
        return ids, true

    def batch_covariance(self, use_range: bool, times: float = 1.0) -> Array:
        """Returns the least covariance of all poses that ever were, (3 places, 3 places).

        All sightings at once, at the true poses, derivatives by differences: the Cramer-Rao bound
        of the whole run, the start and the yaw errors with their deviations.

        Args:
            use_range: whether distances count.
            times: how often each sighting was made with errors of its own.
        """
        places, cameras = len(self.places), len(self.camera_yaws)
        keys = np.array(list(self.errors))
        owner = np.array([self.sources[key] for key in self.errors])
        at = np.array(self.places)
        camera, side = keys[:, 1], keys[:, 3]
        axis = self.camera_yaws[camera] + self.yaw_errors[owner, camera]
        local = np.column_stack([at[keys[:, 0]], at[keys[:, 2]], axis])

        def seen(v: Array) -> Array:
            out = v[:, 5] + side * np.pi / 2
            x = v[:, 3] + OFFSET * np.cos(out) - v[:, 0]
            y = v[:, 4] + OFFSET * np.sin(out) - v[:, 1]
            # In the camera's own axes, where the angle is far from a jump.
            a = v[:, 2] + v[:, 6]
            ahead, left = np.cos(a) * x + np.sin(a) * y, np.cos(a) * y - np.sin(a) * x
            return np.column_stack([np.arctan(left / ahead), np.log(np.hypot(x, y))])

        columns = np.column_stack(
            [
                3 * keys[:, [0]] + np.arange(3),
                3 * keys[:, [2]] + np.arange(3),
                3 * places + owner * cameras + camera,
            ]
        )
        n = np.arange(len(keys))
        J = np.zeros((len(keys), 2, 3 * places + self.robots * cameras))
        for k in range(7):
            step = 1e-6 * (np.arange(7) == k)
            J[n, :, columns[:, k]] += (seen(local + step) - seen(local - step)) / 2e-6
        J /= np.array(self.lasting)[:, None] / np.sqrt(times)
        J = J[:, : 2 if use_range else 1].reshape(-1, J.shape[2])
        position, heading = self.start_noise
        start = np.tile([position, position, heading], self.robots)
        prior = np.zeros(J.shape[1])
        prior[: len(start)] = start**-2.0
        prior[3 * places :] = max(self.yaw_error, 1e-6) ** -2.0
        P = np.linalg.inv(J.T @ J + np.diag(prior))
        return np.asarray(P[: 3 * places, : 3 * places])

    def parameters(self, **changes: object) -> FormationFilterParameters:
        """Returns parameters that say how exact this world's sights are."""
        fitting: dict[str, object] = {
            "pixel_noise": max(self.corner_noise, 1e-3),
            "corner_floor": 0.0,
            "bearing_floor": max(self.lasting[0], 1e-5),
            "range_floor": max(self.lasting[1], 1e-4),
            "start_position_noise": self.start_noise[0],
            "start_heading_noise": self.start_noise[1],
            "yaw_error": self.yaw_error,
        }
        return FormationFilterParameters(**{**fitting, **changes})  # type: ignore[arg-type]

    def estimator(self, **changes: object) -> FormationEstimator:
        """Returns an estimator that knows how exact this world is, but for the changes."""
        return FormationEstimator(self.nominal, self.camera_yaws, 485.0, self.parameters(**changes))

    def looks(self, stamp: float) -> list[Look]:
        """Returns what all cameras see; through pictures if corners are noisy."""
        found = []
        for i in range(self.robots):
            for c in range(len(self.camera_yaws)):
                if self.corner_noise > 0:
                    seen = self.detections(i, c, stamp)
                    ids, values = seen.ids, measure(seen, CAMERA, SIZE)
                else:
                    ids, values = self.values(i, c)
                found.append(Look(i, c, stamp, ids, values))
        return found

    def errors_of(self, belief: Belief) -> tuple[Array, Array]:
        """Returns the errors of the estimated poses (3 N,) and their covariance."""
        size = 3 * self.robots
        errors = belief.x[:size] - self.poses.ravel()
        errors[2::3] = np.remainder(errors[2::3] + np.pi, 2 * np.pi) - np.pi
        return errors, belief.P[:size, :size]


@dataclass(eq=False)
class Trip:
    """What came of a journey.

    Attributes:
        belief: at the end.
        nees: after each move, of all poses, by dimension.
        destination: after each move, from the mover to the vertex it was to stand on, m.
        error: of the mover's estimated position, (moves, 2) m.
        deviation: what the estimator thinks of that, (moves,) m.
        nis: of each robot that was placed.
        counts: of all sightings.
        seconds: that each picture took.
        t: time at the end, s.
    """

    belief: Belief
    nees: list[float] = field(default_factory=list)
    destination: list[float] = field(default_factory=list)
    error: list[Array] = field(default_factory=list)
    deviation: list[float] = field(default_factory=list)
    nis: list[float] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    seconds: list[float] = field(default_factory=list)
    t: float = 0.0


def travel(
    world: FormationWorld,
    estimator: FormationEstimator,
    moves: int,
    *,
    frames: int = 1,
    spoil: Callable[[int, Look], Look] = lambda _, look: look,
) -> Trip:
    """Lets the last robot go to the next vertex, again and again, by what the estimator says.

    It goes 0.1 m past the vertex, stands, is placed, and backs in, as it has to in order to see.

    Args:
        world: is changed.
        estimator: whose estimate decides where a robot thinks it is.
        moves: how many.
        frames: pictures by each camera whenever a robot has stopped.
        spoil: changes what the estimator gets, by the number of the move and the picture.
    """
    trip = Trip(estimator.start())

    def look(move: int) -> None:
        for _ in range(frames):
            trip.t += 0.1
            looks = [spoil(move, look) for look in world.looks(trip.t)]
            began = time.perf_counter()
            trip.counts.update(estimator.look(trip.belief, trip.t, looks))
            trip.seconds.append(time.perf_counter() - began)

    look(-1)
    for move in range(moves):
        robot = move % world.robots
        own = slice(3 * robot, 3 * robot + 3)
        target = vertex(move + world.robots)
        for past, slip in ((0.1, [0.02, 0.02, 0.02]), (0.0, [0.003, 0.003, 0.005])):
            aim = target + past * np.array([math.cos(target[2]), math.sin(target[2]), 0.0])
            estimator.depart(trip.belief, robot, trip.t)
            step = aim - trip.belief.x[own]
            step[2] = math.remainder(step[2], 2 * math.pi)
            world.put(robot, world.poses[robot] + step + slip * world.random.standard_normal(3))
            trip.t += 1.0
            estimator.stop(trip.belief, robot, trip.t)
            trip.t += 0.2
            placed = trip.belief.nis[1]
            look(move)
            if trip.belief.nis[1] > placed:
                trip.nis.append(float(trip.belief.nis[0]))
        errors, P = world.errors_of(trip.belief)
        trip.nees.append(float(errors @ np.linalg.solve(P, errors)) / len(errors))
        trip.destination.append(float(np.hypot(*(world.poses[robot] - target)[:2])))
        trip.error.append(errors[own][:2])
        trip.deviation.append(float(np.sqrt(np.trace(P[own, own][:2, :2]))))
    return trip
