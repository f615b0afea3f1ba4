"""How many markers a robot has met, and whether it sees enough of them now."""

from __future__ import annotations

import math

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.markers.layout import MarkerMap
from systems.messages import Detections
from systems.periods import period
from systems.validation import require_positive


class MarkersSeen(LeafSystem):
    """Counts the markers of a map that detections have shown so far.

    .. pydrake_system::

        name: MarkersSeen
        input_ports:
        - detections
        output_ports:
        - seen

    Args:
        marker_map: which markers count.
        rate: how often it looks, Hz; at least the camera's.
        enough: how many markers a picture is to show.

    Ports:
        detections (input, Detections): of the camera.
        seen (output, vector of 3): whether the latest picture shows enough markers of the map (1 or
            0), the number of different ones met so far, and the share of pictures so far that
            showed enough (0 before the first picture); at `rate`.

    Raises:
        ValueError: rate or number out of range.
    """

    def __init__(self, *, marker_map: MarkerMap, rate: float, enough: int = 1) -> None:
        super().__init__()
        require_positive(rate=rate, enough=enough)
        self._enough = enough
        self._index = {marker: k for k, marker in enumerate(sorted(marker_map.markers))}
        self._detections_input = self.DeclareAbstractInputPort(
            "detections", AbstractValue.Make(Detections())
        )
        self._met = self.DeclareDiscreteState(len(self._index))
        # Whether enough are in view, how many were met, share; then stamp, pictures, with enough.
        self._seen = self.DeclareDiscreteState([0.0, 0.0, 0.0])
        self._pictures = self.DeclareDiscreteState([math.nan, 0.0, 0.0])
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._look)
        self._seen_output = self.DeclareStateOutputPort("seen", self._seen)

    def detections_input_port(self) -> InputPort:
        """Returns the port of the detections."""
        return self._detections_input

    def seen_output_port(self) -> OutputPort:
        """Returns the port of what was seen."""
        return self._seen_output

    def _look(self, context: Context, discrete_state: DiscreteValues) -> None:
        detections: Detections = self._detections_input.Eval(context)
        stamp, pictures, shown = context.get_discrete_state(self._pictures).get_value().tolist()
        if math.isnan(detections.stamp) or detections.stamp == stamp:
            return
        known = [self._index[i] for i in {*detections.ids.tolist()} if i in self._index]
        enough = len(known) >= self._enough
        pictures, shown = pictures + 1, shown + enough
        number = context.get_discrete_state(self._seen)[1]
        if known:
            met = context.get_discrete_state(self._met).get_value().copy()
            met[known] = 1.0
            number = met.sum()
            discrete_state.set_value(self._met, met)
        discrete_state.set_value(self._pictures, [detections.stamp, pictures, shown])
        discrete_state.set_value(self._seen, [float(enough), number, shown / pictures])
