from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    Cylinder,
    FrameId,
    MakeRenderEngineVtk,
    RenderEngineVtkParams,
    Role,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from plants.boards import add_board
from plants.lighting import daylight
from systems.cameras import PinholeCamera
from systems.drawing.shells import DrawnShell, ShellParameters
from systems.image_effects import ImageEffects
from systems.markers.detector import MarkerDetector
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap
from systems.markers.projector import placed_markers
from systems.messages import CameraImage
from systems.sensors.drawn_camera import DrawingParameters, DrawnCamera
from systems.sensors.rendered_camera import RenderedCamera

K = np.array([[300.0, 0.0, 161.3], [0.0, 295.0, 117.6], [0.0, 0.0, 1.0]])
STRAIGHT = PinholeCamera(320, 240, K)
BARREL = PinholeCamera(320, 240, K, np.array([-0.25, 0.07, 1e-3, -2e-3, 0.0]))
R_FORWARD = RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
X_PC = RigidTransform(R_FORWARD, [0.02, 0.0, 0.03])
X_WP = RigidTransform(RollPitchYaw(0.05, -0.1, 0.8), [1.0, -0.5, 0.4])
X_WC = X_WP.multiply(X_PC)
TAG = family("DICT_4X4_50")
Furnish = Callable[[Any], None]


def facing_camera(x: float, y: float, z: float, turn: tuple[float, float, float]) -> RigidTransform:
    """X_WM of a marker at a place in the optical frame, turned from looking at the camera."""
    R_CM = RotationMatrix(np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]]))
    return X_WC @ RigidTransform(R_CM @ RotationMatrix(RollPitchYaw(*turn)), [x, y, z])


MARKERS = {
    m.id: m
    for m in (
        Marker(3, facing_camera(-0.25, -0.15, 1.0, (0.1, 0.2, 0.3)), 0.15),
        Marker(17, facing_camera(0.2, -0.1, 0.9, (0.0, -0.3, -0.4)), 0.15),
        Marker(0, facing_camera(-0.02, 0.2, 1.1, (2.0, 0.1, 0.5)), 0.15),
    )
}
MAP = MarkerMap(TAG, 0.15, MARKERS)


def boards(plant: Any) -> None:
    for m in MAP:
        add_board(plant, plant.world_body(), m.X_WM, family=TAG, marker_id=m.id, size=m.size)


def nothing(plant: Any) -> None:
    """An empty world."""


class Scene:
    """A camera on a head in a world, drawn or rendered."""

    def __init__(
        self,
        furnish: Furnish = nothing,
        *,
        rendered: bool = False,
        velocity: Any = None,
        markers: MarkerMap | None = None,
        shells: Callable[[FrameId], list[DrawnShell]] | None = None,
        **arguments: Any,
    ) -> None:
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.1)
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
        head = plant.AddRigidBody("head", SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.1, 0.1))
        plant.SetDefaultFloatingBaseBodyPose(head, X_WP)
        furnish(plant)
        plant.Finalize()
        world = scene_graph.world_frame_id()
        common = {
            "camera": STRAIGHT,
            "parent_frame": plant.GetBodyFrameIdOrThrow(head.index()),
            "X_PC": X_PC,
            "rate": 20.0,
        } | arguments
        if rendered:
            parameters = RenderEngineVtkParams(backend="EGL", lights=daylight())
            scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(parameters))
            system: Any = RenderedCamera(renderer="vtk", **common)
        else:
            if markers is not None:
                common = {"markers": placed_markers(markers, world), "family": TAG} | common
            if shells is not None:
                common["shells"] = shells(world)
            system = DrawnCamera(**common)
        self.camera = builder.AddSystem(system)
        builder.Connect(scene_graph.get_query_output_port(), self.camera.query_object_input_port())
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        if velocity is not None:
            own = self.camera.GetMyMutableContextFromRoot(self.context)
            self.camera.spatial_velocity_input_port().FixValue(own, velocity)

    def at(self, t: float) -> CameraImage:
        self.simulator.AdvanceTo(t)
        own = self.camera.GetMyContextFromRoot(self.context)
        return self.camera.image_output_port().Eval(own)


def corners_in(image: np.ndarray, camera: PinholeCamera) -> dict[int, np.ndarray]:
    found = MarkerDetector(family=TAG, camera=camera).detect(image)
    return dict(zip(found.ids.tolist(), found.corners, strict=True))


