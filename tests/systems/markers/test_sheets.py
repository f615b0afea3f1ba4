from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import pytest
from apriltag import apriltag
from pydrake.math import RigidTransform

from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap
from systems.markers.sheets import (
    PAGES,
    arrange,
    cell_outlines,
    choose_page,
    largest_marker,
    sheet_side,
    write_sheets,
)

needs_poppler = pytest.mark.skipif(
    shutil.which("pdftoppm") is None, reason="pdftoppm (poppler-utils) is not installed"
)


def marker_map(name: str, sizes: dict[int, float]) -> MarkerMap:
    return MarkerMap(
        family(name), 0.1, {i: Marker(i, RigidTransform(), size) for i, size in sizes.items()}
    )


def rasterise(pdf: Path, dpi: int = 300) -> list[np.ndarray]:
    """The pages as grey pictures, by another program."""
    stem = pdf.with_suffix("")
    subprocess.run(["pdftoppm", "-r", str(dpi), "-gray", str(pdf), str(stem)], check=True)
    files = sorted(pdf.parent.glob(f"{stem.name}-*.pgm"))
    images = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files]
    for file in files:
        file.unlink()
    return images


def ink(row: np.ndarray) -> float:
    """How many pixels of a row are black, edge pixels by their share."""
    return float((255 - row.astype(float)).sum() / 255)


def found_by_opencv(image: np.ndarray, name: str) -> dict[int, np.ndarray]:
    """Ids and corners (4, 2), in the order that OpenCV's own image of the marker has."""
    detector = cv2.aruco.ArucoDetector(family(name).opencv_dictionary())
    corners, ids, _ = detector.detectMarkers(image)
    return {} if ids is None else dict(zip(ids.ravel().tolist(), [c[0] for c in corners]))  # noqa: B905


def found_by_apriltag(image: np.ndarray) -> dict[int, np.ndarray]:
    """Ids and corners (4, 2) top-left first, clockwise, from AprilTag 3."""
    detector = apriltag("tag36h11", threads=1, decimate=2.0)
    # It names the corners left-bottom, right-bottom, right-top, left-top of the upright tag.
    return {d["id"]: np.array(d["lb-rb-rt-lt"])[[3, 2, 1, 0]] - 0.5 for d in detector.detect(image)}


def assert_upright(corners: np.ndarray) -> None:
    """Top-left, top-right, bottom-right, bottom-left on the page."""
    directions = np.sign(np.round((corners - corners.mean(axis=0)) / np.ptp(corners, axis=0), 2))
    np.testing.assert_array_equal(directions, [[-1, -1], [1, -1], [1, 1], [-1, 1]])


@needs_poppler
def test_apriltags_are_found_upright_and_of_their_size_by_both_engines(tmp_path: Path) -> None:
    sizes = {0: 0.16, 7: 0.1, 586: 0.0523}
    pdf = tmp_path / "sheets.pdf"
    assert write_sheets(marker_map("36h11", sizes), pdf) == 3
    for image, (marker_id, size) in zip(rasterise(pdf), sizes.items(), strict=True):
        tags = found_by_apriltag(image)
        assert list(tags) == [marker_id]
        assert_upright(tags[marker_id])
        sides = np.linalg.norm(tags[marker_id] - np.roll(tags[marker_id], 1, axis=0), axis=1)
        np.testing.assert_allclose(sides * 25.4 / 300, 1000 * size, atol=0.1)
        # OpenCV draws AprilTags turned by half a turn, so its first corner is our third.
        markers = found_by_opencv(image, "36h11")
        assert list(markers) == [marker_id]
        assert_upright(np.roll(markers[marker_id], 2, axis=0))


@needs_poppler
def test_aruco_markers_are_found_upright(tmp_path: Path) -> None:
    sizes = {0: 0.15, 17: 0.04}
    pdf = tmp_path / "sheets.pdf"
    write_sheets(marker_map("4x4_50", sizes), pdf)
    for image, marker_id in zip(rasterise(pdf), sizes, strict=True):
        markers = found_by_opencv(image, "4x4_50")
        assert list(markers) == [marker_id]
        assert_upright(markers[marker_id])


