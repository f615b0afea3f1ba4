from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydrake.geometry import MakeRenderEngineVtk, Mesh, RenderEngineVtkParams, Role, Sphere
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from plants.lighting import daylight
from plants.shell import ShellParameters as Sheet
from plants.shell import add_shell
from plants.shell_surface import (
    Surface,
    add_shell_surface,
    bent_sheet,
    hole_tile,
    outlined,
    steel_with_tiles,
)
from systems.cameras import PinholeCamera
from systems.drawing.shells import DrawnShell, ShellParameters, bent
from systems.image_effects import ImageEffects
from systems.markers.detector import MarkerDetector
from systems.markers.layout import Marker, MarkerMap
from systems.messages import CameraImage
from systems.sensors.drawn_camera import DrawnCamera
from systems.sensors.rendered_camera import RenderedCamera
from systems.shell.layout import misplaced, shell_markers

RADIUS = 0.075
CAMERA = PinholeCamera.from_focal_length(640, 480, 481.0)
MARKERS = misplaced(shell_markers(radius=RADIUS), bound=0.02, seed=3)
X_WR = RigidTransform(RollPitchYaw(0.4, -0.3, 1.0), [0.3, -0.2, 0.5])
# The renderer encodes for the screen by a plain power of 2.2, up to 2 levels beside sRGB, and all
# is rounded three times.
_GREY = 4
LOOK_DOWN = RotationMatrix(np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]]))
PLAIN = ShellParameters(spangle=0.0)
FRAME = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.01)[1].world_frame_id()


def above(
    pitch: float, yaw: float, *, height: float = 0.01, turn: float = 0.0, lean: float = 0.0
) -> RigidTransform:
    """X_RC of a camera that looks down at the shell; leaning, past its middle."""
    R = RotationMatrix.MakeZRotation(yaw) @ RotationMatrix.MakeYRotation(-pitch)
    spin = RotationMatrix.MakeZRotation(turn) @ RotationMatrix.MakeXRotation(lean)
    return RigidTransform(R @ LOOK_DOWN @ spin, R @ np.array([RADIUS + height, 0.0, 0.0]))


class Scene:
    """A shell, rendered and drawn from the same places."""

    def __init__(self, parameters: ShellParameters, *, rendered: bool = True) -> None:
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
        model = add_shell(plant, Sheet(radius=RADIUS), "reference", X_PR=X_WR, plain=False)
        self.shell = add_shell_surface(
            plant,
            plant.GetBodyByName("shell", model),
            radius=RADIUS,
            markers=MARKERS,
            parameters=parameters,
            rendered=rendered,
        )
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
        head = plant.AddRigidBody(
            "head",
            plant.AddModelInstance("photographer"),
            SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.1, 0.1),
        )
        plant.Finalize()
        engine = RenderEngineVtkParams(backend="EGL", lights=daylight())
        scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(engine))
        common: dict[str, Any] = {
            "camera": CAMERA,
            "parent_frame": plant.GetBodyFrameIdOrThrow(head.index()),
            "X_PC": RigidTransform(),
            "rate": 60.0,
            "clipping": (0.001, 0.1),
        }
        seen = RenderedCamera(renderer="vtk", effects=ImageEffects(supersampling=2), **common)
        drawn = DrawnCamera(
            shells=[self.shell], solids=None if rendered else Role.kPerception, **common
        )
        self._cameras = {"rendered": seen, "drawn": drawn}
        for camera in self._cameras.values():
            builder.AddSystem(camera)
            builder.Connect(scene_graph.get_query_output_port(), camera.query_object_input_port())
        self._plant, self._head = plant, head
        self.inspector = scene_graph.model_inspector()
        self.diagram = builder.Build()

    def picture(self, kind: str, X_RC: RigidTransform) -> np.ndarray:
        simulator = Simulator(self.diagram)
        context = simulator.get_mutable_context()
        own = self._plant.GetMyMutableContextFromRoot(context)
        self._plant.SetFreeBodyPose(own, self._head, X_WR @ X_RC)
        simulator.AdvanceTo(0.001)
        camera = self._cameras[kind]
        image: CameraImage = camera.image_output_port().Eval(camera.GetMyContextFromRoot(context))
        return image.data


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(ShellParameters())


