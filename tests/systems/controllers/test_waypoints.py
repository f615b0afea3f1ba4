from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.autodiffutils import ExtractValue, InitializeAutoDiff
from pydrake.symbolic import Expression, Variable
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    EventStatus,
    InputPortSelection,
    OutputPortSelection,
)
from pydrake.systems.primitives import (
    ConstantVectorSource,
    FirstOrderTaylorApproximation,
    MatrixGain,
)

from plants.differential_drive import (
    DifferentialDriveParameters,
    KinematicDifferentialDrive,
    wheel_speeds,
)
from systems.angles import wrap
from systems.controllers.waypoints import (
    WaypointController,
    WaypointParameters,
    distance_and_bearing,
    drive_toward,
)

FREE = WaypointParameters(k_p=0.8, k_a=2.0, max_speed=1e3, max_turn_rate=1e3)


@pytest.mark.parametrize(
    ("pose", "goal", "rho", "alpha"),
    [
        ([0, 0, 0], [3, 4], 5.0, math.atan2(4, 3)),
        ([1, 1, math.pi / 2], [1, 3], 2.0, 0.0),
        ([0, 0, math.pi / 2], [1, 0], 1.0, -math.pi / 2),
        ([0, 0, 0], [-1, 0], 1.0, math.pi),
        ([0, 0, 3.0], [-1, -0.1], math.hypot(1, 0.1), math.atan2(-0.1, -1) - 3.0 + 2 * math.pi),
        ([0, 0, 20 * math.pi + 0.25], [2, 0], 2.0, -0.25),
    ],
)
def test_distance_and_bearing(pose: Any, goal: Any, rho: float, alpha: float) -> None:
    found = distance_and_bearing(np.array(pose, float), np.array(goal, float))
    np.testing.assert_allclose(found, [rho, alpha], atol=1e-12)


def test_the_bearing_is_that_of_the_paper_wrapped() -> None:
    rng = np.random.default_rng(0)
    for x, y, theta, gx, gy in rng.uniform(-5, 5, (200, 5)):
        rho, alpha = distance_and_bearing([x, y, theta], [gx, gy])
        assert rho == pytest.approx(math.hypot(gx - x, gy - y))
        assert alpha == pytest.approx(wrap(math.atan2(gy - y, gx - x) - theta), abs=1e-9)


def test_the_command_is_proportional_within_its_limits() -> None:
    p = WaypointParameters(k_p=0.5, k_a=2.0, max_speed=0.3, max_turn_rate=1.0)
    for goal, expected in (
        ([0.4, 0.0], [0.2, 0.0]),
        ([3.0, 0.0], [0.3, 0.0]),  # saturated speed
        ([0.3 * math.cos(0.2), 0.3 * math.sin(0.2)], [0.15, 0.4]),
        ([0.0, 0.4], [0.2, 1.0]),  # saturated turn to the left
        ([0.0, -0.4], [0.2, -1.0]),  # and to the right
        ([-0.4, 0.0], [0.2, 1.0]),  # as printed it drives at every bearing
    ):
        np.testing.assert_allclose(drive_toward([0, 0, 0], goal, p), expected, atol=1e-12)


def test_at_the_waypoint_it_stands() -> None:
    assert drive_toward([1.0, 2.0, 0.3], [1.0, 2.0], WaypointParameters())[0] == 0.0


def test_on_request_it_turns_before_it_drives() -> None:
    p = WaypointParameters(k_p=0.5, max_speed=0.3, turn_in_place_beyond=1.0)
    for bearing, share in ((0.0, 1.0), (0.25, 0.75), (-0.5, 0.5), (1.0, 0.0), (2.0, 0.0)):
        goal = [math.cos(bearing), math.sin(bearing)]
        assert drive_toward([0, 0, 0], goal, p)[0] == pytest.approx(0.3 * share, abs=1e-12)


