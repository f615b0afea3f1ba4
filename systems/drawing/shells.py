"""Spherical shells of perforated steel with markers bent onto them.

Everything on the shell is an outline on the sphere: the holes, the patches of unlike grey that
galvanised steel has (spangle), the cells of the markers. So there is no texture whose resolution a
near camera could exceed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import FrameId
from pydrake.math import RigidTransform

from systems.cameras import PinholeCamera
from systems.compiled import in_rows, packed
from systems.drawing.boards import Sheet, marker_sheet, on_the_face
from systems.drawing.coverage import Box, Edges, outlines
from systems.drawing.layers import Drawing, Layer, box_of, projected_edges
from systems.drawing.shell_sight import find_visible, project_outlines
from systems.drawing.solids import border_rays, clip_polygon, view_planes
from systems.markers.layout import Marker, MarkerMap
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

_FLATNESS = 0.02  # px by which a straight piece of a marker's edge may miss the line
_ROUNDNESS = 0.05  # px by which a hole's polygon may miss the circle
_FINEST = 2.0  # px: what is smaller is not told apart and becomes part of the mean grey
_RIM_CORNERS = 256


@dataclass
class ShellParameters:
    """How a shell looks.

    Attributes:
        steel: mean grey level of the metal, 0 to 1.
        hole: grey level of the holes, 0 to 1.
        hole_diameter: m; 0 for none.
        hole_pitch: from hole to hole, in rows along the parallels, m.
        spangle: standard deviation of the patches' grey level, 0 to 1; 0 for plain metal.
        spangle_size: of a patch, m.
        spangle_seed: of the patches' places and grey levels.
        paper: grey level of the markers' paper, 0 to 1.
        ink: grey level of their ink, 0 to 1.
        margin: white cells around a marker's black square.
    """

    steel: float = 0.55
    hole: float = 0.08
    hole_diameter: float = 0.001
    hole_pitch: float = 0.002
    spangle: float = 0.04
    spangle_size: float = 0.0015
    spangle_seed: int = 0
    paper: float = 0.9
    ink: float = 0.05
    margin: int = 1

    def __post_init__(self) -> None:
        for name in ("steel", "hole", "paper", "ink"):
            value = getattr(self, name)
            require(0 <= value <= 1, name, value, "0 to 1")
        require_non_negative(hole_diameter=self.hole_diameter, spangle=self.spangle)
        require_positive(hole_pitch=self.hole_pitch, spangle_size=self.spangle_size)
        require(
            self.hole_diameter < self.hole_pitch,
            "hole_diameter",
            self.hole_diameter,
            "less than hole_pitch",
        )
        require(self.margin >= 1, "margin", self.margin, "at least 1 cell")
        require(self.spangle_seed >= 0, "spangle_seed", self.spangle_seed, "0 or greater")


@dataclass(frozen=True, eq=False)
class DrawnShell:
    """A sphere that is fixed to a frame of the scene.

    Attributes:
        frame: what it is fixed to.
        radius: m.
        markers: on it, their poses in the shell's frame (origin in the sphere's centre); None for
            none.
        X_FS: pose of the shell's frame there.
        parameters: how it looks.

    Raises:
        ValueError: a radius that is not positive, or a marker whose corners are off the sphere.
    """

    frame: FrameId
    radius: float
    markers: MarkerMap | None = None
    X_FS: RigidTransform = field(default_factory=RigidTransform)
    parameters: ShellParameters = field(default_factory=ShellParameters)

    def __post_init__(self) -> None:
        require_positive(radius=self.radius)
        for marker in self.markers or ():
            off = float(np.abs(np.linalg.norm(marker.corners(), axis=1) - self.radius).max())
            require(
                off < 0.02 * self.radius,
                f"distance of marker {marker.id} from the sphere",
                round(off, 6),
                "less than 2 % of the radius",
            )

    @cached_property
    def marker_places(self) -> tuple[Array, Array]:
        """Directions of the markers' middles (n, 3), and how far around they reach (n,) rad."""
        if self.markers is None:
            return np.zeros((0, 3)), np.zeros(0)
        margins = 1 + 2 * self.parameters.margin / self.markers.family.cells
        sides = np.array([marker.size for marker in self.markers]) * margins
        middles = np.array([marker.X_WM.translation() for marker in self.markers]).reshape(-1, 3)
        middles /= np.linalg.norm(middles, axis=1, keepdims=True)
        return middles, sides / np.sqrt(2) / self.radius

    @cached_property
    def holes(self) -> Array:
        """Middles of the holes: (n, 3) of unit length."""
        middles, _, _ = _rows(self.parameters.hole_pitch / self.radius)
        return middles

    @cached_property
    def patches(self) -> tuple[Array, Array]:
        """Corners (n, 8, 3) of the spangle's patches, of unit length, and their steps of grey."""
        p = self.parameters
        _, latitudes, counts = _rows(p.spangle_size / self.radius)
        rng = np.random.default_rng(p.spangle_seed)
        half = 0.5 * (latitudes[1] - latitudes[0])
        corners = []
        for latitude, count in zip(latitudes[1:-1], counts[1:-1], strict=True):
            # Straight seams between rows, jittered ones within them.
            seams = np.arange(count) + rng.uniform(-0.3, 0.3, count)
            west = 2 * np.pi / count * seams
            east = np.append(west[1:], west[0] + 2 * np.pi)
            lean = rng.uniform(-0.3, 0.3, count) * 2 * np.pi / count
            yaw = np.concatenate(
                [
                    np.linspace(west + lean, east + np.roll(lean, -1), 4, axis=1),
                    np.linspace(east - np.roll(lean, -1), west - lean, 4, axis=1),
                ],
                axis=1,
            )
            pitch = latitude + half * np.repeat([1.0, -1.0], 4)
            corners.append(_unit(yaw, np.broadcast_to(pitch, yaw.shape)))
        together = np.concatenate(corners)
        return together, rng.normal(0.0, p.spangle, len(together))

    @cached_property
    def patch_places(self) -> Array:
        """A corner of each patch, (n, 3)."""
        return self.patches[0][:, 0].copy()


