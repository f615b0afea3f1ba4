"""The paper's rule and our filter on a peer's shell: change one key, compare the errors.

The robot climbs over the pole. Camera, markers, gyro and body have the same errors for both, drawn
from bounds of your own.
"""

import numpy as np
from matplotlib.figure import Figure

from diagrams.run import simulate
from diagrams.scenario import load_scenario

bounds = {"placement_deg": 0.5, "mounting_deg": 1.5, "flow_scale": 0.03, "gyro_bias_deg_s": 0.3}
over_the_pole = {"roll_deg": 0, "pitch_deg": 0, "yaw_deg": 0, "arc_deg": 180}

axes = Figure(figsize=(7, 4), layout="constrained").subplots()
for estimator, style in (("rule", "--"), ("ekf", "-")):
    scenario = load_scenario(
        "snailbot",
        {
            "sight": "projected",
            "estimator": estimator,
            "errors": bounds,
            "team": [{"route": [over_the_pole]}],
        },
    )
    run = simulate(scenario)
    log = run.mission.shell_log(run.context)
    error = np.linalg.norm(log.errors(), axis=1)
    axes.plot(log.t, error, style, label=estimator)
    print(
        f"{estimator}: {run.report['outcome']}, after the second marker "
        f"{np.sqrt(np.mean(error[log.scored()] ** 2)):.2f} deg RMS, "
        f"{1e3 * run.report['metrics']['position_rmse_m']:.2f} mm"
    )

axes.fill_between(log.t, 0, 0.03, where=log.visible, color="k", label="marker in view")
axes.set(xlabel="time [s]", ylabel="error of the orientation [deg]", ylim=(0, None))
axes.set_title("The same robot, two estimators")
axes.legend()
axes.figure.savefig("shell_estimators.png", dpi=120)
print("shell_estimators.png")
