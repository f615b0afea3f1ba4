"""What was told wrong is named with what it looks like; what is right is not suspected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from systems.cameras import PinholeCamera
from systems.mapping.camera_check import free_camera, suspect_camera
from systems.mapping.gathering import gather
from systems.mapping.mapping import TagMap, build_map
from tests.mapping_world import CAMERA, SIZE, circuit

WORLD = circuit(frames=100)
SEEN = WORLD.detections(0.3, seed=2)


def known(*tags: int) -> dict[int, RigidTransform]:
    scene = WORLD.scene
    return {k: RigidTransform(RotationMatrix(scene.R_WT[k]), scene.p_WT[k]) for k in tags}


def mapped(
    camera: PinholeCamera,
    sizes: dict[int, float] | None = None,
    tags: dict[int, RigidTransform] | None = None,
) -> TagMap:
    gathered = gather(SEEN, camera=camera, size=SIZE, sizes=sizes)
    return build_map(gathered, anchor=None if tags else 0, known=tags)


def suspected(camera: PinholeCamera, **arguments: object) -> dict[str, str]:
    def remap(camera: PinholeCamera) -> TagMap:
        return mapped(camera, **arguments)  # type: ignore[arg-type]

    sizes = arguments.get("tags") is not None
    return suspect_camera(remap(camera), camera, remap=remap, sizes=sizes)[1]


def test_the_right_camera_is_not_suspected() -> None:
    assert suspected(CAMERA) == {}
    assert suspected(CAMERA, tags=known(*range(0, 24, 2))) == {}


@pytest.mark.parametrize("focal", [300.0, 460.0, 500.0, 600.0])
def test_a_wrong_focal_length_is_named_with_what_it_looks_like(focal: float) -> None:
    found = suspected(PinholeCamera.from_focal_length(640, 480, focal))
    words = found["focal_length"].split()
    assert words[:5] == ["the", "focal", "length", "looks", "like"]
    assert float(words[5]) == pytest.approx(480, abs=4)
    assert found["focal_length"].endswith(f"px, the camera says {focal:.0f}")


def test_a_distortion_that_is_not_there_is_named() -> None:
    found = suspected(replace(CAMERA, D=np.array([-0.1, 0, 0, 0, 0])))
    assert "k1 looks like" in found["distortion"]
    k1 = float(found["distortion"].split("like ")[1].split(",")[0])
    assert k1 == pytest.approx(0.0, abs=0.01)


def test_the_camera_is_not_blamed_for_tags_that_sway() -> None:
    swaying = []
    for k, d in enumerate(SEEN):
        aside = 25.0 * (d.ids % 2) * (k % 2)  # px
        swaying.append(replace(d, corners=d.corners + aside[:, None, None]))

    def remap(camera: PinholeCamera) -> TagMap:
        return build_map(gather(swaying, camera=camera, size=SIZE))

    tag_map = remap(CAMERA)
    assert tag_map.suspects
    assert suspect_camera(tag_map, CAMERA, remap=remap)[1] == {}


def test_sizes_are_told_by_known_tags() -> None:
    odd = dict.fromkeys(range(1, 24, 2), 1.25 * SIZE)
    found = suspected(CAMERA, tags=known(*range(0, 24, 2)), sizes=odd)
    assert found["new_size"].startswith("the new tags look 0.80 times as large")
    even = dict.fromkeys(range(0, 24, 2), SIZE / 1.1)
    found = suspected(CAMERA, tags=known(*range(0, 24, 2)), sizes=even)
    assert found["known_size"].startswith("the map's tags look 1.10 times as large")


def test_what_is_freed_is_as_far_off_as_its_deviation_says() -> None:
    off = []
    for seed in range(12):
        gathered = gather(WORLD.detections(0.3, seed), camera=CAMERA, size=SIZE)
        tags = known(*range(0, 24, 2))
        tag_map = build_map(gathered, known=tags)
        freed = free_camera(
            tag_map.adjustment.scene,
            tag_map.all_sightings,
            CAMERA,
            held=tag_map.held,
            pixel_noise=0.3,
            sizes=True,
        )
        errors = [np.log(freed.focal[0]), freed.radial[0], np.log(freed.new_size[0]),
                  np.log(freed.known_size[0])]  # fmt: skip
        deviations = [v[1] for v in (freed.focal, freed.radial, freed.new_size, freed.known_size)]
        off.append(np.divide(errors, deviations))
        assert 0 <= freed.explained < 0.05
    assert np.mean(np.square(off)) == pytest.approx(1.0, abs=0.5)
