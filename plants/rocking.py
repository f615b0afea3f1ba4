"""A body that rocks on its springs, carried by a chassis that does not; see `rocking_motion`."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import FrameId, FramePoseVector, GeometryFrame, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    InputPort,
    LeafSystem,
    OutputPort,
    ValueProducer,
)

from plants.rocking_motion import ADDED, POSE, VELOCITY, RockingParameters, draw_waves, ride
from systems.compiled import packed
from systems.noise import NoiseStream
from systems.validation import require


class RockingBody(LeafSystem):
    """Rocks on its springs over a chassis, at random within a band of frequencies.

    .. pydrake_system::

        name: RockingBody
        input_ports:
        - state
        - generalized_acceleration
        output_ports:
        - pose
        - spatial_velocity
        - spatial_acceleration
        - frame_pose

    Args:
        num_positions: of the chassis' model instance; the floating body's quaternion and place come
            first.
        num_velocities: likewise; the floating body's come first.
        parameters: how far and how fast.
        frame_id: of a geometry frame that rocks with the body, its parent the world's; None for
            none.
        seed: of the motion, a parameter of the Context.
        name: of the noise stream.

    Ports:
        state (input, vector of positions and velocities): the plant's `{model}_state`.
        generalized_acceleration (input, vector of velocities): the plant's
            `{model}_generalized_acceleration`.
        pose (output, RigidTransform): `X_WB`; its origin is B0's.
        spatial_velocity (output, vector of 6): of B in W, rotation first (rad/s, m/s).
        spatial_acceleration (output, vector of 6): likewise (rad/s^2, m/s^2).
        frame_pose (output, FramePoseVector): `X_WB` for SceneGraph; empty without a frame.

    It stands where a `BodyState` does for a body without springs. The motion is a sum of sines
    drawn from the seed and depends on nothing but the time: nothing that happens to the chassis
    shakes the body, and the body's inertia does not act back. It fades in during the first half
    second.

    Raises:
        ValueError: num_positions or seed out of range.
    """

    def __init__(
        self,
        *,
        num_positions: int = 7,
        num_velocities: int = 6,
        parameters: RockingParameters | None = None,
        frame_id: FrameId | None = None,
        seed: int = 0,
        name: str = "rocking",
    ) -> None:
        super().__init__()
        require(num_positions >= 7, "num_positions", num_positions, "at least 7")
        self._num_positions = num_positions
        self._parameters = parameters or RockingParameters()
        self._frame_id = frame_id
        self._noise = NoiseStream(self, seed=seed, name=name)
        self._state_input = self.DeclareVectorInputPort("state", num_positions + num_velocities)
        self._acceleration_input = self.DeclareVectorInputPort(
            "generalized_acceleration", num_velocities
        )
        self._waves = self.DeclareCacheEntry(
            "sines of this seed",
            ValueProducer(allocate=lambda: AbstractValue.Make([]), calc=self._calc_waves),
            {self.all_parameters_ticket()},
        )
        self._motion = self.DeclareCacheEntry(
            "the body in the world",
            ValueProducer(allocate=lambda: AbstractValue.Make([]), calc=self._calc_motion),
            {self.time_ticket(), self._waves.ticket(), self._state_input.ticket()},
        )
        motion = {self._motion.ticket()}
        self._pose_output = self.DeclareAbstractOutputPort(
            "pose", lambda: AbstractValue.Make(RigidTransform()), self._calc_pose, motion
        )
        self._velocity_output = self.DeclareVectorOutputPort(
            "spatial_velocity", 6, self._calc_velocity, motion
        )
        self._acceleration_output = self.DeclareVectorOutputPort(
            "spatial_acceleration",
            6,
            self._calc_acceleration,
            motion | {self._acceleration_input.ticket()},
        )
        self._frame_pose_output = self.DeclareAbstractOutputPort(
            "frame_pose",
            lambda: AbstractValue.Make(FramePoseVector()),
            self._calc_frame_pose,
            motion,
        )

    @property
    def frame_id(self) -> FrameId | None:
        """The geometry frame that rocks with the body."""
        return self._frame_id

    def state_input_port(self) -> InputPort:
        """Returns the port of positions and velocities."""
        return self._state_input

    def generalized_acceleration_input_port(self) -> InputPort:
        """Returns the port of the accelerations."""
        return self._acceleration_input

    def pose_output_port(self) -> OutputPort:
        """Returns the port of the body's pose."""
        return self._pose_output

    def spatial_velocity_output_port(self) -> OutputPort:
        """Returns the port of the body's velocity."""
        return self._velocity_output

    def spatial_acceleration_output_port(self) -> OutputPort:
        """Returns the port of the body's acceleration."""
        return self._acceleration_output

    def frame_pose_output_port(self) -> OutputPort:
        """Returns the port of the geometry frame's pose."""
        return self._frame_pose_output

    def _calc_waves(self, context: Context, output: AbstractValue) -> None:
        output.set_value([draw_waves(self._parameters, self._noise.generator(context, 0))])

    def _calc_motion(self, context: Context, output: AbstractValue) -> None:
        (waves,) = self._waves.Eval(context)
        state = packed(self._state_input.Eval(context))
        motion = np.empty(21)
        ride(waves.rates, waves.weights, context.get_time(), state, self._num_positions, motion)
        output.set_value([motion])

    def _calc_pose(self, context: Context, output: AbstractValue) -> None:
        (motion,) = self._motion.Eval(context)
        # A product of rotations is one: it needs no check.
        output.set_value(RigidTransform.MakeUnchecked(motion[POSE].reshape(3, 4)))

    def _calc_velocity(self, context: Context, output: Any) -> None:
        (motion,) = self._motion.Eval(context)
        output.SetFromVector(motion[VELOCITY])

    def _calc_acceleration(self, context: Context, output: Any) -> None:
        (motion,) = self._motion.Eval(context)
        acceleration = self._acceleration_input.Eval(context)[:6].copy()
        acceleration[:3] += motion[ADDED]
        output.SetFromVector(acceleration)

    def _calc_frame_pose(self, context: Context, output: Any) -> None:
        if self._frame_id is not None:
            X_WB = self._pose_output.Eval(context)
            output.get_mutable_value().set_value(self._frame_id, X_WB)

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder,
        plant: MultibodyPlant,
        model: ModelInstanceIndex,
        scene_graph: SceneGraph,
        *,
        parameters: RockingParameters | None = None,
        seed: int = 0,
        name: str = "rocking",
    ) -> RockingBody:
        """Adds the block over a model whose base floats, with a geometry frame of its name.

        It is connected to plant and scene. A camera on the body has this frame (`frame_id`) as its
        parent.
        """
        source = scene_graph.RegisterSource(name)
        frame = scene_graph.RegisterFrame(source, GeometryFrame(name))
        block = builder.AddSystem(
            RockingBody(
                num_positions=plant.num_positions(model),
                num_velocities=plant.num_velocities(model),
                parameters=parameters,
                frame_id=frame,
                seed=seed,
                name=name,
            )
        )
        block.set_name(name)
        builder.Connect(plant.get_state_output_port(model), block.state_input_port())
        builder.Connect(
            plant.get_generalized_acceleration_output_port(model),
            block.generalized_acceleration_input_port(),
        )
        builder.Connect(block.frame_pose_output_port(), scene_graph.get_source_pose_port(source))
        return block