@needs_poppler
@pytest.mark.parametrize("page", PAGES)
@pytest.mark.parametrize("several", [False, True])
def test_every_cell_is_where_the_arrangement_says(page: str, several: bool, tmp_path: Path) -> None:
    kind = family("4x4_50")
    sizes = {3: 0.06, 8: 0.025, 9: 0.12, 30: 0.0301}
    markers = marker_map("4x4_50", sizes)
    pdf = tmp_path / "sheets.pdf"
    write_sheets(markers, pdf, page=page, several=several)
    images = rasterise(pdf)
    pages = arrange(markers, page, several=several)
    assert len(images) == len(pages)
    scale = 300 / 25.4  # px/mm
    width, height = PAGES[page]
    for image, sheets in zip(images, pages, strict=True):
        assert abs(image.shape[1] - width * scale) <= 1
        assert abs(image.shape[0] - height * scale) <= 1
        for sheet in sheets:
            cells = kind.cells
            cell = 1000 * sheet.marker.size / cells
            expected = kind.cell_image(sheet.marker.id, margin=1)
            for row in range(cells + 2):
                for column in range(cells + 2):
                    left, top = sheet.left + column * cell, sheet.top + row * cell
                    patch = image[
                        int(np.ceil(top * scale)) + 1 : int((top + cell) * scale) - 1,
                        int(np.ceil(left * scale)) + 1 : int((left + cell) * scale) - 1,
                    ]
                    # Not one grey pixel within a cell: no hairlines, no smear.
                    assert (patch == expected[row, column]).all()
            # The upper border of the marker is one black run of the marker's size.
            y = round((sheet.top + 1.5 * cell) * scale)
            run = image[
                y, round(sheet.left * scale) + 2 : round((sheet.left + sheet.side) * scale) - 2
            ]
            assert ink(run) / scale == pytest.approx(1000 * sheet.marker.size, abs=0.05)
            # Cut marks run toward the corners of the white margin, from outside.
            for x in (sheet.left, sheet.left + sheet.side):
                for y in (sheet.top, sheet.top + sheet.side):
                    outside = np.sign([x, y] - np.array([sheet.left, sheet.top]) - sheet.side / 2)
                    u, v = np.array([x, y]) * scale
                    du, dv = outside * 2.5 * scale
                    beside = image[round(v) - 2 : round(v) + 3, round(u + du)]
                    above = image[round(v + dv), round(u) - 2 : round(u) + 3]
                    assert beside.min() < 100
                    assert above.min() < 100


@needs_poppler
@pytest.mark.parametrize("dpi", [72, 96, 137, 200])
def test_there_are_no_hairlines_at_any_resolution(dpi: int, tmp_path: Path) -> None:
    markers = marker_map("4x4_50", {0: 0.0931})
    pdf = tmp_path / "sheets.pdf"
    write_sheets(markers, pdf)
    (image,) = rasterise(pdf, dpi)
    ((sheet,),) = arrange(markers, "A4")
    black = family("4x4_50").cell_image(0) == 0
    # Black wherever a pixel and its neighbours lie in black cells.
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    cell = sheet.side / len(black)

    def at(du: float, dv: float) -> np.ndarray:
        column = np.floor(((u + du) * 25.4 / dpi - sheet.left) / cell).astype(int)
        row = np.floor(((v + dv) * 25.4 / dpi - sheet.top) / cell).astype(int)
        on = (column >= 0) & (column < len(black)) & (row >= 0) & (row < len(black))
        return on & black[row.clip(0, len(black) - 1), column.clip(0, len(black) - 1)]

    inside = at(-0.5, -0.5) & at(1.5, -0.5) & at(-0.5, 1.5) & at(1.5, 1.5)
    assert inside.sum() > 10000
    assert (image[inside] == 0).all()


@needs_poppler
@pytest.mark.parametrize("page", PAGES)
def test_the_ruler_is_100_mm_long(page: str, tmp_path: Path) -> None:
    pdf = tmp_path / "sheets.pdf"
    write_sheets(marker_map("4x4_50", {0: 0.05}), pdf, page=page)
    (image,) = rasterise(pdf)
    foot = image[-round(20 * 300 / 25.4) :]
    line = max(foot, key=ink)
    runs = np.flatnonzero(line < 255)
    # Ticks of 0.2 mm stand on its ends.
    assert (runs[-1] - runs[0] + 1) * 25.4 / 300 == pytest.approx(100.2, abs=0.1)
    assert (np.diff(runs) == 1).all()


@needs_poppler
def test_the_text_names_id_family_and_size(tmp_path: Path) -> None:
    pdf = tmp_path / "sheets.pdf"
    write_sheets(marker_map("36h11", {12: 0.0525}), pdf)
    text = subprocess.run(
        ["pdftotext", "-layout", str(pdf), "-"], capture_output=True, text=True, check=True
    ).stdout
    for expected in ("tag36h11", "id 12", "52.5 mm", "up", "Print at 100 %", "100 mm long"):
        assert expected in text


