"""The figure of a formation's run: that it shows the numbers of the log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse

from diagrams.formation_metrics import FormationLog, formation_metrics, nees_mean
from diagrams.formation_summary import formation_figure, plot_formation
from plants.arena import ArenaParameters
from systems.formation.triangles import next_vertex
from systems.planners.formation_lattice import strip

OFF = np.array([0.03, 0.04])  # m, the mover from its vertex
WRONG = np.array([0.0, 0.012])  # m, what is believed of it from where it stands


def log(*, covariance: bool = True, done: bool = True) -> FormationLog:
    """Robot 2 moves in 4 s; all look at each other until 5 s, then its place is known."""
    t = np.arange(0.0, 6.01, 0.2)
    truth = np.zeros((len(t), 4, 3))
    truth[:, :, :2] = strip(4, 1.5)
    believed = truth[:, :, :2].copy()
    target = next_vertex(truth[0, [2, 3, 0], :2])
    moved = t > 4 - 1e-9
    truth[moved, 1, :2] = target + OFF
    believed[t > 5 - 1e-9, 1] = target + OFF + WRONG
    record = np.zeros((len(t), 10))
    record[moved] = [1, 1, 2, 3, 0, *target, 1 if done else -1, 0, 0]
    estimate = np.zeros_like(truth)
    estimate[:, :, :2] = believed
    P = np.tile(1e-6 * np.eye(12), (len(t), 1, 1))
    P[:, 3, 3] = 0.01**2
    return FormationLog(t, record, truth, believed, estimate, P if covariance else None)


def axes_of(run: FormationLog) -> list[Axes]:
    figure = formation_figure(run, arena=ArenaParameters(), destination=[5.0, 0.6], side=1.5)
    return figure.axes


def line(ax: Axes, label: str) -> Line2D:
    (found,) = [line for line in ax.lines if str(line.get_label()).startswith(label)]
    return found


def test_panels_show_the_errors_of_the_move() -> None:
    _, errors, sides, belief = axes_of(log())
    metrics = formation_metrics(log(), 1.5)
    for name in ("lateral", "longitudinal"):
        assert np.abs(line(errors, name).get_ydata()) == pytest.approx(
            [metrics[f"{name}_error_mm"]]
        )
    assert line(sides, "place").get_ydata() == pytest.approx([50.0])
    assert line(sides, "worse").get_ydata() == pytest.approx([1e3 * metrics["side_error_max_m"]])
    assert line(belief, "believed").get_ydata() == pytest.approx([12.0])
    assert line(belief, "95 %").get_ydata() == pytest.approx([24.477], rel=1e-4)


def test_truth_and_belief_are_told_apart_by_their_marks() -> None:
    plan = axes_of(log())[0]
    believed = line(plan, "believed")
    np.testing.assert_allclose(np.transpose(believed.get_data()), log().believed[-1])
    styles = {(line(plan, f"robot{k}").get_linestyle()) for k in range(1, 5)}
    assert len(styles) == 4
    ellipses = [patch for patch in plan.patches if isinstance(patch, Ellipse)]
    assert len(ellipses) == 4
    assert max(ellipses[1].width, ellipses[1].height) == pytest.approx(20 * 0.024477, rel=1e-4)
    assert plan.get_legend() is not None
    assert [text.get_text() for text in plan.texts] == ["1"]


def test_axes_have_units_and_moves_are_whole_numbers() -> None:
    plan, *below = axes_of(log())
    assert (plan.get_xlabel(), plan.get_ylabel()) == ("x [m]", "y [m]")
    for ax in below:
        assert ax.get_xlabel() == "move"
        assert "[mm]" in ax.get_ylabel()
        assert all(tick == int(tick) for tick in ax.get_xticks())


def test_without_covariance_there_are_no_ellipses_and_no_bounds() -> None:
    plan, *_, belief = axes_of(replace(log(covariance=False), estimate=None))
    assert not [patch for patch in plan.patches if isinstance(patch, Ellipse)]
    assert len(belief.lines) == 1


def test_a_move_that_was_given_up_is_in_no_panel(tmp_path: Path) -> None:
    plan, *below = axes_of(log(done=False))
    assert len(plan.texts) == 0
    for ax in below:
        assert all(len(line.get_xdata()) in (0, 2) for line in ax.lines)
    target = tmp_path / "summary.png"
    plot_formation(
        target, log(done=False), arena=ArenaParameters(), destination=[5.0, 0.6], side=1.5
    )
    assert cv2.imread(str(target)).std() > 5


def test_a_robot_that_is_lost_is_left_out_of_consistency_and_trajectory() -> None:
    sound = log()
    assert sound.covariance is not None
    assert sound.known(1).all()
    expected = nees_mean(sound)
    lost = sound.covariance.copy()
    lost[:, 0, 0] = 30.0**2
    estimate = np.array(sound.estimate)
    estimate[:, 0, 1] += 3.0  # along what counts as known: one sighting leaves a circle
    astray = replace(sound, covariance=lost, estimate=estimate)
    assert not astray.known(0).any()
    assert astray.known(1).all()
    # Robot 1 has no error in either: of 12 numbers 9 are left.
    assert nees_mean(astray) == pytest.approx(expected * 12 / 9)
