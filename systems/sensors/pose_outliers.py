"""Poses that are wrong on purpose, by far more than their covariance says."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.health import Counts
from systems.markers.pnp import rotation_from_vector
from systems.messages import PoseEstimate
from systems.noise import NoiseStream, sample_index
from systems.periods import period
from systems.validation import require, require_non_negative, require_positive


def turned(told: PoseEstimate, angle: float, random: np.random.Generator) -> PoseEstimate:
    """Returns a pose turned as a whole about its parent frame's origin, about any axis.

    Args:
        told: the pose.
        angle: by how much, rad.
        random: where the axis comes from, evenly from all directions.
    """
    axis = random.standard_normal(3)
    turn = RotationMatrix(rotation_from_vector(angle * axis / np.linalg.norm(axis)))
    return replace(told, pose=RigidTransform(turn, np.zeros(3)) @ told.pose)


class PoseOutliers(LeafSystem):
    """Turns some of the poses that pass.

    .. pydrake_system::

        name: PoseOutliers
        input_ports:
        - pose
        output_ports:
        - told
        - health

    Args:
        probability: that a pose is turned, 0 to 1.
        angle: by how much, rad.
        rate: of the pictures that the poses come from, Hz; a stamp by it is the number of a pose.
        seed: of which are turned and how, a parameter of the Context.
        name: of the noise stream.

    Ports:
        pose (input, PoseEstimate): as measured.
        told (output, PoseEstimate): the same at once, or turned about the origin of its parent
            frame, place and rotation; its covariance is not. On a shell that is a pose elsewhere on
            it, as if a marker were taken for another or its pose had flipped.
        health (output, Health): poses turned.

    Raises:
        ValueError: probability, angle, rate or seed out of range.
    """

    def __init__(
        self,
        *,
        probability: float,
        angle: float,
        rate: float = 60.0,
        seed: int = 0,
        name: str = "pose_outliers",
    ) -> None:
        super().__init__()
        require(0 <= probability <= 1, "probability", probability, "0 to 1")
        require_non_negative(angle=angle)
        require_positive(rate=rate)
        self._probability = probability
        self._angle = angle
        self._rate = rate
        self._noise = NoiseStream(self, seed=seed, name=name)
        self._pose_input = self.DeclareAbstractInputPort("pose", AbstractValue.Make(PoseEstimate()))
        self._last = self.DeclareDiscreteState([math.nan])  # stamp of the last pose counted
        self._told_output = self.DeclareAbstractOutputPort(
            "told",
            lambda: AbstractValue.Make(PoseEstimate()),
            self._calc_told,
            {self._pose_input.ticket(), self.all_parameters_ticket()},
        )
        self._counts = Counts(self, "turned")
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._look)

    def pose_input_port(self) -> InputPort:
        """Returns the port of the poses as measured."""
        return self._pose_input

    def told_output_port(self) -> OutputPort:
        """Returns the port of the poses as told."""
        return self._told_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _random(self, context: Context, told: PoseEstimate) -> np.random.Generator | None:
        """Returns where a pose's axis comes from; None if it is not turned."""
        if not told.valid:
            return None
        # A clock that is off may begin before zero.
        index = sample_index(told.stamp, self._rate) % 2**63
        random = self._noise.generator(context, index)
        return random if random.random() < self._probability else None

    def _calc_told(self, context: Context, output: Any) -> None:
        told: PoseEstimate = self._pose_input.Eval(context)
        random = self._random(context, told)
        output.set_value(told if random is None else turned(told, self._angle, random))

    def _look(self, context: Context, discrete_state: DiscreteValues) -> None:
        told: PoseEstimate = self._pose_input.Eval(context)
        if told.valid and told.stamp != context.get_discrete_state(self._last)[0]:
            discrete_state.set_value(self._last, [told.stamp])
            self._counts.add(
                context, discrete_state, turned=self._random(context, told) is not None
            )
