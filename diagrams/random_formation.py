"""Clutter that comes from the seed, for a formation: its key `world.random`.

    world: {random: {size: [18, 14], obstacles: 60, distance: 8}}

The keys are those of `plants.formation_arena.FormationArenaParameters`. Walls and obstacles become
plain keys under `world.arena`, and the robots' `start` and the `destination` are drawn too, for
four robots and triangles as the key `formation` says; see `diagrams.random_world`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from diagrams.random_world import RandomWorld
from diagrams.schema import Place, convert, to_plain
from plants.formation_arena import FormationArenaParameters, formation_arena
from systems.planners.formation_ground import FormationParameters


def _draw(seed: int, data: Mapping[str, Any], place: Place) -> dict[str, Any]:
    at = place / "world" / "random"
    parameters = convert(data["world"]["random"], FormationArenaParameters, at)
    formation = convert(data.get("formation", {}), FormationParameters, place / "formation")
    try:
        drawn = formation_arena(seed, parameters, formation=formation)
    except ValueError as error:
        raise at.error(f"{at}: {error}") from error
    # A tenth of a millimetre is nothing to a formation, and can be read.
    return {
        "world": {"arena": to_plain(drawn.arena)},
        "start": drawn.start.round(4).tolist(),
        "destination": drawn.destination.round(4).tolist(),
    }


CLUTTER = RandomWorld(keys=(("world", "arena"), ("start",), ("destination",)), draw=_draw)
