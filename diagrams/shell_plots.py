"""The figure of a run on a shell. Line styles and marks tell things apart, colour only helps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from diagrams.shell_metrics import AXES, ShellLog
from systems.angles import wrap
from systems.cameras import PinholeCamera
from systems.drawing.coverage import CoverageSheet
from systems.drawing.layers import paint
from systems.drawing.shells import DrawnShell, draw_shell
from systems.markers.layout import MarkerMap
from systems.shell.angles import angle_differences, angles_defined, angles_of, nearest_rotation

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]
View = tuple[str, Image]

_TRUTH: dict[str, Any] = {"color": "black", "linestyle": "-", "linewidth": 0.9}
_ESTIMATE: dict[str, Any] = {"color": "tab:red", "linestyle": "--", "linewidth": 1.5}
_DPI = 100
_BROAD: dict[str, Any] = {"linewidth": 3.2, "alpha": 0.45}  # the truth under the estimate
_TRIADS = 7  # poses shown in 3D
_LETTERS = "xyz"
_TRIAD_COLOURS = ("tab:red", "tab:green", "tab:blue")
_LETTER: dict[str, Any] = {"fontsize": 8, "ha": "center", "va": "center", "zorder": 6}
_AROUND = 200.0  # grey level around the shell


def plot_shell(
    path: Path,
    log: ShellLog,
    *,
    camera_views: Sequence[View],
    markers: MarkerMap | None,
    radius: float,
) -> None:
    """Writes the figure of a run: angles, errors, the poses in 3D, what the camera sees.

    Args:
        path: of the PNG.
        log: truth and estimate.
        camera_views: titles and pictures, grey or RGB; the first two are shown.
        markers: of the shell, in R.
        radius: of the shell, m.
    """
    figure = shell_figure(log, camera_views=camera_views, markers=markers, radius=radius)
    figure.savefig(path, dpi=_DPI, metadata={"Software": None})


def shell_figure(
    log: ShellLog,
    *,
    camera_views: Sequence[View],
    markers: MarkerMap | None,
    radius: float,
) -> Figure:
    """Returns the figure that `plot_shell` writes: 16 by 10.5 inches."""
    figure = Figure(figsize=(16.0, 10.5), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = cast(NDArray[Any], figure.subfigures(1, 2, width_ratios=[1.0, 0.86]))
    axes = left.subplots(6, 1, sharex=True)
    if len(log.t):
        _angles(axes[:3], log)
        _errors(axes[3:], log)
        axes[-1].set_xlim(log.t[0], max(log.t[-1], log.t[0] + 1e-3))
    axes[-1].set_xlabel("time [s]")
    left.align_ylabels()
    upper, lower = right.subfigures(2, 1, height_ratios=[1.0, 0.46])
    _globe(upper, log, markers, radius)
    _pictures(lower, camera_views[:2])
    return figure


# --- Over time ---


def angle_curves(log: ShellLog) -> tuple[Array, Array]:
    """Returns true and estimated [roll, pitch, yaw] (n, 3) deg as curves without false jumps.

    Roll and yaw are NaN near the poles, where they are not separate. Between, the truth has no
    jumps of a turn and begins within -90 to 270 degrees, so that a robot that stays at 180 does not
    jump to and fro; the estimate lies within half a turn of it.
    """
    truth = angles_of(log.R)
    defined = angles_defined(log.R)
    begins = np.flatnonzero(defined & ~np.append(False, defined[:-1]))
    ends = np.flatnonzero(defined & ~np.append(defined[1:], False)) + 1
    for k in (0, 2):
        for begin, end in zip(begins, ends, strict=True):
            piece = np.unwrap(truth[begin:end, k])
            piece += wrap(piece[0] - np.pi / 2) + np.pi / 2 - piece[0]
            truth[begin:end, k] = piece
        truth[~defined, k] = np.nan
    estimate = truth + angle_differences(log.R_estimate, log.R)
    return np.degrees(truth), np.degrees(estimate)


def _angles(axes: Array, log: ShellLog) -> None:
    truth, estimate = angle_curves(log)
    every = max(1, len(log.t) // 40)
    for k, (ax, name) in enumerate(zip(axes, AXES, strict=True)):
        ax.plot(log.t, truth[:, k], label="truth", **_TRUTH)
        ax.plot(
            log.t,
            estimate[:, k],
            label="estimate",
            marker="o",
            markersize=3.5,
            markerfacecolor="none",
            markevery=every,
            **_ESTIMATE,
        )
        ax.set_ylabel(f"{name} [deg]")
        ax.grid(alpha=0.3)
        ax.locator_params(axis="y", nbins=6, steps=[1, 3, 4.5, 9, 10])
    _legend(axes[0], 2)


def _errors(axes: Array, log: ShellLog) -> None:
    errors = log.errors()
    deviations = np.degrees(
        np.sqrt(np.maximum(np.diagonal(log.covariance, axis1=1, axis2=2)[:, :3], 0.0))
    )
    scored = log.scored()
    counted = scored if scored.any() else ~scored
    for k, (ax, name) in enumerate(zip(axes, AXES, strict=True)):
        bound = 2 * deviations[:, k]
        ax.fill_between(log.t, -bound, bound, color="0.85", linewidth=0, label="± 2 sigma")
        ax.plot(log.t, errors[:, k], color="tab:red", linewidth=1.0, label="error")
        ax.fill_between(
            log.t,
            0,
            0.05,
            where=log.visible.tolist(),
            step="post",
            transform=ax.get_xaxis_transform(),
            color="black",
            linewidth=0,
            label="marker in view",
        )
        _limits(ax, errors[counted, k], bound[counted])
        if not scored.all():
            last = log.t[scored][0] if scored.any() else log.t[-1]
            ax.axvspan(
                log.t[0],
                last,
                facecolor="none",
                edgecolor="0.6",
                hatch="//",
                linewidth=0,
                label="not scored (before the second marker)",
            )
        ax.set_ylabel(f"{name} error\n({_LETTERS[k]} of R) [deg]")
        ax.grid(alpha=0.3)
    _legend(axes[0], 4)


def _limits(ax: Axes, errors: Array, bound: Array) -> None:
    """Shows every error, and the band's usual width."""
    errors, bound = errors[np.isfinite(errors)], bound[np.isfinite(bound)]
    limit = 1.2 * np.abs(errors).max(initial=0.0)
    if len(bound):
        limit = max(limit, 1.25 * float(np.quantile(bound, 0.9)))
    ax.set_ylim(-(limit or 1.0), limit or 1.0)


