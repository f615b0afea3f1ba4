"""The replay of a robot on a shell in a browser: print, holes, ghost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    Meshcat,
    MeshcatParams,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Role,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from diagrams.shell_viewer import ShellViewer
from plants.shell import ShellParameters, add_shell
from plants.shell_surface import add_shell_surface
from plants.snailbot import SnailBotParameters, stance
from systems.drawing.shells import bent
from systems.shell.angles import angles_of
from systems.shell.layout import shell_markers
from tests.diagrams.test_replay import CHROMIUM, SEEK, browse

Array = NDArray[np.float64]

WIDTH, HEIGHT = 1600, 1200
RATE = 20.0
EARLY, LATE = 0.2, 0.8  # s; the estimate is known from 0.5 s on
BODY, SHELL = SnailBotParameters(), ShellParameters()
MARKERS = shell_markers(radius=SHELL.radius)
MARKER = MARKERS.markers[8]
X_WR = RigidTransform(RollPitchYaw(0.2, -0.1, 0.4), [0.05, 0.02, 0.1])
EYE = X_WR @ (2.4 * MARKER.X_WM.translation())

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="the program chromium is not installed")


def estimate() -> RigidTransform:
    """X_RB of a robot that stands 45 degrees to the east of the marker."""
    place = MARKER.X_WM.translation()
    yaw = np.arctan2(place[1], place[0]) + np.radians(45)
    return stance(np.array([0.3, np.radians(30), yaw]), BODY, SHELL)


def replay() -> str:
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    meshcat.SetCameraPose(EYE, X_WR @ MARKER.X_WM.translation())
    for name in ("/Grid", "/Axes", "/Background"):
        meshcat.SetProperty(name, "visible", False)
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    body = plant.GetBodyByName("shell", add_shell(plant, SHELL, "reference", None, X_WR, False))
    add_shell_surface(plant, body, radius=SHELL.radius, markers=MARKERS, rendered=False)
    plant.Finalize()
    parameters = MeshcatVisualizerParams(publish_period=1 / RATE, role=Role.kIllustration)
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, parameters)
    viewer = builder.AddSystem(ShellViewer(meshcat=meshcat, body=BODY, shell=SHELL, rate=RATE))
    for X, port in (
        (estimate(), viewer.pose_input_port()),
        (X_WR, viewer.reference_pose_input_port()),
    ):
        source = builder.AddSystem(ConstantValueSource(AbstractValue.Make(X)))
        builder.Connect(source.get_output_port(), port)
    variances = np.stack([(v * np.eye(6)).ravel() for v in (10.0, 1e-6, 1e-6)], axis=1)
    covariance = PiecewisePolynomial.ZeroOrderHold([0.0, 0.5, 2.0], variances)
    source = builder.AddSystem(TrajectorySource(covariance))
    builder.Connect(source.get_output_port(), viewer.covariance_input_port())
    meshcat.StartRecording(frames_per_second=RATE)
    Simulator(builder.Build()).AdvanceTo(1.0)
    meshcat.PublishRecording()
    html: str = meshcat.StaticHtml()
    return html


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> dict[float, Any]:
    """Pictures (height, width, 3) of the replay, by time."""
    content = replay()
    assert len(content) < 8e6  # bytes
    found = {}
    for t in (EARLY, LATE):
        folder: Path = tmp_path_factory.mktemp("shot")
        page, target = folder / "replay.html", folder / "shot.png"
        page.write_text(content)
        script = SEEK.replace("TIME", str(t))
        browse(page, script, f"--screenshot={target}", f"--window-size={WIDTH},{HEIGHT}")
        found[t] = cv2.cvtColor(cv2.imread(str(target)), cv2.COLOR_BGR2RGB)
        assert found[t].shape == (HEIGHT, WIDTH, 3)
    return found


def pixels(points_R: Array) -> NDArray[np.intp]:
    """Where the browser draws points of the shell: 75 degrees from top to bottom, as three.js."""
    forward = X_WR @ MARKER.X_WM.translation() - EYE
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    d = X_WR.multiply(points_R.T).T - EYE
    focal = HEIGHT / 2 / np.tan(np.deg2rad(75) / 2)
    plane = np.stack([d @ right, d @ np.cross(forward, right)], axis=1)
    return np.rint(np.array([WIDTH, HEIGHT]) / 2 + focal * plane / (d @ forward)[:, None]).astype(
        np.intp
    )


def test_the_print_can_be_read(pictures: dict[float, Any]) -> None:
    cells = MARKERS.family.cell_image(MARKER.id, 1)
    n = len(cells)
    row, column = (index.ravel() for index in np.mgrid[0:n, 0:n])
    places = np.stack([column + 0.5 - n / 2, n / 2 - row - 0.5], axis=1) / MARKERS.family.cells
    u, v = pixels(bent(places, MARKER, SHELL.radius)).T
    grey = pictures[LATE].mean(axis=2)[v, u]
    assert grey[cells.ravel() == 255].min() > grey[cells.ravel() == 0].max() + 40


def test_holes_are_darker_than_the_metal_between_them(pictures: dict[float, Any]) -> None:
    middle = MARKER.X_WM.translation() / np.linalg.norm(MARKER.X_WM.translation())
    pitch, yaw = np.arcsin(middle[2]), np.arctan2(middle[1], middle[0])
    rows = round(np.pi * SHELL.radius / 0.002)
    row = round((pitch + np.pi / 2) / np.pi * rows) - 4  # below the marker
    latitude = -np.pi / 2 + np.pi * row / rows
    count = round(2 * np.pi * np.cos(latitude) * SHELL.radius / 0.002)
    number = round(yaw / (2 * np.pi) * count) + np.arange(-3, 3)
    grey = []
    for shift in (0.0, 0.5):
        yaws = 2 * np.pi * (number + shift) / count
        places = np.stack([np.cos(latitude) * np.cos(yaws), np.cos(latitude) * np.sin(yaws)])
        points = SHELL.radius * np.column_stack([*places, np.full(6, np.sin(latitude))])
        u, v = pixels(points).T
        grey.append(pictures[LATE].mean(axis=2)[v, u])
    assert grey[0].max() < grey[1].min() - 30


def test_the_ghost_appears_when_it_is_known(pictures: dict[float, Any]) -> None:
    X_RB = estimate()
    assert np.degrees(angles_of(X_RB.rotation().matrix()))[1] == pytest.approx(30.0)
    roof = X_RB.multiply(np.array([[x, 0.015, BODY.height] for x in (-0.015, 0.015)]).T).T
    for u, v in pixels(roof):
        early, late = (
            pictures[t][v - 3 : v + 4, u - 3 : u + 4].reshape(-1, 3).mean(axis=0)
            for t in (EARLY, LATE)
        )
        assert np.ptp(early) < 40  # no colour
        assert late[0] > late[1:].max() + 40  # red
