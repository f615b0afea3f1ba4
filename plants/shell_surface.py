"""What a shell of perforated steel with bent markers looks like to Drake's renderer and to Meshcat.

It is built from the same outlines and grey levels as the drawn camera's shell. Seen from 10 mm, a
picture of the whole sphere would need 160 megapixels: so for cameras all edges on it, those of the
metal's patches, of the holes and of the markers' cells, are edges of triangles. Meshcat, which
looks from farther off and sends everything to a browser, gets pictures of the markers and of one
hole, over and over.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    GeometryInstance,
    IllustrationProperties,
    Mesh,
    PerceptionProperties,
    Rgba,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody

from plants.boards import marker_texture
from plants.textured_mesh import Surface, textured_mesh
from systems.drawing.shells import DrawnShell, ShellParameters, bent
from systems.markers.layout import Marker, MarkerMap

Array = NDArray[np.float64]

_GRID = 16  # quads along the side of Meshcat's markers
_PIECES = 3  # quads along the side of a marker's cell, for cameras
_HOLE_CORNERS = 20
# Pieces of the metal, which the renderer leaves out while they are not in view: this times this on
# each side of a cube around the sphere.
_SPLIT = 6
_MERIDIANS = 96  # of Meshcat's sphere
_TILE = 64  # px, of a hole's tile


def add_shell_surface(
    plant: MultibodyPlant,
    body: RigidBody,
    *,
    radius: float,
    markers: MarkerMap | None = None,
    parameters: ShellParameters | None = None,
    rendered: bool = True,
) -> DrawnShell:
    """Gives a shell its surface, in place of the plain sphere of `plants.shell` (`plain=False`).

    Cameras see grey levels that do not depend on the scene's lamps, as under a lamp that the robot
    above carries along. They must see as near as they are: their nearest distance is to be a small
    part of their height.

    Args:
        plant: not finalized yet, registered with a SceneGraph.
        body: of the shell; its frame is R, with the origin in the sphere's centre.
        radius: of the sphere, m.
        markers: as they lie on the sphere, in R; None for none.
        parameters: how it looks; None for the defaults.
        rendered: whether cameras see the surface, through Drake's renderer. If not they see a plain
            sphere, which the drawn camera replaces by its own shell.

    Returns:
        The same shell for the drawn camera.

    Raises:
        ValueError: a radius that is not positive, or a marker whose corners are off the sphere.
    """
    p = parameters or ShellParameters()
    frame = plant.GetBodyFrameIdOrThrow(body.index())
    shell = DrawnShell(frame=frame, radius=radius, markers=markers, parameters=p)
    look = _Registry(plant, body)
    look.show(steel_with_tiles(shell), hole_tile(p), "steel", repeats=True)
    if rendered:
        ramp = _encoded(np.arange(256) / 255)[None]
        for k, piece in enumerate(outlined(shell)):
            look.show(piece, ramp, f"piece_{k}", cameras=True)
    else:
        look.show_sphere(radius, p.steel)
    for marker in markers or ():
        assert markers is not None
        sheet = bent_sheet(marker, radius, markers.family.cells, p.margin)
        black_or_white = marker_texture(markers.family, marker.id, p.margin)
        picture = _shown(np.where(black_or_white > 0, p.paper, p.ink))
        look.show(sheet, picture, f"marker_{marker.id}")
    return shell


class _Registry:
    """Registers what only Meshcat sees, lit by its lamps, and what only cameras see, glowing."""

    def __init__(self, plant: MultibodyPlant, body: RigidBody) -> None:
        self._plant, self._body = plant, body

    def show(
        self,
        surface: Surface,
        texture: NDArray[np.uint8],
        name: str,
        *,
        cameras: bool = False,
        repeats: bool = False,
    ) -> None:
        mesh = Mesh(textured_mesh(surface, texture, name, repeats=repeats, glows=cameras), 1.0)
        geometry = GeometryInstance(RigidTransform(), mesh, name)
        if cameras:
            geometry.set_perception_properties(PerceptionProperties())
        else:
            geometry.set_illustration_properties(IllustrationProperties())
        self._plant.RegisterVisualGeometry(self._body, geometry)

    def show_sphere(self, radius: float, level: float) -> None:
        geometry = GeometryInstance(RigidTransform(), Sphere(radius), "plain_steel")
        properties = PerceptionProperties()
        properties.AddProperty("phong", "diffuse", Rgba(level, level, level, 1.0))
        geometry.set_perception_properties(properties)
        self._plant.RegisterVisualGeometry(self._body, geometry)


# --- For cameras: outlines ---


def outlined(shell: DrawnShell) -> list[Surface]:
    """Returns metal, holes and markers as polygons of even grey, in pieces near together.

    The place of a polygon in the texture is on the grey ramp from 0 (left) to 255 (right). Markers
    lie on the sphere, the holes and the metal by some micrometres deeper, so that even where their
    flat triangles cut into the sphere none comes through what is above it.
    """
    p, radius = shell.parameters, shell.radius
    sheets = [_cells(marker, shell) for marker in shell.markers or ()]
    quad = max((float(np.linalg.norm(q[0, 2] - q[0, 0])) for q, _ in sheets), default=0.0)
    hole_depth = 2 * _sagitta(quad, radius)
    metal_depth = hole_depth + 2 * _sagitta(p.hole_diameter, radius)
    # What lies on top comes first: the renderer need not shade what that hides.
    polygons = sheets
    if p.hole_diameter > 0:
        rims = _hole_rims(shell.holes, p.hole_diameter / 2 / radius)
        polygons.append(((radius - hole_depth) * rims, np.full(len(rims), p.hole)))
    patches, steps = shell.patches
    caps = _polar_caps(float(np.abs(patches[:, :, 2]).max()))
    polygons += [
        ((radius - metal_depth) * _strips(patches), np.repeat(p.steel + steps, 3)),
        ((radius - metal_depth) * caps, np.full(len(caps), p.steel)),
    ]
    regions = [_regions(outline.mean(axis=1)) for outline, _ in polygons]
    pieces = []
    for region in np.unique(np.concatenate(regions)):
        parts = [
            _grey_polygons(outline[where == region], grey[where == region])
            for (outline, grey), where in zip(polygons, regions, strict=True)
            if (where == region).any()
        ]
        pieces.append(_joined(parts))
    return pieces


def _cells(marker: Marker, shell: DrawnShell) -> tuple[Array, Array]:
    """Returns the cells of a marker's sheet as bent quads (n, 4, 3) m, and their grey levels."""
    assert shell.markers is not None
    p, family = shell.parameters, shell.markers.family
    image = np.kron(family.cell_image(marker.id, p.margin), np.ones((_PIECES, _PIECES)))
    n = len(image)
    line = (np.arange(n + 1) - n / 2) / (_PIECES * family.cells)
    y, z = np.meshgrid(line, -line)
    corners = bent(np.stack([y.ravel(), z.ravel()], axis=1), marker, shell.radius)
    grid = corners.reshape(n + 1, n + 1, 3)
    quads = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2)
    return quads.reshape(-1, 4, 3), np.where(image.ravel() > 0, p.paper, p.ink)


