"""What a route has to keep to."""

from __future__ import annotations

from dataclasses import dataclass

from systems.validation import require, require_non_negative, require_positive


@dataclass
class RouteLimits:
    """Limits of a route.

    The defaults suit a small indoor robot that slips on its four wheels (LIMO: 1 m/s at most).

    Attributes:
        max_speed: m/s.
        max_acceleration: along the path, m/s^2.
        max_lateral_acceleration: speed squared by curvature, m/s^2.
        max_turn_rate: speed by curvature, rad/s.
        max_curvature: 1/m.
        corridor: largest distance from the taught path, m.
        tag_distance: smallest distance of base_link from every tag, m.
        min_tags: tags that must be in view.
        view_share: part of the way along which they must be.
    """

    max_speed: float = 0.5
    max_acceleration: float = 0.3
    max_lateral_acceleration: float = 0.3
    max_turn_rate: float = 1.0
    max_curvature: float = 2.5
    corridor: float = 0.15
    tag_distance: float = 0.35
    min_tags: int = 2
    view_share: float = 0.95

    def __post_init__(self) -> None:
        positive = (
            "max_speed", "max_acceleration", "max_lateral_acceleration", "max_turn_rate",
            "max_curvature", "corridor",
        )  # fmt: skip
        require_positive(**{name: getattr(self, name) for name in positive})
        require_non_negative(tag_distance=self.tag_distance, min_tags=self.min_tags)
        require(0 <= self.view_share <= 1, "view_share", self.view_share, "0 to 1")