def _unit(yaw: Array, pitch: Array) -> Array:
    return np.stack(
        [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], axis=-1
    )


def _rows(pitch: float) -> tuple[Array, Array, NDArray[np.intp]]:
    """Places on the unit sphere about `pitch` (rad) apart, in rows from pole to pole.

    Returns:
        (n, 3) places, (r,) latitudes of the rows, (r,) places in each.
    """
    latitudes = np.linspace(-np.pi / 2, np.pi / 2, max(round(np.pi / pitch), 2) + 1)
    counts = np.maximum(np.rint(2 * np.pi * np.cos(latitudes) / pitch), 1).astype(np.intp)
    row = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    return _unit(2 * np.pi * number / counts[row], latitudes[row]), latitudes, counts


def bent(places: Array, marker: Marker, radius: float) -> Array:
    """Returns where places of a marker's face come to lie on the sphere.

    The face is pressed onto the sphere along its radii. Corners of the black square that lie on
    the sphere stay where they are.

    Args:
        places: (n, 2) y and z in the marker's frame, in sides of the black square.
        marker: its pose in the shell's frame.
        radius: of the shell, m.

    Returns:
        (n, 3) m, in the shell's frame.
    """
    flat = on_the_face(places, marker.size, marker.X_WM.GetAsMatrix34())
    return np.asarray(flat * (radius / np.linalg.norm(flat, axis=1, keepdims=True)))


def draw_shell(
    camera: PinholeCamera, shell: DrawnShell, X_CS: Array, channels: int = 1
) -> Drawing | None:
    """Draws a shell with its holes and markers, lit evenly.

    Patches, holes and markers that reach to the horizon are left out: the metal is plain there.
    So it is where they are too small to be told apart.

    Args:
        camera: calibrated camera.
        shell: what is drawn.
        X_CS: (3, 4) rotation and translation (m) of its frame in the optical frame.
        channels: of the picture.

    Returns:
        The drawing; None when it cannot be seen, as from within.
    """
    R, centre = X_CS[:, :3], X_CS[:, 3]
    distance = float(np.linalg.norm(centre))
    if distance <= shell.radius:
        return None
    look = _Look(camera, shell, R, centre)
    steel = look.metal(channels)
    if steel is None:
        return None
    layers = [steel, *look.spangle(), *look.holes(channels), *look.markers()]
    return Drawing(tuple(layers), points=centre[None], radius=shell.radius)


