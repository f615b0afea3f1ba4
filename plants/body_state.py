"""What a robot's body does, on the same ports for a multibody model and a kinematic twin."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem

from systems.angles import spatial_pose, wrap
from systems.validation import require


class BodyState(LeafSystem):
    """What the floating body of a model does, out of its generalized coordinates.

    .. pydrake_system::

        name: BodyState
        input_ports:
        - state
        - generalized_acceleration
        output_ports:
        - pose
        - planar_pose
        - spatial_velocity
        - spatial_acceleration

    Args:
        num_positions: of the model instance; the floating body's quaternion and place come first.
        num_velocities: of the model instance; the floating body's come first.

    Ports:
        state (input, vector of positions and velocities): the plant's `{model}_state`.
        generalized_acceleration (input, vector of velocities): the plant's
            `{model}_generalized_acceleration`.
        pose (output, RigidTransform): `X_WB`.
        planar_pose (output, vector of 3): [x (m), y (m), theta (rad)] in the world.
        spatial_velocity (output, vector of 6): of B in W, rotation first (rad/s, m/s).
        spatial_acceleration (output, vector of 6): of B in W, rotation first (rad/s^2, m/s^2).

    The plant's ports of all body poses would do too, but Python makes a list of all of them each
    time one is looked at.
    """

    def __init__(self, *, num_positions: int, num_velocities: int) -> None:
        super().__init__()
        require(num_positions >= 7, "num_positions", num_positions, "at least 7")
        self._velocities = slice(num_positions, num_positions + 6)
        self._state_input = self.DeclareVectorInputPort("state", num_positions + num_velocities)
        self._acceleration_input = self.DeclareVectorInputPort(
            "generalized_acceleration", num_velocities
        )
        state_only = {self._state_input.ticket()}
        self.DeclareAbstractOutputPort(
            "pose", lambda: AbstractValue.Make(RigidTransform()), self._calc_pose, state_only
        )
        self.DeclareVectorOutputPort("planar_pose", 3, self._calc_planar_pose, state_only)
        self.DeclareVectorOutputPort(
            "spatial_velocity",
            6,
            lambda context, output: output.SetFromVector(
                self._state_input.Eval(context)[self._velocities]
            ),
            state_only,
        )
        self.DeclareVectorOutputPort(
            "spatial_acceleration",
            6,
            lambda context, output: output.SetFromVector(
                self._acceleration_input.Eval(context)[:6]
            ),
            {self._acceleration_input.ticket()},
        )

    def _calc_pose(self, context: Context, output: Any) -> None:
        state = self._state_input.Eval(context)
        w, i, j, k = state[:4].tolist()
        n = math.sqrt(w * w + i * i + j * j + k * k)
        # From an array and a rotation matrix at once: of anything else pydrake makes these first.
        R_WB = RotationMatrix(Quaternion(w / n, i / n, j / n, k / n))
        output.set_value(RigidTransform(R_WB, state[4:7]))

    def _calc_planar_pose(self, context: Context, output: Any) -> None:
        w, i, j, k, x, y = self._state_input.Eval(context)[:6].tolist()
        theta = math.atan2(2 * (w * k + i * j), w * w + i * i - j * j - k * k)
        output.SetFromVector([x, y, theta])

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder, plant: MultibodyPlant, model: ModelInstanceIndex
    ) -> BodyState:
        """Adds the block for a model whose base floats, connected to the plant's outputs."""
        state = builder.AddSystem(
            BodyState(
                num_positions=plant.num_positions(model), num_velocities=plant.num_velocities(model)
            )
        )
        builder.Connect(plant.get_state_output_port(model), state.GetInputPort("state"))
        builder.Connect(
            plant.get_generalized_acceleration_output_port(model),
            state.GetInputPort("generalized_acceleration"),
        )
        return state


