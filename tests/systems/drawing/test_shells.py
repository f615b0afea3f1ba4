from __future__ import annotations

import numpy as np
import pytest
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RotationMatrix

from systems.cameras import PinholeCamera
from systems.drawing.coverage import CoverageSheet
from systems.drawing.layers import paint
from systems.drawing.shells import DrawnShell, ShellParameters, bent, draw_shell
from systems.markers.detector import MarkerDetector
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap

RADIUS = 0.075
SIZE = 0.005
TAG = family("DICT_4X4_50")
FRAME = SceneGraph().world_frame_id()
NEAR = PinholeCamera.from_focal_length(160, 120, 120.0)
BARREL = PinholeCamera(160, 120, NEAR.K, np.array([-0.15, 0.02, 1e-3, -2e-3, 0.0]))
FULL = PinholeCamera.from_focal_length(640, 480, 481.0)
PLAIN = ShellParameters(spangle=0.0)


def on_sphere(marker_id: int, yaw: float, pitch: float) -> Marker:
    """A marker whose corners lie on the sphere, upright toward the pole."""
    R = RotationMatrix.MakeZRotation(yaw) @ RotationMatrix.MakeYRotation(-pitch)
    deep = np.sqrt(RADIUS**2 - SIZE**2 / 2)
    return Marker(marker_id, RigidTransform(R, R @ np.array([deep, 0, 0])), SIZE)


MARKERS = {
    1: on_sphere(1, np.pi, np.pi / 2),
    6: on_sphere(6, 0.0, 0.5),
    7: on_sphere(7, 0.1, 0.55),
    8: on_sphere(8, 0.8, -0.3),
}
MAP = MarkerMap(TAG, SIZE, MARKERS, "shell")


def shell(parameters: ShellParameters = PLAIN, markers: MarkerMap | None = MAP) -> DrawnShell:
    return DrawnShell(frame=FRAME, radius=RADIUS, markers=markers, parameters=parameters)


def above(
    yaw: float, pitch: float, height: float, *, turn: float = 0.0, lean: float = 0.0
) -> RigidTransform:
    """X_SC of a camera that looks down at the shell; leaning, past its middle."""
    R = RotationMatrix.MakeZRotation(yaw) @ RotationMatrix.MakeYRotation(-pitch)
    R_down = RotationMatrix(np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]]))  # y of C to the south
    place = R @ np.array([RADIUS + height, 0, 0])
    spin = RotationMatrix.MakeZRotation(turn) @ RotationMatrix.MakeXRotation(lean)
    return RigidTransform(R @ R_down @ spin, place)


def picture(camera: PinholeCamera, drawn: DrawnShell, X_SC: RigidTransform) -> np.ndarray:
    canvas = np.full((camera.height, camera.width, 1), 200, np.float32)
    drawing = draw_shell(camera, drawn, X_SC.inverse().GetAsMatrix34())
    paint(canvas, [] if drawing is None else [drawing], CoverageSheet())
    return canvas[:, :, 0]


def traced(camera: PinholeCamera, drawn: DrawnShell, X_SC: RigidTransform, n: int) -> np.ndarray:
    """The same by n x n rays a pixel, each looked up where it meets the sphere."""
    p = drawn.parameters
    large = camera.scaled(n)
    v, u = np.mgrid[0 : large.height, 0 : large.width]
    rays = large.undistort(np.stack([u, v], axis=-1).reshape(-1, 2).astype(float))
    rays = np.column_stack([rays, np.ones(len(rays))])
    d = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ X_SC.rotation().matrix().T
    o = X_SC.translation()
    along = -(d @ o)
    square = RADIUS**2 - (o @ o - along**2)
    hit = (square > 0) & (along > 0)
    grey = np.full(len(d), 200.0)
    q = (o + (along[hit] - np.sqrt(square[hit]))[:, None] * d[hit]) / RADIUS
    found = np.full(len(q), 255 * p.steel)
    # Rows of holes along the parallels, the first of each at yaw 0.
    rows = round(np.pi * RADIUS / p.hole_pitch)
    row = np.rint((np.arcsin(q[:, 2].clip(-1, 1)) + np.pi / 2) / np.pi * rows)
    inside = np.zeros(len(q), bool)
    for step in (-1, 0, 1):
        latitude = -np.pi / 2 + np.pi * (row + step).clip(0, rows) / rows
        count = np.maximum(np.rint(2 * np.pi * np.cos(latitude) * RADIUS / p.hole_pitch), 1)
        yaw = np.rint(np.arctan2(q[:, 1], q[:, 0]) / (2 * np.pi) * count) * 2 * np.pi / count
        middle = np.stack(
            [np.cos(latitude) * np.cos(yaw), np.cos(latitude) * np.sin(yaw), np.sin(latitude)], 1
        )
        gap = 2 * np.arcsin(np.linalg.norm(q - middle, axis=1).clip(0, 2) / 2)
        inside |= gap < 0.5 * p.hole_diameter / RADIUS
    found[inside] = 255 * p.hole
    for marker in drawn.markers or ():
        M = marker.X_WM.GetAsMatrix34()
        deep = q @ M[:, 0]
        facing = deep > 0.5
        flat = q[facing] * ((M[:, 0] @ M[:, 3]) / deep[facing])[:, None] - M[:, 3]
        cell = marker.size / TAG.cells
        cells = TAG.cell_image(marker.id, p.margin)
        column = np.floor(flat @ M[:, 1] / cell + len(cells) / 2).astype(int)
        line = np.floor(-(flat @ M[:, 2]) / cell + len(cells) / 2).astype(int)
        on = (line >= 0) & (line < len(cells)) & (column >= 0) & (column < len(cells))
        index = np.flatnonzero(facing)[on]
        white = cells[line[on], column[on]] > 0
        found[index] = 255 * np.where(white, p.paper, p.ink)
    grey[hit] = found
    return grey.reshape(camera.height, n, camera.width, n).mean(axis=(1, 3))


