from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from systems.cameras import PinholeCamera, load_camera

K = np.array([[590.0, 0.0, 322.5], [0.0, 610.0, 236.2], [0.0, 0.0, 1.0]])
BARREL = PinholeCamera(640, 480, K, np.array([-0.28, 0.09, 1e-3, -2e-3, -0.01]))
PINCUSHION = PinholeCamera(640, 480, K, np.array([0.25, 0.1, -2e-3, 1e-3, 0.05]))
STRAIGHT = PinholeCamera(640, 480, K)
CAMERAS = [STRAIGHT, BARREL, PINCUSHION]


def random_points(n: int, seed: int = 0) -> np.ndarray:
    """Points (n, 3) m before the cameras above, all over their pictures."""
    rng = np.random.default_rng(seed)
    rays = np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)), np.ones(n)])
    return rays * rng.uniform(0.2, 20.0, (n, 1))


@pytest.mark.parametrize("camera", CAMERAS)
def test_points_are_projected_where_opencv_projects_them(camera: PinholeCamera) -> None:
    points = random_points(500)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, camera.D)
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(camera.project_with_jacobian(points)[0], expected[:, 0], atol=1e-9)


def test_points_of_any_shape_are_projected() -> None:
    points = random_points(24)
    pixels = BARREL.project(points)
    in_blocks = points.reshape(2, 3, 4, 3)
    np.testing.assert_array_equal(BARREL.project(in_blocks), pixels.reshape(2, 3, 4, 2))
    np.testing.assert_array_equal(BARREL.project(points[0]), pixels[0])
    for value, shape in zip(BARREL.rays(pixels.reshape(2, 3, 4, 2)), [(2,), (2, 2)], strict=True):
        assert value.shape == (2, 3, 4, *shape)


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_jacobian_by_points_is_the_difference_quotient(camera: PinholeCamera) -> None:
    points, h = random_points(50, seed=1), 1e-6
    steps = h * np.eye(3)
    quotient = np.stack(
        [(camera.project(points + s) - camera.project(points - s)) / (2 * h) for s in steps], -1
    )
    _, jacobian = camera.project_with_jacobian(points)
    np.testing.assert_allclose(jacobian, quotient, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_derivative_by_rays_is_the_difference_quotient(camera: PinholeCamera) -> None:
    points, h = random_points(50, seed=2), 1e-6
    points /= points[:, 2:]
    rays, by_ray = camera.rays(camera.project(points))
    quotient = np.stack(
        [
            (camera.project(points + s) - camera.project(points - s)) / (2 * h)
            for s in h * np.eye(3)[:2]
        ],
        -1,
    )
    np.testing.assert_allclose(rays, points[:, :2], atol=1e-12)
    np.testing.assert_allclose(by_ray, quotient, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("camera", CAMERAS)
def test_opencvs_pixels_are_taken_back_to_their_rays(camera: PinholeCamera) -> None:
    points = random_points(500, seed=3)
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, camera.D)
    rays = camera.undistort(pixels[:, 0])
    np.testing.assert_allclose(rays, points[:, :2] / points[:, 2:], atol=1e-12)


def test_opencv_undistorts_to_the_same_rays() -> None:
    grid = np.stack(np.meshgrid(np.arange(0, 640, 40.0), np.arange(0, 480, 40.0)), -1)
    for camera in CAMERAS:
        # Its five fixed-point steps stop short of ours.
        expected = cv2.undistortPoints(grid.reshape(-1, 1, 2), camera.K, camera.D)
        np.testing.assert_allclose(
            camera.undistort(grid), expected.reshape(grid.shape), atol=2e-3 * camera.distorted
        )


@pytest.mark.parametrize(
    "coefficients",
    [[-0.3, 0, 0, 0, 0], [-0.35, 0.15, 0, 0, -0.03], [0.1, -0.3, 0, 0, 0], [-0.5, 0.4, 0, 0, -0.2]],
)
def test_a_pixel_that_no_ray_reaches_has_none(coefficients: list[float]) -> None:
    # Its equation has solutions, beyond the fold or on the far side of the axis. None may come out.
    camera = PinholeCamera(640, 480, K, np.array(coefficients))
    r = np.linspace(0.0, 4.0, 100_000)
    distorted = r * (1 + sum(k * r**n for k, n in zip(coefficients, (2, 4, 0, 0, 6), strict=True)))
    turn = int(np.argmax(np.diff(distorted) < 0))
    reach = distorted[turn]
    assert camera.fold_radius == pytest.approx(r[turn], abs=1e-4)

    angle = np.arange(0.0, 2 * np.pi, 0.1)[:, None]
    radius = np.linspace(0.0, 3.0, 200)
    n = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
    rays = camera.undistort(n * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2])
    assert np.isnan(rays[np.broadcast_to(radius > 1.001 * reach, rays.shape[:2])]).all()
    inner = np.broadcast_to(radius < 0.999 * reach, rays.shape[:2])
    assert np.isfinite(rays[inner]).all()
    assert (np.einsum("...i,...i->...", rays, n)[inner] >= 0).all()
    expected = np.interp(radius, distorted[: turn + 1], r[: turn + 1])
    found = np.hypot(*np.moveaxis(rays, -1, 0))
    np.testing.assert_allclose(
        found[inner], np.broadcast_to(expected, found.shape)[inner], atol=1e-4
    )