class _Look:
    """A shell before a camera."""

    def __init__(self, camera: PinholeCamera, shell: DrawnShell, R: Array, centre: Array) -> None:
        self.camera, self.shell, self.R, self.centre = camera, shell, R, centre
        self.parameters = shell.parameters
        self.eye = -(centre @ R)  # the camera in the shell's frame
        self._seen_from = packed(self.eye), packed(R), packed(centre)
        far = float(np.linalg.norm(centre))
        self.nearest = far - shell.radius
        self.horizon = shell.radius / far  # cosine, at the centre
        self.scale = float(camera.K[[0, 1], [0, 1]].max()) / self.nearest  # px/m at most
        self.blurred_holes = self.parameters.hole_diameter * self.scale < _FINEST

    def metal(self, channels: int) -> Layer | None:
        """The disc: the cone that touches the sphere, cut by the circle in which it does."""
        p = self.parameters
        open_part = np.pi / 4 * (p.hole_diameter / p.hole_pitch) ** 2 if self.blurred_holes else 0.0
        colour = np.full(channels, 255 * (p.steel + open_part * (p.hole - p.steel)))
        rays = border_rays(self.camera)
        across = np.column_stack([rays, np.ones(len(rays))]) @ self.centre
        length = np.sqrt(1 + (rays**2).sum(axis=1)) * np.linalg.norm(self.centre)
        if (across > np.sqrt(1 - self.horizon**2) * length).all():
            return Layer(Box(0, 0, self.camera.width, self.camera.height), None, colour)
        away = -self.centre / np.linalg.norm(self.centre)
        side = np.linalg.svd(away[None])[2][1:]
        if np.linalg.det(np.vstack([side, away])) < 0:
            side = side[::-1]
        angle = np.linspace(0, 2 * np.pi, _RIM_CORNERS, endpoint=False)
        ring = np.cos(angle)[:, None] * side[0] + np.sin(angle)[:, None] * side[1]
        grow = np.sqrt(angle[1] / np.sin(angle[1]))  # the polygon has the circle's area
        sine = np.sqrt(1 - self.horizon**2) * grow
        corners = self.centre + self.shell.radius * (self.horizon * away + sine * ring)
        corners = clip_polygon(corners, view_planes(self.camera))[::-1]
        if len(corners) < 3:
            return None
        ends = np.roll(corners, -1, axis=0)
        cover = projected_edges(self.camera, corners, ends, np.ones(len(corners)))
        box = box_of(self.camera, cover)
        if box.empty:
            return None
        return Layer(box, cover, colour)

    def spangle(self) -> list[Layer]:
        """The patches, as steps of grey from the mean."""
        if self.parameters.spangle == 0 or self.parameters.spangle_size * self.scale < _FINEST:
            return []
        corners, steps = self.shell.patches
        size = 2 * self.parameters.spangle_size / self.shell.radius
        near = np.flatnonzero(self._in_sight(self.shell.patch_places, size))
        places, chosen = self._project(self.shell.radius * corners[near])
        if not len(chosen):
            return []
        edges = outlines(places, 255 * steps[near[chosen]])
        return [Layer(box_of(self.camera, edges), None, (edges,))]

    def holes(self, channels: int) -> list[Layer]:
        """The holes, as polygons of the circles' area."""
        radius = 0.5 * self.parameters.hole_diameter
        if radius == 0 or self.blurred_holes:
            return []
        middles = self.shell.holes
        angle = radius / self.shell.radius
        middles = middles[self._in_sight(middles, angle)]
        if not len(middles):
            return []
        size = radius * self.scale
        n = int(np.clip(np.ceil(np.pi / np.sqrt(2 * _ROUNDNESS / size)), 8, 96))
        turn = -2 * np.pi / n * np.arange(n)  # clockwise
        grow = np.sqrt(2 * np.pi / n / np.sin(2 * np.pi / n))
        # Any two directions along the sphere will do.
        other = np.where(np.abs(middles[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
        a = np.cross(other, middles)
        a /= np.linalg.norm(a, axis=1, keepdims=True)
        b = np.cross(middles, a)
        ring = np.cos(turn)[:, None] * a[:, None] + np.sin(turn)[:, None] * b[:, None]
        corners = np.cos(angle) * middles[:, None] + grow * np.sin(angle) * ring
        places, chosen = self._project(self.shell.radius * corners)
        if not len(chosen):
            return []
        edges = outlines(places)
        return [
            Layer(box_of(self.camera, edges), edges, np.full(channels, 255 * self.parameters.hole))
        ]

    def markers(self) -> list[Layer]:
        """The markers, each bent onto the sphere."""
        markers = self.shell.markers
        if markers is None:
            return []
        family = markers.family
        layers: list[Layer] = []
        in_sight = self._in_sight(*self.shell.marker_places)
        for marker, visible in zip(markers, in_sight.tolist(), strict=True):
            if visible:
                sheet = marker_sheet(family, marker.id, self.parameters.margin)
                layers += self._marker(marker, sheet, marker.size / family.cells)
        return layers

    def _marker(self, marker: Marker, sheet: Sheet, cell: float) -> list[Layer]:
        # The sagitta of a cell's edge, as it looks from nearby.
        bend = cell * self.scale * cell / (8 * self.shell.radius)
        pieces = max(int(np.ceil(np.sqrt(bend / _FLATNESS))), 1)
        along = np.linspace(0, 1, pieces + 1)[:, None]
        flat = sheet.start[:, None] * (1 - along) + sheet.end[:, None] * along
        on_shell = bent(flat.reshape(-1, 2), marker, self.shell.radius)
        places, chosen = self._project(on_shell.reshape(1, -1, 3))
        if not len(chosen):
            return []
        places = places.reshape(*flat.shape[:2], 2)
        light = 255 * (self.parameters.paper * sheet.paper + self.parameters.ink * sheet.ink)
        begin, finish = places[:, :-1].reshape(-1, 2), places[:, 1:].reshape(-1, 2)
        edges = Edges(begin, finish, np.repeat(light, pieces))
        rim = np.repeat(sheet.rim, pieces)
        cover = np.repeat(sheet.paper + sheet.ink, pieces)[rim]
        box = box_of(self.camera, edges)
        if box.empty:
            return []
        return [Layer(box, Edges(begin[rim], finish[rim], cover), (edges,))]

    def _in_sight(self, places: Array, reach: Array | float) -> NDArray[np.bool_]:
        """Whether what reaches `reach` (rad) around unit vectors (n, 3) may be in the picture."""
        visible = np.empty(len(places), bool)
        slack = 2.0 if self.camera.distorted else 1.2  # the lens may enlarge what it bends
        find_visible(
            packed(places), np.array(reach, float).reshape(-1), *self._seen_from, self.horizon,
            self.shell.radius, *self.camera.matrices, float(self.camera.width),
            float(self.camera.height), slack, visible,
        )  # fmt: skip
        return visible

    def _project(self, corners: Array) -> tuple[Array, NDArray[np.intp]]:
        """Projects outlines, those that are wholly before the horizon and within the lens.

        Args:
            corners: (m, k, 3) m, in the shell's frame.

        Returns:
            (c, k, 2) px, and (c,) which of them.
        """
        places, good = np.empty((*corners.shape[:2], 2)), np.empty(len(corners), bool)
        project_outlines(
            in_rows(corners, *corners.shape[1:]), *self._seen_from, self.shell.radius,
            *self.camera.matrices, self.camera.fold_radius, places, good,
        )  # fmt: skip
        chosen = np.flatnonzero(good)
        return places[chosen], chosen
