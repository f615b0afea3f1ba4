"""Faults on purpose: what comes out, when, and that nothing else is touched."""

from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from systems.messages import CameraImage, Detections, PointMatches, Scan
from systems.sensors.faults import Fault, FaultInjector

RATE = 10.0  # Hz, of the signal


def scan(k: int) -> Scan:
    return Scan(stamp=k / RATE, range_max=12.0, ranges=np.full(8, 1.0 + k))


def detections(k: int) -> Detections:
    return Detections(
        stamp=k / RATE,
        family="4x4_50",
        ids=np.array([3, 7]),
        corners=np.full((2, 4, 2), 10.0 * k),
        hamming=np.zeros(2, np.int64),
        decision_margin=np.ones(2),
    )


def image(k: int) -> CameraImage:
    return CameraImage(stamp=k / RATE, data=np.full((4, 6), k, np.uint8))


def matches(k: int) -> PointMatches:
    points = np.full((5, 2), 10.0 * k)
    return PointMatches(
        stamp=k / RATE, previous_stamp=(k - 1) / RATE, previous=points, current=points + 1.0
    )


class Source(LeafSystem):
    """Message k from k / RATE on; of a vector, [k, k, k]."""

    def __init__(self, make: Any) -> None:
        super().__init__()
        if make is None:
            self.DeclareVectorOutputPort("out", 3, self._vector)
        else:
            self.DeclareAbstractOutputPort(
                "out",
                lambda: AbstractValue.Make(make(0)),
                lambda context, output: output.set_value(make(self._k(context))),
            )

    def _vector(self, context: Any, output: Any) -> None:
        output.SetFromVector([self._k(context)] * 3)

    def _k(self, context: Any) -> int:
        return int(context.get_time() * RATE + 1e-6)