@pytest.mark.parametrize("camera", [STRAIGHT, BARREL])
def test_markers_are_found_where_they_are_and_where_the_renderer_has_them(
    camera: PinholeCamera,
) -> None:
    drawn = Scene(boards, markers=MAP, camera=camera).at(0.01).data
    effects = ImageEffects(supersampling=3)
    rendered = Scene(boards, rendered=True, camera=camera, effects=effects).at(0.01).data
    assert drawn.shape == rendered.shape == (240, 320)
    assert drawn.dtype == np.uint8
    ours, theirs = corners_in(drawn, camera), corners_in(rendered, camera)
    assert set(ours) == set(theirs) == set(MARKERS)
    X_CW = X_WC.inverse()
    truth = {i: camera.project(X_CW.multiply(m.corners().T).T) for i, m in MARKERS.items()}
    exact = np.array([ours[i] - truth[i] for i in MARKERS])
    assert np.sqrt((exact**2).mean()) < 0.05
    assert np.abs(exact.mean(axis=(0, 1))).max() < 0.02
    apart = np.array([ours[i] - theirs[i] for i in MARKERS])
    assert np.abs(apart.mean(axis=(0, 1))).max() < 0.1  # half a pixel would show
    assert np.sqrt((apart**2).mean()) < 0.2


def test_without_its_plate_the_board_is_drawn_all_the_same() -> None:
    with_plates = Scene(boards, markers=MAP).at(0.01).data
    alone = Scene(boards, markers=MAP, solids=None).at(0.01).data
    for i, corners in corners_in(with_plates, STRAIGHT).items():
        np.testing.assert_allclose(corners_in(alone, STRAIGHT)[i], corners, atol=0.03)


def hidden_by(x: float, y: float, z: float, shape: Any) -> Furnish:
    def furnish(plant: Any) -> None:
        boards(plant)
        place = X_WC @ RigidTransform([x, y, z])
        colour = np.array([0.5, 0.5, 0.5, 1.0])
        plant.RegisterVisualGeometry(plant.world_body(), place, shape, "thing", colour)

    return furnish


@pytest.mark.parametrize("shape", [Box(0.05, 0.05, 0.05), Cylinder(0.03, 0.06), Sphere(0.03)])
def test_solids_hide_what_is_behind_them_and_nothing_else(shape: Any) -> None:
    before = Scene(hidden_by(0.1, -0.05, 0.45, shape), markers=MAP)  # on the way to 17
    assert set(corners_in(before.at(0.01).data, STRAIGHT)) == {0, 3}
    behind = Scene(hidden_by(0.4, -0.2, 1.8, shape), markers=MAP)
    assert set(corners_in(behind.at(0.01).data, STRAIGHT)) == {0, 3, 17}


def test_solids_look_as_the_renderer_has_them() -> None:
    # Where they are, not how they are lit: outlines of the darker part of the picture.
    def furnish(plant: Any) -> None:
        things = [
            (Box(0.2, 0.1, 0.3), (-0.3, 0.0, 1.0)),
            (Cylinder(0.1, 0.3), (0.0, 0.05, 1.1)),
            (Sphere(0.12), (0.3, -0.1, 1.2)),
        ]
        for k, (shape, place) in enumerate(things):
            pose = X_WC @ RigidTransform(RollPitchYaw(0.4, 0.5 * k, -0.3), place)
            colour = np.array([0.05, 0.05, 0.05, 1.0])
            plant.RegisterVisualGeometry(plant.world_body(), pose, shape, f"{k}", colour)

    drawn = Scene(furnish).at(0.01).data
    rendered = Scene(furnish, rendered=True, effects=ImageEffects(supersampling=2)).at(0.01).data
    ours, theirs = drawn < drawn[0, 0] / 2, rendered < rendered[0, 0] / 2
    assert ours.sum() > 5000
    assert (ours != theirs).sum() < 0.02 * ours.sum()


def test_colours_are_red_green_blue() -> None:
    def furnish(plant: Any) -> None:
        for x, colour in ((-0.3, [1, 0, 0, 1]), (0.0, [0, 1, 0, 1]), (0.3, [0, 0, 1, 1])):
            place = X_WC @ RigidTransform([x, 0.0, 1.0])
            shape = Box(0.2, 0.2, 0.01)
            plant.RegisterVisualGeometry(
                plant.world_body(), place, shape, f"{x}", np.array(colour, float)
            )

    image = Scene(furnish, effects=ImageEffects(grey=False)).at(0.01).data
    grey = Scene(furnish).at(0.01).data
    assert image.shape == (240, 320, 3)
    for x, channel, weight in ((-0.3, 0, 0.299), (0.0, 1, 0.587), (0.3, 2, 0.114)):
        u, v = np.rint(STRAIGHT.project(np.array([x, 0.0, 1.0]))).astype(int)
        assert image[v, u].argmax() == channel
        assert np.sort(image[v, u])[1] == 0
        assert grey[v, u] == pytest.approx(weight * image[v, u, channel], abs=1)


def plate(plant: Any) -> None:
    """A dark plate of 24 px straight ahead, before the bright background."""
    place = X_WC @ RigidTransform([0.0, 0.0, 1.0])
    black = np.array([0.0, 0.0, 0.0, 1.0])
    plant.RegisterVisualGeometry(plant.world_body(), place, Box(0.08, 0.08, 0.001), "plate", black)


