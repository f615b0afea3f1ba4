from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Box, FrameId, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder

from systems.cameras import PinholeCamera
from systems.markers.corner_noise import narrow_side
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap
from systems.markers.projector import (
    MarkerProjector,
    PlacedMarker,
    ProjectorParameters,
    placed_markers,
    project_markers,
    visible_markers,
)
from systems.messages import Detections
from systems.raycasting import Solids

TAG = family("tag36h11")  # 8 cells
CAMERA = PinholeCamera.from_focal_length(640, 480, 600.0)
DISTORTED = PinholeCamera(640, 480, CAMERA.K, np.array([-0.28, 0.09, 1e-3, -2e-3, -0.01]))
# Optical axes (z forward, x right, y down) for a camera that looks along the world's x, z up.
R_WC = RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
AHEAD = RigidTransform(R_WC, np.zeros(3))
EXACT = ProjectorParameters(pixel_noise=0.0)


def facing(x: float, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> RigidTransform:
    """A marker at that place whose printed face looks back along -x, turned by `yaw`."""
    return RigidTransform(RollPitchYaw(0.0, 0.0, np.pi + yaw), [x, y, z])


def see(
    *markers: RigidTransform,
    size: float = 0.2,
    camera: PinholeCamera = CAMERA,
    parameters: ProjectorParameters = EXACT,
    solids: Solids | Callable[[], Solids] | None = None,
    X_WC: RigidTransform = AHEAD,
    rng: np.random.Generator | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    return project_markers(
        camera=camera,
        X_WC=X_WC,
        X_WM=np.array([X.GetAsMatrix34() for X in markers]).reshape(-1, 3, 4),
        sizes=np.full(len(markers), size),
        cells=TAG.cells,
        parameters=parameters,
        random=rng or np.random.default_rng(0),
        solids=solids,
    )


def by_opencv(
    X_WC: RigidTransform, X_WM: RigidTransform, size: float, camera: PinholeCamera
) -> np.ndarray:
    """Corners by OpenCV, from the convention in words: y to the viewer's right, z up."""
    h = size / 2
    top_left, top_right = [0, -h, h], [0, h, h]
    bottom_right, bottom_left = [0, h, -h], [0, -h, -h]
    X_CM = X_WC.inverse() @ X_WM
    rotation, _ = cv2.Rodrigues(X_CM.rotation().matrix())
    points = np.array([top_left, top_right, bottom_right, bottom_left])
    pixels, _ = cv2.projectPoints(points, rotation, X_CM.translation(), camera.K, camera.D)
    return pixels[:, 0]


def test_the_corners_go_round_from_the_top_left_as_the_viewer_sees_them() -> None:
    _, corners = see(facing(2.0))
    side = 600 * 0.2 / 2.0
    expected = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * side / 2 + [319.5, 239.5]
    np.testing.assert_allclose(corners, [expected], atol=1e-9)


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED])
def test_without_noise_the_corners_are_opencvs(camera: PinholeCamera) -> None:
    rng = np.random.default_rng(1)
    seen = 0
    for _ in range(100):
        X_WC = RigidTransform(
            RotationMatrix(Quaternion(_unit(rng.normal(size=4)))), rng.normal(size=3)
        )
        markers = [
            X_WC
            @ AHEAD.inverse()
            @ RigidTransform(
                RollPitchYaw(rng.uniform(0, 6), rng.uniform(-0.8, 0.8), np.pi + rng.uniform(-1, 1)),
                [rng.uniform(0.5, 3), rng.uniform(-1.5, 1.5), rng.uniform(-1, 1)],
            )
            for _ in range(8)
        ]
        index, corners = see(*markers, camera=camera, X_WC=X_WC)
        seen += len(index)
        for i, found in zip(index, corners, strict=True):
            np.testing.assert_allclose(found, by_opencv(X_WC, markers[i], 0.2, camera), atol=1e-8)
    assert seen > 100


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def test_the_narrow_side_is_a_singular_value() -> None:
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    rng = np.random.default_rng(2)
    maps = rng.normal(size=(50, 2, 2)) * 30
    quads = square @ maps.transpose(0, 2, 1) + rng.uniform(0, 500, (50, 1, 2))
    expected = np.linalg.svd(maps, compute_uv=False)[:, 1]
    np.testing.assert_allclose(narrow_side(quads), expected, atol=1e-9)