class TwinState(LeafSystem):
    """What `BodyState` says, of a kinematic twin that stands and turns on the ground.

    .. pydrake_system::

        name: TwinState
        input_ports:
        - twin_pose
        - twin_velocity
        output_ports:
        - pose
        - planar_pose
        - spatial_velocity
        - spatial_acceleration

    Ports:
        twin_pose (input, vector of 3): [x (m), y (m), theta (rad)] in the world.
        twin_velocity (input, vector of 2): [v (m/s), omega (rad/s)].
        pose (output, RigidTransform): `X_WB`.
        planar_pose (output, vector of 3): [x (m), y (m), theta (rad)], theta in (-pi, pi].
        spatial_velocity (output, vector of 6): of B in W, rotation first (rad/s, m/s).
        spatial_acceleration (output, vector of 6): of B in W, rotation first (rad/s^2, m/s^2); of
            steady motion: the twin's wheels change their speed in no time.
    """

    def __init__(self) -> None:
        super().__init__()
        self._pose_input = self.DeclareVectorInputPort("twin_pose", 3)
        self._velocity_input = self.DeclareVectorInputPort("twin_velocity", 2)
        pose_only = {self._pose_input.ticket()}
        both = {self._pose_input.ticket(), self._velocity_input.ticket()}
        self.DeclareAbstractOutputPort(
            "pose",
            lambda: AbstractValue.Make(RigidTransform()),
            lambda context, output: output.set_value(spatial_pose(self._pose_input.Eval(context))),
            pose_only,
        )
        self.DeclareVectorOutputPort("planar_pose", 3, self._calc_planar_pose, pose_only)
        self.DeclareVectorOutputPort("spatial_velocity", 6, self._calc_velocity, both)
        self.DeclareVectorOutputPort("spatial_acceleration", 6, self._calc_acceleration, both)

    def _calc_planar_pose(self, context: Context, output: Any) -> None:
        x, y, theta = self._pose_input.Eval(context)
        output.SetFromVector([x, y, wrap(theta)])

    def _calc_velocity(self, context: Context, output: Any) -> None:
        theta = self._pose_input.Eval(context)[2]
        v, omega = self._velocity_input.Eval(context)
        output.SetFromVector([0.0, 0.0, omega, v * np.cos(theta), v * np.sin(theta), 0.0])

    def _calc_acceleration(self, context: Context, output: Any) -> None:
        theta = self._pose_input.Eval(context)[2]
        v, omega = self._velocity_input.Eval(context)
        centripetal = v * omega
        output.SetFromVector(
            [0.0, 0.0, 0.0, -centripetal * np.sin(theta), centripetal * np.cos(theta), 0.0]
        )


class TwinPositions(LeafSystem):
    """Puts the planar poses of kinematic twins into the positions of their multibody model.

    .. pydrake_system::

        name: TwinPositions
        input_ports:
        - "{model}"
        output_ports:
        - positions

    Args:
        plant: the model, finalized; each robot's `base_link` floats in it.
        models: names of the robots' model instances.

    Ports:
        {model} (input, vector of 3): [x (m), y (m), theta (rad)] of that robot's `base_link`.
        positions (output, vector of the plant's positions): wheels at their zeros.
    """

    def __init__(self, *, plant: MultibodyPlant, models: list[str]) -> None:
        super().__init__()
        context = plant.CreateDefaultContext()
        zero = plant.GetPositions(context)
        bodies = [plant.GetBodyByName("base_link", plant.GetModelInstanceByName(m)) for m in models]
        starts = [body.floating_positions_start() for body in bodies]
        inputs = [self.DeclareVectorInputPort(model, 3) for model in models]

        def calc(own: Context, output: Any) -> None:
            q = zero.copy()
            for port, start in zip(inputs, starts, strict=True):
                x, y, theta = port.Eval(own)
                # A floating body's positions: quaternion (w first), then its place.
                q[start : start + 7] = [np.cos(theta / 2), 0, 0, np.sin(theta / 2), x, y, 0]
            output.SetFromVector(q)

        self.DeclareVectorOutputPort("positions", len(zero), calc)
