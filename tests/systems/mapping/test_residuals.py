"""Residuals by tag and by frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from systems.mapping.gathering import gather
from systems.mapping.mapping import TagMap, build_map
from systems.mapping.residuals import residuals_of
from systems.messages import Detections
from tests.mapping_world import CAMERA, SIZE, circuit

FRAMES, SPOILT = 80, 31


def mapped(frames: list[Detections]) -> TagMap:
    return build_map(gather(frames, camera=CAMERA, size=SIZE), anchor=0)


def test_corners_that_are_moved_by_hand_have_that_residual() -> None:
    """All else is where the map has it, to the last digit."""
    world = circuit(frames=FRAMES)
    tag_map = mapped(world.detections(0.3))
    s = world.sightings()
    tag, other = s.tag[s.frame == SPOILT][:2]
    (one,) = np.flatnonzero((s.frame == SPOILT) & (s.tag == tag))
    (two,) = np.flatnonzero((s.frame == SPOILT) & (s.tag == other))
    rays = s.rays.copy()
    rays[one] += np.array([3.0, 4.0]) / 480.0  # 5 px, and one corner 13 px
    rays[one, 2] += np.array([2.0, 8.0]) / 480.0
    rays[two] += 100.0 / 480.0
    moved = replace(s, rays=rays)
    used = np.arange(len(s)) != two
    adjustment = replace(tag_map.adjustment, scene=world.scene)
    true = replace(
        tag_map, adjustment=adjustment, sightings=moved.select(used), all_sightings=moved
    )
    of_tags, of_frames = residuals_of(true)
    squared = 3 * 25.0 + 169.0
    seen = int((s.frame == SPOILT).sum())
    assert (of_frames.used[SPOILT], of_frames.outliers[SPOILT]) == (seen - 1, 1)
    assert of_frames.squared[SPOILT] == pytest.approx(squared)
    assert of_frames.rms[SPOILT] == pytest.approx(np.sqrt(squared / (4 * (seen - 1))))
    assert of_frames.largest[SPOILT] == pytest.approx(100 * np.sqrt(2))
    assert of_tags.squared[tag] == pytest.approx(squared)
    assert of_tags.largest[[tag, other]] == pytest.approx([13.0, 100 * np.sqrt(2)])
    assert of_tags.outliers[other] == 1
    for residuals, mine in ((of_frames, [SPOILT]), (of_tags, [tag, other])):
        assert np.delete(residuals.largest, mine).max() < 1e-9
        assert np.delete(residuals.outliers, mine).max() == 0
    np.testing.assert_array_equal(of_frames.used + of_frames.outliers, np.bincount(s.frame))


def test_sums_over_frames_are_sums_over_tags_and_the_map_s() -> None:
    world = circuit(frames=FRAMES)
    frames = world.detections(0.3)
    corners = frames[5].corners.copy()
    corners[0] += 40.0
    frames[5] = replace(frames[5], corners=corners)
    tag_map = mapped(frames)
    of_tags, of_frames = residuals_of(tag_map)
    assert of_tags.used.sum() == of_frames.used.sum() == len(tag_map.sightings)
    left_out = len(tag_map.all_sightings) - len(tag_map.sightings)
    assert of_tags.outliers.sum() == of_frames.outliers.sum() == left_out > 0
    assert of_tags.squared.sum() == pytest.approx(of_frames.squared.sum())
    rms = np.sqrt(of_frames.squared.sum() / (4 * len(tag_map.sightings)))
    assert rms == pytest.approx(tag_map.rms())


def test_a_spoilt_frame_shows_and_no_other() -> None:
    """A picture that was shaken: three times the noise, and nothing is left out for it."""
    world = circuit(frames=FRAMES)
    clean = world.detections(0.3)
    frames = list(clean)
    shaken = np.random.default_rng(3).normal(0.0, 0.8, clean[SPOILT].corners.shape)
    frames[SPOILT] = replace(frames[SPOILT], corners=clean[SPOILT].corners + shaken)
    _, before = residuals_of(mapped(clean))
    _, after = residuals_of(mapped(frames))
    off = frames[SPOILT].corners - world.corners[SPOILT][frames[SPOILT].ids]
    true = np.sqrt((off * off).sum() / (4 * len(off)))
    assert 0.6 * true < after.rms[SPOILT] < true  # the frame's own pose takes a part of it
    assert after.rms[SPOILT] > 2 * before.rms.max()
    others = np.arange(FRAMES) != SPOILT
    assert np.abs(after.rms - before.rms)[others].max() < 0.05
    assert after.outliers.sum() == 0


def test_a_frame_of_which_nothing_fits_has_no_rms() -> None:
    world = circuit(frames=FRAMES)
    frames = world.detections(0.3)
    alone = frames[SPOILT].select(np.arange(len(frames[SPOILT])) == 0)
    wild = np.array([[[0.0, 0.0], [60.0, -60.0], [0.0, 0.0], [0.0, 0.0]]])
    frames[SPOILT] = replace(alone, corners=alone.corners + wild)
    _, of_frames = residuals_of(mapped(frames))
    assert (of_frames.used[SPOILT], of_frames.outliers[SPOILT]) == (0, 1)
    assert np.isnan(of_frames.rms[SPOILT])
    assert np.isfinite(np.delete(of_frames.rms, SPOILT)).all()
