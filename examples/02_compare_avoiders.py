"""Two avoiders in one arena: change one key of the scenario, compare the paths.

The paper's sector method and VFH+ have the same ports; robot, filter, planner and noise are equal.
"""

from matplotlib.figure import Figure

from diagrams.plots import draw_arena
from diagrams.run import simulate
from diagrams.scenario import load_scenario

axes = Figure(figsize=(7, 5.5), layout="constrained").subplots()
for avoider, style in (("sector", "--"), ("vfh_plus", "-")):
    scenario = load_scenario("navigation", {"sight": "projected", "avoider": avoider})
    run = simulate(scenario)
    metrics = run.report["metrics"]
    print(
        f"{avoider}: {run.report['outcome']} after {run.report['sim_seconds']:.1f} s, "
        f"{metrics['path_length_m']:.2f} m, nearest obstacle {metrics['min_clearance_m']:.2f} m, "
        f"jerk {metrics['integrated_jerk']:.1f} m^2/s^5"
    )
    truth = run.mission.pose_log(run.context).truth
    axes.plot(truth[:, 0], truth[:, 1], style, label=avoider)

draw_arena(axes, scenario.world.arena)
for k, (x, y) in enumerate(scenario.waypoints, start=1):
    axes.annotate(str(k), (x, y), ha="center", va="center", bbox={"boxstyle": "circle", "fc": "w"})
axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="The same robot, two avoiders")
axes.legend(loc="upper left")
axes.figure.savefig("compare_avoiders.png", dpi=120)
print("compare_avoiders.png")
