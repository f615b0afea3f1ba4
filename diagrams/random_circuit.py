"""Circuits that come from the seed: the key `world.random` of teaching, and of what follows it.

    world: {random: {length: 15, tags: 24}}

The keys are those of `plants.circuit_parameters.CircuitParameters`. Tags, ground, `route` and the
robot's start become plain keys; see `diagrams.random_world`. What the camera sees is what the
scenario's own camera sees, unless `camera` says otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from diagrams.random_world import RandomWorld, plain_markers
from diagrams.schema import Place, convert, file_path
from plants.circuit import circuit
from plants.circuit_parameters import CircuitParameters
from systems.cameras import load_camera


def _draw(seed: int, data: Mapping[str, Any], place: Place) -> dict[str, Any]:
    at = place / "world" / "random"
    given = data["world"]["random"]
    if isinstance(given, Mapping):
        own = given.get("camera", {})
        if isinstance(own, Mapping):
            given = {**given, "camera": {**_camera_of(data), **own}}
    parameters = convert(given, CircuitParameters, at)
    try:
        drawn = circuit(seed, parameters)
    except ValueError as error:
        raise at.error(f"{at}: {error}") from error
    x, y, theta = drawn.start()
    reach = float(np.abs(drawn.points).max())
    return {
        "world": {
            "markers": plain_markers(drawn.markers),
            "arena": {"ground": round(2 * reach + 3.0, 3)},
        },
        "route": drawn.points.tolist(),
        "robot": {
            "start": {"x": float(x), "y": float(y), "heading_deg": round(math.degrees(theta), 6)}
        },
    }


def _camera_of(data: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what the scenario says of its camera, as far as it can be read already."""
    try:
        sensor = data["robot"]["sensors"][data.get("camera", "front_camera")]
        model = load_camera(file_path(sensor["calibration"], "cameras"))
    except (KeyError, TypeError, AttributeError, ValueError):  # said when it is built
        return {}
    found = {
        "width": model.width,
        "height": model.height,
        "focal_length": float(model.K[0, 0]),
    }
    if "position" in sensor:
        found["position"] = sensor["position"]
    if "rpy_deg" in sensor:
        found["pitch_deg"] = sensor["rpy_deg"][1]
    return found


CIRCUIT = RandomWorld(
    keys=(("world", "markers"), ("world", "arena"), ("route",), ("robot", "start")), draw=_draw
)
