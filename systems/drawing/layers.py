"""What is drawn, layer upon layer, and how layers make a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from systems.cameras import PinholeCamera
from systems.drawing.coverage import Box, CoverageSheet, Edges, Picture

Array = NDArray[np.float64]

_SMOOTH = 8.0  # px: straight pieces of an edge that a lens bends are shorter
NEAREST = 1e-6  # m: what is nearer to the camera's plane than this is behind it


@dataclass(frozen=True, eq=False)
class Layer:
    """Something opaque that lies upon what is behind it, or adds to it.

    A pixel becomes `before (1 - cover) + light`.

    Attributes:
        box: the pixels that it touches.
        cover: edges of the share of the pixel that is hidden; None adds the light alone.
        light: edges of the light, one for all channels or one a channel; or a colour (c,), of a
            layer that is as bright all over, and fills the box when it has no cover. Grey levels.
    """

    box: Box
    cover: Edges | None
    light: tuple[Edges, ...] | Array


@dataclass(frozen=True, eq=False)
class Drawing:
    """An object in its place: its layers, and what decides whether it hides another.

    Attributes:
        layers: from the lowest to the uppermost.
        points: (n, 3) m, whose hull holds the object; in the optical frame.
        radius: m, by which the hull is grown: a sphere is a point that is grown.
        normals: (f, 3) unit normals of planes that may part it from another. The object is behind
            each: its points have `normal . p <= height`.
        heights: (f,) m.
    """

    layers: tuple[Layer, ...]
    points: Array
    radius: float = 0.0
    normals: Array = field(default_factory=lambda: np.zeros((0, 3)))
    heights: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def box(self) -> Box:
        """The box around those of its layers."""
        boxes = np.array([layer.box for layer in self.layers])
        low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
        return Box(int(low[0]), int(low[1]), int(high[0]), int(high[1]))


def projected_edges(
    camera: PinholeCamera, start: Array, end: Array, weight: Array, curved: int = 1
) -> Edges:
    """Returns the edges of the picture of straight lines in space.

    Where the lens bends lines they are cut into short pieces first.

    Args:
        camera: calibrated camera.
        start: (n, 3) m, before the camera, in its optical frame.
        end: (n, 3) m.
        weight: (n,)
        curved: pieces at least.
    """
    pieces = curved
    if camera.distorted and len(start):
        length = np.abs(camera.project(end) - camera.project(start)).max()
        pieces = max(pieces, int(np.ceil(min(length, 2.0 * camera.width) / _SMOOTH)))
    if pieces == 1:
        both = camera.project(np.concatenate([start, end]))
        return Edges(both[: len(start)], both[len(start) :], weight)
    along = np.linspace(0, 1, pieces + 1)[:, None]
    places = camera.project(start[:, None] * (1 - along) + end[:, None] * along)
    begin, finish = places[:, :-1].reshape(-1, 2), places[:, 1:].reshape(-1, 2)
    return Edges(begin, finish, np.repeat(weight, pieces))


def box_of(camera: PinholeCamera, edges: Edges) -> Box:
    """Returns the pixels that edges can touch."""
    return Box.around(np.concatenate([edges.start, edges.end]), camera.width, camera.height)


def paint(picture: Picture, drawings: Sequence[Drawing], sheet: CoverageSheet) -> None:
    """Paints objects into a picture, each over those before it.

    Args:
        picture: (height, width, channels) grey levels; changed in place.
        drawings: from the farthest to the nearest.
        sheet: memory to work in.
    """
    layers = [layer for drawing in drawings for layer in drawing.layers if not layer.box.empty]
    planes = []
    for layer in layers:
        if layer.cover is not None:
            planes.append((layer.cover, layer.box))
        if isinstance(layer.light, tuple):
            planes.extend((edges, layer.box) for edges in layer.light)
    measured = iter(sheet(planes))
    for layer in layers:
        left, top, right, bottom = layer.box
        part = picture[top:bottom, left:right]
        cover = None if layer.cover is None else next(measured)
        if isinstance(layer.light, tuple):
            if cover is not None:
                np.subtract(1.0, cover, out=cover)
                part *= cover[:, :, None]
            lights = [next(measured) for _ in layer.light]
            for channel in range(part.shape[2]):
                part[:, :, channel] += lights[min(channel, len(lights) - 1)]
        elif cover is None:
            part[:] = layer.light
        else:
            for channel, level in enumerate(np.broadcast_to(layer.light, part.shape[2])):
                below = part[:, :, channel]
                below += cover * (np.float32(level) - below)
