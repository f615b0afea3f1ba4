"""A memo for costly stateless outputs, kept in the Context.

Drake marks every output that depends on abstract state as out of date whenever any block of the
diagram updates abstract state. A detector would look at the same image again each time. A memo
keeps, beside the output, the input object it was computed from: messages are immutable, so the
same object means the same result. It is a cache entry, so each Context has its own.
"""

from __future__ import annotations

from collections.abc import Callable
from operator import is_
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DependencyTicket, LeafSystem, ValueProducer


class Memo:
    """The last input objects of one function and what it returned for them.

    Args:
        system: the block that owns the memo; call this in its constructor.
        name: what is remembered, for Drake's diagnostics.
        reads: what the function reads of the Context besides its inputs, state for example; when
            that changes, all is forgotten.
    """

    def __init__(
        self, system: LeafSystem, name: str, reads: set[DependencyTicket] | None = None
    ) -> None:
        self._entry = system.DeclareCacheEntry(
            f"memo of {name}",
            ValueProducer(
                allocate=lambda: AbstractValue.Make([]), calc=lambda _, slot: slot.set_value([])
            ),
            reads or {system.nothing_ticket()},
        )

    def __call__(self, context: Context, function: Callable[..., Any], *inputs: Any) -> Any:
        """Returns `function(*inputs)`, computed anew only when an input is another object."""
        slot = self._entry.Eval(context)
        if not slot or not all(map(is_, slot[0], inputs)):
            slot[:] = [inputs, function(*inputs)]
        return slot[1]