def test_a_model_that_never_folds_reaches_everywhere() -> None:
    assert STRAIGHT.fold_radius == np.inf
    assert PINCUSHION.fold_radius == np.inf
    far = np.array([[-4000.0, 3000.0], [9000.0, 9000.0]])
    rays = PINCUSHION.undistort(far)
    p_C = np.column_stack([rays, np.ones(2)])
    np.testing.assert_allclose(PINCUSHION.project(p_C), far, rtol=1e-12)


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_pixel_that_is_not_finite_spoils_no_other(camera: PinholeCamera) -> None:
    pixels = camera.project(random_points(5))
    alone = camera.undistort(pixels)
    pixels[2] = np.nan
    pixels[3, 0] = np.inf
    together = camera.undistort(pixels)
    assert not np.isfinite(together[2:4]).all(axis=1).any()
    np.testing.assert_allclose(together[[0, 1, 4]], alone[[0, 1, 4]], atol=1e-14)


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("factor", [2, 3, 0.5])
def test_a_scaled_camera_sees_the_same_picture_larger(camera: PinholeCamera, factor: float) -> None:
    # Pixel u is the square from u - 1/2 to u + 1/2: its outline, not its centre, is multiplied.
    points = random_points(20)
    large = camera.scaled(factor)
    assert (large.width, large.height) == (640 * factor, 480 * factor)
    expected = (camera.project(points) + 0.5) * factor - 0.5
    np.testing.assert_allclose(large.project(points), expected, atol=1e-9)


def test_a_camera_of_a_focal_length_looks_through_the_pictures_centre() -> None:
    camera = PinholeCamera.from_focal_length(640, 480, 500.0)
    corners = camera.rays(np.array([[-0.5, -0.5], [639.5, 479.5]]))[0]  # of the picture
    np.testing.assert_allclose(corners, [[-0.64, -0.48], [0.64, 0.48]], atol=1e-15)
    assert not camera.distorted


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "width is 0: must be greater than 0"),
        ({"height": -3}, "height is -3: must be greater than 0"),
        ({"K": [1.0, 2.0]}, "K is .*: must be 9 numbers"),
        ({"K": np.full((3, 3), np.nan)}, "K is .*: must be finite"),
        ({"K": np.diag([-500.0, 500.0, 1.0])}, "K is .*: must be of positive focal length"),
        ({"K": K + np.eye(3, k=1)}, r"K is .*: must be \[\[fx, 0, cx\]"),
        ({"K": K * 2}, r"K is .*: must be \[\[fx, 0, cx\]"),
        ({"D": np.zeros(8)}, "D is .*: must be 4 or 5 numbers"),
        ({"D": [0.0, np.inf, 0.0, 0.0]}, "D is .*: must be finite"),
    ],
)
def test_nonsense_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PinholeCamera(**({"width": 640, "height": 480, "K": K} | change))


def test_a_camera_cannot_be_changed_behind_its_back() -> None:
    with pytest.raises(ValueError, match="read-only"):
        BARREL.K[0, 0] = 1.0
    own = K.copy()
    camera = PinholeCamera(640, 480, own)
    own[0, 0] = 1.0
    assert camera.K[0, 0] == 590.0


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_saved_camera_is_read_back_to_the_bit(camera: PinholeCamera, tmp_path: Path) -> None:
    camera.save(tmp_path / "camera.yaml")
    again = load_camera(tmp_path / "camera.yaml")
    assert (again.width, again.height) == (camera.width, camera.height)
    np.testing.assert_array_equal(again.K, camera.K)
    np.testing.assert_array_equal(again.D, camera.D)


