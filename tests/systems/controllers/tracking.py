"""Routes with known answers, and a robot that does what it is told, for the tests of trackers."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

from systems.controllers.path_tracking import PathTracker
from systems.controllers.unicycle import Unicycle
from systems.planners.route import Route

Array = NDArray[np.float64]


def circle(radius: float = 1.5, v: float = 0.4, way: float = 1.0) -> Route:
    """A closed circle that begins at the origin along x, to the left for way 1, right for -1."""
    n = round(2 * math.pi * radius / v / 0.05)
    t = 2 * math.pi * radius / v / n * np.arange(n)
    a = way * v / radius * t
    return Route(
        t, way * radius * np.sin(a), way * radius * (1 - np.cos(a)), a, np.full(n, v),
        np.full(n, way * v / radius), closed=True,
    )  # fmt: skip


def straight(length: float = 4.0, v: float = 0.4) -> Route:
    t = 0.05 * np.arange(round(length / v / 0.05) + 1)
    one, none = np.ones(len(t)), np.zeros(len(t))
    return Route(t, v * t, none, none, v * one, none)


def mirrored(route: Route) -> Route:
    return Route(route.t, route.x, -route.y, -route.theta, route.v, -route.omega, route.closed)


def closed_loop(
    tracker: PathTracker, start: tuple[float, float, float], duration: float
) -> tuple[Array, Array, Context]:
    """Lets a tracker lead a perfect robot: poses and commands at 100 Hz, and the tracker's end."""
    builder = DiagramBuilder()
    robot: LeafSystem = builder.AddSystem(Unicycle())
    builder.AddSystem(tracker)
    covariance = builder.AddSystem(ConstantVectorSource(1e-6 * np.eye(3).ravel()))
    builder.Connect(robot.GetOutputPort("pose"), tracker.GetInputPort("pose"))
    builder.Connect(covariance.get_output_port(), tracker.GetInputPort("covariance"))
    builder.Connect(tracker.GetOutputPort("command"), robot.GetInputPort("command"))
    poses = LogVectorOutput(robot.GetOutputPort("pose"), builder, 0.01)
    commands = LogVectorOutput(tracker.GetOutputPort("command"), builder, 0.01)
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    robot.GetMyMutableContextFromRoot(root).SetContinuousState(list(start))
    simulator.AdvanceTo(duration)
    return (
        poses.FindLog(root).data().T.copy(),
        commands.FindLog(root).data().T.copy(),
        tracker.GetMyContextFromRoot(root),
    )
