from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import pytest
from pydrake.common.value import AbstractValue
from pydrake.geometry import FrameId
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues, LeafSystem

from systems.cameras import PinholeCamera
from systems.flow.projector import FlowProjector
from systems.markers.family import family
from systems.markers.projector import MarkerProjector
from systems.messages import Detections, Message
from systems.sensors.drawn_camera import DrawnCamera
from systems.sensors.rendered_camera import RenderedCamera
from systems.sensors.sampled import SampledSensor


@dataclass(frozen=True, eq=False)
class Reading(Message):
    stamp: float = math.nan
    index: int = -1


class Clock(SampledSensor):
    """Measures the time."""

    def __init__(self, rate: float, latency: float, clock_error: float = 0.0) -> None:
        super().__init__()
        self.out = self._declare_sampling(
            name="reading",
            rate=rate,
            latency=latency,
            nothing=Reading(),
            clock_error=clock_error,
        )

    def _measure(self, context: Context, stamp: float, index: int) -> Reading:
        assert abs(stamp - self.clock_error - context.get_time()) < 1e-9
        return Reading(stamp, index)


def arrivals(
    rate: float, latency: float, start: float, end: float, clock_error: float = 0.0
) -> list[tuple[float, Reading]]:
    """The readings and when each arrived, to 1 ms."""
    clock = Clock(rate, latency, clock_error)
    simulator = Simulator(clock)
    context = simulator.get_mutable_context()
    context.SetTime(start)
    found: list[tuple[float, Reading]] = []
    assert math.isnan(clock.out.Eval(context).stamp)
    for k in range(round((end - start) * 1000)):
        # Between the milliseconds, where nothing happens.
        simulator.AdvanceTo(start + (k + 0.5) / 1000)
        reading = clock.out.Eval(context)
        if not found or reading is not found[-1][1]:
            found.append((start + k / 1000, reading))
    if math.isnan(found[0][1].stamp):
        del found[0]
    return found


@pytest.mark.parametrize("latency", [0.0, 0.004, 0.02, 0.05, 0.1, 0.13])
def test_every_reading_arrives_its_latency_later_in_order(latency: float) -> None:
    rate = 50.0  # a period of 20 ms: up to seven are under way
    found = arrivals(rate, latency, 0.0, 0.4)
    assert [reading.index for _, reading in found] == list(range(len(found)))
    assert len(found) == math.floor((0.3995 - latency) * rate) + 1
    for arrived, reading in found:
        assert reading.stamp == reading.index / rate
        assert arrived == pytest.approx(reading.stamp + latency, abs=1e-9)


CAMERA = PinholeCamera.from_focal_length(64, 48, 50.0)
MOUNTED: dict[str, Any] = {"parent_frame": FrameId.get_new_id(), "X_PC": RigidTransform()}


@pytest.mark.parametrize(
    "build",
    [
        lambda **a: FlowProjector(camera=CAMERA, rate=60.0, **a),
        lambda **a: DrawnCamera(camera=CAMERA, rate=60.0, **MOUNTED, **a),
        lambda **a: RenderedCamera(camera=CAMERA, rate=60.0, renderer="vtk", **MOUNTED, **a),
        lambda **a: MarkerProjector(
            camera=CAMERA, markers=[], family=family("DICT_4X4_50"), **MOUNTED, **a
        ),
    ],
    ids=["flow", "drawn", "rendered", "projected"],
)
def test_whoever_samples_pictures_may_have_a_clock_that_is_off(build: Any) -> None:
    assert build(latency=0.04, clock_error=0.03).clock_error == 0.03
    assert build().clock_error == 0.0
    with pytest.raises(ValueError, match=r"clock_error is 0.05: must be at most the latency, 0.04"):
        build(latency=0.04, clock_error=0.05)


class Busy(LeafSystem):
    """Has events at times that mean the same as the sensor's, but for a rounding error."""

    def __init__(self, every: float) -> None:
        super().__init__()
        self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(every, 0.0, lambda context, state: None)  # noqa: ARG005


class Receiver(LeafSystem):
    """Notes which reading it sees when, at a rate."""

    def __init__(self, every: float) -> None:
        super().__init__()
        self.DeclareDiscreteState(1)
        self.seen: list[tuple[float, Reading]] = []
        self.port = self.DeclareAbstractInputPort("reading", AbstractValue.Make(Reading()))
        self.DeclarePeriodicDiscreteUpdateEvent(every, 0.0, self._look)

    def _look(self, context: Context, state: DiscreteValues) -> None:  # noqa: ARG002
        self.seen.append((context.get_time(), self.port.Eval(context)))


