"""How long should the sides of a formation's triangles be? Build some of each, count the moves.

Robots build triangles by pixels alone (the paper's Algorithm I) and by bearings (resection), two
hundred of each size, in worlds of kinematics and projection that are all simulated at once.
"""

import numpy as np
from matplotlib.figure import Figure

from systems.formation.trials import TrialParameters, build_by_algorithm1, build_by_resection
from systems.formation.vertex_walk import closest_vertex_walk

SIDES = (0.75, 1.0, 1.5, 2.0, 3.0)  # m
TRIALS = 200

left, right = Figure(figsize=(8, 3.6), layout="constrained").subplots(1, 2)
for name, build, style in (
    ("Algorithm I", build_by_algorithm1, "o-"),
    ("resection", build_by_resection, "s--"),
):
    errors = []
    for side in SIDES:
        outcome = build(TRIALS, 0, TrialParameters(side=side))
        errors.append(1e3 * np.mean(np.hypot(outcome.aside, outcome.along)))
        print(f"{name}, {side} m: {errors[-1]:.1f} mm off on average, "
              f"built in {np.mean(outcome.seconds):.0f} s")  # fmt: skip
    left.plot(SIDES, errors, style, label=name)

moves = [len(closest_vertex_walk([(30.0, 0.65)], side=side)) for side in SIDES]
print("moves over 30 m:", dict(zip(SIDES, moves, strict=True)))
right.plot(SIDES, moves, "kD:")
left.set(title="One triangle", ylabel="mean error [mm]", ylim=(0, None))
right.set(title="30 m of them", ylabel="moves", ylim=(0, None))
for axes in (left, right):
    axes.set_xlabel("side [m]")
    axes.grid(alpha=0.3)
left.legend()
left.figure.savefig("formation_sides.png", dpi=120)
print("formation_sides.png")
