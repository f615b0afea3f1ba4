"""A controller of your own in the navigation robot: name it in the scenario, simulate, plot.

The robot, its camera, its filter and its arena stay as they are.
"""

import numpy as np
from matplotlib.figure import Figure
from pydrake.systems.framework import LeafSystem

from diagrams.run import simulate
from diagrams.scenario import load_scenario


class CarrotController(LeafSystem):
    """Always at full speed, turning in proportion to the sine of the bearing."""

    def __init__(self, *, speed: float = 0.25, gain: float = 1.5):
        super().__init__()
        self.speed, self.gain = speed, gain
        self.pose = self.DeclareVectorInputPort("pose", 3)  # x, y, theta in map
        self.goal = self.DeclareVectorInputPort("goal", 2)  # the next waypoint
        self.DeclareVectorOutputPort("command", 2, self.calc_command)  # v, omega

    def calc_command(self, context, output):
        x, y, theta = self.pose.Eval(context)
        goal_x, goal_y = self.goal.Eval(context)
        bearing = np.arctan2(goal_y - y, goal_x - x) - theta
        turn = self.gain if np.cos(bearing) < 0 else self.gain * np.sin(bearing)
        output.SetFromVector([self.speed * max(0.0, np.cos(bearing)), turn])


controllers = {
    "waypoint controller": "waypoint",
    "carrot controller": {"type": f"{__name__}:CarrotController", "gain": 1.2},
}
axes = Figure(figsize=(6, 5), layout="constrained").subplots()
for (label, controller), style in zip(controllers.items(), ("-", "--"), strict=True):
    scenario = load_scenario("navigation", {"sight": "projected", "controller": controller})
    run = simulate(scenario)
    metrics = run.report["metrics"]
    print(f"{label}: {run.report['outcome']} after {metrics['time_to_goal_s']:.1f} s, "
          f"{metrics['path_length_m']:.2f} m")  # fmt: skip
    truth = run.mission.pose_log(run.context).truth
    axes.plot(truth[:, 0], truth[:, 1], style, label=label)

axes.plot(*np.transpose(scenario.waypoints), "k+", markersize=12, label="waypoints")
axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="The same robot, two controllers")
axes.legend()
axes.figure.savefig("own_controller.png", dpi=120)
print("own_controller.png")