def _legend(ax: Axes, columns: int) -> None:
    ax.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        borderaxespad=0.1,
        ncol=columns,
        fontsize=9,
        frameon=False,
        columnspacing=1.4,
    )


# --- In space ---


def _globe(figure: SubFigure, log: ShellLog, markers: MarkerMap | None, radius: float) -> None:
    """Draws the shell as it looks from far away, with what is behind it dotted."""
    ax = cast(Any, figure.add_subplot(projection="3d", computed_zorder=False))
    ax.set_proj_type("ortho")
    scored = log.scored()
    toward = viewpoint(log.p)
    azimuth, elevation = np.degrees(
        [np.arctan2(toward[1], toward[0]), np.arcsin(np.clip(toward[2], -1, 1))]
    )
    ax.view_init(elevation, azimuth)
    mm = 1e3 * radius
    yaw, pitch = np.meshgrid(np.linspace(-np.pi, np.pi, 73), np.linspace(-np.pi / 2, np.pi / 2, 37))
    ball = mm * np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    ax.plot_surface(*ball, color="0.94", shade=False, linewidth=0, rcount=37, ccount=73, zorder=1)
    for line in (*np.moveaxis(ball[:, ::6], 1, 0), *np.moveaxis(ball[:, :, ::6], 2, 0)):
        near = ~hidden(line.T, toward, mm * 0.999)
        ax.plot(*np.where(near, line, np.nan), color="0.8", linewidth=0.6, zorder=2)
    squares = [1e3 * marker.corners() for marker in markers or ()]
    shown = [square for square in squares if not hidden(square, toward, mm).any()]
    if shown:
        ax.add_collection3d(Poly3DCollection(shown, facecolor="0.35", edgecolor="black", zorder=3))
    ax.plot([], [], marker="s", color="0.35", linestyle="", label="marker")
    for places, style, label in (
        (1e3 * log.p, {**_TRUTH, **_BROAD}, "true path"),
        (1e3 * log.p_estimate[scored], _ESTIMATE, "estimated path"),
    ):
        behind = hidden(places, toward, mm)[:, None]
        faint = {**style, "linestyle": ":", "linewidth": 0.8, "alpha": 0.5}
        ax.plot(*np.where(behind, places, np.nan).T, zorder=2, **faint)
        ax.plot(*np.where(behind, np.nan, places).T, zorder=4, label=label, **style)
    _triads(ax, log, toward, mm)
    reach = 1.05 * mm
    ax.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(-reach, reach))
    ax.set_box_aspect((1, 1, 1), zoom=1.05)
    for letter in _LETTERS:
        getattr(ax, f"set_{letter}label")(f"{letter} of R [mm]", fontsize=9)
        getattr(ax, f"{letter}axis").set_pane_color((1.0, 1.0, 1.0, 0.0))
        getattr(ax, f"{letter}axis").line.set_color("0.6")
    ax.grid(False)
    ax.tick_params(labelsize=8)
    ax.locator_params(nbins=5)
    figure.legend(*ax.get_legend_handles_labels(), loc="upper left", fontsize=9, frameon=False)


