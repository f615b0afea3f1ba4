"""A robot on a shell that stands, and another on the shell which the first carries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Adder

from plants.magnets import MagneticAdhesion, MagnetParameters
from plants.shell import ShellParameters, add_shell
from plants.snailbot import (
    SnailBotParameters,
    add_snailbot,
    carried_shell_pose,
    servo_matrix,
    stance,
    wheel_speeds,
)

ROBOT = SnailBotParameters()
SHELL = ShellParameters()


class TwoRobots:
    """Both at rest, the servos told to stay.

    Args:
        angles: [roll, pitch, yaw] of the upper robot on the shell that the lower one carries, deg.
        below: of the lower one on the shell that stands, deg.
        forces: of the magnets of the lower and of the upper one, N.
        load: whether the lower one's margin is told what it carries.
    """

    def __init__(
        self,
        angles: Sequence[float],
        *,
        below: Sequence[float] = (0.0, 90.0, 0.0),
        forces: Sequence[float] = (4.0, 4.0),
        load: bool = True,
    ) -> None:
        builder = DiagramBuilder()
        config = MultibodyPlantConfig(
            time_step=1 / 300, discrete_contact_approximation="lagged",
            use_sampled_output_ports=False,
        )  # fmt: skip
        self.plant, _ = AddMultibodyPlant(config, builder)
        plant = self.plant
        reference = add_shell(plant, SHELL, "reference")
        one = add_snailbot(plant, ROBOT, SHELL, "one")
        base = plant.GetBodyByName("base_link", one)
        X_BR = carried_shell_pose(ROBOT, SHELL)
        own = add_shell(plant, SHELL, "one_shell", base.body_frame(), X_BR)
        two = add_snailbot(plant, ROBOT, SHELL, "two")
        X_WB = stance(np.radians(below), ROBOT, SHELL)
        plant.SetDefaultFloatingBaseBodyPose(base, X_WB)
        X_WTwo = X_WB @ X_BR @ stance(np.radians(angles), ROBOT, SHELL)
        plant.SetDefaultFloatingBaseBodyPose(plant.GetBodyByName("base_link", two), X_WTwo)
        plant.Finalize()
        self.robots: list[ModelInstanceIndex] = [one, two]
        self.shells: list[ModelInstanceIndex] = [reference, own]
        loads = [[own, two] if load else [], []]
        self.adhesions = [
            builder.AddSystem(
                MagneticAdhesion(
                    plant=plant,
                    model=self.robots[k],
                    shell=self.shells[k],
                    wheel_radius=ROBOT.wheel_radius,
                    shell_parameters=SHELL,
                    parameters=MagnetParameters(force=forces[k]),
                    carried=loads[k],
                )
            )
            for k in (0, 1)
        ]
        total = builder.AddSystem(Adder(2, plant.num_velocities()))
        for k, adhesion in enumerate(self.adhesions):
            builder.Connect(plant.get_state_output_port(), adhesion.state_input_port())
            builder.Connect(adhesion.generalized_forces_output_port(), total.get_input_port(k))
        builder.Connect(total.get_output_port(), plant.get_applied_generalized_force_input_port())
        for k in (0, 1):
            builder.ExportInput(plant.get_desired_state_input_port(self.robots[k]), f"servos_{k}")
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        self.plant_context = plant.GetMyMutableContextFromRoot(self.context)
        for k in (0, 1):
            self.command(k, 0.0, 0.0)

    def command(self, k: int, v: float, omega: float) -> None:
        """Tells the lower (0) or upper (1) robot how to drive."""
        servos = servo_matrix(self.plant, self.robots[k], ROBOT, SHELL)
        speeds = servos @ wheel_speeds([v, omega], ROBOT, SHELL)
        self.diagram.GetInputPort(f"servos_{k}").FixValue(self.context, speeds)

    def run(self, duration: float) -> None:
        self.simulator.AdvanceTo(self.context.get_time() + duration)

    def output(self, k: int, name: str) -> Any:
        """Of the magnets of the lower or upper robot."""
        adhesion = self.adhesions[k]
        return adhesion.GetOutputPort(name).Eval(adhesion.GetMyContextFromRoot(self.context))

    def pose(self, k: int) -> RigidTransform:
        """Of the lower or upper robot on its shell."""
        X_WR, X_WB = (
            self.plant.GetBodyByName(name, model).EvalPoseInWorld(self.plant_context)
            for name, model in (("shell", self.shells[k]), ("base_link", self.robots[k]))
        )
        return X_WR.inverse() @ X_WB
