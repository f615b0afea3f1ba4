"""Pictures of marker boards by Drake's renderer from any pose, for tests and benchmarks."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from plants.boards import add_board
from plants.lighting import daylight
from systems.cameras import PinholeCamera
from systems.image_effects import ImageEffects, Lens, expose, linear_light
from systems.markers.layout import MarkerMap


class Studio:
    """The boards of a map before a grey wall, photographed from anywhere.

    Args:
        markers: what hangs there.
        camera: calibrated camera.
        effects: lens and noise.
        wall: pose of the wall's face (x out of it), None for none.
    """

    def __init__(
        self,
        *,
        markers: MarkerMap,
        camera: PinholeCamera,
        effects: ImageEffects | None = None,
        wall: RigidTransform | None = None,
    ) -> None:
        self.camera = camera
        self.effects = effects or ImageEffects()
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
        parameters = RenderEngineVtkParams(backend="EGL", lights=daylight())
        scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(parameters))
        for marker in markers:
            add_board(
                plant,
                plant.world_body(),
                marker.X_WM,
                family=markers.family,
                marker_id=marker.id,
                size=marker.size,
            )
        if wall is not None:
            plant.RegisterVisualGeometry(
                plant.world_body(),
                wall @ RigidTransform([-0.05, 0.0, 0.0]),
                Box(0.05, 30.0, 30.0),
                "wall",
                np.array([0.62, 0.62, 0.58, 1.0]),
            )
        plant.Finalize()
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        own = scene_graph.GetMyContextFromRoot(self._context)
        self._query = scene_graph.get_query_output_port().Eval(own)
        self._world = scene_graph.world_frame_id()
        self._lens = Lens(camera, self.effects.supersampling)
        core = RenderCameraCore(
            "vtk", self._lens.ideal.to_drake(), ClippingRange(0.01, 50.0), RigidTransform()
        )
        self._render_camera = ColorRenderCamera(core, False)

    def picture(self, X_WC: RigidTransform, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Returns the grey picture from the optical frame's pose."""
        rgba = self._query.RenderColorImage(self._render_camera, self._world, X_WC).data
        grey = cv2.cvtColor(rgba, cv2.COLOR_RGBA2GRAY)
        return expose(self._lens(linear_light(grey)), self.effects, rng)
