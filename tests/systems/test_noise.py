from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.framework import LeafSystem
from scipy import stats

from systems.noise import NoiseStream, coarse_bits, generator, sample_index, stream_key

ROOT = Path(__file__).resolve().parents[2]


def draw(seed: int, name: str, index: int, n: int = 1000) -> np.ndarray:
    return generator(stream_key(seed, name), index).standard_normal(n)


def test_a_draw_depends_on_nothing_but_seed_name_and_index() -> None:
    first = draw(3, "imu", 7)
    draw(3, "imu", 8)
    np.testing.assert_array_equal(draw(3, "imu", 7), first)
    # Nor on how much was drawn for another sample.
    draw(3, "imu", 6, n=100_000)
    np.testing.assert_array_equal(draw(3, "imu", 7), first)


@pytest.mark.parametrize("key", [0, 1, 2**64 - 1, 2**64, 2**128 - 1, stream_key(3, "imu")])
@pytest.mark.parametrize("index", [0, 1, 12345, 2**64 + 7])
def test_the_generator_is_philox_of_that_key_and_counter(key: int, index: int) -> None:
    plain = np.random.Generator(np.random.Philox(key=key, counter=index << 128))
    ours = generator(key, index)
    np.testing.assert_array_equal(ours.standard_normal(50), plain.standard_normal(50))
    np.testing.assert_array_equal(ours.random(50), plain.random(50))


def test_a_draw_is_the_same_in_another_process() -> None:
    # Python's own hash of a string is not: it is salted.
    code = (
        "from systems.noise import generator, stream_key\n"
        "print(stream_key(3, 'imu'), generator(stream_key(3, 'imu'), 7).integers(1 << 62))"
    )
    other = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    key = stream_key(3, "imu")
    assert other.stdout.split() == [str(key), str(generator(key, 7).integers(1 << 62))]


@pytest.mark.parametrize("other", [(4, "imu", 7), (3, "imv", 7), (3, "imu", 8), (3, "imu", 2**40)])
def test_other_seeds_names_and_indices_draw_other_numbers(other: tuple[int, str, int]) -> None:
    a, b = draw(3, "imu", 7), draw(*other)
    assert not np.isin(a, b).any()
    assert abs(np.corrcoef(a, b)[0, 1]) < 5 / np.sqrt(len(a))


def test_seed_and_name_do_not_run_into_each_other() -> None:
    assert stream_key(1, "2/imu") != stream_key(12, "imu")
    assert stream_key(-1, "imu") != stream_key(1, "imu")


def test_first_draws_of_successive_samples_are_white() -> None:
    # What a filter gets to see: one number of each sample.
    key = stream_key(0, "gyro")
    series = np.array([generator(key, k).standard_normal() for k in range(4000)])
    n = len(series)
    assert abs(series.mean()) < 5 / np.sqrt(n)
    assert series.std() == pytest.approx(1.0, abs=5 / np.sqrt(2 * n))
    for lag in (1, 2, 3, 10):
        assert abs(np.mean(series[lag:] * series[:-lag])) < 5 / np.sqrt(n)


@pytest.mark.parametrize("rate", [15.0, 100.0, 285.7, 1 / 3])
def test_the_index_of_a_sample_is_found_from_its_time(rate: float) -> None:
    period = 1.0 / rate
    for k in (0, 1, 2, 999, 123_457):
        assert sample_index(k * period, rate) == k


class Noisy(LeafSystem):
    def __init__(self, seed: int) -> None:
        super().__init__()
        self.noise = NoiseStream(self, seed=seed, name="noisy")


def test_the_seed_is_a_parameter_of_the_context() -> None:
    system = Noisy(5)
    context = system.CreateDefaultContext()
    expected = generator(stream_key(5, "noisy"), 0).standard_normal(3)
    np.testing.assert_array_equal(system.noise.generator(context, 0).standard_normal(3), expected)
    context.get_mutable_numeric_parameter(0).SetAtIndex(0, 6.0)
    expected = generator(stream_key(6, "noisy"), 0).standard_normal(3)
    np.testing.assert_array_equal(system.noise.generator(context, 0).standard_normal(3), expected)


@pytest.mark.parametrize("seed", [-1, 2**53])
def test_a_seed_that_a_float_cannot_hold_is_refused(seed: int) -> None:
    with pytest.raises(ValueError, match=r"seed is .*: must be a whole number from 0 to 2\^53 - 1"):
        Noisy(seed)


def test_the_largest_seeds_are_told_apart() -> None:
    def first(seed: int) -> float:
        system = Noisy(seed)
        return system.noise.generator(system.CreateDefaultContext(), 0).standard_normal()

    assert first(2**53 - 1) != first(2**53 - 2)


def test_normals_depend_on_nothing_but_seed_and_sample() -> None:
    system = Noisy(5)
    context = system.CreateDefaultContext()
    n = 4000
    series = np.array([system.noise.normals(context, k, 2) for k in range(n)])
    again = Noisy(5)
    for k in (3999, 63, 64, 0):
        found = again.noise.normals(again.CreateDefaultContext(), k, 2)
        np.testing.assert_array_equal(found, series[k])
    # White across the samples that are drawn together and those that are not.
    assert np.abs(series.mean(axis=0)).max() < 5 / np.sqrt(n)
    assert np.abs(series.std(axis=0) - 1).max() < 5 / np.sqrt(2 * n)
    for lag in (1, 63, 64, 65, 128):
        assert np.abs((series[lag:] * series[:-lag]).mean(axis=0)).max() < 5 / np.sqrt(n)
    assert abs((series[:, 0] * series[:, 1]).mean()) < 5 / np.sqrt(n)
    context.get_mutable_numeric_parameter(0).SetAtIndex(0, 6.0)
    assert not np.array_equal(system.noise.normals(context, 0, 2), series[0])


def test_coarse_normals_are_normal() -> None:
    bits, normals = coarse_bits(generator(1, 0), 301 * 333)
    numbers = normals[bits].reshape(301, 333)
    assert numbers.shape == (301, 333)
    n = numbers.size
    result = stats.kstest(numbers.ravel(), "norm")
    assert result.pvalue > 0.01
    assert numbers.std() == pytest.approx(1.0, abs=4 / np.sqrt(2 * n))
    # Neighbours, which share a word of the generator, have nothing to do with each other.
    for lag in (1, 2, 3, 4):
        flat = numbers.ravel()
        assert abs((flat[lag:] * flat[:-lag]).mean()) < 4 / np.sqrt(n)
    np.testing.assert_array_equal(coarse_bits(generator(1, 0), 301 * 333)[0], bits)
