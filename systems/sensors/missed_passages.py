"""Markers that a camera misses on purpose, for as long as it passes over them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.health import Counts
from systems.memo import Memo
from systems.messages import Detections
from systems.noise import NoiseStream
from systems.periods import period
from systems.validation import require, require_positive

Array = NDArray[np.float64]
Missed = Callable[[int, int], bool]

_MANY = 64  # markers that may be in view at one time
_ID, _LAST, _MISSED, _NUMBER = range(4)


def passages_after(
    passages: Array, number: int, detections: Detections, *, gap: float, missed: Missed
) -> tuple[Array, int]:
    """Returns the passages that go on after a picture, and how many there have been.

    Args:
        passages: (n, 4) of those that went on before: id, stamp last seen, whether it is missed,
            its number.
        number: how many there had been.
        detections: the picture.
        gap: a marker not seen for so long has gone, s.
        missed: says of the number and the id of a passage whether it is missed.

    Returns:
        (m, 4) likewise, the latest seen last, and the number.
    """
    stamp = detections.stamp
    going = {int(row[_ID]): row for row in passages.tolist() if stamp - row[_LAST] < gap}
    for marker in detections.ids.tolist():
        row = going.pop(marker, None)
        if row is None:
            number += 1
            row = [marker, stamp, missed(number, marker), number]
        going[marker] = [marker, stamp, *row[_MISSED:]]
    return np.array([*going.values()], float).reshape(-1, 4), number


class MissedPassages(LeafSystem):
    """Leaves out some markers from when they come into view until they are gone.

    .. pydrake_system::

        name: MissedPassages
        input_ports:
        - detections
        output_ports:
        - seen
        - health

    Args:
        probability: that a passage is missed, 0 to 1.
        gap: a marker that has not been seen for so long comes into view anew, s.
        rate: how often there is a look at the pictures, Hz; at least the camera's.
        seed: of what is missed, a parameter of the Context.
        name: of the noise stream.

    Ports:
        detections (input, Detections): what there is to be seen.
        seen (output, Detections): the same without the markers whose passage is missed, at once.
        health (output, Health): detections that were left out, and passages that were.

    Whether the n-th passage is missed depends on the seed, n and the marker's id. The very first is
    not: a robot must start somewhere. Dirt, glare and damage work like this: what hides a marker in
    one picture hides it in the next, and pictures left out one by one would hardly matter. Of more
    than 64 markers in view some count as new each time.

    Raises:
        ValueError: probability, gap, rate or seed out of range.
    """

    def __init__(
        self,
        *,
        probability: float,
        gap: float = 0.5,
        rate: float = 60.0,
        seed: int = 0,
        name: str = "missed_passages",
    ) -> None:
        super().__init__()
        require(0 <= probability <= 1, "probability", probability, "0 to 1")
        require_positive(gap=gap, rate=rate)
        self._probability = probability
        self._gap = gap
        self._noise = NoiseStream(self, seed=seed, name=name)
        self._detections_input = self.DeclareAbstractInputPort(
            "detections", AbstractValue.Make(Detections())
        )
        # See `passages_after`; NaN where there is none.
        self._passages = self.DeclareDiscreteState(np.full(4 * _MANY, math.nan))
        # Stamp of the last picture, and how many passages there have been.
        self._past = self.DeclareDiscreteState([math.nan, 0.0])
        reads = {
            self.discrete_state_ticket(self._passages),
            self.discrete_state_ticket(self._past),
            self.all_parameters_ticket(),
        }
        self._memo = Memo(self, "the last picture", reads)
        self._seen_output = self.DeclareAbstractOutputPort(
            "seen",
            lambda: AbstractValue.Make(Detections()),
            self._calc_seen,
            {self._detections_input.ticket(), *reads},
        )
        self._counts = Counts(self, "missed", "missed_passages")
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._look)

    def detections_input_port(self) -> InputPort:
        """Returns the port of what there is to be seen."""
        return self._detections_input

    def seen_output_port(self) -> OutputPort:
        """Returns the port of what is seen."""
        return self._seen_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _sifted(self, context: Context, detections: Detections) -> tuple[Detections, Array, int]:
        """Returns what is seen of a picture, the passages then, and how many there have been."""
        found: tuple[Detections, Array, int] = self._memo(
            context, lambda picture: self._sift(context, picture), detections
        )
        return found

    def _sift(self, context: Context, detections: Detections) -> tuple[Detections, Array, int]:
        passages = context.get_discrete_state(self._passages).get_value().reshape(-1, 4)
        passages = passages[~np.isnan(passages[:, _ID])]
        past, before = context.get_discrete_state(self._past).get_value().tolist()
        number = int(before)

        def missed(n: int, marker: int) -> bool:
            random = self._noise.generator(context, (n << 32) + marker)
            return n > 1 and bool(random.random() < self._probability)

        if not (math.isnan(detections.stamp) or detections.stamp == past):
            passages, number = passages_after(
                passages, number, detections, gap=self._gap, missed=missed
            )
            passages = passages[-_MANY:]
        gone = passages[passages[:, _MISSED] == 1, _ID].tolist()
        shown = [marker not in gone for marker in detections.ids.tolist()]
        seen = detections if all(shown) else detections.select(np.array(shown))
        return seen, passages, number

    def _calc_seen(self, context: Context, output: Any) -> None:
        detections: Detections = self._detections_input.Eval(context)
        output.set_value(self._sifted(context, detections)[0] if len(detections) else detections)

    def _look(self, context: Context, discrete_state: DiscreteValues) -> None:
        detections: Detections = self._detections_input.Eval(context)
        if not len(detections):  # the passages end by the time
            return
        past, before = context.get_discrete_state(self._past).get_value().tolist()
        if math.isnan(detections.stamp) or detections.stamp == past:
            return
        seen, passages, number = self._sifted(context, detections)
        rows = np.full((_MANY, 4), math.nan)
        rows[: len(passages)] = passages
        discrete_state.set_value(self._passages, rows.ravel())
        discrete_state.set_value(self._past, [detections.stamp, number])
        new = (passages[:, _MISSED] == 1) & (passages[:, _NUMBER] > before)
        self._counts.add(
            context,
            discrete_state,
            missed=len(detections) - len(seen),
            missed_passages=int(new.sum()),
        )
