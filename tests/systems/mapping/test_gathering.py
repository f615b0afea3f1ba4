"""What becomes of detections that cannot be used."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from systems.mapping.gathering import gather
from systems.messages import Detections
from tests.mapping_world import CAMERA

SQUARE = np.array([[0.0, 0], [40, 0], [40, 40], [0, 40]]) + 100


def frame(stamp: float, *ids: int, corners: NDArray[np.float64] | None = None) -> Detections:
    """One frame that shows these tags."""
    if corners is None:
        corners = np.tile(SQUARE, (len(ids), 1, 1))
    return Detections(stamp=stamp, ids=np.array(ids, np.int64), corners=corners)


def test_good_frames_become_sightings_in_order() -> None:
    found = gather([frame(k, 9, 4) for k in range(3)], camera=CAMERA, size=0.2)
    assert found.ids.tolist() == [4, 9]
    assert found.stamps.tolist() == [0, 1, 2]
    assert found.sightings.frame.tolist() == [0, 0, 1, 1, 2, 2]
    assert found.sightings.tag.tolist() == [1, 0] * 3
    np.testing.assert_allclose(found.sightings.rays[0], CAMERA.rays(SQUARE)[0])
    assert not any(found.dropped.values())


def test_what_cannot_be_used_is_counted() -> None:
    broken = np.tile(SQUARE, (2, 1, 1))
    broken[1, 2, 0] = np.nan
    frames = [
        frame(1.0, 4, 9),
        frame(1.0, 4, 9),  # the same time again
        frame(0.5, 4, 9),  # back
        frame(np.nan, 4, 9),
        frame(2.0, 4, 9, 4),  # 4 twice
        frame(3.0, 4, 9, corners=broken),
        frame(4.0, 4, 9, corners=np.stack([SQUARE, (SQUARE - 100) / 8 + 100])),
        frame(5.0, 4, 9, 77),  # 77 just once
        frame(6.0),
    ]
    found = gather(frames, camera=CAMERA, size=0.2)
    assert found.dropped == {
        "bad_stamp": 3,
        "repeated_id": 2,
        "bad_corners": 1,
        "too_small": 1,
        "rare_tag": 1,
    }
    assert found.ids.tolist() == [4, 9]
    assert found.stamps.tolist() == [1, 2, 3, 4, 5]
    assert found.sightings_of().tolist() == [4, 3]


@pytest.mark.parametrize(
    ("stamps", "kept"),
    [
        ([0, 1, 2, 900, 3, 4, 5], [0, 1, 2, 3, 4, 5]),  # one far ahead
        ([5, 6, 7, 0, 1, 2, 3], [0, 1, 2, 3]),  # a clock that was set back: the longer part
        ([3, 2, 1], [3]),  # the earliest of several
        ([1, 1, 2, np.inf, 2, np.nan, 3], [1, 2, 3]),
    ],
)
def test_frames_that_most_stamps_agree_with_stay(stamps: list[float], kept: list[float]) -> None:
    found = gather([frame(t, 4) for t in stamps], camera=CAMERA, size=0.2, min_frames=1)
    assert found.stamps.tolist() == kept
    assert found.dropped["bad_stamp"] == len(stamps) - len(kept)


def test_pixels_that_the_lens_model_cannot_explain_are_bad_corners() -> None:
    lens = type(CAMERA)(640, 480, CAMERA.K, np.array([-0.9, 0.0, 0.0, 0.0, 0.0]))
    far = SQUARE + np.array([480.0, 320.0])
    found = gather(
        [
            frame(k, 4, 9, corners=np.stack([SQUARE + np.array([170.0, 100.0]), far]))
            for k in range(3)
        ],
        camera=lens,
        size=0.2,
    )
    assert found.dropped["bad_corners"] == 3
    assert found.ids.tolist() == [4]


def test_nothing_at_all_gives_no_sightings() -> None:
    found = gather([], camera=CAMERA, size=0.2)
    assert len(found.sightings) == 0
    assert len(found.ids) == 0


def test_tags_may_have_sizes_of_their_own() -> None:
    found = gather([frame(k, 4, 9) for k in range(3)], camera=CAMERA, size=0.2, sizes={9: 0.5})
    assert found.sightings.sizes.tolist() == [0.2, 0.5]


@pytest.mark.parametrize("sizes", [{"size": 0.0}, {"size": 0.2, "sizes": {4: -0.1}}])
def test_sizes_must_be_positive(sizes: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="size"):
        gather([frame(0, 4)], camera=CAMERA, **sizes)  # type: ignore[arg-type]