def _sagitta(chord: float, radius: float) -> float:
    return chord**2 / (8 * radius)


def _strips(patches: Array) -> Array:
    """Returns the patches (n, 8, 3) as quads (3 n, 4, 3): near a pole they are not convex.

    Four corners of a patch run to the east along its northern edge, four back along the southern.
    """
    quads = np.stack([patches[:, [i, 7 - i, 6 - i, i + 1]] for i in range(3)], axis=1)
    return quads.reshape(-1, 4, 3)


def _hole_rims(middles: Array, angle: float) -> Array:
    """Returns polygons (n, k, 3) of the area of circles, counter-clockwise from outside."""
    turn = 2 * np.pi / _HOLE_CORNERS
    grow = np.sqrt(turn / np.sin(turn))
    other = np.where(np.abs(middles[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    a = np.cross(other, middles)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(middles, a)
    phi = turn * np.arange(_HOLE_CORNERS)
    ring = np.cos(phi)[:, None] * a[:, None] + np.sin(phi)[:, None] * b[:, None]
    rims = middles[:, None] + grow * np.tan(angle) * ring
    return np.asarray(rims / np.linalg.norm(rims, axis=2, keepdims=True))


def _polar_caps(height: float) -> Array:
    """Returns what is left beyond two parallels, as polygons (2, k, 3) on the unit sphere."""
    phi = 2 * np.pi / _MERIDIANS * np.arange(_MERIDIANS)
    ring = np.sqrt(1 - height**2) * np.stack([np.cos(phi), np.sin(phi)], axis=1)
    north, south = (np.column_stack([ring, np.full(_MERIDIANS, z)]) for z in (height, -height))
    return np.stack([north, south[::-1]])


def _regions(places: Array) -> NDArray[np.intp]:
    """Returns which piece of the sphere each of the directions (n, 3) is in."""
    side = np.abs(places).argmax(axis=1)
    rows = np.arange(len(places))
    largest = places[rows, side]
    others = np.stack([places[rows, (side + k) % 3] for k in (1, 2)]) / np.abs(largest)
    i, j = np.minimum((_SPLIT * (others + 1) / 2).astype(np.intp), _SPLIT - 1)
    return np.asarray(((2 * side + (largest > 0)) * _SPLIT + i) * _SPLIT + j)


def _grey_polygons(outlines: Array, grey: Array) -> Surface:
    """Returns convex polygons (n, k, 3), counter-clockwise, each of a grey level (n,), 0 to 1."""
    n, k, _ = outlines.shape
    vertices = outlines.reshape(-1, 3)
    level = (np.rint(255 * np.clip(grey, 0, 1)) + 0.5) / 256
    places = np.column_stack([np.repeat(level, k), np.full(n * k, 0.5)])
    fan = np.array([[0, i, i + 1] for i in range(1, k - 1)])
    triangles = (fan + k * np.arange(n)[:, None, None]).reshape(-1, 3)
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return Surface(vertices, normals, places, triangles)


def _joined(parts: list[Surface]) -> Surface:
    shifts = np.cumsum([0] + [len(part.vertices) for part in parts])
    return Surface(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.places for part in parts]),
        np.concatenate([part.triangles + s for part, s in zip(parts, shifts, strict=False)]),
    )


# --- For Meshcat: tiles ---


def steel_with_tiles(shell: DrawnShell) -> Surface:
    """Returns the sphere in bands, one for each row of holes, on which a hole's tile repeats."""
    latitudes, counts = np.unique(np.arcsin(shell.holes[:, 2]).round(9), return_counts=True)
    half = 0.5 * (latitudes[1] - latitudes[0])
    turn = np.linspace(0.0, 1.0, _MERIDIANS + 1)
    bands = []
    for latitude, count in zip(latitudes[1:-1], counts[1:-1], strict=True):
        pitch = latitude + half * np.array([1.0, -1.0])  # the tile's first row is in the north
        yaw, pitch = (grid.ravel() for grid in np.meshgrid(2 * np.pi * turn, pitch))
        normals = _directions(yaw, pitch)
        places = np.stack(np.meshgrid(count * turn + 0.5, [0.0, 1.0]), axis=-1).reshape(-1, 2)
        bands.append(
            Surface(shell.radius * normals, normals, places, _grid_triangles(_MERIDIANS, 1))
        )
    for sign in (1.0, -1.0):  # a tile for each pole
        yaw = 2 * np.pi * turn[:-1]
        normals = _directions(sign * yaw, np.full(_MERIDIANS, sign * (np.pi / 2 - half)))
        places = 0.5 + 0.5 * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        fan = np.array([[0, i, i + 1] for i in range(1, _MERIDIANS - 1)])
        bands.append(Surface(shell.radius * normals, normals, places, fan))
    return _joined(bands)


def bent_sheet(marker: Marker, radius: float, cells: int, margin: int) -> Surface:
    """Returns a marker's sheet, white margin included, pressed onto the sphere.

    Args:
        marker: its pose in R.
        radius: of the sphere, m.
        cells: along a side of the black square.
        margin: white cells around it.
    """
    line = np.linspace(0.0, 1.0, _GRID + 1)
    right, down = (grid.ravel() for grid in np.meshgrid(line, line))
    sides = 1 + 2 * margin / cells
    places = np.stack([right, down], axis=1)
    vertices = bent(sides * np.stack([right - 0.5, 0.5 - down], axis=1), marker, radius)
    return Surface(vertices, vertices / radius, places, _grid_triangles(_GRID, _GRID))


def hole_tile(parameters: ShellParameters) -> NDArray[np.uint8]:
    """Returns a hole in its square of metal: (n, n) grey for Meshcat."""
    fine = 8
    line = (np.arange(_TILE * fine) + 0.5) / (_TILE * fine) - 0.5
    reach = 0.5 * parameters.hole_diameter / parameters.hole_pitch
    inside = np.hypot(*np.meshgrid(line, line)) < reach
    share = inside.reshape(_TILE, fine, _TILE, fine).mean(axis=(1, 3))
    return _shown(parameters.steel + share * (parameters.hole - parameters.steel))


def _directions(yaw: Array, pitch: Array) -> Array:
    return np.stack(
        [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], axis=-1
    )


def _grid_triangles(columns: int, rows: int) -> NDArray[np.intp]:
    """Returns the triangles of a grid of corners, row by row, from the top left as seen."""
    corner = np.arange((columns + 1) * (rows + 1)).reshape(rows + 1, columns + 1)
    a, b = corner[:-1, :-1].ravel(), corner[:-1, 1:].ravel()
    c, d = corner[1:, :-1].ravel(), corner[1:, 1:].ravel()
    return np.concatenate([np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1)])


def _shown(grey: Array) -> NDArray[np.uint8]:
    """Returns grey levels for Meshcat, whose lamps make all much brighter than it is, as they are.

    Encoded for screens, metal would be as white as paper.
    """
    return np.rint(255 * grey).astype(np.uint8)


def _encoded(light: Array) -> NDArray[np.uint8]:
    """Returns shares of full light as grey for screens (sRGB, IEC 61966-2-1)."""
    low = light <= 0.0031308
    power = np.maximum(light, 0.0031308) ** (1 / 2.4)
    return np.rint(255 * np.where(low, 12.92 * light, 1.055 * power - 0.055)).astype(np.uint8)