def test_the_narrow_side_of_a_tilted_square_shrinks_by_the_cosine() -> None:
    for turn in np.linspace(0, np.pi, 7):
        # Far away, where perspective is weak; a marker turned in its plane, then tilted.
        X_WM = facing(2000.0, yaw=1.0) @ RigidTransform(RollPitchYaw(turn, 0, 0), np.zeros(3))
        found = visible_markers(
            camera=CAMERA,
            X_WC=AHEAD,
            X_WM=X_WM.GetAsMatrix34()[None],
            sizes=np.array([20.0]),
            cells=TAG.cells,
            parameters=replace(EXACT, min_side_px=0.0),
        )
        np.testing.assert_allclose(found.side, [6 * np.cos(1.0)], rtol=1e-3)
        np.testing.assert_allclose(found.incidence, [1.0], atol=1e-12)


BOARD = Box(0.02, 0.3, 0.3)
# What is to be seen, and the one change that hides it (or does not).
CASES: dict[str, tuple[dict[str, Any], bool]] = {
    "straight ahead": ({}, True),
    "behind the camera": ({"X": facing(-2.0)}, False),
    "behind the camera, its face toward it": ({"X": facing(-2.0, yaw=np.pi)}, False),
    "its back toward the camera": ({"X": facing(2.0, yaw=np.pi)}, False),
    "incidence within the limit": ({"X": facing(2.0, yaw=1.39), "min_side_px": 0.0}, True),
    "incidence beyond the limit": ({"X": facing(2.0, yaw=1.41), "min_side_px": 0.0}, False),
    "range within the limit": ({"max_range": 2.001}, True),
    "range beyond the limit": ({"max_range": 1.999}, False),
    # 600 px focal length, 0.2 m: 12 px at 10 m.
    "just large enough": ({"X": facing(9.99)}, True),
    "just too small": ({"X": facing(10.01)}, False),
    "large enough, too narrow": ({"X": facing(6.0, yaw=np.arccos(0.55))}, False),
    # The picture ends 320 px from the axis; the corners are 30 px and the rim 37.5 px from the
    # marker's centre, which stands 300 px/m from the axis.
    "rim just inside": ({"X": facing(2.0, y=-282.4 / 300)}, True),
    "rim just outside": ({"X": facing(2.0, y=-282.6 / 300)}, False),
    "rim just inside, above": ({"X": facing(2.0, z=202.4 / 300)}, True),
    "rim just outside, above": ({"X": facing(2.0, z=202.6 / 300)}, False),
    "rim outside, not asked for": (
        {"X": facing(2.0, y=-282.6 / 300), "white_margin": 0.0},
        True,
    ),
    "corners outside": ({"X": facing(2.0, y=-290.1 / 300), "white_margin": 0.0}, False),
    "inside the border": ({"X": facing(2.0, y=277.4 / 300), "border_px": 5.0}, True),
    "outside the border": ({"X": facing(2.0, y=277.6 / 300), "border_px": 5.0}, False),
    "half outside": ({"X": facing(2.0, y=320 / 300)}, False),
    "beside the camera": ({"X": facing(0.0, y=2.0, yaw=np.pi / 2)}, False),
    "behind a box": ({"solid": (Box(0.1, 0.5, 0.5), (1.0, 0, 0))}, False),
    "one corner behind a ball": ({"solid": (Sphere(0.01), (1.0, 0.05, 0.05))}, False),
    "the centre behind a ball": ({"solid": (Sphere(0.02), (1.0, 0, 0))}, False),
    "beside a box": ({"solid": (Box(0.1, 0.1, 0.1), (1.0, 0.11, 0))}, True),
    "before a box": ({"solid": (Box(0.1, 0.5, 0.5), (2.2, 0, 0))}, True),
    "on its board": ({"solid": (BOARD, (2.01, 0, 0))}, True),
    "sunk 1 mm into its board": ({"solid": (BOARD, (2.009, 0, 0))}, True),
    "2 cm behind a board": ({"solid": (BOARD, (1.99, 0, 0))}, False),
    "the white margin behind a ball": ({"solid": (Sphere(0.01), (1.0, 0.0625, 0.0625))}, True),
    "the camera inside a ball": ({"solid": (Sphere(0.3), (0.0, 0, 0))}, True),
}


