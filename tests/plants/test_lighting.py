from __future__ import annotations

import cv2
import numpy as np
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from plants.boards import add_board
from plants.lighting import daylight
from systems.cameras import PinholeCamera
from systems.image_effects import linear_light
from systems.markers.family import family

CAMERA = PinholeCamera.from_focal_length(64, 64, 100.0)
R_FORWARD = RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))


def test_upright_paper_is_lit_whichever_way_it_faces() -> None:
    # Boards all around, each looking at the middle, where the camera turns from one to the next.
    headings = np.arange(0.0, 2 * np.pi, np.pi / 8)
    kind = family("DICT_4X4_50")
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    for k, heading in enumerate(headings):
        X_WM = RigidTransform(
            RollPitchYaw(0.0, 0.0, heading + np.pi), [np.cos(heading), np.sin(heading), 0.0]
        )
        add_board(plant, plant.world_body(), X_WM, family=kind, marker_id=k, size=0.15, margin=2)
    plant.Finalize()
    parameters = RenderEngineVtkParams(backend="EGL", lights=daylight())
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(parameters))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    core = RenderCameraCore("vtk", CAMERA.to_drake(), ClippingRange(0.01, 5.0), RigidTransform())
    camera = ColorRenderCamera(core, False)
    white, black = [], []
    for heading in headings:
        R_WC = RotationMatrix.MakeZRotation(heading) @ R_FORWARD
        X_WC = RigidTransform(R_WC, np.zeros(3))
        rgba = query.RenderColorImage(camera, scene_graph.world_frame_id(), X_WC).data
        light = linear_light(cv2.cvtColor(rgba, cv2.COLOR_RGBA2GRAY)) / 255
        # The margin reaches from 7.5 to 12.5 px from the middle, the black border inward of it.
        white.append(light[31:33, 21:23].mean())
        black.append(light[31:33, 25].mean())
    # Paper is bright but nowhere clipped, and ink stays dark.
    assert min(white) > 0.75
    assert max(white) < 0.95
    assert max(black) < 0.06
    assert min(white) > 0.84 * max(white)  # three lights all around: cos 30 degrees
