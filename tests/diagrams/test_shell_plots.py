from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.axes import Axes
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from diagrams.shell_metrics import ShellLog
from diagrams.shell_plots import (
    angle_curves,
    apart,
    camera_view,
    camera_views,
    hidden,
    plot_shell,
    shell_figure,
    viewpoint,
)
from systems.cameras import PinholeCamera
from systems.drawing.shells import DrawnShell, ShellParameters
from systems.markers.detector import MarkerDetector
from systems.shell.angles import rotation
from systems.shell.layout import shell_markers
from tests.diagrams.shell_report_log import HEIGHT, RADIUS, shell_log

CAMERA = PinholeCamera.from_focal_length(640, 480, 481.0)
X_BC = RigidTransform(
    RotationMatrix(np.column_stack([(0.0, -1, 0), (-1, 0, 0), (0, 0, -1)])),
    [0.0, 0.0, 0.010 - HEIGHT],
)
MARKERS = shell_markers(radius=RADIUS)
SHELL = DrawnShell(
    frame=SceneGraph().world_frame_id(),
    radius=RADIUS,
    markers=MARKERS,
    parameters=ShellParameters(spangle=0.0),
)


def noisy(n: int = 400, seed: int = 2) -> ShellLog:
    return shell_log(np.random.default_rng(seed).normal(0, 1.0, (n, 3)))


def at(angles: list[list[float]]) -> ShellLog:
    """A log of poses at [roll, pitch, yaw] (deg), estimated without error."""
    made = shell_log(np.zeros((len(angles), 3)))
    R = rotation(np.radians(np.array(angles)))
    p = (RADIUS + HEIGHT) * R[:, :, 2]
    return replace(made, R=R, p=p, R_estimate=R, p_estimate=p)


def axes_of(log: ShellLog) -> list[Axes]:
    figure = shell_figure(log, camera_views=[], markers=MARKERS, radius=RADIUS)
    return [ax for ax in figure.axes if ax.name != "3d"]


# --- Curves ---


def test_curves_break_at_the_pole_and_nowhere_else() -> None:
    log = noisy()
    truth, estimate = angle_curves(log)
    from_pole = np.degrees(np.arccos(log.R[:, 2, 2]))
    for k in (0, 2):
        np.testing.assert_array_equal(np.isnan(truth[:, k]), from_pole < 10)
        steps = np.diff(truth[:, k])
        assert np.nanmax(np.abs(steps)) < 10
    assert np.isfinite(truth[:, 1]).all()
    assert np.nanmax(np.abs(estimate - truth)) < 40  # no jump by a turn
    np.testing.assert_array_equal(np.isnan(estimate), np.isnan(truth))
    # Modulo a turn they are the angles of the rotations.
    good = ~np.isnan(truth).any(axis=1)
    np.testing.assert_allclose(rotation(np.radians(truth[good])), log.R[good], atol=1e-9)
    again = rotation(np.radians(estimate[good]))
    np.testing.assert_allclose(again, log.R_estimate[good], atol=1e-9)


def test_a_robot_that_stays_at_the_seam_does_not_jump() -> None:
    wiggle = np.random.default_rng(1).normal(0, 0.5, (50, 2))
    log = at([[180 + a, 20.0, 180 + b] for a, b in wiggle])
    truth, estimate = angle_curves(log)
    np.testing.assert_allclose(truth[:, [0, 2]], 180 + wiggle, atol=1e-9)
    np.testing.assert_allclose(estimate, truth, atol=1e-9)


# --- The figure ---


def test_panels_are_labelled_with_units_and_hold_the_numbers() -> None:
    log = noisy()
    axes = axes_of(log)
    words = ["roll [deg]", "pitch [deg]", "yaw [deg]"]
    words += [f"{name} error\n({axis} of R) [deg]" for name, axis in zip(
        ("roll", "pitch", "yaw"), "xyz", strict=True
    )]  # fmt: skip
    assert [ax.get_ylabel() for ax in axes] == words
    assert axes[-1].get_xlabel() == "time [s]"
    truth, estimate = angle_curves(log)
    for k in range(3):
        lines = {str(line.get_label()): line for line in axes[k].lines}
        np.testing.assert_array_equal(lines["truth"].get_ydata(), truth[:, k])
        np.testing.assert_array_equal(lines["estimate"].get_ydata(), estimate[:, k])
        # Told apart without colour.
        assert lines["truth"].get_linestyle() == "-"
        assert lines["estimate"].get_linestyle() == "--"
        assert lines["estimate"].get_marker() == "o"
        np.testing.assert_array_equal(axes[3 + k].lines[0].get_ydata(), log.errors()[:, k])


