"""Figure of a route: from above, and its speed and bend along the way with their limits."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from systems.markers.layout import MarkerMap
from systems.planners.route_plan import RoutePlan

Array = NDArray[np.float64]

_TAUGHT: dict[str, Any] = {"color": "0.45", "linestyle": ":", "linewidth": 1.4}
_LIMIT: dict[str, Any] = {"color": "tab:blue", "linestyle": "--", "linewidth": 1.0}
_STYLES = {"speed": "--", "lateral_acceleration": "-.", "turn_rate": ":"}


def plot_route(path: Path, plan: RoutePlan, tags: MarkerMap) -> None:
    """Writes the figure.

    Args:
        path: of the PNG.
        plan: the route.
        tags: of the map.
    """
    figure = Figure(figsize=(13.0, 6.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = cast(NDArray[Any], figure.subfigures(1, 2, width_ratios=[1.0, 0.95]))
    _plan(left.subplots(), plan, tags)
    axes = right.subplots(4, 1, sharex=True)
    _speed(axes[0], plan)
    _band(axes[1], plan, plan.curvature, plan.limits.max_curvature, "curvature [1/m]")
    _band(axes[2], plan, plan.offset, plan.limits.corridor, "left of the\ntaught path [m]")
    _tags(axes[3], plan)
    axes[3].set_xlabel("way along the route [m]")
    kind = "lap" if plan.route.closed else "way"
    figure.suptitle(
        f"{plan.route.length:.2f} m in {plan.route.duration:.1f} s a {kind}; "
        f"taught: {plan.taught.length:.2f} m"
    )
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _plan(ax: Axes, plan: RoutePlan, tags: MarkerMap) -> None:
    ax.plot(*plan.taught.polyline.T, label="taught", **_TAUGHT)
    pieces = np.stack([plan.points[:-1], plan.points[1:]], axis=1)
    route = LineCollection(list(pieces), cmap="viridis", linewidths=2.5)
    route.set_array(plan.speed[:-1])
    route.set_clim(0.0, plan.limits.max_speed)
    ax.add_collection(route)
    ax.get_figure().colorbar(route, ax=ax, label="speed [m/s]", shrink=0.6)  # type: ignore[union-attr]
    distance = plan.limits.tag_distance
    for tag in tags:
        p = tag.X_WM.translation()[:2]
        across = tag.X_WM.rotation().matrix()[:2, 1] * tag.size / 2
        normal = tag.X_WM.rotation().matrix()[:2, 0]
        ax.plot(*np.transpose([p - across, p + across]), color="black", linewidth=3)
        ax.add_patch(Circle(p, distance, facecolor="tab:red", alpha=0.08, linewidth=0))
        ax.annotate(
            str(tag.id), p - 0.14 * normal, ha="center", va="center", fontsize=7, color="0.3"
        )
    step = max(len(plan.points) // 8, 1)
    for k in range(step // 2, len(plan.points), step):
        ax.annotate(
            "", plan.points[k] + 0.12 * _ahead(plan, k), plan.points[k],
            arrowprops={"arrowstyle": "->", "color": "black"},
        )  # fmt: skip
    ax.plot(*plan.points[0], "o", color="black", markersize=5, label="start")
    ax.plot([], [], color="black", linewidth=3, label="tag (id)")
    ax.plot([], [], color="tab:red", alpha=0.2, linewidth=8, label=f"{distance:g} m around tags")
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, 1.12), ncol=4, fontsize=8, frameon=False)


def _ahead(plan: RoutePlan, k: int) -> Array:
    return np.array([np.cos(plan.heading[k]), np.sin(plan.heading[k])])


def _speed(ax: Axes, plan: RoutePlan) -> None:
    top = 1.25 * plan.limits.max_speed
    for name, cap in plan.caps.items():
        if cap.min() < top:
            ax.plot(
                plan.run, np.minimum(cap, 2 * top), color="tab:blue", linewidth=1.0,
                linestyle=_STYLES[name], label=f"limit by {name.replace('_', ' ')}",
            )  # fmt: skip
    ax.plot(plan.run, plan.speed, color="black", linewidth=1.6, label="speed")
    ax.set_ylim(0.0, top)
    ax.set_ylabel("speed [m/s]")
    ax.legend(loc="lower center", ncol=3, fontsize=7, frameon=False)
    ax.grid(alpha=0.3)


def _band(ax: Axes, plan: RoutePlan, values: Array, limit: float, label: str) -> None:
    ax.plot(plan.run, values, color="black", linewidth=1.4)
    for sign in (-1.0, 1.0):
        ax.axhline(sign * limit, **_LIMIT)
    ax.set_ylabel(label)
    ax.grid(alpha=0.3)


def _tags(ax: Axes, plan: RoutePlan) -> None:
    ax.step(plan.run, plan.tags_in_view, color="black", linewidth=1.4, where="mid")
    ax.axhline(plan.limits.min_tags, **_LIMIT)
    ax.set_ylim(0, max(int(plan.tags_in_view.max()), plan.limits.min_tags) + 1)
    ax.set_ylabel("tags in view")
    ax.grid(alpha=0.3)
