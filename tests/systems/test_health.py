from __future__ import annotations

from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from systems.health import Counts


class Dropper(LeafSystem):
    """Drops one sample for `a` a step, and two more for `b` every other step."""

    def __init__(self) -> None:
        super().__init__()
        self.own = self.DeclareDiscreteState([5.0])
        self.counts = Counts(self, "a", "b", "never")
        self.DeclarePeriodicDiscreteUpdateEvent(0.125, 0.0, self._step)

    def _step(self, context: Context, state: DiscreteValues) -> None:
        every_other = int(context.get_time() / 0.125) % 2
        self.counts.add(context, state, a=1, b=2 * every_other)


def test_counts_add_up_by_reason() -> None:
    system = Dropper()
    simulator = Simulator(system)
    context = simulator.get_context()
    assert system.counts.output_port.Eval(context).counts == {"a": 0, "b": 0, "never": 0}
    simulator.AdvanceTo(1.0)  # steps at 0, 0.125, ..., 0.875
    assert system.counts.output_port.Eval(context).counts == {"a": 8, "b": 8, "never": 0}
    assert all(type(n) is int for n in system.counts.output_port.Eval(context).counts.values())
    assert context.get_discrete_state(system.own)[0] == 5.0


def test_every_context_counts_for_itself() -> None:
    system = Dropper()
    first, second = Simulator(system), Simulator(system)
    first.AdvanceTo(1.0)
    second.AdvanceTo(0.2)
    assert system.counts.output_port.Eval(second.get_context()).counts["a"] == 2
    assert system.counts.output_port.get_name() == "health"