@pytest.mark.parametrize("case", CASES)
def test_visibility(case: str) -> None:
    change, expected = CASES[case]
    change = dict(change)
    X_WM = change.pop("X", facing(2.0))
    shape, place = change.pop("solid", (None, None))
    solids = Solids([shape], [RigidTransform(np.array(place))]) if shape else None
    index, _ = see(X_WM, parameters=replace(EXACT, **change), solids=solids)
    assert (len(index) == 1) is expected


def test_a_marker_flush_with_a_slanted_board_is_not_hidden_by_it() -> None:
    for distance in (0.3, 1.0, 3.0):
        for yaw in np.linspace(-1.3, 1.3, 15):
            X_WM = facing(distance, yaw=yaw)
            board = X_WM @ RigidTransform([-0.05, 0.0, 0.0])
            solids = Solids([Box(0.1, 0.3, 0.3)], [board])
            index, _ = see(
                X_WM, size=0.1, parameters=replace(EXACT, min_side_px=0.0), solids=solids
            )
            assert len(index) == 1


def test_how_close_a_solid_may_be_grows_with_the_distance() -> None:
    near, far = facing(1.0, y=0.15), facing(4.0, y=-0.6)
    # 12 mm before each marker: more than 0.5 % of 1 m, less than 0.5 % of 4 m.
    plates = [X @ RigidTransform([0.012 - 0.005, 0.0, 0.0]) for X in (near, far)]
    solids = Solids([Box(0.01, 0.3, 0.3)] * 2, plates)
    index, _ = see(near, far, size=0.1, solids=solids)
    assert index.tolist() == [1]
    # Close by, a millimetre is left.
    for depth, seen in ((0.0009, True), (0.0011, False)):
        close = facing(0.05)
        board = close @ RigidTransform([depth - 0.005, 0.0, 0.0])
        index, _ = see(close, size=0.01, solids=Solids([Box(0.01, 0.1, 0.1)], [board]))
        assert (len(index) == 1) is seen


def test_what_may_hide_markers_is_asked_for_only_when_some_are_in_the_picture() -> None:
    asked = []

    def wall() -> Solids:
        asked.append(True)
        return Solids([Box(0.02, 2.0, 2.0)], [RigidTransform([1.0, 0.0, 0.0])])

    assert see(facing(-2.0), solids=wall)[0].tolist() == []
    assert asked == []
    assert see(facing(2.0), solids=wall)[0].tolist() == []
    assert asked == [True]
    assert see(facing(2.0))[0].tolist() == [0]


def test_a_distorted_picture_does_not_fold_back() -> None:
    """Far off the axis the distortion model turns around: what is beside us would show ahead."""
    camera = PinholeCamera(640, 480, CAMERA.K, np.array([-0.4, 0.0, 0.0, 0.0, 0.0]))
    fold = camera.fold_radius
    assert fold == pytest.approx(np.sqrt(1 / 1.2))
    angles = np.linspace(0.05, 1.4, 60)
    beyond = 0
    for angle in angles:
        X_WM = facing(2 * np.cos(angle), y=2 * np.sin(angle), yaw=angle)
        index, corners = see(X_WM, size=0.1, camera=camera)
        rim = by_opencv(AHEAD, X_WM, 0.125, camera)
        in_picture = ((rim > -0.5) & (rim < [639.5, 479.5])).all()
        p_C = np.abs(by_opencv(AHEAD, X_WM, 0.125, CAMERA) - [319.5, 239.5]).max(axis=0) / 600
        if np.hypot(*p_C) > fold:
            beyond += in_picture
            assert len(index) == 0
        elif in_picture and narrow_side(rim[None])[0] > 16:
            assert len(index) == 1
            np.testing.assert_allclose(corners[0], by_opencv(AHEAD, X_WM, 0.1, camera), atol=1e-9)
    assert beyond > 3  # the trap was there
    assert CAMERA.fold_radius == np.inf
    assert replace(CAMERA, D=np.array([0.1, 0.0, 0.01, 0.0, 0.0])).fold_radius == np.inf