def viewpoint(p: Array) -> Array:
    """Returns the direction (unit vector in R) from which most of a path (n, 3) is seen."""
    middle = np.zeros(3)
    if len(p):
        middle = (p / np.linalg.norm(p, axis=1, keepdims=True)).mean(axis=0)
    if np.linalg.norm(middle) < 0.1:  # it goes all around
        middle = np.ones(3)
    toward = middle / np.linalg.norm(middle)
    # Not along an axis: what lies along it would be seen end-on.
    turn = np.radians(12.0)
    c, s = np.cos(turn), np.sin(turn)
    toward = np.array([c * toward[0] - s * toward[1], s * toward[0] + c * toward[1], toward[2]])
    toward[2] = np.clip(toward[2], -0.8, 0.8)
    return np.asarray(toward / np.linalg.norm(toward))


def hidden(p: Array, toward: Array, radius: float) -> Mask:
    """Returns (n,) whether points (n, 3) lie behind or in a ball, seen from far away.

    Args:
        p: in the frame of the ball's centre.
        toward: unit vector to the viewer.
        radius: in the unit of p.
    """
    depth = p @ toward
    aside = np.sqrt(np.maximum((p**2).sum(axis=1) - depth**2, 0.0))
    front = np.sqrt(np.maximum(radius**2 - aside**2, 0.0))
    return np.asarray((aside < radius) & (depth < 0.999 * front))


def _triads(ax: Any, log: ShellLog, toward: Array, mm: float) -> None:
    """Draws the axes of true and estimated poses at some instants."""
    on_shell = np.linalg.norm(1e3 * log.p, axis=1) < 1.3 * mm  # and not fallen off
    seen = np.flatnonzero(log.scored() & on_shell & ~hidden(1e3 * log.p, toward, mm))
    instants = seen[apart(log.p[seen], _TRIADS)]
    for name, R, p, style in (
        ("true", log.R, log.p, {"linestyle": "-", **_BROAD}),
        ("estimated", log.R_estimate, log.p_estimate, {"linestyle": "--", "linewidth": 1.4}),
    ):
        for k in range(3):
            start, along = 1e3 * p[instants], mm * R[instants, :, k]
            # One line of many pieces: NaN lifts the pen.
            pieces = np.stack([start, start + 0.3 * along, np.full_like(start, np.nan)], axis=1)
            ax.plot(*pieces.reshape(-1, 3).T, color=_TRIAD_COLOURS[k], zorder=5, **style)
            if name == "true":
                for end in start + 0.34 * along:
                    ax.text(*end, _LETTERS[k], color=_TRIAD_COLOURS[k], **_LETTER)
        ax.plot([], [], color="0.2", label=f"axes of the {name} pose", **style)


def apart(p: Array, count: int) -> NDArray[np.intp]:
    """Returns which `count` of points (n, 3) lie far apart, the last point first.

    Each is the one farthest from those before it; fewer when points coincide.
    """
    chosen: list[int] = []
    farthest = len(p) - 1
    distance = np.full(len(p), np.inf)
    while len(chosen) < count and farthest >= 0 and distance[farthest] > 0:
        chosen.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(p - p[farthest], axis=1))
        farthest = int(np.argmax(distance))
    return np.array(chosen, np.intp)