def test_the_page_is_true_to_scale_whatever_the_users_style(tmp_path: Path) -> None:
    markers = marker_map("36h11", {0: 0.1, 1: 0.05})
    plain, styled = tmp_path / "plain.pdf", tmp_path / "styled.pdf"
    write_sheets(markers, plain)
    style = {"savefig.bbox": "tight", "figure.autolayout": True, "font.size": 30, "figure.dpi": 50}
    with matplotlib.rc_context(style):
        write_sheets(markers, styled)
    assert plain.read_bytes() == styled.read_bytes()
    assert b"CreationDate" not in plain.read_bytes()
    boxes = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", plain.read_bytes())
    np.testing.assert_allclose(np.array(boxes, float) * 25.4 / 72, [[210.0, 297.0]] * 2, atol=1e-6)


def test_cells_that_touch_at_a_corner_keep_outlines_of_their_own() -> None:
    checkers = np.indices((6, 6)).sum(axis=0) % 2 == 0
    outlines = cell_outlines(checkers)
    assert len(outlines) == 18
    assert all(len(outline) == 4 for outline in outlines)


def test_the_outlines_enclose_the_black_cells() -> None:
    rng = np.random.default_rng(0)
    images = [rng.random((rng.integers(1, 12), rng.integers(1, 12))) < 0.5 for _ in range(50)]
    images += [family("36h11").cell_image(3) == 0]
    for black in images:
        winding = np.zeros(black.shape, int)
        area = 0.0
        for outline in cell_outlines(black):
            following = np.roll(outline, -1, axis=0)
            steps = following - outline
            assert (np.count_nonzero(steps, axis=1) == 1).all()  # along rows and columns
            area += (outline[:, 0] * following[:, 1] - following[:, 0] * outline[:, 1]).sum() / 2
            # The winding number of a cell's centre: the vertical sides to its left.
            for (x, y0), (_, y1) in zip(outline, following, strict=True):
                winding[min(y0, y1) : max(y0, y1), x:] += np.sign(y0 - y1)
        assert area == black.sum()
        np.testing.assert_array_equal(winding, black.astype(int))


@pytest.mark.parametrize("page", PAGES)
def test_several_sheets_share_a_page_without_touching(page: str) -> None:
    rng = np.random.default_rng(1)
    kind = family("4x4_50")
    sizes = {i: float(rng.uniform(0.015, 0.08)) for i in range(50)}
    sizes[25] = largest_marker(page, kind)
    shuffled = {int(i): sizes[int(i)] for i in rng.permutation(50)}
    markers = marker_map("4x4_50", shuffled)
    pages = arrange(markers, page, several=True)
    assert 1 < len(pages) < 25
    assert [sheet.marker.id for sheets in pages for sheet in sheets] == list(range(50))
    width, height = PAGES[page]
    for sheets in pages:
        for i, a in enumerate(sheets):
            assert a.side == pytest.approx(sheet_side(a.marker, kind))
            assert a.left >= 5 - 1e-9
            assert a.left + a.side <= width - 5 + 1e-9
            assert a.top >= 5
            assert a.top + a.side <= height - 30  # label, ruler and note below
            for b in sheets[:i]:
                beside = max(a.left, b.left) - min(a.left + a.side, b.left + b.side)
                above = max(a.top, b.top) - min(a.top + a.side, b.top + b.side)
                assert beside > 9 or above > 20


def test_the_page_is_chosen_by_the_largest_marker() -> None:
    kind = family("4x4_50")
    # 6 cells and one of margin either side, between 5 mm that printers leave blank.
    assert largest_marker("A4", kind) == pytest.approx(0.2 * 6 / 8)
    assert choose_page(marker_map("4x4_50", {0: 0.15, 1: 0.02}), "auto") == "A4"
    assert choose_page(marker_map("4x4_50", {0: 0.1501, 1: 0.02}), "auto") == "A3"
    assert choose_page(marker_map("4x4_50", {0: 0.1501}), "LETTER") == "letter"


@pytest.mark.parametrize(
    ("sizes", "page", "message"),
    [
        ({3: 0.02, 4: 0.1501}, "A4", "size of marker 4 is 0.1501 m: must be at most 0.15 m .* A4"),
        ({4: 0.3}, "auto", r"size of marker 4 is 0.3 m: must be at most 0.2152 m .* A3"),
        ({4: 0.1}, "A5", "page is 'A5': unknown; known: A3, A4, auto, letter"),
        ({}, "A4", "no markers"),
    ],
)
def test_refuses_what_cannot_be_printed(
    sizes: dict[int, float], page: str, message: str, tmp_path: Path
) -> None:
    pdf = tmp_path / "sheets.pdf"
    with pytest.raises(ValueError, match=message):
        write_sheets(marker_map("4x4_50", sizes), pdf, page=page)
    assert not pdf.exists()