def test_noise_is_white_and_of_the_asked_size() -> None:
    rng = np.random.default_rng(3)
    markers = [facing(2.0, y=y) for y in (-0.6, 0.0, 0.6)]
    _, exact = see(*markers)
    noisy = replace(EXACT, pixel_noise=0.3)
    errors = np.array([see(*markers, parameters=noisy, rng=rng)[1] - exact for _ in range(4000)])
    samples = errors.reshape(4000, 24)
    n = samples.size
    assert abs(samples.mean()) < 5 * 0.3 / np.sqrt(n)
    # The standard deviation of a standard deviation is sigma / sqrt(2 n).
    assert samples.std() == pytest.approx(0.3, abs=5 * 0.3 / np.sqrt(2 * n))
    correlation = np.corrcoef(samples.T) - np.eye(24)
    assert np.abs(correlation).max() < 5 / np.sqrt(4000)
    kurtosis = ((samples / 0.3) ** 4).mean()
    assert kurtosis == pytest.approx(3.0, abs=5 * np.sqrt(96 / n))


def test_misses_are_as_frequent_as_asked() -> None:
    rng = np.random.default_rng(4)
    markers = [facing(2.0, y=y) for y in (-0.6, 0.0, 0.6)]
    parameters = replace(EXACT, miss_probability=0.2)
    found = sum(len(see(*markers, parameters=parameters, rng=rng)[0]) for _ in range(2000))
    assert found / 6000 == pytest.approx(0.8, abs=5 * np.sqrt(0.16 / 6000))
    assert len(see(*markers, parameters=replace(EXACT, miss_probability=1.0))[0]) == 0


def test_the_noise_of_a_marker_does_not_depend_on_the_others() -> None:
    markers = [facing(2.0, y=y) for y in (-0.6, 0.0, 0.6)]
    noisy = ProjectorParameters(pixel_noise=0.3)
    _, all_seen = see(*markers, parameters=noisy)
    hidden = [facing(-2.0), *markers[1:]]
    index, rest = see(*hidden, parameters=noisy)
    assert index.tolist() == [1, 2]
    np.testing.assert_array_equal(rest, all_seen[1:])

    # Nor do its misses.
    chancy = replace(noisy, miss_probability=0.5)
    for seed in range(20):
        both = see(*markers, parameters=chancy, rng=np.random.default_rng(seed))[0].tolist()
        rest = see(*hidden, parameters=chancy, rng=np.random.default_rng(seed))[0].tolist()
        assert rest == [i for i in both if i != 0]


def test_no_markers() -> None:
    index, corners = see()
    assert index.shape == (0,)
    assert corners.shape == (0, 4, 2)


@pytest.mark.parametrize(
    ("field", "value", "allowed"),
    [
        ("pixel_noise", -0.1, "0 or greater"),
        ("min_side_px", np.nan, "0 or greater"),
        ("max_incidence", np.pi / 2, "between 0 and pi/2"),
        ("max_range", 0.0, "greater than 0"),
        ("miss_probability", 1.1, "0 to 1"),
        ("white_margin", -1.0, "0 or greater"),
        ("border_px", -1.0, "0 or greater"),
    ],
)
def test_refuses_parameters(field: str, value: float, allowed: str) -> None:
    with pytest.raises(ValueError, match=f"{field} is .*must be {allowed}"):
        ProjectorParameters(**{field: value})


# --- the block -----------------------------------------------------------------------------------

V_WB = np.array([0.0, 0.4, 0.1])  # of the body that carries marker 1, m/s
OMEGA = np.array([0.0, 0.0, 0.5])  # of the same, rad/s
X_BM = RigidTransform(RollPitchYaw(0.1, -0.2, 0.3), [-0.05, 0.02, 0.1])
X_WB = RigidTransform(RollPitchYaw(0.0, 0.0, np.pi - 0.4), [2.0, -0.5, 0.0])
X_RC = RigidTransform(R_WC, [0.1, 0.0, 0.2])


