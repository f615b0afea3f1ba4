"""Meshes with a grey texture, for Drake's renderer and for Meshcat alike.

They are glTF, since that can ask for mipmaps: the renderer then averages the texture over a pixel,
as a real camera does. On 40 px markers the detector's corners are 0.04 px off; with an OBJ, whose
texture is sampled at a point, 0.26 px.
"""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh

Array = NDArray[np.float64]

# Constants of glTF, which are OpenGL's.
_FLOAT, _UINT32 = 5126, 5125
_LINEAR, _LINEAR_MIPMAP_LINEAR, _CLAMP_TO_EDGE, _REPEAT = 9729, 9987, 33071, 10497

_MATT = {
    "pbrMetallicRoughness": {
        "baseColorTexture": {"index": 0},
        "metallicFactor": 0,
        "roughnessFactor": 1,
    }
}
# A rough black metal reflects nothing: what it sends out is all there is. (The extension for unlit
# materials would be faster, but Drake 1.51 and 1.58 encode what they draw with it differently.)
_GLOWING = {
    "pbrMetallicRoughness": {
        "baseColorFactor": [0, 0, 0, 1],
        "metallicFactor": 1,
        "roughnessFactor": 1,
    },
    "emissiveTexture": {"index": 0},
    "emissiveFactor": [1, 1, 1],
}


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles with a place in a texture for each corner.

    Attributes:
        vertices: (n, 3) m.
        normals: (n, 3) outward, of unit length.
        places: (n, 2) in the texture, from its top left corner, to the right and down, in parts of
            its width and height.
        triangles: (m, 3) corners, counter-clockwise as seen from outside.
    """

    vertices: Array
    normals: Array
    places: Array
    triangles: NDArray[np.intp]


def textured_mesh(
    surface: Surface,
    texture: NDArray[np.uint8],
    name: str,
    *,
    repeats: bool = False,
    glows: bool = False,
) -> InMemoryMesh:
    """Returns a glTF file.

    Args:
        surface: in the frame of the geometry.
        texture: (height, width) grey, encoded for screens (sRGB), as glTF wants it.
        name: for messages.
        repeats: whether the texture goes on beyond its borders by itself, or by its last pixels.
        glows: whether it is as bright as the texture says, whatever the lamps of the scene do.
    """
    attributes = [
        (surface.vertices, "POSITION", "VEC3"),
        (surface.normals, "NORMAL", "VEC3"),
        (surface.places, "TEXCOORD_0", "VEC2"),
    ]
    low, high = (
        end(surface.vertices.astype(np.float32), axis=0).tolist() for end in (np.min, np.max)
    )
    accessors: list[dict[str, Any]] = [
        {"bufferView": k, "componentType": _FLOAT, "count": len(array), "type": kind}
        for k, (array, _, kind) in enumerate(attributes)
    ]
    accessors[0] |= {"min": low, "max": high}
    accessors.append(
        {
            "bufferView": 3,
            "componentType": _UINT32,
            "count": surface.triangles.size,
            "type": "SCALAR",
        }
    )
    blocks = [np.ascontiguousarray(array, np.float32).tobytes() for array, _, _ in attributes]
    blocks.append(np.ascontiguousarray(surface.triangles, np.uint32).tobytes())
    starts = np.cumsum([0] + [len(block) for block in blocks]).tolist()
    primitive = {
        "attributes": {attribute: k for k, (_, attribute, _) in enumerate(attributes)},
        "indices": 3,
        "material": 0,
    }
    wrap = _REPEAT if repeats else _CLAMP_TO_EDGE
    sampler = {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP_LINEAR}
    _, png = cv2.imencode(".png", cv2.cvtColor(texture, cv2.COLOR_GRAY2BGR))
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        # glTF's up is y, Drake's z.
        "nodes": [{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [_GLOWING if glows else _MATT],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [sampler | {"wrapS": wrap, "wrapT": wrap}],
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
    return InMemoryMesh(mesh_file=MemoryFile(json.dumps(content), ".gltf", name))


def _data_uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
