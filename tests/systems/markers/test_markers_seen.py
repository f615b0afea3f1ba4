from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem

from systems.markers.markers_seen import MarkersSeen
from systems.messages import Detections
from systems.shell.layout import shell_markers

RATE = 60.0
NOTHING = (0.0, 0.0, 0.0)


class Pictures(LeafSystem):
    """Picture k, with the ids of the k-th list, from time k / rate on."""

    def __init__(self, shown: Sequence[Sequence[int]], rate: float) -> None:
        super().__init__()
        self._pictures = [picture(k / rate, ids) for k, ids in enumerate(shown)]
        self._rate = rate
        self.DeclareAbstractOutputPort(
            "detections", lambda: AbstractValue.Make(Detections()), self._calc
        )

    def _calc(self, context: Context, output: AbstractValue) -> None:
        k = math.floor(context.get_time() * self._rate + 1e-6)
        output.set_value(self._pictures[min(k, len(self._pictures) - 1)])


def picture(stamp: float, ids: Sequence[int]) -> Detections:
    n = len(ids)
    return Detections(
        stamp=stamp,
        family="4x4_50",
        ids=np.array(ids, np.int64),
        corners=np.zeros((n, 4, 2)),
        hamming=np.zeros(n, np.int64),
        decision_margin=np.full(n, 50.0),
    )


def counted(
    shown: Sequence[Sequence[int]], *, camera: float = RATE, rate: float = RATE
) -> list[Any]:
    """What is said after each picture; of a camera and a counter of these rates (Hz)."""
    builder = DiagramBuilder()
    source = builder.AddSystem(Pictures(shown, camera))
    block = builder.AddSystem(MarkersSeen(marker_map=shell_markers(), rate=rate))
    builder.Connect(source.GetOutputPort("detections"), block.detections_input_port())
    simulator = Simulator(builder.Build())
    simulator.Initialize()
    said = []
    for k in range(len(shown)):
        simulator.AdvanceTo((k + 0.9) / camera)
        context = block.GetMyContextFromRoot(simulator.get_context())
        said.append(tuple(block.seen_output_port().Eval(context)))
    return said


def test_a_drive_past_some_markers_by_hand() -> None:
    # Some are seen twice, and 77 is no marker of the map.
    shown: list[list[int]] = [[], [3], [3, 4], [], [77], [3]]
    assert counted(shown) == [
        NOTHING,
        (1.0, 1.0, 1 / 2),
        (1.0, 2.0, 2 / 3),
        (0.0, 2.0, 2 / 4),
        (0.0, 2.0, 2 / 5),
        (1.0, 2.0, pytest.approx(3 / 6)),
    ]


def test_before_the_first_picture_nothing_is_said() -> None:
    block = MarkersSeen(marker_map=shell_markers(), rate=RATE)
    simulator = Simulator(block)
    context = simulator.get_mutable_context()
    block.detections_input_port().FixValue(context, AbstractValue.Make(Detections()))
    simulator.AdvanceTo(1.0)
    assert tuple(block.seen_output_port().Eval(context)) == NOTHING


def test_a_picture_is_counted_once_however_often_it_is_looked_at() -> None:
    shown: list[list[int]] = [[1], [], [], [2]]
    assert counted(shown, camera=15.0, rate=60.0) == counted(shown)


def test_all_markers_of_the_shell_can_be_met() -> None:
    marker_map = shell_markers()
    said = counted([[marker_id] for marker_id in marker_map.markers])
    assert [met for _, met, _ in said] == list(range(1, 26))


@pytest.mark.parametrize("rate", [0.0, -1.0, math.nan])
def test_a_rate_that_is_none_is_refused(rate: float) -> None:
    with pytest.raises(ValueError, match="rate"):
        MarkersSeen(marker_map=shell_markers(), rate=rate)