class Scene:
    """A camera on a robot at rest, one marker on the wall, one on a body that drifts and turns."""

    def __init__(
        self,
        solids: Sequence[tuple[Shape, RigidTransform]] = (),
        shade: tuple[Shape, RigidTransform] | None = None,
        transparent: bool = False,
        **arguments: Any,
    ) -> None:
        builder = DiagramBuilder()
        self.plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1 / 64)
        self.plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        inertia = SpatialInertia(1.0, np.zeros(3), UnitInertia(1.0, 1.0, 1.0))
        robot = self.plant.AddRigidBody("robot", inertia)
        self.body = self.plant.AddRigidBody("body", inertia)
        for i, (shape, X) in enumerate(solids):
            self.plant.RegisterVisualGeometry(
                self.plant.world_body(), X, shape, f"solid {i}", np.ones(4)
            )
        self.plant.RegisterVisualGeometry(robot, X_RC, Sphere(0.05), "camera housing", np.ones(4))
        if shade is not None:
            self.plant.RegisterVisualGeometry(self.body, shade[1], shade[0], "shade", np.ones(4))
        self.plant.Finalize()

        def frame(body: Any) -> FrameId:
            return self.plant.GetBodyFrameIdOrThrow(body.index())

        wall = MarkerMap(TAG, 0.2, {7: Marker(7, facing(3.0), 0.2)})
        self.markers = [
            *placed_markers(wall, scene_graph.world_frame_id(), RigidTransform([0.0, 0.6, 0.3])),
            PlacedMarker(1, 0.15, frame(self.body), X_BM),
        ]
        self.projector = builder.AddSystem(
            MarkerProjector(
                **{
                    "camera": DISTORTED,
                    "parent_frame": frame(robot),
                    "X_PC": X_RC,
                    "markers": self.markers,
                    "family": TAG,
                    "rate": 10.0,
                    "frame_id": "front_camera",
                    "transparent_frames": [frame(self.body)] if transparent else [],
                    **arguments,
                }
            )
        )
        builder.Connect(
            scene_graph.get_query_output_port(), self.projector.query_object_input_port()
        )
        self.diagram: Diagram = builder.Build()

    def context(self, seed: int | None = None) -> Any:
        context = self.diagram.CreateDefaultContext()
        own = self.plant.GetMyMutableContextFromRoot(context)
        self.plant.SetFreeBodyPose(own, self.body, X_WB)
        self.plant.SetFreeBodySpatialVelocity(own, self.body, SpatialVelocity(OMEGA, V_WB))
        if seed is not None:
            projector = self.projector.GetMyMutableContextFromRoot(context)
            projector.get_mutable_numeric_parameter(0).SetFromVector([seed])
        return context

    def run(
        self,
        times: Sequence[float],
        context: Any = None,
        look: Callable[[Any], None] | None = None,
    ) -> list[Detections]:
        """The message on the port at each of the times."""
        simulator = Simulator(self.diagram, context or self.context())
        port = self.projector.detections_output_port()
        messages = []
        for t in times:
            simulator.AdvanceTo(t)
            if look is not None:
                look(simulator.get_context())
            messages.append(port.Eval(self.projector.GetMyContextFromRoot(simulator.get_context())))
        return messages


def same(a: Detections, b: Detections) -> bool:
    return (
        a.stamp == b.stamp
        and a.ids.tolist() == b.ids.tolist()
        and a.corners.tobytes() == b.corners.tobytes()
    )


def test_a_still_and_a_moving_marker_are_seen_where_they_are() -> None:
    # Periods that are exact in binary: else a picture at 3 * 0.1 s would see the plant's step at
    # 0.3 s done already.
    scene = Scene(parameters=EXACT, rate=8.0)
    for t, message in zip(
        [0.0, 0.125, 0.25, 0.375, 1.0], scene.run([0.05, 0.15, 0.3, 0.4, 1.1]), strict=True
    ):
        assert message.stamp == t
        assert message.ids.tolist() == [7, 1]
        assert message.ids.dtype == message.hamming.dtype == np.int64
        assert message.hamming.tolist() == [0, 0]
        assert np.isnan(message.decision_margin).all()
        assert (message.frame_id, message.family) == ("front_camera", "tag36h11")
        still = RigidTransform([0.0, 0.6, 0.3]) @ facing(3.0)
        # Constant velocity and turn rate about z.
        R = RotationMatrix.MakeZRotation(OMEGA[2] * t) @ X_WB.rotation()
        moving = RigidTransform(R, X_WB.translation() + V_WB * t) @ X_BM
        for X_WM, size, corners in zip((still, moving), (0.2, 0.15), message.corners, strict=True):
            # The plant integrates the turn in steps; one step of time would be 2 px.
            np.testing.assert_allclose(corners, by_opencv(X_RC, X_WM, size, DISTORTED), atol=1e-3)


