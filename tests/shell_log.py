"""The paper's routine as a robot's sensors see it: a kinematic rover, without Drake's scene.

The rover follows the routine on the truth, with motors that lag; its body rocks against the normal.
The flow's points are projected with the true camera and fitted on the sphere, the markers' corners
are projected and solved, the gyro is sampled: nothing here knows the filter's model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from scipy.spatial.transform import Rotation

from plants.shell_rover import body_rate
from systems.controllers.shell_route import ShellRouteParameters, follow, on_leg, routine
from systems.estimators.madgwick import IDENTITY, madgwick_step
from systems.estimators.shell_ekf import ShellEkf
from systems.estimators.shell_ekf_parameters import ShellEkfParameters
from systems.estimators.shell_rule import ShellRule
from systems.flow.projector import FlowProjectorParameters, project_flow
from systems.flow.shell import ShellView
from systems.flow.sphere_flow import SphereFlowEstimator, SphereFlowParameters
from systems.messages import PointMatches, PoseEstimate, RotationIncrement
from systems.sensors.imu import digital, piece_errors
from systems.sensors.imu_parameters import GRAVITY, Bmi088Parameters
from systems.shell.angles import rotation, rotation_error, rotation_vector
from systems.shell.layout import misplaced
from systems.shell.marker_pose import shell_localizer
from tests.systems.shell.shell_world import CAMERA, HEIGHT, MAP, RADIUS, X_BC, detections

Array = NDArray[np.float64]
DEG = math.radians(1.0)
RATE = 300  # Hz, of the IMU
EACH = 5  # samples of the IMU for each picture
VIEW = ShellView(camera=CAMERA)
CAMERA_HEIGHT = VIEW.parameters.camera_height


@dataclass(frozen=True)
class Errors:
    """Bounds, from within which each seed draws uniformly; the issue's base errors."""

    placement: float = 0.5 * DEG
    mounting: float = 1.0 * DEG
    scale: float = 0.02  # of the flow: a camera 1 / (1 + scale) times as high as planned
    bias: float = 0.3 * DEG  # rad/s
    rock: float = 0.3 * DEG
    missed: float = 0.2  # part of the passages over markers
    delay: float = 0.0  # s, the same for every seed
    outliers: float = 0.0  # part of the marker poses
    outlier: float = 8 * DEG
    pixels: float = 0.3
    cross_axis: float = 0.0  # of the gyro, beside the BMI088's other errors
    dark: tuple[float, float] = (1.0, 1.0)  # part of the drive without a marker, from, to


BASE = Errors()
HARSH = Errors(
    placement=1.0 * DEG, mounting=2.0 * DEG, scale=0.04, rock=0.6 * DEG, missed=0.5, delay=0.03,
    outliers=0.03,
)  # fmt: skip
NONE = Errors(placement=0.0, mounting=0.0, scale=0.0, bias=0.0, rock=0.0, missed=0.0, pixels=1e-3)


@dataclass(frozen=True, eq=False)
class ShellLog:
    """What happened and what the sensors told.

    Attributes:
        R: (n, 3, 3) `R_RB` at 300 Hz. p: (n, 3) m.
        imu: (n, 6).
        increments: by the sample at which they arrive.
        markers: likewise.
        second: the sample at which a second marker had been seen.
        mounting: (3,) true turn of the camera, in B. scale: of the flow over the shell, by the
            camera's true height. bias: (3,).
        ids: (n,) the marker in view, seen or not; 0 for none.
    """

    R: Array
    p: Array
    imu: Array
    increments: dict[int, RotationIncrement]
    markers: dict[int, PoseEstimate]
    second: int
    mounting: Array
    scale: float
    bias: Array
    delay: float
    ids: NDArray[np.int64]


@lru_cache(maxsize=4)
def way(iterations: int) -> Array:
    """`R_RN` at 300 Hz along the routine, motors with a lag of 0.1 s."""
    p, R, dt = ShellRouteParameters(), rotation(np.zeros(3)), 1 / RATE
    rotations, motion, target = [], np.zeros(2), np.zeros(2)
    for leg in routine(iterations)[:-1]:
        driven, frame = 0.0, leg.frame()
        while (leg.arc - driven) * RADIUS > p.position_tolerance:
            if len(rotations) % EACH == 0:
                where = on_leg(R, frame)
                driven += math.remainder(where.along - driven, 2 * np.pi)
                target = np.array(follow(where, leg.arc - driven, RADIUS, p))
            motion = motion + (target - motion) * dt / 0.1
            rotations.append(R)
            R = R @ Rotation.from_rotvec(body_rate(motion, RADIUS) * dt).as_matrix()
    return np.array(rotations)


