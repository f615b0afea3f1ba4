"""Printable marker sheets, true to scale.

The PDF is vector graphics in millimetres. The black cells of a marker are one filled outline, so
no viewer or printer draws hairlines between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from systems.markers.family import Family
from systems.markers.layout import Marker, MarkerMap
from systems.validation import nearest

# Width and height, mm.
PAGES = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "letter": (215.9, 279.4)}
_AUTOMATIC = ("A4", "A3")

_MM_PER_INCH = 25.4
_POINTS_PER_MM = 72 / _MM_PER_INCH
# What printers leave blank at the edges of the paper, mm.
_BLANK = 5.0
# At the bottom of the page, for the ruler and the note, mm.
_FOOTER = 16.0
# Below each marker, for cut marks and label, mm.
_LABEL = 12.0
# Between the sheets on a page, for their cut marks, mm.
_GAP = 10.0
# Cut marks begin this far outside the corner of the white margin and are this long, mm.
_CUT_START, _CUT_LENGTH = 1.0, 3.0
# Where the white margins begin on a page of several, so that cut marks are printed, mm.
_INSET = _BLANK + _CUT_START + _CUT_LENGTH
# Size of the text, mm.
_FONT = 3.0
# Width of the arrow beside the label, mm.
_ARROW = 4.0


@dataclass(frozen=True)
class Sheet:
    """A marker on a page.

    Attributes:
        marker: which one.
        left: distance of its white margin from the left edge of the page, mm.
        top: distance of its white margin from the upper edge of the page, mm.
        side: side of the marker with its white margin, mm.
    """

    marker: Marker
    left: float
    top: float
    side: float


def sheet_side(marker: Marker, family: Family) -> float:
    """Returns the side of a marker with its white margin of one cell, mm."""
    return 1000 * marker.size * (1 + 2 / family.cells)


def largest_marker(page: str, family: Family) -> float:
    """Returns the side of the largest black square that fits on a page with its margin, m."""
    width, height = PAGES[page]
    side = min(width - 2 * _BLANK, height - 2 * _BLANK - _LABEL - _FOOTER)
    return side / (1 + 2 / family.cells) / 1000


def choose_page(marker_map: MarkerMap, page: str) -> str:
    """Returns the page size for a map.

    Args:
        marker_map: the markers, at least one.
        page: "A4", "A3", "letter", or "auto" for the smaller of A4 and A3 that takes all markers.

    Raises:
        ValueError: an unknown page size, or a marker that does not fit; the message names the
            largest one that does.
    """
    names = {name.lower(): name for name in PAGES}
    if page.lower() not in [*names, "auto"]:
        raise ValueError(f"page is {page!r}: unknown; {nearest(page, [*PAGES, 'auto'])}")
    allowed = _AUTOMATIC if page.lower() == "auto" else (names[page.lower()],)
    largest = max(marker_map, key=lambda marker: marker.size)
    for name in allowed:
        # Rounding must not turn away a size that fits exactly.
        if largest.size <= largest_marker(name, marker_map.family) + 1e-9:
            return name
    limit = np.floor(largest_marker(allowed[-1], marker_map.family) * 1e4) / 1e4
    raise ValueError(
        f"size of marker {largest.id} is {largest.size:g} m: must be at most {limit:g} m to fit on "
        f"{allowed[-1]} with its white margin"
    )


def arrange(marker_map: MarkerMap, page: str, *, several: bool = False) -> list[list[Sheet]]:
    """Arranges the markers of a map on pages, in the order of their ids.

    Args:
        marker_map: the markers, all of which fit on the page.
        page: "A4", "A3" or "letter".
        several: fill each page row by row, instead of one marker a page, centred.
    """
    width, height = PAGES[page]
    bottom = height - _BLANK - _FOOTER
    pages: list[list[Sheet]] = []
    left = top = _INSET
    row = 0.0  # height of the row so far
    for marker in sorted(marker_map, key=lambda marker: marker.id):
        side = sheet_side(marker, marker_map.family)
        if not several:
            space = bottom - _BLANK - _LABEL - side
            pages.append([Sheet(marker, (width - side) / 2, _BLANK + space / 2, side)])
            continue
        if row > 0 and left + side > width - _INSET:
            left, top, row = _INSET, top + row + _GAP, 0.0
        if not pages or (top > _INSET and top + side + _LABEL > bottom):
            pages.append([])
            left, top, row = _INSET, _INSET, 0.0
        if row == 0:  # the widest marker of all leaves no room for its cut marks
            left = min(left, (width - side) / 2)
        pages[-1].append(Sheet(marker, left, top, side))
        left, row = left + side + _GAP, max(row, side + _LABEL)
    return pages


def cell_outlines(black: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Returns the outlines of the black area of an image.

    Args:
        black: (rows, columns)

    Returns:
        Closed polygons, each (n, 2) of corners (column, row) where they turn, with the black cells
        on the right-hand side; outer outlines run clockwise as seen, holes the other way.
    """
    edges: dict[tuple[int, int], list[tuple[int, int]]] = {}
    padded = np.pad(black, 1)
    for row, column in np.argwhere(black).tolist():
        # The cell's four sides, clockwise with rows counted downward, and the neighbour beyond.
        for start, step, beyond in (
            ((column, row), (1, 0), (row, column + 1)),
            ((column + 1, row), (0, 1), (row + 1, column + 2)),
            ((column + 1, row + 1), (-1, 0), (row + 2, column + 1)),
            ((column, row + 1), (0, -1), (row + 1, column)),
        ):
            if not padded[beyond]:
                edges.setdefault(start, []).append(step)
    outlines = []
    while edges:
        first = point = next(iter(edges))
        step = (0, 0)
        turns: list[tuple[int, int]] = []
        while not turns or point != first:
            steps = edges[point]
            # Where two cells touch at a corner, keep to the one we came along.
            right = (-step[1], step[0])
            following = right if right in steps else steps[0]
            steps.remove(following)
            if not steps:
                del edges[point]
            if following != step:
                turns.append(point)
            step = following
            point = (point[0] + step[0], point[1] + step[1])
        outlines.append(np.array(turns))
    return outlines