# As camera_calibration's cameracalibrator writes it.
ROS = """
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [590.0, 0.0, 322.5, 0.0, 610.0, 236.2, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.28, 0.09, 0.001, -0.002, -0.01]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
projection_matrix:
  rows: 3
  cols: 4
  data: [560.0, 0.0, 321.0, 0.0, 0.0, 590.0, 236.0, 0.0, 0.0, 0.0, 1.0, 0.0]
"""
OURS = """
width: 640
height: 480
K: [590.0, 0.0, 322.5, 0.0, 610.0, 236.2, 0.0, 0.0, 1.0]
D: [-0.28, 0.09, 0.001, -0.002, -0.01]
"""


@pytest.mark.parametrize(
    "text", [ROS, OURS, OURS.replace("[590", "[[590").replace("1.0]", "1.0]]")]
)
def test_camera_files_of_every_form_are_read(text: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    camera = load_camera(path)
    assert (camera.width, camera.height) == (640, 480)
    np.testing.assert_array_equal(camera.K, BARREL.K)
    np.testing.assert_array_equal(camera.D, BARREL.D)


def test_a_camera_file_may_leave_out_the_distortion(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(OURS[: OURS.index("D:")])
    assert not load_camera(path).distorted


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must be a mapping with the keys width, height, K, D"),
        ("- 1\n- 2\n", "must be a mapping"),
        ("width: [", "is not YAML"),
        (OURS.replace("width: 640", ""), "width is None: must be a whole number"),
        (OURS.replace("width: 640", "width: 640.5"), "width is 640.5: must be a whole number"),
        (OURS.replace("width: 640", "width: yes"), "width is .*: must be a whole number"),
        (OURS.replace("width: 640", "width: true"), "width is True: must be a whole number"),
        (OURS.replace("height: 480", "height: -480"), "height is -480: must be a whole number"),
        (OURS.replace("K:", "k:"), "key is 'k': must be one of width, height, K, D"),
        (OURS.replace("590.0,", ""), "K is .*: must be 9 numbers"),
        (OURS.replace("590.0", "wide"), "K is .*: must be a list of numbers"),
        (OURS.replace("590.0", ".nan"), "K is .*: must be finite"),
        (OURS.replace("-0.28", "[-0.28]"), "D is .*: must be a list of numbers"),
        (OURS.replace("-0.28", "1.0, 2.0, -0.28"), "D is .*: must be 4 or 5 numbers"),
        (ROS.replace("image_height: 480", ""), "height is None: must be a whole number"),
        (ROS.replace("plumb_bob", "equidistant"), "distortion_model is 'equidistant'"),
        (ROS.replace("camera_matrix:", "matrix:"), "camera_matrix is None: must be a mapping"),
        (ROS.replace("  data: [590", "  K: [590"), "camera_matrix is .*: must be a mapping"),
        (
            "image_width: 640\nimage_height: 480\ncamera_matrix: [590]\n",
            "camera_matrix is .*: must be a mapping",
        ),
    ],
)
def test_a_camera_file_that_is_refused_says_which_key(
    text: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "my_camera.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"my_camera\.yaml.*{message}"):
        load_camera(path)


KALIBR = """
cam0:
  camera_model: pinhole
  intrinsics: [461.6, 460.3, 362.7, 248.1]
  distortion_model: radtan
  distortion_coeffs: [-0.28, 0.07, 0.0002, 0.00002]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1: [[1, 0, 0, -0.11], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: pinhole
  intrinsics: [457.6, 456.1, 379.9, 255.2]
  distortion_model: none
  distortion_coeffs: []
  resolution: [752, 480]
"""


def test_kalibrs_cameras_are_read_by_name(tmp_path: Path) -> None:
    path = tmp_path / "cameras.yaml"
    path.write_text(KALIBR)
    first = load_camera(tmp_path / "cameras.yaml:cam0")
    assert (first.width, first.height) == (752, 480)
    np.testing.assert_array_equal(first.K, [[461.6, 0, 362.7], [0, 460.3, 248.1], [0, 0, 1]])
    np.testing.assert_array_equal(first.D, [-0.28, 0.07, 0.0002, 0.00002, 0])
    assert not load_camera(tmp_path / "cameras.yaml:cam1").distorted
    path.write_text(KALIBR[: KALIBR.index("cam1")])
    np.testing.assert_array_equal(load_camera(path).K, first.K)  # of one camera no name is needed


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("", ("", ""), "cameras is 'cam0, cam1': must be one: name it, as in FILE:cam0"),
        (":cam7", ("", ""), "camera is 'cam7': must be one of cam0, cam1"),
        (":cam0", ("radtan", "equidistant"), "cam0.distortion_model is 'equidistant': must be "
                  "radtan, plumb_bob, none: no other is modelled"),
        (":cam0", ("pinhole", "omni"), "cam0.camera_model is 'omni': must be pinhole"),
        (":cam0", ("[752, 480]", "752"), "cam0.resolution is 752: must be a list of 2 numbers"),
        (":cam0", ("  resolution: [752, 480]\n", ""), "cam0 lacks the key 'resolution'"),
    ],
)  # fmt: skip
def test_a_kalibr_file_that_is_refused_says_why(
    tmp_path: Path, name: str, change: tuple[str, str], words: str
) -> None:
    (tmp_path / "cameras.yaml").write_text(KALIBR.replace(*change, 1) if change[0] else KALIBR)
    with pytest.raises(ValueError, match=r"camera file .*cameras.yaml: ") as caught:
        load_camera(tmp_path / f"cameras.yaml{name}")
    assert words in str(caught.value)