@pytest.mark.parametrize("field", ["k_p", "k_a", "max_speed", "max_turn_rate"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_nonsense_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}: must be greater than 0"):
        WaypointParameters(**{field: value})


# --- The block, in three scalar types ---

PARAMETERS = [
    WaypointParameters(),
    WaypointParameters(turn_in_place_beyond=1.2),
    WaypointParameters(k_p=0.2, k_a=0.5, max_speed=5.0, max_turn_rate=9.0),
]


def command(parameters: WaypointParameters, x: np.ndarray) -> np.ndarray:
    """The block's command at [pose (3), goal (2)]."""
    block = WaypointController(parameters=parameters)
    context = block.CreateDefaultContext()
    block.pose_input_port().FixValue(context, x[:3])
    block.goal_input_port().FixValue(context, x[3:])
    return block.command_output_port().Eval(context)


@pytest.mark.parametrize("parameters", PARAMETERS)
def test_the_block_commands_what_the_function_says(parameters: WaypointParameters) -> None:
    for x in np.random.default_rng(1).uniform(-2, 2, (20, 5)):
        np.testing.assert_allclose(
            command(parameters, x), drive_toward(x[:3], x[3:], parameters), atol=1e-15
        )


@pytest.mark.parametrize("parameters", PARAMETERS)
def test_automatic_derivatives(parameters: WaypointParameters) -> None:
    block = WaypointController(parameters=parameters).ToAutoDiffXd()
    context = block.CreateDefaultContext()
    h = 1e-6
    for x in np.random.default_rng(2).uniform(-1, 1, (20, 5)):
        ad = InitializeAutoDiff(x).ravel()
        block.pose_input_port().FixValue(context, ad[:3])
        block.goal_input_port().FixValue(context, ad[3:])
        found = block.command_output_port().Eval(context)
        np.testing.assert_allclose(ExtractValue(found).ravel(), command(parameters, x))
        quotient = np.column_stack(
            [
                (command(parameters, x + s) - command(parameters, x - s)) / (2 * h)
                for s in h * np.eye(5)
            ]
        )
        # A saturated command depends on nothing, and then has no derivatives at all.
        gradient = [u.derivatives() if u.derivatives().size else np.zeros(5) for u in found]
        np.testing.assert_allclose(gradient, quotient, atol=1e-5)


@pytest.mark.parametrize("parameters", PARAMETERS)
def test_symbolic_form(parameters: WaypointParameters) -> None:
    block = WaypointController(parameters=parameters).ToSymbolic()
    context = block.CreateDefaultContext()
    variables = [Variable(name) for name in ("x", "y", "theta", "gx", "gy")]
    expressions = np.array([Expression(v) for v in variables])
    block.pose_input_port().FixValue(context, expressions[:3])
    block.goal_input_port().FixValue(context, expressions[3:])
    found = block.command_output_port().Eval(context)
    for x in np.random.default_rng(3).uniform(-2, 2, (20, 5)):
        environment = dict(zip(variables, x, strict=True))
        values = [expression.Evaluate(environment) for expression in found]
        np.testing.assert_allclose(values, command(parameters, x), atol=1e-12)


def closed_loop(parameters: WaypointParameters) -> Any:
    """The controller drives the kinematic robot to the origin."""
    robot = DifferentialDriveParameters()
    inverse = np.column_stack([wheel_speeds([1.0, 0.0], robot), wheel_speeds([0.0, 1.0], robot)])
    builder = DiagramBuilder()
    controller = builder.AddSystem(WaypointController(parameters=parameters))
    drive = builder.AddSystem(KinematicDifferentialDrive(parameters=robot))
    gain = builder.AddSystem(MatrixGain(inverse))
    goal = builder.AddSystem(ConstantVectorSource(np.zeros(2)))
    builder.Connect(drive.pose_output_port(), controller.pose_input_port())
    builder.Connect(goal.get_output_port(), controller.goal_input_port())
    builder.Connect(controller.command_output_port(), gain.get_input_port())
    builder.Connect(gain.get_output_port(), drive.wheel_speeds_input_port())
    return builder.Build()


def test_the_closed_loop_is_linearised_as_theory_says() -> None:
    # At a distance d straight before the waypoint: rho' = -k_p rho, y' = k_p d theta and
    # theta' = k_a (-y / d - theta).
    d, k_p, k_a = 2.0, 0.8, 2.0
    diagram = closed_loop(FREE)
    context = diagram.CreateDefaultContext()
    context.SetContinuousState([-d, 0.0, 0.0])
    linear = FirstOrderTaylorApproximation(
        diagram, context, InputPortSelection.kNoInput, OutputPortSelection.kNoOutput
    )
    expected = [[-k_p, 0.0, 0.0], [0.0, 0.0, k_p * d], [0.0, -k_a / d, -k_a]]
    np.testing.assert_allclose(linear.A(), expected, atol=1e-9)
    np.testing.assert_allclose(linear.f0(), [k_p * d + expected[0][0] * d, 0, 0], atol=1e-9)


@pytest.mark.parametrize(("k_a", "stable"), [(2.0, True), (1.0, True), (0.6, False)])
def test_the_bearing_dies_out_if_the_turn_is_faster_than_the_approach(
    k_a: float, stable: bool
) -> None:
    # alpha' = k_p sin(alpha) - k_a alpha, rho' = -k_p rho cos(alpha): stable for k_a > k_p.
    k_p, alpha0, T = 0.8, 0.02, 2.0
    diagram = closed_loop(WaypointParameters(k_p=k_p, k_a=k_a, max_speed=1e3, max_turn_rate=1e3))
    simulator = Simulator(diagram)
    state = simulator.get_mutable_context().get_mutable_continuous_state_vector()
    state.SetFromVector([-2.0, 0.0, -alpha0])
    simulator.AdvanceTo(T)
    rho, alpha = distance_and_bearing(state.CopyToVector(), [0.0, 0.0])
    assert (abs(alpha) < alpha0) == stable
    assert alpha == pytest.approx(alpha0 * math.exp((k_p - k_a) * T), rel=2e-3)
    assert rho == pytest.approx(2.0 * math.exp(-k_p * T), rel=2e-3)


def test_from_anywhere_the_waypoint_is_reached() -> None:
    for pose in np.random.default_rng(4).uniform([-3, -3, -np.pi], [3, 3, np.pi], (10, 3)):
        diagram = closed_loop(WaypointParameters(turn_in_place_beyond=1.5))

        def near(context: Context, diagram: Any = diagram) -> EventStatus:
            if math.hypot(*context.get_continuous_state_vector().CopyToVector()[:2]) > 0.05:
                return EventStatus.DidNothing()
            return EventStatus.ReachedTermination(diagram, "near")

        simulator = Simulator(diagram)
        simulator.get_mutable_context().SetContinuousState(pose)
        simulator.set_monitor(near)
        assert (
            simulator.AdvanceTo(40.0).reason()
            == SimulatorStatus.ReturnReason.kReachedTerminationCondition
        )