def test_detections_arrive_after_the_latency_with_the_pictures_stamp() -> None:
    scene = Scene(latency=0.13)
    messages = scene.run([0.125, 0.135, 0.225, 0.235, 0.335])
    stamps = [message.stamp for message in messages]
    assert np.isnan(stamps[0])
    assert len(messages[0]) == 0
    assert stamps[1:] == [0.0, 0.0, 0.1, 0.2]
    undelayed = Scene().run([0.05, 0.15, 0.25])
    assert same(messages[1], undelayed[0])
    assert same(messages[3], undelayed[1])
    assert same(messages[4], undelayed[2])


def test_a_solid_of_the_scene_hides_a_marker() -> None:
    pillar = (Box(0.1, 0.3, 1.0), RigidTransform([1.0, 0.24, 0.2]))
    assert Scene([pillar]).run([0.05])[0].ids.tolist() == [1]


def test_geometry_of_transparent_frames_hides_nothing() -> None:
    # On the body that carries marker 1, between it and the camera.
    shade = (Box(0.02, 0.6, 0.6), X_BM @ RigidTransform([0.3, 0.0, 0.0]))
    assert Scene(shade=shade).run([0.05])[0].ids.tolist() == [7]
    assert Scene(shade=shade, transparent=True).run([0.05])[0].ids.tolist() == [7, 1]


def test_the_same_seed_gives_the_same_bits_and_another_seed_others() -> None:
    scene = Scene(seed=5)
    times = [0.05, 0.15, 0.25]
    first, again = scene.run(times), Scene(seed=5).run(times)
    assert all(same(a, b) for a, b in zip(first, again, strict=True))
    by_context = Scene(seed=0)
    varied = by_context.run(times, by_context.context(seed=5))
    assert all(same(a, b) for a, b in zip(first, varied, strict=True))
    other = scene.run(times, scene.context(seed=6))
    assert not any(same(a, b) for a, b in zip(first, other, strict=True))
    renamed = Scene(seed=5, name="rear").run(times)
    assert not any(same(a, b) for a, b in zip(first, renamed, strict=True))
    # And each sample draws anew.
    still = [message.corners[0] for message in first]
    assert not np.array_equal(still[0], still[1])
    assert np.abs(still[0] - still[1]).max() < 3.0


def test_the_noise_does_not_depend_on_what_was_evaluated_before() -> None:
    scene = Scene(seed=5)
    plain = scene.run([0.05, 0.15, 0.25, 0.35])
    port = scene.projector.detections_output_port()

    def look(context: Any) -> None:
        for _ in range(3):
            port.Eval(scene.projector.GetMyContextFromRoot(context))
            port.Eval(scene.projector.GetMyContextFromRoot(context.Clone()))

    watched = scene.run([0.01, 0.05, 0.07, 0.15, 0.25, 0.35], look=look)
    assert all(same(a, b) for a, b in zip(plain, [watched[i] for i in (1, 3, 4, 5)], strict=True))

    # Started in the middle of the run, from the state of that time.
    simulator = Simulator(scene.diagram, scene.context())
    simulator.AdvanceTo(0.25)
    middle = simulator.get_context().Clone()
    late = scene.run([0.35], middle)
    assert same(late[0], plain[3])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"markers": [PlacedMarker(587, 0.1, FrameId.get_new_id(), facing(1))]}, "id is 587"),
        ({"markers": [PlacedMarker(3, 0.0, FrameId.get_new_id(), facing(1))]}, "marker 3 is 0.0"),
        ({"rate": 0.0}, "rate is 0.0"),
        ({"latency": -0.1}, "latency is -0.1"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_refuses_arguments(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Scene(**change)
