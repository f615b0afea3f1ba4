from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem

from systems.messages import Detections
from systems.sensors.missed_passages import MissedPassages, passages_after

RATE = 20.0  # Hz, of the pictures
Scene = Callable[[float], list[int]]


def picture(stamp: float, ids: list[int]) -> Detections:
    n = len(ids)
    return Detections(
        stamp=stamp,
        ids=np.array(ids, np.int64),
        corners=np.arange(8.0 * n).reshape(n, 4, 2),
        hamming=np.zeros(n, np.int64),
        decision_margin=np.arange(float(n)),
    )


class Camera(LeafSystem):
    """Sees what a scene shows at each time of a picture; nothing before `start`."""

    def __init__(self, scene: Scene, start: float) -> None:
        super().__init__()
        self.scene, self.start = scene, start
        self.DeclareAbstractOutputPort(
            "detections", lambda: AbstractValue.Make(Detections()), self._calc
        )

    def _calc(self, context: Context, output: Any) -> None:
        stamp = math.floor(context.get_time() * RATE + 1e-6) / RATE
        seen = picture(stamp, self.scene(stamp)) if stamp >= self.start else Detections()
        output.set_value(seen)


def run(
    scene: Scene, duration: float, *, rate: float = RATE, start: float = 0.0, **arguments: Any
) -> tuple[list[Detections], dict[str, int]]:
    """What is seen of each picture, and the counts at the end."""
    builder = DiagramBuilder()
    camera = builder.AddSystem(Camera(scene, start))
    block = builder.AddSystem(MissedPassages(rate=rate, **arguments))
    builder.Connect(camera.get_output_port(), block.detections_input_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    own = block.GetMyContextFromRoot(simulator.get_context())
    seen = []
    for k in range(round(duration * RATE)):
        # Once right after the picture and once later: it is the same.
        simulator.AdvanceTo(k / RATE + 1e-3)
        seen.append(block.seen_output_port().Eval(own))
        simulator.AdvanceTo((k + 0.9) / RATE)
        again = block.seen_output_port().Eval(own)
        assert np.array_equal(again.ids, seen[-1].ids)
    return seen, dict(block.health_output_port().Eval(own).counts)


def turns(t: float) -> list[int]:
    """A marker each two seconds, in view for half of them, eight of them in turn."""
    return [1 + int(t // 2) % 8] if t % 2 < 1 else []


def shown(seen: list[Detections], passage: int) -> list[bool]:
    """Whether each picture of a passage shows the marker."""
    return [bool(len(d)) for d in seen if d.stamp // 2 == passage and d.stamp % 2 < 1]


def test_a_passage_is_seen_or_missed_as_a_whole_and_the_first_is_seen() -> None:
    seen, counts = run(turns, 160.0, probability=0.4, seed=3)
    passages = [shown(seen, k) for k in range(80)]
    assert all(len(set(pictures)) == 1 and len(pictures) == 20 for pictures in passages)
    missed = [not pictures[0] for pictures in passages]
    assert not missed[0]
    assert 0.25 < np.mean(missed) < 0.55  # of 79; three standard deviations are 0.16
    # One passage does not tell of the next, nor of the next over the same marker.
    for step in (1, 8):
        both = np.mean(np.array(missed[1:-step]) & np.array(missed[1 + step :]))
        assert both == pytest.approx(0.16, abs=0.12)
    assert counts == {"missed": 20 * sum(missed), "missed_passages": sum(missed)}


@pytest.mark.parametrize("seed", range(3))
def test_of_all_missed_the_first_remains(seed: int) -> None:
    seen, counts = run(turns, 16.0, probability=1.0, seed=seed, start=3.0)
    passages = [k for k in range(8) if any(shown(seen, k))]
    assert passages == [2]  # that at 3 s had already gone
    assert counts["missed_passages"] == 5


def test_with_none_missed_the_pictures_pass_as_they_are() -> None:
    block = MissedPassages(probability=0.0)
    context = block.CreateDefaultContext()
    for told in (picture(1.0, [3, 4]), Detections(), picture(2.0, [])):
        block.detections_input_port().FixValue(context, AbstractValue.Make(told))
        assert block.seen_output_port().Eval(context) is told


def test_a_short_gap_does_not_begin_a_new_passage() -> None:
    def flickers(t: float) -> list[int]:
        return [7] if round(t * RATE) % 9 == 0 else []  # each 0.45 s

    def slowly(t: float) -> list[int]:
        return [7] if round(t * RATE) % 11 == 0 else []  # each 0.55 s

    seen, _ = run(flickers, 18.0, probability=0.9)
    assert sum(map(len, seen)) == 40  # one passage, the first
    seen, counts = run(slowly, 18.15, probability=0.9)
    assert 1 <= sum(map(len, seen)) < 15  # each is a passage of its own
    assert counts["missed"] == counts["missed_passages"] == 33 - sum(map(len, seen))
    seen, _ = run(slowly, 18.15, probability=0.9, gap=0.6)
    assert sum(map(len, seen)) == 33


def test_of_two_markers_in_view_one_may_be_missed() -> None:
    def scene(t: float) -> list[int]:
        return [4, 9] if t % 2 < 1 else []

    seen, counts = run(scene, 30.0, probability=0.5, seed=1)
    found = {tuple(d.ids.tolist()) for d in seen if d.stamp % 2 < 1}
    assert found == {(), (4,), (9,), (4, 9)}
    alone = next(d for d in seen if d.ids.tolist() == [9])
    np.testing.assert_array_equal(alone.corners, picture(0.0, [4, 9]).corners[1:])
    assert alone.decision_margin.tolist() == [1.0]
    assert counts["missed"] == sum(2 - len(d) for d in seen if d.stamp % 2 < 1)


def test_the_rate_does_not_matter_and_the_seed_does() -> None:
    def ids(**arguments: Any) -> list[list[int]]:
        return [d.ids.tolist() for d in run(turns, 24.0, probability=0.5, **arguments)[0]]

    assert ids(seed=5) == ids(seed=5, rate=100.0) == ids(seed=5, rate=300.0)
    assert ids(seed=5) != ids(seed=6)
    assert ids(seed=5) != ids(seed=5, name="another")


def test_a_picture_is_sifted_anew_when_the_seed_or_what_is_known_of_passages_changes() -> None:
    block = MissedPassages(probability=0.5, seed=0)
    context = block.CreateDefaultContext()
    told = picture(1.0, list(range(40)))
    block.detections_input_port().FixValue(context, AbstractValue.Make(told))

    def ids() -> list[int]:
        seen: Detections = block.seen_output_port().Eval(context)
        assert block.seen_output_port().Eval(context) is seen
        return seen.ids.tolist()

    first = ids()
    assert 10 < len(first) < 30
    assert first[0] == 0
    context.get_mutable_numeric_parameter(0).SetFromVector([1.0])
    assert ids() != first
    context.get_mutable_numeric_parameter(0).SetFromVector([0.0])
    assert ids() == first
    passages = np.full((64, 4), math.nan)
    passages[:2] = [[first[1], 0.9, 1.0, 7.0], [0, 0.9, 1.0, 8.0]]
    context.get_mutable_discrete_state(0).SetFromVector(passages.ravel())
    assert not {0, first[1]} & set(ids())


def test_passages_known_answer() -> None:
    def missed(number: int, marker: int) -> bool:
        return number == 3 and marker == 8

    before = np.array([[7.0, 1.0, 1.0, 1.0], [5.0, 0.4, 1.0, 2.0]])
    after, number = passages_after(before, 2, picture(1.2, [8, 7, 5]), gap=0.5, missed=missed)
    # 5 had gone and comes anew, 7 goes on, 8 is missed.
    np.testing.assert_array_equal(after, [[8, 1.2, 1, 3], [7, 1.2, 1, 1], [5, 1.2, 0, 4]])
    assert number == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"probability": 1.1}, "probability is 1.1: must be 0 to 1"),
        ({"probability": math.nan}, "probability is nan"),
        ({"gap": 0.0}, "gap is 0.0"),
        ({"rate": -1.0}, "rate is -1.0"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MissedPassages(**({"probability": 0.5} | arguments))
