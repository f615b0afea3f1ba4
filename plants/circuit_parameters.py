"""What kind of circuit is drawn, and for which camera; see `plants.circuit`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from systems.cameras import PinholeCamera
from systems.markers.family import family
from systems.markers.visibility import ProjectorParameters
from systems.validation import require, require_non_negative, require_positive


@dataclass
class CircuitCamera:
    """What the installer thinks of the camera: an undistorted one that looks ahead.

    Attributes:
        width: px.
        height: px.
        focal_length: px.
        position: [x, y, z] of the optical centre in base_link, m.
        pitch_deg: positive looks down.
        min_side_px: of a tag's shorter side; what looks smaller is not counted.
        max_incidence_deg: between a tag's normal and the line of sight; more is not counted.
        max_range: m.
        border_px: how far inside the picture a tag has to be with its white rim.
    """

    width: int = 640
    height: int = 480
    focal_length: float = 448.6
    position: list[float] = field(default_factory=lambda: [0.1, 0.0, 0.18])
    pitch_deg: float = 0.0
    min_side_px: float = 18.0
    max_incidence_deg: float = 65.0
    max_range: float = 4.0
    border_px: float = 4.0

    def __post_init__(self) -> None:
        require(
            len(self.position) == 3 and bool(np.isfinite(self.position).all()),
            "position",
            self.position,
            "[x, y, z] in metres",
        )
        require(abs(self.pitch_deg) < 90, "pitch_deg", self.pitch_deg, "between -90 and 90")
        require_positive(
            width=self.width,
            height=self.height,
            focal_length=self.focal_length,
            min_side_px=self.min_side_px,
            max_incidence_deg=self.max_incidence_deg,
            max_range=self.max_range,
        )
        require_non_negative(border_px=self.border_px)
        require(
            self.max_incidence_deg < 90,
            "max_incidence_deg",
            self.max_incidence_deg,
            "below 90",
        )

    def model(self) -> PinholeCamera:
        """Returns the camera."""
        return PinholeCamera.from_focal_length(self.width, self.height, self.focal_length)

    def mounting(self) -> RigidTransform:
        """Returns `X_BC`, the pose of the optical frame in base_link."""
        R = RollPitchYaw(0.0, math.radians(self.pitch_deg), 0.0).ToRotationMatrix()
        forward = RotationMatrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
        return RigidTransform(R @ forward, self.position)

    def limits(self) -> ProjectorParameters:
        """Returns when a tag counts."""
        return ProjectorParameters(
            min_side_px=self.min_side_px,
            max_incidence=math.radians(self.max_incidence_deg),
            max_range=self.max_range,
            border_px=self.border_px,
        )


@dataclass
class CircuitParameters:
    """What kind of circuit is drawn.

    Attributes:
        length: of the route, m.
        waviness: how much the route's distance from its middle varies, as a part of it.
        min_radius: of the route's curves, m.
        tags: how many.
        family: of the tags.
        size: side of the black squares, m.
        offset: [least, greatest] distance of tags from the route, m.
        height: [least, greatest] height of the tags' centres, m.
        turn_deg: by how much a tag that looks against the direction of travel is turned toward the
            route.
        turn_spread_deg: by how much that varies from tag to tag, either way.
        inside_share: part of the tags that are on the inner side.
        clearance: no part of a tag's board is nearer to the route, m: the robot's safe distance
            and a margin.
        in_view: tags that the camera has in view, at least, everywhere.
        sway: so far the robot may be beside the route, either way, m.
        askew_deg: so far it may be turned, either way.
        camera: of the robot.
    """

    length: float = 15.0
    waviness: float = 0.25
    min_radius: float = 0.8
    tags: int = 24
    family: str = "36h11"
    size: float = 0.18
    offset: list[float] = field(default_factory=lambda: [0.55, 0.85])
    height: list[float] = field(default_factory=lambda: [0.16, 0.45])
    turn_deg: float = 35.0
    turn_spread_deg: float = 5.0
    inside_share: float = 0.2
    clearance: float = 0.4
    in_view: int = 2
    sway: float = 0.05
    askew_deg: float = 4.0
    camera: CircuitCamera = field(default_factory=CircuitCamera)

    def __post_init__(self) -> None:
        require_positive(length=self.length, min_radius=self.min_radius, size=self.size)
        require(0 <= self.waviness < 1, "waviness", self.waviness, "0 or more, below 1")
        require(self.tags >= 1, "tags", self.tags, "1 or more")
        require(0 <= self.inside_share <= 1, "inside_share", self.inside_share, "0 to 1")
        require_non_negative(
            clearance=self.clearance,
            sway=self.sway,
            askew_deg=self.askew_deg,
            turn_spread_deg=self.turn_spread_deg,
        )
        require(abs(self.turn_deg) <= 180, "turn_deg", self.turn_deg, "from -180 to 180")
        require(self.in_view >= 0, "in_view", self.in_view, "0 or more")
        for name in ("offset", "height"):
            value = getattr(self, name)
            fits = len(value) == 2 and all(math.isfinite(v) and v > 0 for v in value)
            require(fits and value[0] <= value[-1], name, value, "[least, greatest], above 0")
        half = self.board() / 2
        require(
            self.height[0] >= half,
            "height",
            self.height,
            f"from {half:.3g} m on, for the whole board to be over the ground",
        )
        kind = family(self.family)
        require(
            self.tags <= kind.count, "tags", self.tags, f"at most {kind.count}, as {kind.name} has"
        )

    def board(self) -> float:
        """Returns the side of a tag's board, with its white rim, m."""
        cells = family(self.family).cells
        return self.size * (cells + 2) / cells
