"""Four tracking controllers on one route: the same robot, map and noise, how far off is each?

The LIMO knows the map of its tags and follows the bundled route for a third of a lap, from a start
13 cm beside it. Kanayama's law, pure pursuit, time-varying LQR and MPC have the same ports.
"""

from matplotlib.figure import Figure

from diagrams.run import simulate
from diagrams.scenario import load_scenario

axes = Figure(figsize=(7.5, 4), layout="constrained").subplots()
styles = {"kanayama": "-", "pure_pursuit": "--", "tvlqr": "-.", "mpc": ":"}
for controller, style in styles.items():
    changes = {"sight": "projected", "controller": controller, "duration": 11.0}
    run = simulate(load_scenario("replay", changes))
    metrics = run.report["metrics"]
    print(
        f"{controller}: joins the route after {metrics['joined_after_m']:.2f} m, then "
        f"{1e3 * metrics['cross_track_rmse_m']:.1f} mm RMS beside it, "
        f"at most {1e3 * metrics['cross_track_max_m']:.1f} mm"
    )
    log = run.mission.replay_log(run.context)
    way, left = log.cross_track(log.poses.truth[log.on_the_way()])
    axes.plot(way, 100 * left, style, label=controller)

axes.set(xlabel="way along the route [m]", ylabel="left of the route [cm]")
axes.axhline(0.0, color="0.7", linewidth=0.8)
axes.legend()
axes.figure.savefig("compare_trackers.png", dpi=120)
print("compare_trackers.png")