# --- What the camera sees ---


def _pictures(figure: SubFigure, views: Sequence[View]) -> None:
    if not views:
        figure.text(0.5, 0.5, "no camera views", ha="center", color="0.4")
        return
    for ax, (title, picture) in zip(
        np.atleast_1d(figure.subplots(1, len(views))), views, strict=True
    ):
        ax.imshow(picture, cmap="gray", vmin=0, vmax=255, interpolation="antialiased")
        ax.set_title(title, fontsize=10)
        ax.set_xlabel("u [px]", fontsize=9)
        ax.set_ylabel("v [px]", fontsize=9)
        ax.tick_params(labelsize=8)


def camera_view(
    R_RB: Array, p_RB: Array, *, camera: PinholeCamera, X_BC: RigidTransform, shell: DrawnShell
) -> Image:
    """Draws what a camera on a robot sees of a shell, without blur or noise.

    Args:
        R_RB: (3, 3) of the robot.
        p_RB: (3,) m.
        camera: calibrated camera.
        X_BC: true pose of the optical frame in the robot.
        shell: its frame is R.

    Returns:
        (height, width) grey levels.
    """
    X_RC = _pose(R_RB, p_RB) @ X_BC
    drawing = draw_shell(camera, shell, X_RC.inverse().GetAsMatrix34())
    picture = np.full((camera.height, camera.width, 1), _AROUND, np.float32)
    paint(picture, [] if drawing is None else [drawing], CoverageSheet())
    image: Image = np.rint(np.clip(picture[:, :, 0], 0.0, 255.0)).astype(np.uint8)
    return image


def camera_views(
    log: ShellLog, camera: PinholeCamera, X_BC: RigidTransform, shell: DrawnShell
) -> list[View]:
    """Returns what the camera saw with a marker and without: titles and pictures.

    Of the scored part (of all, where none is): when a marker was nearest to the optical axis, and
    when the nearest marker was farthest away. Drawn from the true poses, so that every sight has
    them. Nothing without log or markers.

    Args:
        log: of the run.
        camera: calibrated camera.
        X_BC: true pose of the optical frame in the robot.
        shell: with its markers; its frame is R.
    """
    scored = log.scored()
    instants = np.flatnonzero(scored if scored.any() else ~scored)
    placed = list(shell.markers or ())
    if not len(instants) or not placed:
        return []
    p_RM = np.array([marker.X_WM.translation() for marker in placed])
    normals = np.array([marker.X_WM.rotation().matrix()[:, 0] for marker in placed])
    R, p = log.R[instants], log.p[instants]
    eye = p + R @ X_BC.translation()
    axis = R @ X_BC.rotation().matrix()[:, 2]
    line = p_RM - eye[:, None]
    distance = np.linalg.norm(line, axis=2)
    off_axis = np.einsum("nmi,ni->nm", line, axis) / distance
    off_axis[np.einsum("nmi,mi->nm", line, normals) >= 0] = -1.0  # seen from behind
    central, which = np.unravel_index(np.argmax(off_axis), off_axis.shape)
    lonely = int(np.argmax(distance.min(axis=1)))
    nearest = int(np.argmin(distance[lonely]))
    times = log.t[instants]
    X_CR = (_pose(R[central], p[central]) @ X_BC).inverse()
    u, v = camera.project(X_CR.multiply(p_RM[which])[None])[0]
    in_view = off_axis[central, which] > 0 and 0 <= u < camera.width and 0 <= v < camera.height
    titles = {
        int(central): f"{times[central]:.1f} s: marker {placed[which].id} "
        + ("in view" if in_view else "nearest to the view"),
        lonely: f"{times[lonely]:.1f} s: nearest marker, {placed[nearest].id}, is "
        f"{1e3 * distance[lonely, nearest]:.0f} mm away",
    }
    return [
        (title, camera_view(R[k], p[k], camera=camera, X_BC=X_BC, shell=shell))
        for k, title in titles.items()
    ]


def _pose(R: Array, p: Array) -> RigidTransform:
    return RigidTransform(RotationMatrix(nearest_rotation(R)), p)