def band_limited(n: int, rng: np.random.Generator) -> Array:
    """(n, 2) random motion of unit variance between 0.2 and 3 Hz, at 300 Hz."""
    spectrum = np.fft.rfft(rng.standard_normal((n, 2)), axis=0)
    frequency = np.fft.rfftfreq(n, 1 / RATE)
    spectrum[(frequency < 0.2) | (frequency > 3.0)] = 0.0
    motion = np.fft.irfft(spectrum, n, axis=0)
    return motion / motion.std(axis=0)


def sampled(R: Array, bias: Array, cross_axis: float, rng: np.random.Generator) -> Array:
    """(n, 6) what an IMU tells, its own block's formulas over a whole drive at once."""
    n, p = len(R), Bmi088Parameters(cross_axis_tolerance=cross_axis)
    central = Rotation.from_matrix(R[:-2]).inv() * Rotation.from_matrix(R[2:])
    gyro = np.vstack([np.zeros(3), central.as_rotvec() * RATE / 2, np.zeros(3)])
    true = np.hstack([gyro, R[:, 2] * GRAVITY])  # z of the shell is up
    shake = np.array([*p.gyro_vibration, *p.accel_vibration])
    phase = rng.uniform(0, 2 * np.pi, 6) + 0.2 * np.cumsum(rng.standard_normal((n, 6)), axis=0)
    turning = 2 * np.pi * p.vibration_frequency / RATE * np.arange(n)[:, None]
    true += math.sqrt(2) * shake * np.sin(turning + phase)
    matrix, offset = piece_errors(replace(p, gyro_bias_tolerance=[0.0] * 3), rng)
    noise = np.repeat([p.gyro_noise_density, p.accel_noise_density], 3) * math.sqrt(RATE)
    told = true @ matrix.T + offset + np.r_[bias, 0, 0, 0] + noise * rng.standard_normal((n, 6))
    return digital(told, np.repeat([p.gyro_range or np.inf, p.accel_range or np.inf], 3), p.bits)


