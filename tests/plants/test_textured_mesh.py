from __future__ import annotations

import cv2
import numpy as np
import pytest
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    GeometryInstance,
    LightParameter,
    MakeRenderEngineVtk,
    Mesh,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from plants.textured_mesh import Surface, textured_mesh
from systems.cameras import PinholeCamera
from systems.image_effects import linear_light

CAMERA = PinholeCamera.from_focal_length(100, 100, 100.0)
# The square fills the picture of a camera 1 m before it, on the x axis.
X_WC = RigidTransform(RotationMatrix(np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]])), [1, 0, 0])
TEXTURE = np.array([[60, 120], [180, 240]], np.uint8)


def square(reach: float = 1.0) -> Surface:
    """A square of 1 m in the plane x = 0, seen from +x; `reach` textures wide and high."""
    h = 0.5
    return Surface(
        vertices=np.array([[0, -h, h], [0, h, h], [0, h, -h], [0, -h, -h]]),
        normals=np.tile([1.0, 0.0, 0.0], (4, 1)),
        places=reach * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
        triangles=np.array([[0, 3, 2], [0, 2, 1]]),
    )


def picture(
    surface: Surface, *, lamp: float = 1.0, repeats: bool = False, glows: bool = False
) -> np.ndarray:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    mesh = textured_mesh(surface, TEXTURE, "test", repeats=repeats, glows=glows)
    geometry = GeometryInstance(RigidTransform(), Mesh(mesh, 1.0), "square")
    plant.RegisterVisualGeometry(plant.world_body(), geometry)
    plant.Finalize()
    light = LightParameter(
        type="directional", frame="world", intensity=lamp, direction=np.array([-0.8, 0.0, -0.6])
    )
    parameters = RenderEngineVtkParams(backend="EGL", lights=[light])
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(parameters))
    diagram = builder.Build()
    context = scene_graph.GetMyContextFromRoot(diagram.CreateDefaultContext())
    query = scene_graph.get_query_output_port().Eval(context)
    core = RenderCameraCore("vtk", CAMERA.to_drake(), ClippingRange(0.01, 10.0), RigidTransform())
    image = query.RenderColorImage(
        ColorRenderCamera(core, False), scene_graph.world_frame_id(), X_WC
    )
    return cv2.cvtColor(image.data, cv2.COLOR_RGBA2GRAY)


@pytest.mark.parametrize("lamp", [0.0, 1.0, 5.0])
def test_what_glows_is_as_bright_as_its_texture_whatever_the_lamps_do(lamp: float) -> None:
    image = picture(square(), lamp=lamp, glows=True)
    corners = image[[10, 10, 90, 90], [10, 90, 10, 90]]
    np.testing.assert_allclose(corners, TEXTURE.ravel(), atol=3)
    light = linear_light(image)[[10, 10, 90, 90], [10, 90, 10, 90]]
    expected = 255 * ((TEXTURE.ravel() / 255 + 0.055) / 1.055) ** 2.4  # IEC 61966-2-1
    np.testing.assert_allclose(light, expected, atol=4)


def test_what_does_not_is_as_bright_as_its_lamps() -> None:
    dark, dim, bright = (picture(square(), lamp=lamp).astype(float) for lamp in (0.0, 1.0, 2.0))
    assert dark.max() < 5
    assert (bright > dim + 10).all()
    # Upright: the first row at the top, the first column at the viewer's left.
    corners = dim[[10, 10, 90, 90], [10, 90, 10, 90]]
    assert (np.diff(corners) > 10).all()


def test_beyond_its_borders_a_texture_goes_on_or_begins_anew() -> None:
    once = picture(square(2.0), glows=True)
    over_and_over = picture(square(2.0), repeats=True, glows=True)
    np.testing.assert_allclose(once[60:, 60:], TEXTURE[1, 1], atol=3)
    quarters = over_and_over.reshape(2, 50, 2, 50).swapaxes(1, 2).reshape(4, 50, 50).astype(int)
    for quarter in quarters[1:]:
        assert np.abs(quarter - quarters[0]).mean() < 2
    assert np.ptp(quarters[0]) > 100
