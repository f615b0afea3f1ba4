"""Markers in a picture: an engine proposes, refined corners and the code's cells decide.

OpenCV's ArUco engine serves the `cv2.aruco` dictionaries, AprilTag 3 its own families. Either way
the corners are refined (`systems.markers.corner_refinement`) and the cells read again
(`systems.markers.code_reading`), so corners, hamming distance and decision margin mean the same for
every family, and what an engine takes for a marker in letters, gravel or checkerboards is found
out: its border is not black all round, or its margin not white.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from apriltag import apriltag
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.cameras import PinholeCamera
from systems.health import Counts
from systems.markers.code_reading import CodeReader
from systems.markers.corner_refinement import refine_corners
from systems.markers.family import Family
from systems.markers.family import family as family_by_name
from systems.memo import Memo
from systems.messages import CameraImage, Detections
from systems.periods import period
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]
_APRILTAG_CONTRAST = 5.0  # grey levels: where a neighbourhood has less, it sees neither colour

Found = tuple[NDArray[np.int64], Array]  # ids (n,) and corners (n, 4, 2) px, in the design's order


@dataclass
class DetectorParameters:
    """What counts as a marker.

    Attributes:
        hamming_max: code cells that may be wrong. Never more than half of what the family could
            correct: the other half is what tells markers from clutter.
        rim_errors_max: share of the cells of border and margin that may be on the wrong side of
            the threshold (hidden, in glare, beside a narrow margin).
        min_decision_margin: grey levels; AprilTag 3's scale, where a sharp marker printed with
            contrast c has 0.6 c to 1.1 c.
        min_side: length of the shortest side, px.
        refine: refine the corners to sub-pixels.
        decimate: the engine looks for squares in the picture reduced by this, 1 or greater; faster,
            and blind to small markers. Corners and cells are refined and read in the whole picture.
        blur: standard deviation of the blur with which AprilTag 3 looks for squares, px; for noisy
            pictures.
        min_contrast: grey levels by which black and white side by side differ at least where
            AprilTag 3 looks for squares; its own 5 at the least. It takes noise above that for
            print and is ten times slower; unlike a blur this costs no small markers, only faint
            ones.
    """

    hamming_max: int = 1
    rim_errors_max: float = 1 / 16
    min_decision_margin: float = 10.0
    min_side: float = 8.0
    refine: bool = True
    decimate: float = 1.0
    blur: float = 0.0
    min_contrast: float = _APRILTAG_CONTRAST

    def __post_init__(self) -> None:
        require_non_negative(
            hamming_max=self.hamming_max,
            rim_errors_max=self.rim_errors_max,
            min_decision_margin=self.min_decision_margin,
            min_side=self.min_side,
            blur=self.blur,
        )
        require(self.hamming_max == int(self.hamming_max), "hamming_max", self.hamming_max, "whole")
        require(self.rim_errors_max < 0.5, "rim_errors_max", self.rim_errors_max, "less than 0.5")
        require(
            math.isfinite(self.decimate) and self.decimate >= 1,
            "decimate",
            self.decimate,
            "1 or greater",
        )
        require(
            _APRILTAG_CONTRAST <= self.min_contrast <= 255,
            "min_contrast",
            self.min_contrast,
            f"{_APRILTAG_CONTRAST:g} to 255",
        )


class MarkerDetector:
    """Finds the markers of one family in pictures.

    Markers with one id in two places are both kept. Make one detector and keep it: it holds the
    engine's tables.

    Args:
        family: the family or its name.
        parameters: what counts as a marker.
        camera: the calibrated camera. Needed only where the lens distorts: edges are then fitted
            as the curves that they are. Corners are those of the picture as it is in any case.

    Raises:
        ValueError: unknown family.
    """

    def __init__(
        self,
        *,
        family: Family | str,
        parameters: DetectorParameters | None = None,
        camera: PinholeCamera | None = None,
    ) -> None:
        self.family = family_by_name(family) if isinstance(family, str) else family
        self.parameters = parameters or DetectorParameters()
        self.camera = camera
        self._hamming_max = min(int(self.parameters.hamming_max), self.family.max_correction // 2)
        self._engine: _Engine = (
            _AprilTagEngine(self.family, self.parameters, self._hamming_max)
            if self.family.is_apriltag
            else _ArucoEngine(self.family, self.parameters.decimate)
        )
        self._reader = CodeReader(family=self.family)

    def detect(self, image: Grey, stamp: float = math.nan, frame_id: str = "") -> Detections:
        """Finds the markers in a picture.

        Args:
            image: uint8, (height, width) grey or (height, width, 3) RGB.
            stamp: time of the picture, s.
            frame_id: optical frame of the camera.

        Returns:
            The markers, in the engine's order. All numbers are finite.

        Raises:
            ValueError: not such an image, or one without pixels.
        """
        if not is_picture(image):
            what = f"{getattr(image, 'dtype', type(image).__name__)} {np.shape(image)}"
            raise ValueError(
                f"image is {what}: must be uint8, (height, width) or (height, width, 3)"
            )
        grey = np.ascontiguousarray(image)
        if grey.ndim == 3:
            grey = cv2.cvtColor(grey, cv2.COLOR_RGB2GRAY)
        ids, corners = self._find(grey)
        if len(ids) == 0:
            return Detections(stamp=stamp, frame_id=frame_id, family=self.family.name)
        limits = self.parameters
        # Twice, where the first start comes from a smaller picture.
        for _ in range(int(limits.refine) * (1 if limits.decimate == 1 else 2)):
            corners = refine_corners(grey, corners, self.family.cells, self.camera)
        reading = self._reader.read(grey, ids, corners, self.camera)
        good = (
            (reading.hamming <= self._hamming_max)
            & (reading.rim_errors <= limits.rim_errors_max * self._reader.rim_cells)
            & (reading.decision_margin >= limits.min_decision_margin)
            & (_shortest_sides(corners) >= limits.min_side)
        )
        found = Detections(
            stamp=stamp,
            frame_id=frame_id,
            family=self.family.name,
            ids=ids,
            corners=corners,
            hamming=reading.hamming,
            decision_margin=reading.decision_margin,
        )
        return _without_doubles(found if good.all() else found.select(good))

    def _find(self, grey: Grey) -> Found:
        if min(grey.shape) < self.family.cells + 2:  # no room for a marker of one pixel a cell
            return np.zeros(0, np.int64), np.zeros((0, 4, 2))
        return self._engine.find(grey)


def is_picture(image: Any) -> bool:
    """Whether it is a uint8 array of (height, width) or (height, width, 3) with pixels in it."""
    return (
        isinstance(image, np.ndarray)
        and image.dtype == np.uint8
        and image.size > 0
        and (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3))
    )


_WINDOWS = (7, 29)  # px


class _Engine(Protocol):
    def find(self, grey: Grey) -> Found: ...


class _ArucoEngine:
    def __init__(self, family: Family, decimate: float) -> None:
        self._decimate = decimate
        self._least_size = family.cells + 2
        settings = cv2.aruco.DetectorParameters()
        settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
        # Bits that it reads from rough corners may be wrong; what counts is read again.
        settings.errorCorrectionRate = 1.0
        # OpenCV's 0.125 takes the outline of a board for the marker on it, and then drops both: of
        # markers that fill a quarter of the picture it missed one in ten.
        settings.minMarkerDistanceRate = 0.05
        # Two thresholds instead of three, with wider windows than OpenCV's 3, 13 and 23 px: a third
        # of the time less, and more is found (`bench_detector`) wherever a picture is not quite
        # sharp or its contrast is low; of perfectly sharp markers of 12-16 px one in twenty less.
        settings.adaptiveThreshWinSizeMin, settings.adaptiveThreshWinSizeMax = _WINDOWS
        settings.adaptiveThreshWinSizeStep = _WINDOWS[1] - _WINDOWS[0]
        # As far from the picture's border, whatever the scale.
        settings.minDistanceToBorder = math.ceil(settings.minDistanceToBorder / decimate)
        self._detector = cv2.aruco.ArucoDetector(family.opencv_dictionary(), settings)

    def find(self, grey: Grey) -> Found:
        size = np.array(grey.shape[::-1])
        reduced = np.maximum(np.rint(size / self._decimate), self._least_size).astype(int)
        if self._decimate > 1:
            grey = cv2.resize(grey, reduced.tolist(), interpolation=cv2.INTER_AREA)
        corners, ids, _ = self._detector.detectMarkers(grey)
        if ids is None:
            return np.zeros(0, np.int64), np.zeros((0, 4, 2))
        # From pixels' centres to their corners, where the picture begins, and back.
        places = (np.concatenate(corners).astype(float) + 0.5) * (size / reduced) - 0.5
        return ids.ravel().astype(np.int64), places


class _AprilTagEngine:
    def __init__(self, family: Family, parameters: DetectorParameters, hamming_max: int) -> None:
        share = _APRILTAG_CONTRAST / parameters.min_contrast
        self._paler = np.rint(share * np.arange(256)).astype(np.uint8) if share < 1 else None
        self._detector = apriltag(
            family.name,
            threads=1,
            maxhamming=min(hamming_max, 3),  # its tables grow a hundredfold with every bit
            decimate=parameters.decimate,
            blur=parameters.blur,
        )

    def find(self, grey: Grey) -> Found:
        # Its own limit is fixed, so the picture is made paler.
        found = self._detector.detect(grey if self._paler is None else cv2.LUT(grey, self._paler))
        ids = np.array([tag["id"] for tag in found], np.int64)
        corners = np.array([tag["lb-rb-rt-lt"] for tag in found], float).reshape(-1, 4, 2)
        # The top-left corner first, and from the first pixel's corner to its centre.
        return ids, corners[:, ::-1] - 0.5


def _complex(pairs: Array) -> NDArray[np.complex128]:
    return pairs[..., 0] + 1j * pairs[..., 1]


def _shortest_sides(corners: Array) -> Array:
    return np.abs(_complex(corners - corners.take([1, 2, 3, 0], axis=1))).min(axis=1)


def _without_doubles(found: Detections) -> Detections:
    """Drops a marker that overlaps a surer one of the same id: one marker, seen twice."""
    if len(set(found.ids.tolist())) == len(found):
        return found
    # Two overlap when either has the other's centre inside, to the right of all its edges.
    side = _complex(found.corners.take([1, 2, 3, 0], axis=1)) - _complex(found.corners)
    spoke = _complex(found.corners.mean(axis=1))[:, None, None] - _complex(found.corners)
    inside = ((side.conj() * spoke).imag > 0).all(axis=2)
    double = (inside | inside.T) & (found.ids[:, None] == found.ids)
    surest_first = np.lexsort((-found.decision_margin, found.hamming))
    kept = np.zeros(len(found), bool)
    for i in surest_first:
        kept[i] = not (double[i] & kept).any()
    return found if kept.all() else found.select(kept)


class Detector(LeafSystem):
    """Finds the markers of one family in the pictures of a camera.

    .. pydrake_system::

        name: Detector
        input_ports:
        - image
        output_ports:
        - detections
        - health

    Args:
        detector: the algorithm with its family and lens.
        rate: how often new pictures are looked at to count bad ones, Hz; at least the camera's.

    Ports:
        image (input, CameraImage): grey or RGB.
        detections (output, Detections): the markers in that picture, in its own pixels, with its
            stamp; computed once for each picture. Without a picture yet, or with a bad one, there
            are none and the stamp is NaN.
        health (output, Health): `bad_image` counts pictures that are no uint8 image of (height,
            width) or (height, width, 3).

    Source: Garrido-Jurado et al., "Automatic generation and detection of highly reliable fiducial
    markers under occlusion", Pattern Recognition 2014 (the engine is OpenCV's), and Wang and Olson,
    "AprilTag 2: efficient and robust fiducial detection", IROS 2016 (the engine is AprilTag 3). We
    differ in what comes after the engine: sub-pixel corners and a second look at the cells, alike
    for both.

    Raises:
        ValueError: rate out of range.
    """

    def __init__(self, *, detector: MarkerDetector, rate: float) -> None:
        super().__init__()
        require_positive(rate=rate)
        self._detector = detector
        self._memo = Memo(self, "detections")
        self._image_input = self.DeclareAbstractInputPort(
            "image", AbstractValue.Make(CameraImage())
        )
        self._detections_output = self.DeclareAbstractOutputPort(
            "detections",
            lambda: AbstractValue.Make(Detections()),
            self._calc_detections,
            {self._image_input.ticket()},
        )
        self._last_stamp = self.DeclareDiscreteState([math.nan])
        self._counts = Counts(self, "bad_image")
        self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._count)

    def image_input_port(self) -> InputPort:
        """Returns the port of the pictures."""
        return self._image_input

    def detections_output_port(self) -> OutputPort:
        """Returns the port of the markers found."""
        return self._detections_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of what was dropped."""
        return self._counts.output_port

    def _calc_detections(self, context: Context, output: AbstractValue) -> None:
        image = self._image_input.Eval(context)
        output.set_value(self._memo(context, self._detect, image))

    def _detect(self, image: CameraImage) -> Detections:
        if math.isfinite(image.stamp) and is_picture(image.data):
            return self._detector.detect(image.data, image.stamp, image.frame_id)
        return Detections(frame_id=image.frame_id, family=self._detector.family.name)

    def _count(self, context: Context, discrete_state: DiscreteValues) -> None:
        image = self._image_input.Eval(context)
        last_stamp = context.get_discrete_state(self._last_stamp)[0]
        if math.isfinite(image.stamp) and image.stamp != last_stamp:
            discrete_state.set_value(self._last_stamp, [image.stamp])
            self._counts.add(context, discrete_state, bad_image=not is_picture(image.data))
