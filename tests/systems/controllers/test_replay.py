"""Trackers lead a robot that slips, by what its camera sees of the tags."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from systems.controllers.kanayama import Kanayama
from systems.controllers.mpc import Mpc
from systems.controllers.path_tracking import PathTracker
from systems.controllers.pure_pursuit import PurePursuit
from systems.controllers.tvlqr import Tvlqr
from systems.planners.route_limits import RouteLimits
from systems.planners.route_plan import plan_route
from systems.planners.taught_path import TaughtPath
from tests.replay_world import Circuit, Truth, circuit, replay

KINDS = [Kanayama, PurePursuit, Tvlqr, Mpc]


@pytest.mark.parametrize("kind", KINDS)
def test_it_stays_within_a_centimetre(kind: Callable[..., PathTracker]) -> None:
    world = circuit(5)
    drive = replay(world, kind(route=world.route), seed=5, duration=15.0)
    off = drive.cross_track(world.route, every=5)
    assert np.sqrt(np.mean(off**2)) < 0.01
    assert np.abs(off).max() < 0.03
    assert 0.6 < drive.nees().mean() < 1.4
    assert 0.6 < drive.nis.mean() < 1.25


@pytest.mark.parametrize("kind", KINDS)
def test_slipping_much_and_blind_for_a_while_it_stays_close(
    kind: Callable[..., PathTracker],
) -> None:
    world = circuit(6)
    truth = Truth(slip=0.1, yaw_noise=0.3, blind=(8.0, 11.0))
    drive = replay(world, kind(route=world.route), truth=truth, seed=6, duration=16.0)
    off = drive.cross_track(world.route, every=5)
    assert np.sqrt(np.mean(off**2)) < 0.017
    assert np.abs(off).max() < 0.05


def test_without_the_tags_it_drives_away() -> None:
    world = circuit(5)
    truth = Truth(blind=(0.15, np.inf), gyro=False)
    drive = replay(world, Tvlqr(route=world.route), truth=truth, seed=5)
    assert np.abs(drive.cross_track(world.route, every=5)).max() > 0.1


def test_an_optimised_route_is_driven_as_well() -> None:
    world = circuit(5)
    path = TaughtPath(np.column_stack([world.route.x, world.route.y])[::2], True)
    route = plan_route(path, world.tags, RouteLimits(max_speed=0.7)).route
    drive = replay(Circuit(route, world.tags), Mpc(route=route), seed=5, duration=15.0)
    off = drive.cross_track(route, after=2.0, every=5)
    assert np.sqrt(np.mean(off**2)) < 0.01
    assert np.abs(off).max() < 0.03
