from __future__ import annotations

from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem, State

from systems.memo import Memo
from systems.messages import CameraImage, Health


class Costly(LeafSystem):
    """Counts the calls of a function that is remembered."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[Any] = []
        self.memo = Memo(self, "costly")
        self.image = self.DeclareAbstractInputPort("image", AbstractValue.Make(CameraImage()))
        self.DeclareAbstractOutputPort(
            "out", lambda: AbstractValue.Make(Health()), self._calc, {self.image.ticket()}
        )

    def _function(self, image: CameraImage) -> Health:
        self.calls.append(image)
        return Health({"call": len(self.calls)})

    def _calc(self, context: Context, output: Any) -> None:
        output.set_value(self.memo(context, self._function, self.image.Eval(context)))


class Busy(LeafSystem):
    """Holds an image in abstract state and updates other abstract state all the time."""

    def __init__(self, image: CameraImage) -> None:
        super().__init__()
        held = self.DeclareAbstractState(AbstractValue.Make(image))
        other = self.DeclareAbstractState(AbstractValue.Make(0))

        def update(context: Context, state: State) -> None:
            state.get_mutable_abstract_state(int(other)).set_value(context.get_time())

        self.DeclarePeriodicUnrestrictedUpdateEvent(0.01, 0.0, update)
        self.DeclareStateOutputPort("image", held)


def test_the_same_object_is_computed_once_though_drake_asks_again() -> None:
    builder = DiagramBuilder()
    source = builder.AddSystem(Busy(CameraImage(stamp=1.0)))
    costly = builder.AddSystem(Costly())
    builder.Connect(source.GetOutputPort("image"), costly.image)
    simulator = Simulator(builder.Build())
    context = costly.GetMyContextFromRoot(simulator.get_context())
    for k in range(1, 11):
        simulator.AdvanceTo(0.02 * k)
        assert costly.GetOutputPort("out").Eval(context).counts == {"call": 1}


def test_another_object_is_computed_anew_even_if_it_is_equal() -> None:
    system = Costly()
    context = system.CreateDefaultContext()
    a, b = CameraImage(stamp=1.0), CameraImage(stamp=1.0)
    for expected, image in enumerate([a, b, b, a], 1):
        system.image.FixValue(context, image)
        calls = system.GetOutputPort("out").Eval(context).counts["call"]
        assert calls == expected - (expected > 2)
    assert system.calls == [a, b, a]


def test_two_contexts_do_not_share_their_memory() -> None:
    system = Costly()
    contexts = [system.CreateDefaultContext() for _ in range(2)]
    images = [CameraImage(stamp=float(k)) for k in range(2)]
    for context, image in zip(contexts, images, strict=True):
        system.image.FixValue(context, image)
    for _ in range(3):
        for k, context in enumerate(contexts):
            assert system.GetOutputPort("out").Eval(context).counts == {"call": k + 1}
    copy = contexts[0].Clone()
    assert system.GetOutputPort("out").Eval(copy).counts == {"call": 1}


def test_every_input_counts() -> None:
    system = Costly()
    context = system.CreateDefaultContext()
    calls = []
    a, b, c = BasicVector(1), BasicVector(1), BasicVector(1)
    for inputs in ((a, b), (a, b), (a, c), (b, c), (b, c)):
        system.memo(context, lambda *args: calls.append(args), *inputs)
    assert calls == [(a, b), (a, c), (b, c)]


class Gain(LeafSystem):
    """Scales a number by one of its state, remembered."""

    def __init__(self) -> None:
        super().__init__()
        self.gain = self.DeclareDiscreteState([2.0])
        self.memo = Memo(self, "scaled", {self.discrete_state_ticket(self.gain)})
        self.calls = 0

    def scaled(self, context: Context, stamp: CameraImage) -> float:
        def function(image: CameraImage) -> float:
            self.calls += 1
            return float(context.get_discrete_state(self.gain)[0]) * image.stamp

        return float(self.memo(context, function, stamp))


def test_what_was_read_of_the_state_is_forgotten_when_that_changes() -> None:
    system = Gain()
    context = system.CreateDefaultContext()
    image = CameraImage(stamp=3.0)
    assert [system.scaled(context, image) for _ in range(3)] == [6.0] * 3
    context.get_mutable_discrete_state(system.gain).SetFromVector([5.0])
    assert [system.scaled(context, image) for _ in range(3)] == [15.0] * 3
    assert system.scaled(context, CameraImage(stamp=4.0)) == 20.0
    assert system.calls == 3


def test_a_result_of_none_is_remembered_too_and_an_error_is_not() -> None:
    system = Costly()
    context = system.CreateDefaultContext()
    image, calls = CameraImage(), []

    def fails_once(image: CameraImage) -> None:
        calls.append(image)
        if len(calls) == 1:
            raise RuntimeError("once")

    for _ in range(3):
        try:
            assert system.memo(context, fails_once, image) is None
        except RuntimeError:
            assert len(calls) == 1
    assert len(calls) == 2