@pytest.fixture(scope="module")
def plain() -> Scene:
    return Scene(PLAIN)


def corners_in(image: np.ndarray) -> dict[int, np.ndarray]:
    found = MarkerDetector(family=MARKERS.family, camera=CAMERA).detect(image)
    return dict(zip(found.ids.tolist(), found.corners, strict=True))


def levels(image: np.ndarray, points: np.ndarray, X_RC: RigidTransform) -> np.ndarray:
    """Grey levels (n,) where points (n, 3) of R are seen; NaN where they are not."""
    p_C = X_RC.inverse().multiply(points.T).T
    nearer = np.einsum("ni,ni->n", X_RC.translation() - points, points) > 0.05 * RADIUS * (
        np.linalg.norm(X_RC.translation() - points, axis=1)
    )
    u, v = np.rint(CAMERA.project(p_C)).T
    inside = nearer & (p_C[:, 2] > 0) & (u >= 0) & (u < 640) & (v >= 0) & (v < 480)
    grey = np.full(len(points), np.nan)
    grey[inside] = image[v[inside].astype(int), u[inside].astype(int)]
    return grey


def over(marker_id: int, **arguments: float) -> RigidTransform:
    """X_RC of a camera nearly over a marker."""
    x, y, z = MARKERS.markers[marker_id].X_WM.translation()
    return above(np.arctan2(z, np.hypot(x, y)) + 0.006, np.arctan2(y, x) - 0.01, **arguments)


VIEWS = {
    1: over(1, turn=0.3),  # the pole
    3: over(3, lean=0.08),
    8: over(8, turn=2.0, height=0.012),
    14: over(14),
    20: over(20, turn=-0.3, lean=-0.05, height=0.0095),
}

# --- For cameras ---


@pytest.mark.parametrize("marker_id", VIEWS)
def test_it_looks_as_the_drawn_camera_has_it(plain: Scene, marker_id: int) -> None:
    X_RC = VIEWS[marker_id]
    rendered, drawn = (plain.picture(kind, X_RC) for kind in ("rendered", "drawn"))
    ours, theirs = corners_in(rendered), corners_in(drawn)
    assert set(ours) == set(theirs) == {marker_id}
    assert np.abs(ours[marker_id] - theirs[marker_id]).max() < 0.3
    assert np.corrcoef(rendered.ravel(), drawn.ravel())[0, 1] > 0.99
    assert abs(rendered.mean() - drawn.mean()) < 1.5
    # How far one is shifted against the other, px, by least squares of the grey levels.
    expected, found = drawn.astype(float), rendered.astype(float)
    for axis in (0, 1):
        slope = np.gradient(expected, axis=axis)
        assert abs((slope * (found - expected)).sum() / (slope**2).sum()) < 0.1


@pytest.mark.parametrize("marker_id", VIEWS)
def test_every_cell_is_where_the_print_has_it(scene: Scene, marker_id: int) -> None:
    marker, p = MARKERS.markers[marker_id], scene.shell.parameters
    cells = MARKERS.family.cell_image(marker_id, p.margin)
    n = len(cells)
    image = scene.picture("rendered", VIEWS[marker_id])
    for y, z in ((0.15, 0.15), (0.5, 0.5), (0.85, 0.2)):  # parts of a cell, from its top left
        row, column = (index.ravel() for index in np.mgrid[0:n, 0:n])
        places = np.stack([column + y - n / 2, n / 2 - row - z], axis=1) / MARKERS.family.cells
        grey = levels(image, bent(places, marker, RADIUS), VIEWS[marker_id])
        expected = 255 * np.where(cells.ravel() > 0, p.paper, p.ink)
        assert np.isfinite(grey).sum() == n * n
        np.testing.assert_allclose(grey, expected, atol=_GREY)