@lru_cache(maxsize=64)
def drive(seed: int, errors: Errors = BASE, iterations: int = 1) -> ShellLog:
    """Drives the routine once."""
    rng = np.random.default_rng(seed)
    mounting = rng.uniform(-errors.mounting, errors.mounting, 3)
    scale = rng.uniform(-errors.scale, errors.scale)
    bias = rng.uniform(-errors.bias, errors.bias, 3)
    R_RN = way(iterations)
    n = len(R_RN)
    rock = np.zeros((n, 3))
    rock[:, :2] = errors.rock / math.sqrt(3) * band_limited(n, rng)
    R = R_RN @ Rotation.from_rotvec(rock).as_matrix()
    p = (RADIUS + HEIGHT) * R_RN[:, :, 2]
    turned = Rotation.from_rotvec(mounting).as_matrix() @ X_BC.rotation().matrix()
    lower = np.array([0.0, 0.0, CAMERA_HEIGHT * scale / (1 + scale)])
    X_BC_true = RigidTransform(RotationMatrix(turned), X_BC.translation() - lower)
    markers = misplaced(MAP, bound=errors.placement, seed=seed)
    localizer = shell_localizer(marker_map=MAP, camera=CAMERA, X_BC=X_BC)
    flow = SphereFlowEstimator(view=VIEW, parameters=SphereFlowParameters(hypotheses=16))
    points = FlowProjectorParameters(points=80)
    increments, poses, ids = {}, {}, np.zeros(n, np.int64)
    last, missing, met, second, passages = 0, False, set(), n, 0
    places = np.array([marker.X_WM.translation() for marker in MAP])
    before = None
    for k in range(0, n, EACH):
        X_RB = RigidTransform(RotationMatrix(R[k]), p[k])
        stamp = k / RATE + errors.delay
        arrival = k + 1 + round(errors.delay * RATE)
        X_RC = X_RB @ X_BC_true
        if before is not None:
            matches = project_flow(
                camera=CAMERA, radius=RADIUS, X_RC_before=before, X_RC=X_RC, parameters=points,
                random=rng,
            )  # fmt: skip
            increments[arrival] = flow.fit(
                PointMatches(stamp, stamp - EACH / RATE, "", *matches)
            ).increment
        before = X_RC
        if (places @ p[k]).max() < 0.99 * RADIUS * (RADIUS + HEIGHT):
            continue
        picture = detections(
            X_RB, markers=markers, mounting=X_BC_true, noise=errors.pixels,
            seed=1_000_000 * seed + k, stamp=stamp,
        )  # fmt: skip
        if not len(picture):
            continue
        ids[k : k + EACH] = picture.ids[0]
        if picture.ids[0] != last:
            last = int(picture.ids[0])
            missing = rng.random() < errors.missed and passages > 0
            passages += 1
        if missing or errors.dark[0] * n <= k < errors.dark[1] * n:
            continue
        told = localizer.locate(picture).pose
        if not told.valid:
            continue
        met.add(last)
        if len(met) == 2 and second == n:
            second = arrival
        if rng.random() < errors.outliers:
            axis = rng.standard_normal(3)
            wrong = RotationMatrix(
                Rotation.from_rotvec(errors.outlier * axis / np.linalg.norm(axis)).as_matrix()
            )
            told = replace(told, pose=RigidTransform(wrong, np.zeros(3)) @ told.pose)
        poses[arrival] = told
    return ShellLog(
        R, p, sampled(R, bias, errors.cross_axis, rng), increments, poses, second, mounting, scale,
        bias, errors.delay, ids,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Result:
    """What an estimator said, each time between two pictures.

    Attributes:
        samples: (m,) at which it was asked: half a sample later.
        errors: (m, 3) rotation vectors in R, rad.
        P: (m, 6, 6). p_errors: (m, 3) m.
        block: the estimator. simulator: at the end.
    """

    samples: NDArray[np.int64]
    errors: Array
    P: Array
    p_errors: Array
    block: ShellEkf | ShellRule
    simulator: Simulator

    def nees(self) -> Array:
        """(m,) of the rotation, by its three dimensions."""
        P = self.P[:, :3, :3]
        solved = np.linalg.solve(P, self.errors[:, :, None])[:, :, 0]
        return np.asarray((self.errors * solved).sum(axis=1) / 3)

    def after(self, sample: int) -> Result:
        """Returns the part from a sample on."""
        on = self.samples >= sample
        return replace(
            self, samples=self.samples[on], errors=self.errors[on], P=self.P[on],
            p_errors=self.p_errors[on],
        )  # fmt: skip

    @property
    def health(self) -> dict[str, int]:
        """Returns the counts that are not zero."""
        context = self.simulator.get_context()
        counts = self.block.health_output_port().Eval(context).counts
        return {reason: number for reason, number in counts.items() if number}


def ekf(**parameters: object) -> ShellEkf:
    """Returns the filter for this robot."""
    return ShellEkf(
        view=VIEW, marker_map=MAP, height=HEIGHT,
        parameters=ShellEkfParameters(**parameters),  # type: ignore[arg-type]
    )  # fmt: skip


def listen(log: ShellLog, block: ShellEkf | ShellRule, every: int = EACH) -> Result:
    """Lets an estimator hear a log."""
    simulator = Simulator(block)
    context = simulator.get_mutable_context()
    block.marker_pose_input_port().FixValue(context, PoseEstimate())
    if isinstance(block, ShellEkf):
        block.increment_input_port().FixValue(context, RotationIncrement())
    else:
        block.flow_input_port().FixValue(context, np.zeros(2))
        block.orientation_input_port().FixValue(context, np.array(IDENTITY))
    imu = block.imu_input_port().FixValue(context, np.zeros(6))
    quaternion = IDENTITY
    samples, errors, P, p_errors = [], [], [], []
    for k in range(len(log.R) - 1):
        if k:
            imu.GetMutableData().get_mutable_value().SetFromVector(log.imu[k - 1])
            w, a = log.imu[k - 1, :3].tolist(), log.imu[k - 1, 3:].tolist()
        if k in log.markers:
            block.marker_pose_input_port().FixValue(context, log.markers[k])
        if isinstance(block, ShellEkf):
            if k in log.increments:
                block.increment_input_port().FixValue(context, log.increments[k])
        else:
            if k:
                quaternion = madgwick_step(quaternion, w, a, 0.1, 1 / RATE)
            if k in log.increments:
                told = log.increments[k].rotation * RADIUS * RATE / EACH
                block.flow_input_port().FixValue(context, [told[1], -told[0]])
            block.orientation_input_port().FixValue(context, np.array(quaternion))
        simulator.AdvanceTo((k + 0.5) / RATE)
        if k % every == every - 1:
            half = rotation_vector(log.R[k].T @ log.R[k + 1]) / 2
            R = log.R[k] @ Rotation.from_rotvec(half).as_matrix()
            X = block.pose_output_port().Eval(context)
            samples.append(k)
            errors.append(rotation_error(X.rotation().matrix(), R))
            P.append(block.covariance_output_port().Eval(context).reshape(6, 6))
            p_errors.append(X.translation() - (log.p[k] + log.p[k + 1]) / 2)
    return Result(
        np.array(samples), np.array(errors), np.array(P), np.array(p_errors), block, simulator
    )