def test_the_band_is_two_sigma() -> None:
    log = noisy()
    covariance = np.tile(np.diag(np.radians([0.5, 1.0, 3.0, 0, 0, 0]) ** 2), (len(log.t), 1, 1))
    for ax, sigma in zip(
        axes_of(replace(log, covariance=covariance))[3:], (0.5, 1, 3), strict=True
    ):
        heights = ax.collections[0].get_paths()[0].vertices[:, 1]
        assert (heights.min(), heights.max()) == pytest.approx((-2 * sigma, 2 * sigma))


def test_the_start_does_not_set_the_scale() -> None:
    errors = np.ones((200, 3))
    errors[:50] = 60.0
    ax = axes_of(shell_log(errors, markers_met=np.repeat([1, 2], [50, 150])))[3]
    assert 1.0 < ax.get_ylim()[1] < 10.0
    assert any("not scored" in str(patch.get_label()) for patch in ax.patches)
    assert not axes_of(shell_log(errors))[3].patches
    assert axes_of(shell_log(errors))[3].get_ylim()[1] > 60.0


def broken_logs() -> dict[str, ShellLog]:
    log = noisy(200)
    lost, fallen = log.R_estimate.copy(), log.p.copy()
    lost[20:30] = np.nan
    fallen[150:] += np.arange(50)[:, None] * [0.0, 0.1, -0.3]
    nothing = np.tile(np.full((6, 6), np.inf), (200, 1, 1))
    return {
        "empty": shell_log([]),
        "one sample": shell_log([[1.0, 2.0, 3.0]]),
        "nothing scored": replace(log, markers_met=np.zeros(200, int)),
        "no numbers": replace(log, R_estimate=lost),
        "nothing claimed": replace(log, covariance=nothing),
        "fallen off": replace(log, p=fallen),
        "only at the pole": at([[0.0, 88.0, 0.0]] * 5),
    }


