"""Three seconds without sight on ground that slips much: what is left of the tags' knowledge."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from systems.controllers.tvlqr import Tvlqr
from systems.estimators.planar_ekf_parameters import PlanarEkfParameters
from tests.replay_bound import least_covariance
from tests.replay_world import Circuit, Drive, Truth, circuit, ekf_parameters, replay

TRUTH = Truth(slip=0.1, yaw_noise=0.3, blind=(8.0, 11.0))
SEEDS = (2, 7, 9, 11, 14, 16)


@cache
def driven(seed: int, walks: bool = False) -> tuple[Circuit, Drive]:
    """A drive into the dark and out of it, by a filter that knows how slip comes and goes.

    Or by one to which it only walks away, as fast as it does in the short run.
    """
    world = circuit(seed)
    ekf: PlanarEkfParameters = ekf_parameters(TRUTH.slip, TRUTH.yaw_noise)
    if walks:
        ekf = replace(ekf, scale_wander=0.0, scale_walk=TRUTH.slip / math.sqrt(2))
    tracker = Tvlqr(route=world.route)
    return world, replay(world, tracker, ekf=ekf, truth=TRUTH, seed=seed, duration=12.5)


def at_the_end(drive: Drive) -> int:
    return int(np.searchsorted(drive.t, TRUTH.blind[1] - 1e-9))


def position_errors(walks: bool = False) -> np.ndarray:
    drives = [driven(seed, walks)[1] for seed in SEEDS]
    return np.array(
        [(d.estimate - d.pose)[at_the_end(d), :2] for d in drives]
    )  # fmt: skip


def test_it_stays_on_the_route() -> None:
    for seed in SEEDS:
        world, drive = driven(seed)
        off = drive.cross_track(world.route, every=5)
        assert np.sqrt(np.mean(off**2)) < 0.017
        assert np.abs(off).max() < 0.05


def test_it_is_as_sure_as_one_can_be_and_not_surer() -> None:
    """The bound knows the slip of the last moment to the last digit; the filter has to learn it."""
    for seed in SEEDS:
        _, drive = driven(seed)
        k = at_the_end(drive)
        P, least = drive.covariance[k, :2, :2], least_covariance(drive, TRUTH)
        assert np.linalg.eigvalsh(P - least).min() > 0
        assert 1.05 < math.sqrt(np.trace(P) / np.trace(least)) < 1.6


def test_its_errors_are_as_large_as_it_says() -> None:
    squared = 0.0
    for e, seed in zip(position_errors(), SEEDS, strict=True):
        drive = driven(seed)[1]
        squared += e @ np.linalg.solve(drive.covariance[at_the_end(drive), :2, :2], e) / 2
    # Chi-square with 12 degrees of freedom, by their number: 98 % between 0.30 and 2.18.
    assert 0.30 < squared / len(SEEDS) < 2.18


def test_a_slip_that_only_walks_away_is_carried_too_far() -> None:
    """Dead reckoning goes on with the last slip, long after it has faded."""
    fades, walks = (np.sqrt(np.mean(position_errors(w) ** 2)) for w in (False, True))
    assert fades < 0.7 * walks


def test_the_bound_of_steady_driving_straight_on() -> None:
    """In closed form: v sigma sqrt(2 T - 3 + 4 exp(-T) - exp(-2 T)) of a slip that lasts 1 s."""
    t = np.arange(0.0, 12.0, 0.01)
    steady = np.tile([0.5, 0.0], (len(t), 1))
    nothing = np.zeros((len(t), 3))
    drive = driven(SEEDS[0])[1]
    drive = replace(drive, t=t, command=steady, pose=nothing)
    a = math.exp(-3.0)
    expected = (0.5 * 0.05) ** 2 * (6.0 - 3.0 + 4 * a - a * a)
    np.testing.assert_allclose(
        least_covariance(drive, TRUTH), [[expected, 0.0], [0.0, 0.0]], rtol=0.01, atol=1e-12
    )
