from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from apriltag import apriltag
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder

from plants.boards import add_board, marker_texture
from plants.lighting import daylight
from systems.cameras import PinholeCamera
from systems.markers.family import Family, family
from systems.markers.layout import Marker, marker_corners

CAMERA = PinholeCamera.from_focal_length(480, 360, 420.0)
# The camera looks along the world's x axis, z up.
X_WC = RigidTransform(RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])), [0, 0, 0.5])


def facing(y: float, z: float, roll: float = 0.0, yaw: float = 0.0) -> RigidTransform:
    """A marker 1 m ahead that looks back; roll turns it as a wheel, to its own left."""
    return RigidTransform(
        RotationMatrix(RollPitchYaw(0.0, 0.0, np.pi + yaw)) @ RotationMatrix.MakeXRotation(roll),
        [1.0, y, z],
    )


PLACES = [facing(0.25, 0.7), facing(-0.25, 0.65, yaw=0.5), facing(0.2, 0.35, roll=0.6, yaw=-0.4),
          facing(-0.22, 0.33, roll=-2.0)]  # fmt: skip


def picture(furnish: Any) -> np.ndarray:
    """What the camera sees, grey."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    furnish(plant)
    plant.Finalize()
    parameters = RenderEngineVtkParams(backend="EGL", lights=daylight())
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(parameters))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    core = RenderCameraCore("vtk", CAMERA.to_drake(), ClippingRange(0.01, 10.0), RigidTransform())
    image = query.RenderColorImage(
        ColorRenderCamera(core, False), scene_graph.world_frame_id(), X_WC
    )
    return cv2.cvtColor(image.data, cv2.COLOR_RGBA2GRAY)


def boards(kind: Family, **arguments: Any) -> Any:
    def furnish(plant: Any) -> None:
        for k, X_WM in enumerate(PLACES):
            add_board(plant, plant.world_body(), X_WM, family=kind, marker_id=3 * k, size=0.18,
                      **arguments)  # fmt: skip

    return furnish


def exact(X_WM: RigidTransform, size: float = 0.18) -> np.ndarray:
    """Pixels of the marker's corners, from the top-left one clockwise as its viewer sees it."""
    return CAMERA.project(X_WC.inverse().multiply(Marker(0, X_WM, size).corners().T).T)


@pytest.mark.parametrize("name", ["DICT_4X4_50", "DICT_6X6_250", "DICT_ARUCO_ORIGINAL"])
def test_opencv_finds_aruco_boards_upright(name: str) -> None:
    kind = family(name)
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(kind.opencv_dictionary(), settings)
    corners, ids, _ = detector.detectMarkers(picture(boards(kind)))
    found = {int(i): c[0] for i, c in zip(ids.ravel(), corners, strict=True)}
    assert sorted(found) == [0, 3, 6, 9]
    for k, X_WM in enumerate(PLACES):
        np.testing.assert_allclose(found[3 * k], exact(X_WM), atol=1.0)


@pytest.mark.parametrize("name", ["tag36h11", "tag25h9"])
def test_apriltag_finds_its_boards_upright(name: str) -> None:
    found = {tag["id"]: tag for tag in apriltag(name).detect(picture(boards(family(name))))}
    assert sorted(found) == [0, 3, 6, 9]
    for k, X_WM in enumerate(PLACES):
        corners = np.array(found[3 * k]["lb-rb-rt-lt"])[::-1] - 0.5
        np.testing.assert_allclose(corners, exact(X_WM), atol=1.0)


def test_the_cells_are_where_the_official_image_has_them() -> None:
    kind = family("DICT_5X5_100")
    image = picture(
        lambda plant: add_board(
            plant, plant.world_body(), PLACES[2], family=kind, marker_id=42, size=0.18, margin=2
        )
    )
    # The middle of each cell, white margin included, by rows from the top left.
    cells = kind.cell_image(42, margin=2)
    n, side = len(cells), 0.18 / kind.cells
    row, column = np.mgrid[0:n, 0:n]
    p_M = np.stack([0.0 * row, (column + 0.5 - n / 2) * side, (n / 2 - row - 0.5) * side], -1)
    p_C = X_WC.inverse().multiply(PLACES[2]).multiply(p_M.reshape(-1, 3).T).T
    u, v = np.rint(CAMERA.project(p_C)).astype(int).T
    seen = image[v, u].reshape(n, n)
    assert seen[cells == 255].min() > seen[cells == 0].max() + 80


def test_a_board_moves_with_its_body() -> None:
    X_WB = RigidTransform(RollPitchYaw(0.2, 0.1, 0.3), [0.7, 0.1, 0.4])
    kind = family("DICT_4X4_50")

    def furnish(plant: Any) -> None:
        body = plant.AddRigidBody("cart", SpatialInertia.SolidBoxWithMass(1.0, 1.0, 1.0, 1.0))
        plant.SetDefaultFloatingBaseBodyPose(body, X_WB)
        X_BM = X_WB.inverse().multiply(PLACES[1])
        add_board(plant, body, X_BM, family=kind, marker_id=5, size=0.18)

    detector = cv2.aruco.ArucoDetector(kind.opencv_dictionary())
    corners, ids, _ = detector.detectMarkers(picture(furnish))
    assert ids.ravel().tolist() == [5]
    np.testing.assert_allclose(corners[0][0], exact(PLACES[1]), atol=1.5)


def test_from_behind_there_is_no_marker() -> None:
    kind = family("DICT_4X4_50")

    def furnish(plant: Any) -> None:
        behind = RigidTransform(RollPitchYaw(0.0, 0.0, 0.0), [1.0, 0.0, 0.5])
        add_board(plant, plant.world_body(), behind, family=kind, marker_id=5, size=0.18)

    image = picture(furnish)
    u, v = np.rint(CAMERA.project(np.array([0.0, 0.0, 1.0]))).astype(int)
    patch = image[v - 20 : v + 20, u - 20 : u + 20]
    assert patch.std() < 2.0  # the plain back of the plate
    assert cv2.aruco.ArucoDetector(kind.opencv_dictionary()).detectMarkers(image)[1] is None


def test_the_texture_is_upright() -> None:
    kind = family("tag36h11")
    texture = marker_texture(kind, 9, margin=1)
    cell = len(texture) // (kind.cells + 2)
    middles = texture[cell // 2 :: cell, cell // 2 :: cell]
    np.testing.assert_array_equal(middles, kind.cell_image(9, margin=1))
    # A viewer's left is -y of the marker frame, the top +z: where the corners are counted from.
    np.testing.assert_array_equal(np.sign(marker_corners(1.0)[0]), [0, -1, 1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"size": 0.0}, r"size is 0\.0: must be greater than 0"),
        ({"margin": 0}, "margin is 0: must be at least 1 cell"),
        ({"marker_id": 50}, "id is 50: DICT_4X4_50 has the ids 0 to 49"),
    ],
)
def test_nonsense_is_refused(change: dict[str, Any], message: str) -> None:
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.01)
    arguments = {"family": family("DICT_4X4_50"), "marker_id": 1, "size": 0.1} | change
    with pytest.raises(ValueError, match=message):
        add_board(plant, plant.world_body(), RigidTransform(), **arguments)