@pytest.mark.parametrize("pitch", [-1.2, -0.6, 0.25, 1.3])
def test_steel_and_holes_have_their_grey_whatever_the_lamps_do(scene: Scene, pitch: float) -> None:
    # Far from the markers; daylight comes from above.
    shell, p = scene.shell, scene.shell.parameters
    X_RC = above(pitch, 0.77, turn=0.3)
    image = scene.picture("rendered", X_RC)
    in_holes = levels(image, RADIUS * shell.holes, X_RC)
    in_holes = in_holes[np.isfinite(in_holes)]
    assert len(in_holes) > 20
    np.testing.assert_allclose(in_holes, 255 * p.hole, atol=_GREY)
    corners, steps = shell.patches
    middles = corners.mean(axis=1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    gap = np.arccos((middles @ shell.holes[_near(shell, X_RC)].T).clip(-1, 1)).min(axis=1)
    grey = levels(image, RADIUS * middles, X_RC)
    metal = np.isfinite(grey) & (gap > 0.6 * p.hole_diameter / RADIUS)
    assert metal.sum() > 20
    assert steps[metal].std() > 0.02
    expected = 255 * (p.steel + steps[metal])
    np.testing.assert_allclose(grey[metal], expected, atol=_GREY)


def _near(shell: DrawnShell, X_RC: RigidTransform) -> np.ndarray:
    direction = X_RC.translation() / np.linalg.norm(X_RC.translation())
    return shell.holes @ direction > np.cos(0.3)


def test_all_triangles_face_outward_and_cover_the_sphere() -> None:
    shell = DrawnShell(frame=FRAME, radius=RADIUS, markers=MARKERS, parameters=PLAIN)
    pieces = outlined(shell)
    assert len(pieces) > 50
    level = np.concatenate([p.places[p.triangles[:, 0], 0] for p in pieces])
    area = np.concatenate([_areas(piece) for piece in pieces])
    # Seams between patches that are jittered across each other leave a few turned over.
    assert area.min() > -1e-7
    assert -area[area < 0].sum() < 1e-4 * area.sum()
    sphere, hole = 4 * np.pi * RADIUS**2, np.pi * 0.0005**2
    steel = np.isclose(level, (np.rint(255 * PLAIN.steel) + 0.5) / 256)
    holes = np.isclose(level, (np.rint(255 * PLAIN.hole) + 0.5) / 256)
    assert area[steel].sum() == pytest.approx(sphere, rel=1e-3)
    assert area[holes].sum() == pytest.approx(len(shell.holes) * hole, rel=1e-3)
    white_and_black = area[~steel & ~holes].sum()
    assert white_and_black == pytest.approx(len(MARKERS) * (0.005 * 8 / 6) ** 2, rel=5e-3)


def _areas(surface: Surface) -> np.ndarray:
    """Areas (m,) m^2 of triangles, negative of those that face inward."""
    a, b, c = surface.vertices[surface.triangles].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a) / 2
    return np.linalg.norm(normal, axis=1) * np.sign(np.einsum("ni,ni->n", normal, a + b + c))


# --- For Meshcat ---


