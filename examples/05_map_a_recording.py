"""Map the tags of a recording: your own, or one that the navigation robot makes on the spot.

    python 05_map_a_recording.py [RECORDING SIZE [CAMERA]]

SIZE is the side of the tags' black squares in metres; CAMERA is a camera file, for recordings
without CameraInfo. Of the robot's own recording the true map is known, and drawn beside ours.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from pydrake.math import RigidTransform

from diagrams.mapping import map_recording
from diagrams.run import simulate
from diagrams.scenario import load_scenario
from systems.markers.layout import load_map

given = sys.argv[1:]
truth = None
if given:
    recording, size = Path(given[0]), float(given[1])
else:
    scenario = load_scenario("navigation_open", {"sight": "projected", "duration": 20})
    simulate(scenario, out=Path("drive"))
    truth = scenario.world.marker_map()
    recording, size = Path("drive/bag"), truth.size

camera = Path(given[2]) if len(given) > 2 else None
run = map_recording(recording, out=Path("map"), size=size, camera=camera)
metrics = run.report["metrics"]
print(f"{run.report['outcome']}: {metrics['tags']} tags, {metrics['frames']} frames, "
      f"{metrics['reprojection_rms_px']:.3f} px RMS")  # fmt: skip
for reason in run.report["reasons"].values():
    sys.exit(f"not to be trusted: {reason}")
print("map/summary.png")

found = load_map(Path("map/map.json"))
anchor = run.report["map"]["held"][0]
X_WA = truth.markers[anchor].X_WM if truth else RigidTransform()  # ours is told from its anchor
tags = np.array([X_WA @ marker.X_WM.translation() for marker in found])
way = np.array([X_WA @ p for p in run.path.p_WB])

axes = Figure(figsize=(6, 6), layout="constrained").subplots()
axes.plot(way[:, 0], way[:, 1], label="way")
axes.plot(tags[:, 0], tags[:, 1], "x", label="tags, mapped")
if truth:
    p = np.array([truth.markers[marker.id].X_WM.translation() for marker in found])
    axes.plot(p[:, 0], p[:, 1], "o", fillstyle="none", label="tags, in truth")
    print(f"tags are off by {1e3 * np.linalg.norm(tags - p, axis=1).mean():.1f} mm on average")
axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title=str(recording))
axes.legend()
axes.figure.savefig("map_of_tags.png", dpi=120)
print("map_of_tags.png")