def moments(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroid and variances (px, px^2) of what is darker than the background, along u and v."""
    dark = image[0, 0].astype(float) - image
    v, u = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
    pixels = np.stack([u, v], -1).reshape(-1, 2)
    weight = dark.ravel() / dark.sum()
    centre = weight @ pixels
    return centre, weight @ (pixels - centre) ** 2


@pytest.mark.parametrize(
    ("w_C", "v_C", "flow"),
    [
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
    blur = ImageEffects(exposure=0.04, exposure_samples=16)
    sharp = Scene(plate).at(0.01).data
    blurred = Scene(plate, velocity=[*w_W, *v_W], effects=blur).at(0.01).data
    centre, variance = moments(sharp)
    blurred_centre, blurred_variance = moments(blurred)
    np.testing.assert_allclose(centre, K[:2, 2], atol=0.02)
    np.testing.assert_allclose(blurred_centre, centre, atol=0.1)
    drawn_out = (np.array(flow) * 0.04) ** 2 / 12
    np.testing.assert_allclose(blurred_variance - variance, drawn_out, rtol=0.03, atol=0.3)


def test_there_is_no_picture_before_the_first_arrives() -> None:
    scene = Scene(plate, latency=0.03, frame_id="robot/camera")
    for t, stamp in ((0.029, math.nan), (0.031, 0.0), (0.079, 0.0), (0.081, 0.05)):
        image = scene.at(t)
        assert image.stamp == stamp or (math.isnan(stamp) and math.isnan(image.stamp))
        assert image.frame_id == "robot/camera"
        assert image.data.shape == ((0, 0) if math.isnan(stamp) else (240, 320))


def test_noise_is_of_the_sample_and_of_the_seed() -> None:
    noisy = ImageEffects(read_noise=4.0)

    def pictures(**arguments: Any) -> list[np.ndarray]:
        scene = Scene(plate, effects=noisy, **arguments)
        return [scene.at(t).data for t in (0.01, 0.06)]

    first, second = pictures(seed=1)
    again = pictures(seed=1)
    np.testing.assert_array_equal(again[0], first)
    np.testing.assert_array_equal(again[1], second)
    for other in (second, pictures(seed=2)[0], pictures(seed=1, name="rear")[0]):
        assert (other != first).mean() > 0.5
    noise = first.astype(float) - Scene(plate).at(0.01).data
    assert noise.std() == pytest.approx(math.sqrt(16 + 1 / 12), rel=0.02)


def ball(plant: Any) -> None:
    """The body that a shell is drawn upon."""
    place = X_WC @ RigidTransform([0.0, 0.0, 0.5])
    white = np.array([1.0, 1.0, 1.0, 1.0])
    plant.RegisterVisualGeometry(plant.world_body(), place, Sphere(0.1), "ball", white)


def test_a_shell_takes_the_place_of_its_sphere_and_hides_what_is_behind() -> None:
    plain = ShellParameters(steel=0.2, hole_diameter=0.0, spangle=0.0)
    place = X_WC @ RigidTransform([0.0, 0.0, 0.5])

    def shells(world: FrameId) -> list[DrawnShell]:
        return [DrawnShell(frame=world, radius=0.1, X_FS=place, parameters=plain)]

    def crowd(plant: Any) -> None:
        ball(plant)
        for k, (z, x) in enumerate(((1.5, 0.0), (0.3, 0.05))):
            spot = X_WC @ RigidTransform([x, 0.0, z])
            shape, black = Box(0.02, 0.02, 0.02), np.array([0.0, 0.0, 0.0, 1.0])
            plant.RegisterVisualGeometry(plant.world_body(), spot, shape, f"box{k}", black)

    image = Scene(crowd, shells=shells).at(0.01).data
    centre = np.rint(K[:2, 2]).astype(int)
    assert image[centre[1], centre[0]] == 51
    near = np.rint(STRAIGHT.project(np.array([0.05, 0.0, 0.3]))).astype(int)
    assert image[near[1], near[0]] < 10
    bare = Scene(ball).at(0.01).data
    assert bare[centre[1], centre[0]] > 150


def test_transparent_frames_are_not_drawn() -> None:
    empty = Scene().at(0.01).data
    assert (empty == 204).all()  # the background
    assert (Scene(plate).at(0.01).data != empty).any()
    assert (Scene(plate, solids=Role.kProximity).at(0.01).data == empty).all()
    assert (Scene(plate, clipping=(0.01, 0.5)).at(0.01).data == empty).all()


@pytest.mark.parametrize(
    ("field", "value"), [("rate", 0.0), ("latency", -1.0), ("seed", -1), ("clipping", (1.0, 0.5))]
)
def test_nonsense_is_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"{field} is .*: must be "):
        Scene(**{field: value})


@pytest.mark.parametrize(
    ("field", "value"), [("background", 1.5), ("paper", -1.0), ("shade", 2.0), ("margin", 0)]
)
def test_nonsense_in_the_light_is_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"{field} is .*: must be "):
        DrawingParameters(**{field: value})


def test_markers_need_their_family() -> None:
    with pytest.raises(ValueError, match="family is None: must be"):
        Scene(markers=MAP, family=None)