@pytest.mark.parametrize("kind", broken_logs())
def test_a_figure_comes_out_whatever_happened(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "summary.png"
    log = broken_logs()[kind]
    plot_shell(path, log, camera_views=[], markers=None, radius=RADIUS)
    assert cv2.imread(str(path)).shape == (1050, 1600, 3)


def test_the_same_run_gives_the_same_file(tmp_path: Path) -> None:
    views = [("grey", np.zeros((48, 64), np.uint8)), ("RGB", np.full((48, 64, 3), 90, np.uint8))]
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    for path in files:
        plot_shell(path, noisy(), camera_views=views, markers=MARKERS, radius=RADIUS)
    assert files[0].read_bytes() == files[1].read_bytes()


def test_pictures_are_shown_as_they_are() -> None:
    views = [(f"view {k}", np.full((48, 64), 60 * k, np.uint8)) for k in range(3)]
    figure = shell_figure(noisy(), camera_views=views, markers=MARKERS, radius=RADIUS)
    shown = {ax.get_title(): ax for ax in figure.axes if ax.images}
    assert list(shown) == ["view 0", "view 1"]
    image = shown["view 1"].images[0]
    assert (np.asarray(image.get_array()) == 60).all()
    assert image.get_clim() == (0, 255)  # a dark picture stays dark


# --- In space ---


def test_what_lies_behind_a_ball_by_hand() -> None:
    toward = np.array([1.0, 0.0, 0.0])
    places = np.array([[1.1, 0, 0], [-1.1, 0, 0], [-1.1, 1.2, 0], [0.1, 0.5, 0], [0.7, 0, 0.8]])
    np.testing.assert_array_equal(hidden(places, toward, 1.0), [False, True, False, True, False])


def test_most_of_a_path_is_seen() -> None:
    log = noisy()
    toward = viewpoint(log.p)
    assert np.linalg.norm(toward) == pytest.approx(1.0)
    assert hidden(log.p, toward, RADIUS).mean() < 0.25
    assert hidden(log.p, -toward, RADIUS).mean() > 0.5
    turn = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    around = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    assert np.isfinite(viewpoint(around)).all()


def test_points_far_apart() -> None:
    line = np.column_stack([np.linspace(0, 1, 101), np.zeros(101), np.zeros(101)])
    np.testing.assert_array_equal(np.sort(apart(line, 5)), [0, 25, 50, 75, 100])
    np.testing.assert_array_equal(apart(np.zeros((4, 3)), 3), [3])
    assert len(apart(np.zeros((0, 3)), 3)) == 0


# --- What the camera sees ---


def seen_at(angles: list[float], X_BC: RigidTransform = X_BC) -> np.ndarray:
    log = at([angles])
    return camera_view(log.R[0], log.p[0], camera=CAMERA, X_BC=X_BC, shell=SHELL)


def test_a_marker_is_where_the_pose_puts_it() -> None:
    detector = MarkerDetector(family=MARKERS.family)
    turned = X_BC @ RigidTransform(RollPitchYaw(0.02, -0.03, 0.2), [0.0, 0.0, 0.0])
    for angles, marker_id in (([20.0, 61.0, 91.0], 3), ([0.0, 0.5, -0.4], 14), ([0, 89, 10], 1)):
        for mounting in (X_BC, turned):
            image = seen_at(angles, mounting)
            assert image.dtype == np.uint8
            found = detector.detect(image)
            assert list(found.ids) == [marker_id]
            log = at([angles])
            X_RC = RigidTransform(RotationMatrix(log.R[0]), log.p[0]) @ mounting
            corners = MARKERS.markers[marker_id].corners()
            expected = CAMERA.project(X_RC.inverse().multiply(corners.T).T)
            # The detector fits straight lines to edges that bulge by 0.5 px.
            assert np.abs(found.corners[0] - expected).max() < 1.2


def test_the_picture_is_the_robots() -> None:
    # Heading to the pole the marker stands upright: its upper corners are ahead, up in the picture.
    detector = MarkerDetector(family=MARKERS.family)
    upright = detector.detect(seen_at([0.0, 30.0, 45.0])).corners[0]
    assert upright[:2, 1].max() < 240 < upright[2:, 1].min()
    # Heading west (roll 90), what is north is to the right.
    west = detector.detect(seen_at([90.0, 30.0, 45.0])).corners[0]
    assert west[2:, 0].max() < 320 < west[:2, 0].min()
    assert (seen_at([0.0, 30.0, 45.0], RigidTransform([0, 0, 0.05])) == 200).all()  # looks away


def test_the_views_are_of_the_scored_part() -> None:
    # Markers 14 and 15 are at yaw 0 and 30 on the equator: exactly over one before the second was
    # met, near the other later, and about halfway: the eye 85 mm and the marker 74.9 mm from the
    # centre, 14 degrees apart.
    log = at([[90.0, 0.0, yaw] for yaw in (0.0, 13.0, 29.6, 20.0, 16.0, 33.0)])
    log = replace(log, markers_met=np.array([1, 1, 2, 2, 2, 2]))
    views = camera_views(log, CAMERA, X_BC, SHELL)
    assert [title for title, _ in views] == [
        "0.0 s: marker 15 in view",
        "0.1 s: nearest marker, 15, is 22 mm away",
    ]
    for (_, picture), k in zip(views, (2, 4), strict=True):
        expected = camera_view(log.R[k], log.p[k], camera=CAMERA, X_BC=X_BC, shell=SHELL)
        np.testing.assert_array_equal(picture, expected)
    detector = MarkerDetector(family=MARKERS.family)
    assert [list(detector.detect(picture).ids) for _, picture in views] == [[15], []]
    # Where nothing was scored, all of it is looked at.
    start = camera_views(replace(log, markers_met=np.ones(6, int)), CAMERA, X_BC, SHELL)
    assert start[0][0] == "0.0 s: marker 14 in view"


def test_a_marker_that_is_not_in_view_is_not_said_to_be() -> None:
    ((title, _),) = camera_views(at([[0.0, 0.0, 15.0]]), CAMERA, X_BC, SHELL)
    assert "in view" not in title
    ahead = camera_views(at([[0.0, 0.0, 10.0], [0.0, 0.0, 15.0]]), CAMERA, X_BC, SHELL)
    assert "nearest to the view" in ahead[0][0]


def test_without_markers_or_log_there_are_no_views() -> None:
    bare = DrawnShell(frame=SHELL.frame, radius=RADIUS)
    assert camera_views(noisy(20), CAMERA, X_BC, bare) == []
    assert camera_views(shell_log([]), CAMERA, X_BC, SHELL) == []