def test_a_tile_has_its_hole_where_the_sphere_has_one() -> None:
    shell = DrawnShell(frame=FRAME, radius=RADIUS, parameters=PLAIN)
    surface = steel_with_tiles(shell)
    assert _areas(surface).min() > 0
    assert _areas(surface).sum() == pytest.approx(4 * np.pi * RADIUS**2, rel=2e-3)
    a, b, c = surface.vertices[surface.triangles].transpose(1, 0, 2)
    frames = np.stack([a, b, c], axis=2)  # a direction's weights of the three corners
    poles = [0, len(shell.holes) - 1]
    for k in [*poles, *np.random.default_rng(5).integers(1, len(shell.holes) - 1, 40)]:
        weights = np.linalg.solve(frames, np.broadcast_to(shell.holes[k][:, None], (len(a), 3, 1)))
        hit = np.flatnonzero((weights[:, :, 0] > -1e-9).all(axis=1))
        assert len(hit) >= 1
        inside = weights[hit[0], :, 0] / weights[hit[0]].sum()
        place = inside @ surface.places[surface.triangles[hit[0]]]
        assert np.abs(place % 1 - 0.5).max() < 0.05


def test_the_tile_is_as_dark_as_the_metal() -> None:
    tile = hole_tile(ShellParameters(steel=0.6, hole=0.1, hole_diameter=0.0012, hole_pitch=0.002))
    assert tile.mean() / 255 == pytest.approx(0.6 - 0.5 * np.pi / 4 * 0.36, abs=3e-3)
    assert tile[0, 0] == 153  # 0.6 of 255
    assert tile[len(tile) // 2, len(tile) // 2] in (25, 26)  # 0.1
    assert hole_tile(ShellParameters(hole_diameter=0.0)).std() == 0


def test_a_sheet_is_bent_upright_with_its_corners_on_the_sphere() -> None:
    marker = shell_markers(radius=RADIUS).markers[8]
    sheet = bent_sheet(marker, RADIUS, cells=6, margin=1)
    np.testing.assert_allclose(np.linalg.norm(sheet.vertices, axis=1), RADIUS, rtol=1e-12)
    assert _areas(sheet).min() > 0
    # The black square is 6 of the picture's 8 cells; each is two quads wide.
    for corner, place in zip(marker.corners(), [[1, 1], [7, 1], [7, 7], [1, 7]], strict=True):
        k = np.abs(sheet.places - np.array(place) / 8).sum(axis=1).argmin()
        np.testing.assert_allclose(sheet.places[k], np.array(place) / 8)
        np.testing.assert_allclose(sheet.vertices[k], corner, atol=1e-9)


def test_cameras_and_meshcat_have_their_own() -> None:
    for rendered in (True, False):
        found = Scene(PLAIN, rendered=rendered).inspector
        shown = found.GetAllGeometryIds(Role.kIllustration)
        seen = found.GetAllGeometryIds(Role.kPerception)
        assert not set(shown) & set(seen)
        assert len(shown) == 1 + len(MARKERS)
        assert all(isinstance(found.GetShape(g), Mesh) for g in shown)
        sizes = [len(found.GetShape(g).source().in_memory().mesh_file.contents()) for g in shown]
        assert sum(sizes) < 3e6  # bytes, of what goes into a replay
        shapes = {type(found.GetShape(g)) for g in seen}
        assert shapes == ({Mesh} if rendered else {Sphere})


def test_without_a_renderer_the_drawn_camera_draws_its_own(plain: Scene) -> None:
    drawn = Scene(PLAIN, rendered=False)
    np.testing.assert_array_equal(
        drawn.picture("drawn", VIEWS[8]), plain.picture("drawn", VIEWS[8])
    )


# --- Nonsense ---


def test_nonsense_is_refused() -> None:
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.01)
    body = plant.GetBodyByName("shell", add_shell(plant, Sheet(), "reference", plain=False))
    lost = Marker(4, RigidTransform([0.1, 0.0, 0.0]), 0.005)
    markers = MarkerMap(MARKERS.family, 0.005, {4: lost})
    with pytest.raises(ValueError, match="distance of marker 4 from the sphere is"):
        add_shell_surface(plant, body, radius=RADIUS, markers=markers)
    with pytest.raises(ValueError, match=r"radius is 0\.0: must be greater than 0"):
        add_shell_surface(plant, body, radius=0.0)