def write_sheets(
    marker_map: MarkerMap, path: Path, *, page: str = "A4", several: bool = False
) -> int:
    """Writes the markers of a map to a PDF, upright and true to scale.

    Each has a white margin of one cell with cut marks at its corners, and below it its id, family
    and size and an arrow up. Each page has a line of 100 mm, to check the printer with.
    The same map gives the same bytes.

    Args:
        marker_map: the markers.
        path: of the PDF.
        page: "A4", "A3", "letter", or "auto" for the smaller of A4 and A3 that takes all markers.
        several: as many markers a page as fit, instead of one.

    Returns:
        The number of pages.

    Raises:
        ValueError: no markers, an unknown page size, or a marker that does not fit (see
            `choose_page`).
    """
    if len(marker_map) == 0:
        raise ValueError("the marker map has no markers: must have at least one")
    page = choose_page(marker_map, page)
    pages = arrange(marker_map, page, several=several)
    # The user's own matplotlib style must not rescale the page.
    with (
        matplotlib.style.context("default"),
        PdfPages(path, metadata={"CreationDate": None}) as pdf,
    ):
        for sheets in pages:
            pdf.savefig(_draw_page(sheets, marker_map.family, page))
    return len(pages)


def _draw_page(sheets: list[Sheet], family: Family, page: str) -> Figure:
    width, height = PAGES[page]
    figure = Figure(figsize=(width / _MM_PER_INCH, height / _MM_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    # Millimetres from the upper left corner of the page.
    axes.set_xlim(0.0, width)
    axes.set_ylim(height, 0.0)
    axes.set_axis_off()
    for sheet in sheets:
        _draw_marker(axes, sheet, family)
        _draw_cut_marks(axes, sheet)
        _draw_label(axes, sheet, family)
    _draw_footer(axes, width, height)
    return figure


def _draw_marker(axes: Axes, sheet: Sheet, family: Family) -> None:
    cell = sheet.side / (family.cells + 2)
    black = family.cell_image(sheet.marker.id) == 0
    outlines = [
        Outline(np.concatenate([o, o[:1]]) * cell + [sheet.left, sheet.top], closed=True)
        for o in cell_outlines(black)
    ]
    shape = Outline.make_compound_path(*outlines)
    axes.add_patch(PathPatch(shape, facecolor="black", linewidth=0))


def _draw_cut_marks(axes: Axes, sheet: Sheet) -> None:
    for x, outward in ((sheet.left, -1), (sheet.left + sheet.side, 1)):
        for y, downward in ((sheet.top, -1), (sheet.top + sheet.side, 1)):
            near, far = _CUT_START, _CUT_START + _CUT_LENGTH
            _draw_line(axes, [x + outward * near, x + outward * far], [y, y])
            _draw_line(axes, [x, x], [y + downward * near, y + downward * far])


def _draw_label(axes: Axes, sheet: Sheet, family: Family) -> None:
    lines = [family.name, f"id {sheet.marker.id}, {1000 * sheet.marker.size:g} mm"]
    middle = sheet.left + sheet.side / 2
    y = sheet.top + sheet.side + _CUT_START + _CUT_LENGTH + 1.3 * _FONT
    # Small markers have small labels: a character is about 0.65 of the font's size wide.
    characters = max(map(len, lines))
    font = min(_FONT, (sheet.side + _GAP - 2 * _ARROW) / (0.65 * characters))
    _write(axes, middle, y - 0.65 * font, lines[0], font)
    _write(axes, middle, y + 0.65 * font, lines[1], font)
    x = middle - 0.65 * font * characters / 2 - _ARROW / 2
    _draw_line(axes, [x, x], [y + 1, y - 2])
    _draw_line(axes, [x - 1, x, x + 1], [y - 1, y - 2, y - 1])
    _write(axes, x, y + 2.5, "up", 0.7 * _FONT)


def _draw_footer(axes: Axes, width: float, height: float) -> None:
    left, y = (width - 100) / 2, height - _BLANK - 2.0
    _draw_line(axes, [left, left + 100], [y, y])
    for k in range(11):
        length = 3.0 if k in (0, 5, 10) else 1.5
        _draw_line(axes, [left + 10 * k] * 2, [y, y - length])
    note = "Print at 100 % (no scaling): this line is 100 mm long."
    _write(axes, width / 2, y - 6.0, note, _FONT)


def _draw_line(axes: Axes, x: list[float], y: list[float]) -> None:
    axes.plot(x, y, color="black", linewidth=0.2 * _POINTS_PER_MM, solid_capstyle="butt")


def _write(axes: Axes, x: float, y: float, text: str, font: float) -> None:
    axes.text(x, y, text, fontsize=font * _POINTS_PER_MM, ha="center", va="center")
