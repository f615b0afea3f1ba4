from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import pytest
from pydrake.geometry import Box, MakeRenderEngineVtk, RenderEngineVtkParams
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from plants.boards import add_board
from plants.lighting import daylight
from systems.cameras import PinholeCamera
from systems.image_effects import ImageEffects
from systems.markers.detector import MarkerDetector
from systems.markers.family import family
from systems.markers.layout import Marker
from systems.messages import CameraImage
from systems.sensors.rendered_camera import RenderedCamera

K = np.array([[300.0, 0.0, 161.3], [0.0, 295.0, 117.6], [0.0, 0.0, 1.0]])
STRAIGHT = PinholeCamera(320, 240, K)
BARREL = PinholeCamera(320, 240, K, np.array([-0.25, 0.07, 1e-3, -2e-3, 0.0]))
# The head that carries the camera looks along its own x; it stands askew in the world.
R_FORWARD = RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
X_PC = RigidTransform(R_FORWARD, [0.02, 0.0, 0.03])
X_WP = RigidTransform(RollPitchYaw(0.05, -0.1, 0.8), [1.0, -0.5, 0.4])
X_WC = X_WP.multiply(X_PC)


@dataclass
class Scene:
    """A camera in a world, its velocity fixed at will."""

    diagram: Diagram
    camera: RenderedCamera
    context: Context
    simulator: Simulator

    def at(self, t: float) -> CameraImage:
        self.simulator.AdvanceTo(t)
        own = self.camera.GetMyContextFromRoot(self.context)
        return self.camera.image_output_port().Eval(own)


def build(furnish: Callable[[Any], None], *, velocity: Any = None, **arguments: Any) -> Scene:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.1)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
    head = plant.AddRigidBody("head", SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.1, 0.1))
    plant.SetDefaultFloatingBaseBodyPose(head, X_WP)
    furnish(plant)
    plant.Finalize()
    parameters = RenderEngineVtkParams(backend="EGL", lights=daylight())
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(parameters))
    camera = builder.AddSystem(
        RenderedCamera(
            **{
                "camera": STRAIGHT,
                "parent_frame": plant.GetBodyFrameIdOrThrow(head.index()),
                "X_PC": X_PC,
                "renderer": "vtk",
                "rate": 20.0,
            }
            | arguments
        )
    )
    builder.Connect(scene_graph.get_query_output_port(), camera.query_object_input_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    if velocity is not None:
        own = camera.GetMyMutableContextFromRoot(context)
        camera.spatial_velocity_input_port().FixValue(own, velocity)
    return Scene(diagram, camera, context, simulator)


def facing_camera(x: float, y: float, z: float, turn: tuple[float, float, float]) -> RigidTransform:
    """X_WM of a marker at a place in the optical frame, turned from looking at the camera."""
    R_CM = RotationMatrix(np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]]))
    return X_WC @ RigidTransform(R_CM @ RotationMatrix(RollPitchYaw(*turn)), [x, y, z])


MARKERS = [
    Marker(3, facing_camera(-0.25, -0.15, 1.0, (0.1, 0.2, 0.3)), 0.15),
    Marker(17, facing_camera(0.2, -0.1, 0.9, (0.0, -0.3, -0.4)), 0.15),
    Marker(0, facing_camera(-0.02, 0.2, 1.1, (2.0, 0.1, 0.5)), 0.15),
]


def boards(name: str) -> Callable[[Any], None]:
    def furnish(plant: Any) -> None:
        for m in MARKERS:
            add_board(
                plant, plant.world_body(), m.X_WM, family=family(name), marker_id=m.id, size=m.size
            )

    return furnish


@pytest.mark.parametrize("name", ["DICT_4X4_50", "tag36h11"])
@pytest.mark.parametrize("camera", [STRAIGHT, BARREL])
def test_markers_are_found_where_they_are(name: str, camera: PinholeCamera) -> None:
    scene = build(boards(name), camera=camera, effects=ImageEffects(supersampling=2))
    image = scene.at(0.01)
    assert image.data.shape == (240, 320)
    assert image.data.dtype == np.uint8
    found = MarkerDetector(family=name, camera=camera).detect(image.data)
    corners = dict(zip(found.ids.tolist(), found.corners, strict=True))
    assert sorted(corners) == [0, 3, 17]
    errors = np.array(
        [corners[m.id] - camera.project(X_WC.inverse().multiply(m.corners().T).T) for m in MARKERS]
    )
    assert np.abs(errors.mean(axis=(0, 1))).max() < 0.1  # half a pixel would show
    assert np.sqrt((errors**2).mean()) < 0.2


def test_there_is_no_picture_before_the_first_arrives() -> None:
    scene = build(boards("DICT_4X4_50"), latency=0.03, frame_id="robot/camera")
    for t, stamp in ((0.029, math.nan), (0.031, 0.0), (0.079, 0.0), (0.081, 0.05)):
        image = scene.at(t)
        assert image.stamp == stamp or (math.isnan(stamp) and math.isnan(image.stamp))
        assert image.frame_id == "robot/camera"
        assert image.data.shape == ((0, 0) if math.isnan(stamp) else (240, 320))


