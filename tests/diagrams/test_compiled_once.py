"""No loop is compiled anew while a robot drives: arrays come as the signatures say."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from numba.core.dispatcher import Dispatcher

from diagrams.run import simulate
from diagrams.scenario import load_scenario
from systems.compiled import prepare


@pytest.mark.parametrize("name", ["navigation", "navigation_open", "snailbot", "formation"])
def test_nothing_is_compiled_once_all_is_prepared(name: str, tmp_path: Path) -> None:
    scenario = load_scenario(name, {"sight": "projected", "duration": 3.0})
    scenario.build(meshcat=None, out=None)
    prepare()
    before = _signatures()
    assert len(before) > 20
    simulate(scenario, out=tmp_path)
    assert _signatures() == before


def _signatures() -> dict[str, list[Any]]:
    ours = [m for n, m in sys.modules.items() if n.split(".")[0] in ("systems", "plants")]
    loops = {v for m in ours for v in vars(m).values() if isinstance(v, Dispatcher)}
    return {f"{loop.__module__}.{loop.__name__}": list(loop.signatures) for loop in loops}
