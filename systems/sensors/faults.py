"""Sensors that fail on purpose: what the rest of the robot does when samples are bad or missing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, InputPort, LeafSystem, OutputPort, State

from systems.messages import CameraImage, Detections, PointMatches, Scan
from systems.noise import NoiseStream, sample_index
from systems.periods import period
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]
Kind = Literal[
    "silent", "frozen", "nan", "garbled", "dead", "unknown_ids", "hidden", "misread"
]  # fmt: skip

_NO_SUCH_ID = 1_000_000  # no family has so many
_RUBBISH = 1e3  # magnitude of numbers that no sensor gives
_RATE = 100.0  # Hz, at which what came last is remembered

_KINDS: dict[type, tuple[Kind, ...]] = {
    CameraImage: ("silent", "frozen", "garbled"),
    Detections: ("silent", "frozen", "nan", "garbled", "unknown_ids", "hidden", "misread"),
    PointMatches: ("silent", "frozen", "nan", "garbled"),
    Scan: ("silent", "frozen", "nan", "garbled"),
    int: ("frozen", "nan", "garbled", "dead"),  # a vector
}
_OF_MARKERS = ("hidden", "misread")


@dataclass
class Fault:
    """What goes wrong with a signal, and when.

    Attributes:
        signal: port of the device, such as `imu.sample` or `front_camera.detections`.
        kind: `silent`, no new message comes; `frozen`, the last one comes again and again, under
            new stamps; `nan`, every measured number is NaN; `garbled`, they are rubbish; `dead`,
            they are 0; `unknown_ids`, markers are taken for others that do not exist; `hidden`,
            they are not found; `misread`, they are taken for others that do.
        start: time of the first bad sample, s.
        duration: how long it lasts, s; for ever, if left out.
        ids: which markers are hidden or misread; all, if left out.
        id_offset: what is added to the ids of markers that are misread.
    """

    signal: str
    kind: Kind
    start: float = 0.0
    duration: float = math.inf
    ids: list[int] = field(default_factory=list)
    id_offset: int = 0

    def __post_init__(self) -> None:
        require_non_negative(start=self.start)
        require(self.duration > 0, "duration", self.duration, "greater than 0")
        of_markers = self.kind in _OF_MARKERS
        require(of_markers or not self.ids, "ids", self.ids, "left out, unless hidden or misread")
        fits = (self.id_offset != 0) == (self.kind == "misread")
        allowed = "other than 0 for markers that are misread, and left out otherwise"
        require(fits, "id_offset", self.id_offset, allowed)

    def covers(self, t: float) -> bool:
        """Whether a sample of time t (s) is bad; a message that has no stamp yet never is."""
        return self.start <= t < self.start + self.duration


def tamper(detections: Detections, fault: Fault) -> Detections:
    """Returns what is found when markers are hidden or misread."""
    meant = np.isin(detections.ids, fault.ids) if fault.ids else np.ones(len(detections), bool)
    if fault.kind == "hidden":
        return detections.select(~meant)
    return replace(detections, ids=detections.ids + meant * fault.id_offset)


def kinds_for(model: Any) -> tuple[Kind, ...]:
    """Returns the kinds of faults that what a port carries can have.

    Args:
        model: a message, or a number n for a vector of n.
    """
    return _KINDS.get(type(model), ())


def spoil(value: Any, kind: Kind, held: Any, random: np.random.Generator) -> Any:
    """Returns what arrives in place of a sample.

    Args:
        value: the sample, a vector (n,) or a message.
        kind: what is wrong.
        held: the last good one.
        random: for rubbish.
    """
    if kind == "silent":
        return held
    if isinstance(value, np.ndarray):
        return _spoil_vector(value, kind, held, random)
    if kind == "frozen":
        stamps = ("stamp", "previous_stamp")
        return replace(
            held, **{name: getattr(value, name) for name in stamps if hasattr(value, name)}
        )
    if isinstance(value, CameraImage):
        return replace(value, data=random.integers(0, 256, value.data.shape, np.uint8))
    if isinstance(value, Scan):
        return replace(value, ranges=_spoil_vector(value.ranges, kind, held, random))
    if isinstance(value, PointMatches):
        points = _spoil_vector(value.current.ravel(), kind, held, random)
        return replace(value, current=points.reshape(-1, 2))
    if kind == "unknown_ids":
        return replace(value, ids=_NO_SUCH_ID + np.arange(len(value)))
    corners = _spoil_vector(value.corners.ravel(), kind, held, random)
    return replace(value, corners=corners.reshape(-1, 4, 2))


def _spoil_vector(value: Array, kind: Kind, held: Any, random: np.random.Generator) -> Array:
    if kind == "frozen":
        return np.asarray(held, float)
    if kind in ("nan", "dead"):
        return np.full_like(value, np.nan if kind == "nan" else 0.0)
    rubbish = random.uniform(-_RUBBISH, _RUBBISH, len(value))
    special = random.choice([np.nan, np.inf, -np.inf, 0.0], len(value))
    return np.where(random.random(len(value)) < 0.3, special, rubbish)


class FaultInjector(LeafSystem):
    """Passes a signal on and spoils it while a fault lasts.

    .. pydrake_system::

        name: FaultInjector
        input_ports:
        - input
        output_ports:
        - output

    Args:
        model: what the signal carries: a message, or a number n for a vector of n.
        faults: what goes wrong when; of two at one time the first counts.
        rate: of the signal, Hz; garbled vectors change so often.
        seed: of the rubbish.
        name: of the noise stream.

    Ports:
        input (input, of the type of `model`): the signal.
        output (output, of the type of `model`): the same at once, or what a fault makes of it.
            Whether a message is bad depends on its stamp, whether a vector is on the time.

    Raises:
        ValueError: a kind of fault that such a signal cannot have.
    """

    def __init__(
        self, *, model: Any, faults: Sequence[Fault], rate: float, seed: int, name: str
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        possible = kinds_for(model)
        for fault in faults:
            require(fault.kind in possible, "kind", fault.kind, " or ".join(possible))
        self._faults = tuple(faults)
        self._rate = rate
        self._noise = NoiseStream(self, seed=seed, name=name)
        if isinstance(model, int):
            self._held = self.DeclareAbstractState(AbstractValue.Make(np.full(model, np.nan)))
            self._input = self.DeclareVectorInputPort("input", model)
            self._output = self.DeclareVectorOutputPort(
                "output",
                model,
                lambda context, output: output.SetFromVector(self._calc(context)),
            )
        else:
            self._held = self.DeclareAbstractState(AbstractValue.Make(model))
            self._input = self.DeclareAbstractInputPort("input", AbstractValue.Make(model))
            self._output = self.DeclareAbstractOutputPort(
                "output",
                lambda: AbstractValue.Make(model),
                lambda context, output: output.set_value(self._calc(context)),
            )
        self.DeclarePeriodicUnrestrictedUpdateEvent(period(_RATE), 0.0, self._remember)

    def input_port(self) -> InputPort:
        """Returns the port of the signal."""
        return self._input

    def output_port(self) -> OutputPort:
        """Returns the port of the signal with its faults."""
        return self._output

    def _fault(self, context: Context, value: Any) -> Fault | None:
        t = getattr(value, "stamp", context.get_time())
        return next((fault for fault in self._faults if fault.covers(t)), None)

    def _calc(self, context: Context) -> Any:
        value = self._input.Eval(context)
        fault = self._fault(context, value)
        if fault is None:
            return value
        if fault.kind in _OF_MARKERS:
            return tamper(value, fault)
        held = context.get_abstract_state(int(self._held)).get_value()
        index = sample_index(getattr(value, "stamp", context.get_time()), self._rate)
        return spoil(value, fault.kind, held, self._noise.generator(context, index))

    def _remember(self, context: Context, state: State) -> None:
        value = self._input.Eval(context)
        if self._fault(context, value) is None:
            kept = value.copy() if isinstance(value, np.ndarray) else value
            state.get_mutable_abstract_state(int(self._held)).set_value(kept)