def test_colours_are_red_green_blue() -> None:
    def furnish(plant: Any) -> None:
        for x, colour in ((-0.3, [1, 0, 0, 1]), (0.0, [0, 1, 0, 1]), (0.3, [0, 0, 1, 1])):
            place = X_WC @ RigidTransform([x, 0.0, 1.0])
            shape = Box(0.2, 0.2, 0.01)
            plant.RegisterVisualGeometry(
                plant.world_body(), place, shape, f"{x}", np.array(colour, float)
            )

    image = build(furnish, effects=ImageEffects(grey=False)).at(0.01).data
    assert image.shape == (240, 320, 3)
    for x, channel in ((-0.3, 0), (0.0, 1), (0.3, 2)):
        u, v = np.rint(STRAIGHT.project(np.array([x, 0.0, 1.0]))).astype(int)
        colour = image[v, u].astype(int)
        assert colour.argmax() == channel
        assert colour.max() > 4 * np.sort(colour)[1]


def plate(plant: Any) -> None:
    """A dark plate of 24 px straight ahead, before the bright background."""
    place = X_WC @ RigidTransform([0.0, 0.0, 1.0])
    shape = Box(0.08, 0.08, 0.001)
    plant.RegisterVisualGeometry(
        plant.world_body(), place, shape, "plate", np.array([0.0, 0.0, 0.0, 1.0])
    )


def moments(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroid and variances (px, px^2) of what is darker than the background, along u and v."""
    dark = image[0, 0].astype(float) - image
    assert dark.min() > -3
    v, u = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
    pixels = np.stack([u, v], -1).reshape(-1, 2)
    weight = dark.ravel() / dark.sum()
    centre = weight @ pixels
    return centre, weight @ (pixels - centre) ** 2


EXPOSURE = 0.04
BLUR = ImageEffects(supersampling=2, exposure=EXPOSURE, exposure_samples=16)


@pytest.mark.parametrize(
    ("w_C", "v_C", "flow"),
    [
        ([0, 0, 0], [0, 0, 0], [0, 0]),
        ([0, 0, 0], [1.0, 0, 0], [-300.0, 0]),  # px/s of a point 1 m ahead
        ([0, 0, 0], [0, 1.0, 0], [0, -295.0]),
        ([0, 0.8, 0], [0, 0, 0], [-240.0, 0]),  # turning to the right
        ([0.8, 0, 0], [0, 0, 0], [0, 236.0]),  # and upward
    ],
)
def test_motion_blurs_along_the_motion(w_C: Any, v_C: Any, flow: Any) -> None:
    # The camera moves as the head does: v_C = v_P + w x p_PC. A line of length L that is drawn out
    # evenly has the variance L^2 / 12; its middle is where the plate is in mid-exposure.
    R_WC = X_WC.rotation()
    w_W = R_WC @ np.array(w_C, float)
    v_W = R_WC @ np.array(v_C, float) - np.cross(w_W, X_WP.rotation() @ X_PC.translation())
    sharp = build(plate, effects=ImageEffects(supersampling=2)).at(0.01).data
    blurred = build(plate, velocity=[*w_W, *v_W], effects=BLUR).at(0.01).data
    centre, variance = moments(sharp)
    blurred_centre, blurred_variance = moments(blurred)
    np.testing.assert_allclose(centre, K[:2, 2], atol=0.3)
    np.testing.assert_allclose(blurred_centre, centre, atol=0.3)
    drawn_out = (np.array(flow) * EXPOSURE) ** 2 / 12
    np.testing.assert_allclose(blurred_variance - variance, drawn_out, rtol=0.05, atol=0.5)


def test_without_motion_blur_no_velocity_is_needed() -> None:
    assert build(plate, effects=ImageEffects(exposure_samples=1)).at(0.01).data.size


def test_noise_is_of_the_sample_and_of_the_seed() -> None:
    noisy = ImageEffects(read_noise=4.0)

    def pictures(**arguments: Any) -> list[np.ndarray]:
        scene = build(plate, effects=noisy, **arguments)
        return [scene.at(t).data for t in (0.01, 0.06)]

    first, second = pictures(seed=1)
    again = pictures(seed=1)
    np.testing.assert_array_equal(again[0], first)
    np.testing.assert_array_equal(again[1], second)
    assert (first != second).mean() > 0.5
    for other in ({"seed": 2}, {"seed": 1, "name": "rear"}):
        assert (pictures(**other)[0] != first).mean() > 0.5
    noise = first.astype(float) - build(plate).at(0.01).data
    assert noise.std() == pytest.approx(math.sqrt(16 + 1 / 12), rel=0.02)


def test_the_lens_bends_the_picture() -> None:
    # A distorted picture is the ideal one, remapped by OpenCV.
    straight = build(boards("DICT_4X4_50"), effects=ImageEffects(supersampling=4)).at(0.01).data
    bent = (
        build(boards("DICT_4X4_50"), camera=BARREL, effects=ImageEffects(supersampling=4))
        .at(0.01)
        .data
    )
    back = cv2.undistort(bent, BARREL.K, BARREL.D)
    inner = np.s_[40:200, 50:270]
    unbent, bend = (
        np.abs(picture[inner].astype(float) - straight[inner]).mean() for picture in (back, bent)
    )
    assert unbent < bend / 3


@pytest.mark.parametrize(
    ("field", "value"), [("rate", 0.0), ("latency", -1.0), ("seed", -1), ("clipping", (1.0, 0.5))]
)
def test_nonsense_is_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"{field} is .*: must be "):
        build(plate, **{field: value})