@pytest.mark.parametrize("camera", [NEAR, BARREL])
@pytest.mark.parametrize(
    "X_SC",
    [
        above(0.02, 0.5, 0.01, turn=0.3),
        above(0.05, 0.53, 0.012, turn=-2.0, lean=0.2),
        above(2.0, 1.54, 0.01, turn=1.0),
        above(0.7, -0.25, 0.02),
    ],
)
def test_it_is_what_rays_meet(camera: PinholeCamera, X_SC: RigidTransform) -> None:
    drawn, expected = picture(camera, shell(), X_SC), traced(camera, shell(), X_SC, 6)
    error = np.abs(drawn - expected)
    # Rays tell a share to 1 of 12 along an edge, of the 230 grey levels between ink and paper.
    assert error.mean() < 0.5
    assert error.max() < 40
    assert (error > 20).mean() < 1e-3
    # How far one is shifted against the other, px, by least squares of the grey levels.
    for axis in (0, 1):
        slope = np.gradient(expected, axis=axis)
        assert abs((slope * (drawn - expected)).sum() / (slope**2).sum()) < 0.005


def test_the_disc_is_the_cone_that_touches_the_sphere() -> None:
    # Far away, where holes are too small to tell: their mean grey fills the outline.
    parameters = ShellParameters(spangle=0.0, hole_diameter=0.0)
    X_SC = above(0.3, 0.2, 0.4, lean=0.1)
    bare = shell(parameters, None)
    drawn, expected = picture(NEAR, bare, X_SC), traced(NEAR, bare, X_SC, 8)
    assert np.abs(drawn - expected).max() < 8.0
    sine = RADIUS / (RADIUS + 0.4)
    area = np.abs(picture(NEAR, bare, above(0, 0, 0.4)) - 200).sum() / (
        200 - 255 * parameters.steel
    )
    assert area == pytest.approx(np.pi * 120**2 * sine**2 / (1 - sine**2), rel=1e-3)
    holes = picture(NEAR, shell(PLAIN, None), above(0.3, 0.2, 0.4))
    mean = PLAIN.steel + np.pi / 4 * 0.25 * (PLAIN.hole - PLAIN.steel)
    np.testing.assert_allclose(holes[58:62, 78:82], 255 * mean, rtol=1e-4)


def test_corners_of_bent_markers_keep_their_places() -> None:
    for marker in MARKERS.values():
        corners = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])
        np.testing.assert_allclose(bent(corners, marker, RADIUS), marker.corners(), atol=1e-12)
        middle = bent(np.zeros((1, 2)), marker, RADIUS)[0]
        assert np.linalg.norm(middle) == pytest.approx(RADIUS, rel=1e-12)


def test_a_detector_finds_the_markers_among_the_holes() -> None:
    detector = MarkerDetector(family=TAG)
    for yaw, pitch, turn in ((0.03, 0.5, 0.0), (0.0, 0.52, 2.0), (0.8, -0.32, 1.0), (0, 1.55, 0.5)):
        X_SC = above(yaw, pitch, 0.01, turn=turn)
        image = np.rint(picture(FULL, shell(ShellParameters()), X_SC)).astype(np.uint8)
        found = detector.detect(image)
        assert len(found.ids) >= 1
        for marker_id, corners in zip(found.ids, found.corners, strict=True):
            X_CS = X_SC.inverse()
            truth = FULL.project(X_CS.multiply(MARKERS[int(marker_id)].corners().T).T)
            # The detector fits straight lines to edges that bulge by 0.5 px, so a pixel it is.
            assert np.abs(corners - truth).max() < 1.2


def test_the_spangle_is_of_its_seed_and_contrast() -> None:
    def spangled(**changes: float) -> np.ndarray:
        parameters = ShellParameters(hole_diameter=0.0, **changes)  # type: ignore[arg-type]
        return picture(FULL, shell(parameters, None), above(0.4, 0.7, 0.01))

    one, again, other = spangled(), spangled(), spangled(spangle_seed=1)
    np.testing.assert_array_equal(one, again)
    assert (one != other).mean() > 0.9
    assert one.mean() == pytest.approx(255 * 0.55, abs=4)
    assert one.std() == pytest.approx(255 * 0.04, rel=0.25)
    assert spangled(spangle=0.0).std() == 0.0


def test_from_within_and_from_behind_nothing_is_seen() -> None:
    X_CS = above(0, 0, -0.01).inverse().GetAsMatrix34()
    assert draw_shell(NEAR, shell(), X_CS) is None
    assert (picture(NEAR, shell(), above(0, 0, 0.05, lean=np.pi)) == 200).all()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("steel", 1.2),
        ("paper", -0.1),
        ("hole_diameter", 0.002),
        ("hole_pitch", 0.0),
        ("spangle", -0.1),
        ("margin", 0),
    ],
)
def test_nonsense_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"{field} is .*: must be"):
        ShellParameters(**{field: value})  # type: ignore[arg-type]


def test_markers_off_the_sphere_are_refused() -> None:
    off = Marker(3, RigidTransform([0.08, 0, 0]), SIZE)
    with pytest.raises(ValueError, match="marker 3 from the sphere"):
        shell(PLAIN, MarkerMap(TAG, SIZE, {3: off}))
    with pytest.raises(ValueError, match="radius is -1"):
        DrawnShell(frame=FRAME, radius=-1.0)
