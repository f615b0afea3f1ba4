"""Marker boards as Drake geometry: a plate with the marker's cells on it, drawn crisply."""

from __future__ import annotations

import base64
import json
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common import MemoryFile
from pydrake.geometry import Box, GeometryInstance, InMemoryMesh, Mesh
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody

from systems.markers.family import Family
from systems.validation import require, require_positive

PLATE_THICKNESS = 0.003  # m
_GAP = 0.0005  # m between the plate and the printed face: less, and renderers mix the two
_PLATE_COLOUR = np.array([0.85, 0.85, 0.85, 1.0])
# Constants of glTF, which are OpenGL's.
_FLOAT, _UINT16 = 5126, 5123
_LINEAR, _LINEAR_MIPMAP_LINEAR, _CLAMP_TO_EDGE = 9729, 9987, 33071
_CELL_PIXELS = 32  # of the texture: finer than any camera sees a cell


def marker_texture(family: Family, marker_id: int, margin: int = 1) -> NDArray[np.uint8]:
    """Returns the marker's picture, upright, with a white margin: uint8, square, grey.

    Each cell is `_CELL_PIXELS` wide, so that a renderer's interpolation between texels stays
    within 1/32 of a cell.
    """
    cells = family.cell_image(marker_id, margin)
    return np.kron(cells, np.ones((_CELL_PIXELS, _CELL_PIXELS), np.uint8))


def face_mesh(texture: NDArray[np.uint8], side: float) -> InMemoryMesh:
    """Returns a textured square in the marker frame: in the plane x = 0, seen from +x.

    It is a glTF, since that can ask for mipmaps: the renderer then averages the texture over a
    pixel, as a real camera does. On 40 px markers the detector's corners are 0.04 px off; with an
    OBJ, whose texture is sampled at a point, 0.26 px.

    Args:
        texture: uint8 grey picture; its first row is at the top (+z), its first column at the
            viewer's left (-y).
        side: of the square, m.
    """
    h = side / 2
    position = np.array([[0, -h, h], [0, h, h], [0, h, -h], [0, -h, -h]], np.float32)
    normal = np.tile(np.array([1, 0, 0], np.float32), (4, 1))
    texture_place = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    triangles = np.array([0, 3, 2, 0, 2, 1], np.uint16)
    _, png = cv2.imencode(".png", cv2.cvtColor(texture, cv2.COLOR_GRAY2BGR))
    attributes = [(position, "VEC3"), (normal, "VEC3"), (texture_place, "VEC2")]
    accessors: list[dict[str, Any]] = [
        {"bufferView": k, "componentType": _FLOAT, "count": 4, "type": kind}
        for k, (_, kind) in enumerate(attributes)
    ]
    accessors[0] |= {"min": position.min(axis=0).tolist(), "max": position.max(axis=0).tolist()}
    accessors.append({"bufferView": 3, "componentType": _UINT16, "count": 6, "type": "SCALAR"})
    blocks = [array.tobytes() for array, _ in attributes] + [triangles.tobytes()]
    starts = np.cumsum([0] + [len(block) for block in blocks]).tolist()
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        # glTF's up is y, Drake's z.
        "nodes": [{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2},
                        "indices": 3,
                        "material": 0,
                    }
                ]
            }
        ],
        "materials": [
            {
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0},
                    "metallicFactor": 0,
                    "roughnessFactor": 1,
                }
            }
        ],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [
            {
                "magFilter": _LINEAR,
                "minFilter": _LINEAR_MIPMAP_LINEAR,
                "wrapS": _CLAMP_TO_EDGE,
                "wrapT": _CLAMP_TO_EDGE,
            }
        ],
        "images": [{"uri": _data_uri("image/png", png.tobytes())}],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(block)}
            for start, block in zip(starts, blocks, strict=False)
        ],
        "buffers": [
            {
                "byteLength": starts[-1],
                "uri": _data_uri("application/octet-stream", b"".join(blocks)),
            }
        ],
    }
    return InMemoryMesh(mesh_file=MemoryFile(json.dumps(content), ".gltf", "marker face"))


def _data_uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def add_board(
    plant: MultibodyPlant,
    body: RigidBody,
    X_BM: RigidTransform,
    *,
    family: Family,
    marker_id: int,
    size: float,
    margin: int = 1,
) -> None:
    """Fixes a marker board to a body: cameras and Meshcat see it, contact ignores it.

    Args:
        plant: not finalized yet.
        body: what the board is fixed to.
        X_BM: pose of the marker frame (x out of the printed face, z up) in the body.
        family: the marker's family.
        marker_id: its id.
        size: side of the black square, m.
        margin: white cells around the black square, at least 1.

    Raises:
        ValueError: no such id, a size that is not positive, or no margin.
    """
    require_positive(size=size)
    require(margin >= 1, "margin", margin, "at least 1 cell: without it detectors miss the marker")
    side = size * (family.cells + 2 * margin) / family.cells
    name = f"marker_{marker_id}"
    plate = Box(PLATE_THICKNESS, side, side)
    X_BPlate = X_BM.multiply(RigidTransform([-_GAP - PLATE_THICKNESS / 2, 0.0, 0.0]))
    plant.RegisterVisualGeometry(body, X_BPlate, plate, f"{name}_plate", _PLATE_COLOUR)
    face = Mesh(face_mesh(marker_texture(family, marker_id, margin), side), 1.0)
    # Without properties of its own the face keeps the mesh's material, in both visual roles.
    plant.RegisterVisualGeometry(body, GeometryInstance(X_BM, face, f"{name}_face"))
