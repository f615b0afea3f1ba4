"""A robot that drives as it is told, v and omega: the plant that controllers are designed on."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff
from pydrake.math import cos, sin
from pydrake.systems.framework import BasicVector_, LeafSystem_, System
from pydrake.systems.scalar_conversion import TemplateSystem

Array = NDArray[np.float64]


@TemplateSystem.define("Unicycle_")
def Unicycle_(T: Any) -> Any:  # noqa: D103 - the class carries the documentation
    class Impl(LeafSystem_[T]):
        """The kinematics of a robot that does not slip sideways.

        .. pydrake_system::

            name: Unicycle
            input_ports:
            - command
            output_ports:
            - pose

        Ports:
            command (input, vector of 2): [v (m/s), omega (rad/s)].
            pose (output, vector of 3): [x (m), y (m), theta (rad)], continuous state, theta not
                wrapped.

        Scalar types: float, AutoDiffXd, Expression.
        """

        def _construct(self, *, converter: Any = None) -> None:
            super().__init__(converter=converter)
            self._command_input = self.DeclareVectorInputPort("command", BasicVector_[T](2))
            self._pose_output = self.DeclareStateOutputPort("pose", self.DeclareContinuousState(3))

        def _construct_copy(self, other: Any, converter: Any = None) -> None:  # noqa: ARG002
            Impl._construct(self, converter=converter)

        def command_input_port(self) -> Any:
            """Returns the port of the command."""
            return self._command_input

        def pose_output_port(self) -> Any:
            """Returns the port of the pose."""
            return self._pose_output

        def DoCalcTimeDerivatives(self, context: Any, derivatives: Any) -> None:
            theta = context.get_continuous_state_vector().GetAtIndex(2)
            v, omega = self._command_input.Eval(context)
            derivatives.get_mutable_vector().SetFromVector([v * cos(theta), v * sin(theta), omega])

    return Impl


Unicycle = Unicycle_[None]


def linearized(plant: System, states: Array, inputs: Array) -> tuple[Array, Array]:
    """Linearises a plant at many points with one conversion to automatic differentiation.

    `pydrake.systems.primitives.FirstOrderTaylorApproximation` gives the same, and converts at each
    point anew.

    Args:
        plant: with continuous state and one vector input.
        states: (k, n).
        inputs: (k, m).

    Returns:
        (k, n, n) and (k, n, m): the derivatives of the state's rate by state and input.
    """
    differentiated = plant.ToAutoDiffXd()
    context = differentiated.CreateDefaultContext()
    port = differentiated.get_input_port(0)
    n, m = states.shape[1], inputs.shape[1]
    A, B = np.zeros((len(states), n, n)), np.zeros((len(states), n, m))
    for k, point in enumerate(np.hstack([states, inputs])):
        variables = InitializeAutoDiff(point).ravel()
        context.SetContinuousState(variables[:n])
        port.FixValue(context, variables[n:])
        rate = differentiated.EvalTimeDerivatives(context).CopyToVector()
        gradient = ExtractGradient(rate)
        A[k], B[k] = gradient[:, :n], gradient[:, n:]
    return A, B