def outputs(make: Any, *faults: Fault, seed: int = 0, until: int = 12) -> list[Any]:
    """What comes out half a period after each message."""
    builder = DiagramBuilder()
    source = builder.AddSystem(Source(make))
    model = 3 if make is None else type(make(0))()
    injector = builder.AddSystem(
        FaultInjector(model=model, faults=faults, rate=RATE, seed=seed, name="x")
    )
    builder.Connect(source.get_output_port(), injector.input_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    found = []
    for k in range(until):
        simulator.AdvanceTo((k + 0.5) / RATE)
        value = injector.output_port().Eval(injector.GetMyContextFromRoot(simulator.get_context()))
        found.append(value.copy() if isinstance(value, np.ndarray) else value)
    return found


def fault(kind: Any, start: float = 0.3, duration: float = 0.4) -> Fault:
    """By default the messages 3 to 6 are bad."""
    return Fault("a.signal", kind, start, duration)


def stamps(messages: list[Any]) -> list[int]:
    return [round(message.stamp * RATE) for message in messages]


BAD = range(3, 7)
GOOD = [k for k in range(12) if k not in BAD]


@pytest.mark.parametrize("kind", ["silent", "frozen", "nan", "garbled", "unknown_ids"])
def test_messages_before_and_after_are_the_very_same(kind: str) -> None:
    found = outputs(detections, fault(kind))
    for k in GOOD:
        assert found[k].stamp == k / RATE
        assert (found[k].corners == 10.0 * k).all()
        assert found[k].ids.tolist() == [3, 7]


@pytest.mark.parametrize("make", [scan, detections, image, matches])
def test_silence_leaves_the_last_message(make: Any) -> None:
    assert stamps(outputs(make, fault("silent"))) == [0, 1, 2, 2, 2, 2, 2, 7, 8, 9, 10, 11]


@pytest.mark.parametrize(
    ("make", "content"),
    [
        (scan, lambda m: m.ranges[0] - 1),
        (detections, lambda m: m.corners[0, 0, 0] / 10),
        (matches, lambda m: m.previous[0, 0] / 10),
    ],
)
def test_frozen_is_the_last_content_under_new_stamps(make: Any, content: Any) -> None:
    found = outputs(make, fault("frozen"))
    assert stamps(found) == list(range(12))
    assert [content(m) for m in found] == [0, 1, 2, 2, 2, 2, 2, 7, 8, 9, 10, 11]
    if make is matches:
        assert [round(m.previous_stamp * RATE) for m in found] == list(range(-1, 11))


def test_nothing_yet_stays_nothing_yet() -> None:
    found = outputs(scan, fault("silent", start=0.0, duration=1e9))
    assert all(np.isnan(m.stamp) and len(m) == 0 for m in found)


def test_nan_is_in_every_measured_number_and_in_no_other() -> None:
    found = outputs(scan, fault("nan"))
    for k in BAD:
        assert np.isnan(found[k].ranges).all()
        assert len(found[k]) == 8
        assert found[k].stamp == k / RATE
        assert found[k].range_max == 12.0
    found = outputs(detections, fault("nan"))
    assert all(np.isnan(found[k].corners).all() and len(found[k]) == 2 for k in BAD)


@pytest.mark.parametrize(
    ("make", "content"),
    [
        (scan, lambda m: m.ranges),
        (detections, lambda m: m.corners.ravel()),
        (image, lambda m: m.data.ravel()),
        (matches, lambda m: m.current.ravel()),
    ],
)
def test_rubbish_is_new_each_time_and_the_same_for_one_seed(make: Any, content: Any) -> None:
    first, second, other = (outputs(make, fault("garbled"), seed=s) for s in (0, 0, 1))
    for k in BAD:
        assert content(first[k]).shape == content(make(k)).shape
        assert np.array_equal(content(first[k]), content(second[k]), equal_nan=make is not image)
        assert not np.array_equal(content(first[k]), content(other[k]))
        assert not np.array_equal(content(first[k]), content(first[k + 1]))


def test_unknown_ids_are_of_no_family() -> None:
    found = outputs(detections, fault("unknown_ids"))
    for k in BAD:
        assert (found[k].ids > 100_000).all()
        assert len(set(found[k].ids)) == 2
        assert (found[k].corners == 10.0 * k).all()


def test_hidden_markers_are_not_found_and_the_others_are() -> None:
    one = outputs(detections, Fault("a.signal", "hidden", BAD[0] / RATE, 0.4, ids=[7]))
    for k in range(12):
        assert one[k].ids.tolist() == ([3] if k in BAD else [3, 7])
        assert one[k].corners.shape == (len(one[k].ids), 4, 2)
    assert all(len(outputs(detections, fault("hidden"))[k]) == 0 for k in BAD)


def test_misread_markers_keep_their_corners_under_another_id() -> None:
    found = outputs(detections, Fault("a.signal", "misread", BAD[0] / RATE, 0.4, [3], 4))
    for k in range(12):
        assert found[k].ids.tolist() == ([7, 7] if k in BAD else [3, 7])
        assert (found[k].corners == 10.0 * k).all()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"kind": "misread"}, "id_offset is 0: must be other than 0"),
        ({"kind": "hidden", "id_offset": 4}, "id_offset is 4: must be .* left out otherwise"),
        ({"kind": "nan", "ids": [3]}, r"ids is \[3\]: must be left out, unless hidden or misread"),
    ],
)
def test_marker_faults_that_make_no_sense_are_refused(more: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Fault("front_camera.detections", **more)


def test_vectors_go_by_time() -> None:
    found = outputs(None, fault("frozen"))
    assert [int(v[0]) for v in found] == [0, 1, 2, 2, 2, 2, 2, 7, 8, 9, 10, 11]
    found = outputs(None, fault("nan"))
    assert [bool(np.isnan(v).all()) for v in found] == [k in BAD for k in range(12)]
    found = outputs(None, fault("dead"))
    assert [bool((v == 0).all()) for v in found[1:]] == [k in BAD for k in range(1, 12)]
    found = outputs(None, fault("garbled"))
    assert [bool((v == k).all()) for k, v in enumerate(found)] == [k not in BAD for k in range(12)]


def test_the_first_of_two_at_one_time_counts_and_one_without_an_end_stays() -> None:
    found = outputs(scan, fault("nan"), Fault("a.signal", "garbled", 0.5))
    assert all(np.isnan(found[k].ranges).all() for k in BAD)
    assert all(not (found[k].ranges == 1.0 + k).any() for k in range(7, 12))


@pytest.mark.parametrize(
    ("model", "kind", "allowed"),
    [
        (6, "silent", "frozen or nan or garbled or dead"),
        (6, "unknown_ids", "frozen or nan or garbled or dead"),
        (CameraImage(), "nan", "silent or frozen or garbled"),
        (Scan(), "unknown_ids", "silent or frozen or nan or garbled"),
        (Scan(), "hidden", "silent or frozen or nan or garbled"),
    ],
)
def test_kinds_that_a_signal_cannot_have_are_refused(model: Any, kind: Any, allowed: str) -> None:
    with pytest.raises(ValueError, match=f"kind is '{kind}': must be {allowed}"):
        FaultInjector(model=model, faults=[fault(kind)], rate=10.0, seed=0, name="x")


@pytest.mark.parametrize(("name", "value"), [("start", -1.0), ("duration", 0.0)])
def test_times_out_of_range_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} is "):
        Fault("imu.sample", "nan", **{name: value})