def test_a_name_of_a_camera_is_for_files_with_names(tmp_path: Path) -> None:
    PinholeCamera.from_focal_length(64, 48, 50.0).save(tmp_path / "ours.yaml")
    with pytest.raises(ValueError, match="camera is 'cam0': must be left out"):
        load_camera(tmp_path / "ours.yaml:cam0")


def test_a_camera_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"lost\.yaml: No such file"):
        load_camera(tmp_path / "lost.yaml")
    with pytest.raises(ValueError, match="Is a directory"):
        load_camera(tmp_path)
    (tmp_path / "picture.yaml").write_bytes(b"\xff\xd8\xff\xe0\x00\x10")
    with pytest.raises(ValueError, match=r"picture\.yaml is not YAML"):
        load_camera(tmp_path / "picture.yaml")


def test_what_drake_renders_is_where_the_camera_projects_it() -> None:
    # Bright plates, square to the camera, at random places; their centroids in the picture.
    camera = PinholeCamera(320, 240, np.array([[300.0, 0, 152.3], [0, 300.0, 124.6], [0, 0, 1]]))
    rng = np.random.default_rng(4)
    grid = np.stack(np.meshgrid([-0.36, -0.12, 0.12, 0.36], [-0.24, 0.0, 0.24]), -1).reshape(-1, 2)
    centres = np.column_stack([grid + rng.uniform(-0.03, 0.03, grid.shape), np.ones(len(grid))])

    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    for k, centre in enumerate(centres):
        # The front face is what is seen, so the box' middle lies behind it.
        X_WBox = RigidTransform(centre + np.array([0.0, 0.0, 5e-4]))
        plant.RegisterVisualGeometry(
            plant.world_body(), X_WBox, Box(0.06, 0.06, 1e-3), f"{k}", np.array([0.0, 0, 0, 1])
        )
    plant.Finalize()
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams(backend="EGL")))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))

    def errors(seen_by: PinholeCamera) -> np.ndarray:
        """Mean over the plates of where they are in the picture, less where `camera` puts them."""
        core = RenderCameraCore(
            "vtk", seen_by.to_drake(), ClippingRange(0.1, 10.0), RigidTransform()
        )
        X_WC = RigidTransform(RotationMatrix(), np.zeros(3))
        image = query.RenderColorImage(
            ColorRenderCamera(core, False), scene_graph.world_frame_id(), X_WC
        ).data
        dark = image[0, 0, 1] - image[..., 1].astype(float)
        n, labels = cv2.connectedComponents((dark > 50).astype(np.uint8))
        assert n == len(centres) + 1
        found = np.array([np.mean(np.argwhere(labels == k)[:, ::-1], axis=0) for k in range(1, n)])
        wanted = camera.project(centres)
        nearest = np.linalg.norm(found[:, None] - wanted, axis=2).argmin(axis=0)
        return (found[nearest] - wanted).mean(axis=0)

    # One plate's centroid is uncertain by 0.1 px (its edges are jagged), their mean by 0.03 px.
    np.testing.assert_allclose(errors(camera), 0.0, atol=0.1)
    # The test would notice if the half pixel were left out, or added with the wrong sign.
    for wrong in (0.5, 1.0):
        shifted = camera.K.copy()
        shifted[:2, 2] -= wrong
        np.testing.assert_allclose(errors(PinholeCamera(320, 240, shifted)), -wrong, atol=0.1)