@pytest.mark.parametrize(
    ("rate", "latency"),
    [(10.0, 0.3), (30.0, 0.1), (25.0, 0.03), (20.0, 0.05), (15.0, 0.02), (60.0, 0.0), (25.0, 0.0)],
)
def test_none_is_lost_and_none_is_late_among_other_events(rate: float, latency: float) -> None:
    # 0.3 + 6 * 0.1 is not 9 * 0.1: Drake leaves out an event that lies a rounding error after
    # another one. A receiver that looks at the very moment of arrival sees the reading.
    builder = DiagramBuilder()
    clock = builder.AddSystem(Clock(rate, latency))
    builder.AddSystem(Busy(0.005))
    receiver = builder.AddSystem(Receiver(0.01))
    builder.Connect(clock.out, receiver.port)
    Simulator(builder.Build()).AdvanceTo(90.0)
    first_seen = {reading.index: t for t, reading in reversed(receiver.seen) if reading.index >= 0}
    assert sorted(first_seen) == list(range(len(first_seen)))
    assert len(first_seen) >= (90.0 - latency) * rate - 1
    for index, t in first_seen.items():
        due = index / rate + latency
        assert t == pytest.approx(math.ceil(due / 0.01 - 1e-6) * 0.01, abs=1e-9)


@pytest.mark.parametrize("start", [10.0, 0.013, 123.4567])
def test_a_simulation_may_start_late(start: float) -> None:
    found = arrivals(20.0, 0.13, start, start + 0.5)
    first = math.ceil(start * 20.0 - 1e-9)
    assert [reading.index for _, reading in found] == list(range(first, first + len(found)))
    assert len(found) >= 6
    for arrived, reading in found:
        assert reading.stamp == pytest.approx(reading.index / 20.0)
        assert arrived == pytest.approx(reading.stamp + 0.13, abs=1.1e-3)


def test_stamps_are_what_a_recording_keeps() -> None:
    for _, reading in arrivals(15.0, 0.0, 0.0, 1.0):
        assert reading.stamp == round(reading.stamp * 1e9) / 1e9


@pytest.mark.parametrize(("latency", "error"), [(0.03, 0.03), (0.05, 0.03), (0.0, -0.01)])
def test_a_clock_that_is_off_shows_in_the_stamps_and_in_nothing_else(
    latency: float, error: float
) -> None:
    right = arrivals(50.0, latency, 0.0, 0.4)
    wrong = arrivals(50.0, latency, 0.0, 0.4, clock_error=error)
    assert [(t, reading.index) for t, reading in wrong] == [(t, r.index) for t, r in right]
    for (arrived, late), (_, true) in zip(wrong, right, strict=True):
        assert late.stamp == round((true.stamp + error) * 1e9) / 1e9
        assert late.stamp <= arrived + 1e-9  # nothing comes from the future


def test_contexts_do_not_share_what_is_under_way() -> None:
    clock = Clock(50.0, 0.1)
    first, second = Simulator(clock), Simulator(clock)
    first.AdvanceTo(0.25)
    second.AdvanceTo(0.11)
    assert clock.out.Eval(first.get_context()).index == 7
    assert clock.out.Eval(second.get_context()).index == 0
    copy = Simulator(clock, first.get_context().Clone())
    copy.AdvanceTo(0.29)
    assert clock.out.Eval(copy.get_context()).index == 9
    assert clock.out.Eval(first.get_context()).index == 7


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("rate", 0.0),
        ("rate", math.inf),
        ("latency", -0.1),
        ("latency", math.nan),
        ("clock_error", 0.01),
        ("clock_error", math.nan),
        ("clock_error", -math.inf),
    ],
)
def test_nonsense_is_refused(field: str, value: float) -> None:
    arguments: dict[str, Any] = {"rate": 10.0, "latency": 0.0} | {field: value}
    with pytest.raises(ValueError, match=f"{field} is {value}: must be "):
        Clock(**arguments)


@pytest.mark.parametrize(
    ("active", "taken"), [(None, 6), (1.0, 6), (0.0, 0), (math.nan, 0)], ids=str
)
def test_a_camera_that_is_switched_off_measures_nothing(active: float | None, taken: int) -> None:
    projector = MarkerProjector(
        camera=CAMERA, markers=[], family=family("DICT_4X4_50"), rate=60.0, **MOUNTED
    )
    measured: list[float] = []
    projector._measure = lambda _, stamp, __: measured.append(stamp) or Detections(stamp)  # type: ignore[assignment,func-returns-value]
    simulator = Simulator(projector)
    if active is not None:
        projector.active_input_port().FixValue(simulator.get_mutable_context(), [active])
    simulator.AdvanceTo(0.09)
    assert len(measured) == taken


def test_what_is_under_way_arrives_after_it_was_switched_off() -> None:
    projector = MarkerProjector(
        camera=CAMERA, markers=[], family=family("DICT_4X4_50"), rate=10.0, latency=0.05, **MOUNTED
    )
    projector._measure = lambda _, stamp, __: Detections(stamp)  # type: ignore[assignment]
    simulator = Simulator(projector)
    context = simulator.get_mutable_context()
    switch = projector.active_input_port().FixValue(context, [1.0])
    simulator.AdvanceTo(0.01)
    switch.GetMutableData().get_mutable_value().SetFromVector([0.0])
    simulator.AdvanceTo(0.4)
    assert projector.detections_output_port().Eval(context).stamp == 0.0
