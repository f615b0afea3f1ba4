"""Projected sight is fitted to rendered sight, drawn sight shows the same: in the bundled arena."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from diagrams.scenario import load_scenario
from systems.angles import spatial_pose
from systems.markers.corner_noise import corner_deviation, narrow_side
from systems.messages import Detections

POSES = 110


def random_poses() -> np.ndarray:
    """Places in the arena that are 0.3 m or more from its walls, and any heading."""
    random = np.random.default_rng(4)
    poses = random.uniform([-2.2, -1.7, -np.pi], [2.2, 1.7, np.pi], (2 * POSES, 3))
    clear = (np.abs(poses[:, 0] + 0.8) > 0.3) & (np.abs(poses[:, 0] - 0.9) > 0.3)
    return poses[clear][:POSES]


def seen_from(poses: np.ndarray, *overrides: str) -> list[Detections]:
    """What the front camera of the bundled robot finds from each pose."""
    mission = load_scenario("navigation_open", overrides).build()
    station = mission.station
    body = station.plant.GetBodyByName("base_link")
    found = []
    for k, pose in enumerate(poses):
        simulator = Simulator(mission.diagram)
        root = simulator.get_mutable_context()
        root.SetTime(k / 15.0)  # the noise depends on the picture's number
        plant_context = station.plant.GetMyMutableContextFromRoot(root)
        station.plant.SetFreeBodyPose(plant_context, body, spatial_pose(pose))
        simulator.Initialize()
        simulator.AdvanceTo(k / 15.0 + 0.03)
        port = station.GetOutputPort("robot.front_camera.detections")
        found.append(port.Eval(station.GetMyContextFromRoot(root)))
    return found


@pytest.fixture(scope="module")
def corners() -> dict[str, dict[tuple[int, int], np.ndarray]]:
    """By sight: (pose, id) to corners (4, 2) px. `exact` is projected without noise."""
    projector = "robot.sensors.front_camera.projector"
    silent = (f"{projector}.pixel_noise=0", f"{projector}.pixel_noise_by_side=0")
    sights = {
        "rendered": ("sight=rendered",),
        "drawn": ("sight=drawn",),
        "projected": ("sight=projected",),
        "exact": ("sight=projected", *silent, f"{projector}.min_side_px=4"),
    }
    poses = random_poses()
    return {
        sight: {
            (k, int(i)): c
            for k, detections in enumerate(seen_from(poses, *overrides))
            for i, c in zip(detections.ids, detections.corners, strict=True)
        }
        for sight, overrides in sights.items()
    }


@pytest.mark.parametrize("sight", ["rendered", "drawn", "projected"])
def test_the_corner_noise_is_as_the_scenario_has_it(
    corners: dict[str, dict[tuple[int, int], np.ndarray]], sight: str
) -> None:
    projector = load_scenario("navigation_open").robot.sensors["front_camera"].build().projector
    both = sorted(corners[sight].keys() & corners["exact"].keys())
    exact = np.array([corners["exact"][key] for key in both])
    error = np.array([corners[sight][key] for key in both]) - exact
    deviation = corner_deviation(exact, projector.pixel_noise, projector.pixel_noise_by_side)
    scaled, side = error / deviation[:, None, None], narrow_side(exact)
    for low, high in ((10, 18), (18, 28), (28, 45), (45, 500)):
        some = scaled[(side >= low) & (side < high)]
        assert len(some) >= 20
        rms = np.sqrt((some**2).mean())
        print(f"{sight}, {low} to {high} px: {len(some)} markers, {rms:.2f} of the model")
        # A drawn picture lacks what the renderer's sampling adds.
        assert (0.3 if sight == "drawn" else 0.75) < rms < 1.3
        assert np.abs(some.mean(axis=(0, 1))).max() < 0.3  # no shift


def test_what_is_found_is_the_same(
    corners: dict[str, dict[tuple[int, int], np.ndarray]],
) -> None:
    rendered = corners["rendered"].keys()
    assert len(rendered) > 150
    for sight in ("drawn", "projected"):
        others = corners[sight].keys()
        assert len(others - rendered) < 0.06 * len(others)
        assert len(rendered - others) < 0.06 * len(rendered)
