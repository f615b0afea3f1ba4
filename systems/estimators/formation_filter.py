"""Where all robots of a formation are, from every marker that one of them sees on another.

The model of the sightings is in `formation_model`, the least squares in `formation_information`,
who is a landmark and who a stranger in `formation_belief`; here is the block.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.angles import wrap
from systems.cameras import PinholeCamera
from systems.estimators.formation_belief import REASONS, Belief, FormationEstimator, Look
from systems.estimators.formation_filter_parameters import FormationFilterParameters
from systems.estimators.formation_model import measure
from systems.health import Counts
from systems.messages import Detections
from systems.periods import period
from systems.validation import require, require_positive

Array = NDArray[np.float64]


class FormationFilter(LeafSystem):
    """Estimates the poses of robots that stand as landmarks for one another and move in turns.

    .. pydrake_system::

        name: FormationFilter
        input_ports:
        - moving
        - robot{k}_{camera}
        output_ports:
        - poses
        - covariance
        - nis
        - health

    Args:
        start_poses: (N, 3) [x (m), y (m), theta (rad)] of the robots in W at the start.
        cameras: name to where that camera of each robot looks, from the robot's x axis to the
            left, rad; `{"front_camera": 0.0, "rear_camera": pi}` if left out.
        camera: intrinsics of all of them.
        parameters: noise, sizes and options.
        rate: of the filter, Hz.

    Ports:
        moving (input, vector of N): other than 0 for each robot that moves. To be raised before
            the robot starts and lowered after it has stopped: a robot that moves while it is said
            to stand is a wrong landmark. One that is not finite leaves it as it was.
        robot{k}_{camera} (input, Detections): of camera `camera` of robot k, robot after robot;
            used once for each stamp. Markers 4 k to 4 k + 3 are on the front, left, back and right
            of robot k. Pictures may be late as long as no robot in them has set out since.
        poses (output, vector of 3 N): [x (m), y (m), theta (rad)] in W, robot after robot.
        covariance (output, vector of 9 N N): (3 N, 3 N) of the poses, row by row. Of a robot that
            moves unseen, very large.
        nis (output, vector of 2): of the last robot that was placed after a move, by how much its
            first sightings raised the sum of squares, by degrees of freedom (1 on average if all is
            right); and how many were placed. [NaN, 0] before the first.
        health (output, Health): sightings `accepted`; refused by the gate, or as the one that
            contradicts the others when a robot is placed (`gated`); older than the last move of a
            robot in it (`late`); of markers that none of the others carries (`unknown_marker`);
            twice in one picture (`repeated_marker`); with corners that make no upright marker
            (`bad_corners`). How often a robot could not be placed, since its sightings contradict
            one another and none of them alone is to blame (`unplaced`); samples of `moving` that
            were not finite (`bad_moving`).

    A robot that sees nobody and is seen by nobody stays where it was, its covariance too. A
    landmark that is pushed is not looked for: its sightings are refused from then on.

    Source: information filter by least squares and Schur complement, as in bundle adjustment
    (Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle adjustment: a modern synthesis", 2000, section
    6); robots as one another's landmarks: Kurazume, Nagata, Hirose, "Cooperative positioning with
    multiple robots", ICRA 1994; first-estimate Jacobians as said in `formation_information`.

    Raises:
        ValueError: fewer than two robots, poses or camera yaws that are not finite, no camera, or
            a rate out of range.
    """

    def __init__(
        self,
        *,
        start_poses: ArrayLike,
        cameras: Mapping[str, float] | None = None,
        camera: PinholeCamera,
        parameters: FormationFilterParameters | None = None,
        rate: float = 10.0,
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        poses = np.array(start_poses, float)
        require(
            poses.ndim == 2 and poses.shape[1] == 3 and len(poses) >= 2,
            "start_poses",
            poses.tolist(),
            "[x, y, theta] of two robots or more",
        )
        require(bool(np.isfinite(poses).all()), "start_poses", poses.tolist(), "finite")
        yaws = dict(cameras) if cameras is not None else {"front_camera": 0.0, "rear_camera": np.pi}
        sound = len(yaws) > 0 and bool(np.isfinite(list(yaws.values())).all())
        require(sound, "cameras", yaws, "names and finite yaws of one camera or more")
        self._camera = camera
        self._parameters = parameters or FormationFilterParameters()
        self._robots, self._names = len(poses), list(yaws)
        self._estimator = FormationEstimator(
            poses, np.array(list(yaws.values())), float(camera.K[0, 0]), self._parameters
        )
        self._moving_input = self.DeclareVectorInputPort("moving", self._robots)
        nothing = AbstractValue.Make(Detections())
        self._detections_inputs = [
            [self.DeclareAbstractInputPort(f"robot{k}_{name}", nothing) for name in self._names]
            for k in range(self._robots)
        ]
        begin = self._estimator.start().arrays()
        self._shapes = [array.shape for array in begin]
        self._states = [self.DeclareDiscreteState(array.ravel()) for array in begin]
        x, P, nis = self._states[0], self._states[1], self._states[-1]
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._step)
        size = 3 * self._robots
        self._poses_output = self.DeclareVectorOutputPort(
            "poses", size, self._calc_poses, {self.discrete_state_ticket(x)}
        )
        self._covariance_output = self.DeclareVectorOutputPort(
            "covariance", size * size, self._calc_covariance, {self.discrete_state_ticket(P)}
        )
        self._nis_output = self.DeclareStateOutputPort("nis", nis)
        self._counts = Counts(self, *REASONS, "bad_moving")

    def moving_input_port(self) -> InputPort:
        """Returns the port of who moves."""
        return self._moving_input

    def detections_input_port(self, robot: int, camera: str) -> InputPort:
        """Returns the port of what one camera of one robot finds."""
        return self._detections_inputs[robot][self._names.index(camera)]

    def poses_output_port(self) -> OutputPort:
        """Returns the port of the estimated poses."""
        return self._poses_output

    def covariance_output_port(self) -> OutputPort:
        """Returns the port of their covariance."""
        return self._covariance_output

    def nis_output_port(self) -> OutputPort:
        """Returns the port of how well the last robot that was placed fits."""
        return self._nis_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def yaw_errors(self, context: Context) -> tuple[Array, Array]:
        """Returns the estimated yaw errors of the cameras and standard deviations, (N, C) rad."""
        belief = self._belief(context)
        poses, shape = 3 * self._robots, (self._robots, len(self._names))
        deviations = np.sqrt(np.diag(belief.P)[poses:])
        return belief.x[poses:].reshape(shape), deviations.reshape(shape)

    def _belief(self, context: Context) -> Belief:
        values = (context.get_discrete_state(state).get_value() for state in self._states)
        return Belief(
            *(v.copy().reshape(shape) for v, shape in zip(values, self._shapes, strict=True))
        )

    def _step(self, context: Context, discrete_state: DiscreteValues) -> None:
        t = context.get_time()
        belief = self._belief(context)
        counts: Counter[str] = Counter()
        moving = self._moving_input.Eval(context).tolist()
        for robot, (now, before) in enumerate(zip(moving, belief.moving.tolist(), strict=True)):
            if not math.isfinite(now):
                counts["bad_moving"] += 1
            elif now and not before:
                self._estimator.depart(belief, robot, t)
            elif before and not now:
                self._estimator.stop(belief, robot, t)
        looks = []
        for robot, ports in enumerate(self._detections_inputs):
            for camera, port in enumerate(ports):
                found: Detections = port.Eval(context)
                if found.stamp > belief.stamps[robot, camera]:
                    values = measure(found, self._camera, self._parameters.marker_size)
                    looks.append(Look(robot, camera, found.stamp, found.ids, values))
        counts.update(self._estimator.look(belief, t, looks))
        for state, array in zip(self._states, belief.arrays(), strict=True):
            discrete_state.set_value(state, array.ravel())
        self._counts.add(context, discrete_state, **counts)

    def _calc_poses(self, context: Context, output: Any) -> None:
        x = context.get_discrete_state(self._states[0]).get_value()
        poses = x[: 3 * self._robots].reshape(-1, 3).copy()
        poses[:, 2] = wrap(poses[:, 2])
        output.SetFromVector(poses.ravel())

    def _calc_covariance(self, context: Context, output: Any) -> None:
        P = context.get_discrete_state(self._states[1]).get_value().reshape(self._shapes[1])
        size = 3 * self._robots
        output.SetFromVector(P[:size, :size].ravel())
