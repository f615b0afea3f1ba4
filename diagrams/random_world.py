"""Scenarios whose world comes from the seed: the key `world.random`.

    world: {random: {size: [6, 5], obstacles: 10, waypoints: 3}}

The keys are those of `plants.random_arena.RandomArenaParameters`; `{}` takes them all as they are.
What the room consists of becomes plain keys before anything else looks at the scenario: markers,
walls and obstacles under `world`, the `waypoints`, and `robot.start`. So the resolved scenario that
is saved with a run is an ordinary one, and stays as it is whatever later versions would draw.

Who asks for a random world does away with the world, waypoints and start of the scenario that is
extended; those given in the same layer, or a later one, are laid over what was drawn.

Other missions draw other worlds, under the same key: see `diagrams.random_formation`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from diagrams.schema import Key, Place, convert, to_plain
from plants.random_arena import RandomArena, RandomArenaParameters, random_arena
from systems.markers.layout import MarkerMap

_RANDOM: Key = ("world", "random")


@dataclass(frozen=True)
class RandomWorld:
    """A kind of world that comes from the seed.

    Attributes:
        keys: what is drawn.
        draw: makes plain data with those keys of the seed, plain data of the scenario with
            `world.random`, and the place of its top; raises `ScenarioError`.
    """

    keys: tuple[Key, ...]
    draw: Callable[[int, Mapping[str, Any], Place], dict[str, Any]]


def asks_for_random(data: Mapping[str, Any]) -> bool:
    """Whether plain data of a scenario, or a layer of it, has the key `world.random`."""
    world = data.get("world")
    return isinstance(world, Mapping) and world.get("random") is not None


def make_way(
    base: dict[str, Any], top: Mapping[str, Any], kind: Callable[[], RandomWorld]
) -> dict[str, Any]:
    """Returns `base` without what is to be drawn, if `top`, laid over it, is first to ask for it.

    Args:
        base: plain data of the layers below.
        top: plain data of the layer.
        kind: says which kind of world the mission has.
    """
    if not asks_for_random(top) or asks_for_random(base):
        return base
    for key in kind().keys:
        base = _without(base, key)
    return base


def draw_world(
    data: Mapping[str, Any], known: Mapping[str, Any], place: Place, kind: RandomWorld
) -> tuple[dict[str, Any], Place]:
    """Returns plain data in which a room stands for `world.random`, and the place of the top.

    Args:
        data: of the whole scenario.
        known: keys that the scenario's mission has; no others are added.
        place: of the top; what is drawn is said to come from where `world.random` was written.
        kind: of world.

    Raises:
        ScenarioError: a parameter is refused, or there is no such room.
    """
    at = place / "world" / "random"
    seed = convert(data.get("seed", 0), int, place / "seed")
    drawn = kind.draw(seed, data, place)
    given = _without(dict(data), _RANDOM)
    origins = dict(place.origins)
    for key in kind.keys:
        if key[0] not in known:
            drawn = _without(drawn, key)
        elif not _has(given, key):
            for other in [k for k in origins if k[: len(key)] == key]:
                del origins[other]
            origins[key] = at.origin()
    return _over(drawn, given), Place(origins=origins, folders=place.folders)


def _draw_room(seed: int, data: Mapping[str, Any], place: Place) -> dict[str, Any]:
    at = place / "world" / "random"
    parameters = convert(data["world"]["random"], RandomArenaParameters, at)
    try:
        return _plain(random_arena(seed, parameters))
    except ValueError as error:
        raise at.error(f"{at}: {error}") from error


def _plain(room: RandomArena) -> dict[str, Any]:
    x, y, theta = room.start
    return {
        "world": {"markers": plain_markers(room.markers), "arena": to_plain(room.arena)},
        "robot": {"start": {"x": float(x), "y": float(y), "heading_deg": _degrees(theta)}},
        "waypoints": room.waypoints.tolist(),
    }


ROOM = RandomWorld(
    keys=(("world", "markers"), ("world", "arena"), ("waypoints",), ("robot", "start")),
    draw=_draw_room,
)


def plain_markers(markers: MarkerMap) -> dict[str, Any]:
    """Returns upright markers as a scenario lists them (see `diagrams.world.TagList`)."""
    tags = []
    for marker in markers:
        normal = marker.X_WM.rotation().matrix()[:, 0]
        tags.append(
            {
                "id": marker.id,
                "position": marker.X_WM.translation().round(6).tolist(),
                "facing_deg": _degrees(np.arctan2(normal[1], normal[0])),
                "size": marker.size,
            }
        )
    return {"family": markers.family.name, "size": markers.size, "tags": tags}


def _degrees(angle: float) -> float:
    """Returns an angle as a person would write it: a whole angle in degrees comes back whole."""
    return round(math.degrees(angle), 6)


def _has(data: Any, key: Key) -> bool:
    for step in key:
        if not isinstance(data, Mapping) or step not in data:
            return False
        data = data[step]
    return True


def _without(data: dict[str, Any], key: Key) -> dict[str, Any]:
    """Returns nested mappings without that key."""
    if not _has(data, key):
        return data
    first, *rest = key
    inner = data[str(first)]
    kept = {k: v for k, v in data.items() if k != first}
    return kept | {str(first): _without(inner, tuple(rest))} if rest else kept


def _over(base: Mapping[str, Any], top: Mapping[str, Any]) -> dict[str, Any]:
    """Returns `base` with `top` laid over it, mapping by mapping."""
    both = {
        key: _over(base[key], value)
        if isinstance(value, Mapping) and isinstance(base.get(key), Mapping)
        else value
        for key, value in top.items()
    }
    return {**base, **both}
