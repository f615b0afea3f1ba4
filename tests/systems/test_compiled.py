from __future__ import annotations

import importlib
import math
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import systems
from systems import compiled as module
from systems.compiled import compiled, in_rows, packed, prepare
from systems.small_matrices import (
    congruence,
    eigen,
    multiply,
    rotation_of,
    solve_positive,
    turn,
)


@compiled("f8(f8[::1], i8)")
def _third(values: np.ndarray, index: int) -> float:
    return values[index] / (index - 2)


def test_compiled_functions_divide_as_numpy_does() -> None:
    assert _third(np.ones(4), 3) == 1.0
    assert _third(np.ones(4), 2) == math.inf


def test_what_is_prepared_is_compiled_for_its_signature_and_no_other() -> None:
    for package in pkgutil.walk_packages(systems.__path__, "systems."):
        importlib.import_module(package.name)
    waiting = [function for function, _ in module._WAITING]
    prepare()
    assert module._WAITING == []
    for function in waiting:
        assert len(function.signatures) == 1, function


def test_a_second_start_compiles_nothing(tmp_path: Path) -> None:
    # Some of these call others that are prepared too, which are then compiled for their callers.
    start = """
import systems.controllers.braking
from systems import compiled
functions = [function for function, _ in compiled._WAITING]
compiled.prepare()
print(sum(sum(function.stats.cache_misses.values()) for function in functions))
"""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    misses = [
        int(subprocess.check_output([sys.executable, "-c", start], env=environment))
        for _ in range(2)
    ]
    assert misses[0] > 1
    assert misses[1] == 0


def test_arrays_that_are_packed_already_are_not_copied() -> None:
    values = np.arange(12.0).reshape(4, 3)
    assert packed(values) is values
    assert np.shares_memory(in_rows(values, 2, 2), values)


@pytest.mark.parametrize("kind", ["transposed", "read-only", "whole numbers", "every second"])
def test_other_arrays_are_packed_into_new_ones(kind: str) -> None:
    values = np.arange(12.0).reshape(4, 3)
    if kind == "transposed":
        values = values.T
    elif kind == "read-only":
        values.setflags(write=False)
    elif kind == "whole numbers":
        values = values.astype(int)
    else:
        values = values[::2]
    new = packed(values)
    assert new.flags.c_contiguous
    assert new.flags.writeable
    assert new.dtype == np.float64
    assert not np.shares_memory(new, values)
    np.testing.assert_array_equal(new, values)


def test_positive_systems_are_solved_as_numpy_solves_them() -> None:
    rng = np.random.default_rng(0)
    for n in (1, 3, 6):
        root, b = rng.normal(size=(n, n)), rng.normal(size=n)
        A = root @ root.T + 0.1 * np.eye(n)
        x = b.copy()
        assert solve_positive(A.copy(), x)
        np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-9)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_matrices_that_are_not_positive_are_refused(bad: float) -> None:
    A = np.diag([1.0, bad, 1.0])
    assert not solve_positive(A, np.ones(3))


def test_a_turn_is_that_of_the_exponential_series() -> None:
    rng = np.random.default_rng(1)
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for size in (0.0, 1e-12, 1e-4, 1.0, 3.0):
        w = rng.normal(size=3)
        w *= size / np.linalg.norm(w)
        W = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        series, term = np.eye(3), np.eye(3)
        for k in range(1, 30):
            term = term @ W / k
            series = series + term
        turned = np.empty((3, 3))
        turn(w, R, turned)
        np.testing.assert_allclose(turned, series @ R, atol=1e-14)


def test_a_rotation_of_a_vector_turns_as_a_turn_does() -> None:
    rng = np.random.default_rng(4)
    for size in (0.0, 1e-9, 1e-4, 0.3, 3.0):
        w = size * rng.normal(size=3)
        R, turned = np.empty((2, 3, 3))
        rotation_of(w, R)
        turn(w, np.eye(3), turned)
        np.testing.assert_allclose(R, turned, atol=1e-15)


@pytest.mark.parametrize("n", [1, 3, 4, 6])
def test_eigenvalues_and_eigenvectors_make_up_the_matrix(n: int) -> None:
    rng = np.random.default_rng(n)
    for scales in (np.ones(n), 10.0 ** -np.arange(0, 2 * n, 2), np.r_[np.ones(n - 1), 0.0]):
        A = scales[:, None] * rng.normal(size=(n, n))
        A = A @ A.T
        values, vectors = np.empty(n), np.empty((n, n))
        eigen(A.copy(), values, vectors)
        np.testing.assert_allclose(np.sort(values), np.linalg.eigvalsh(A), atol=1e-14 * A.max())
        np.testing.assert_allclose(vectors.T @ vectors, np.eye(n), atol=1e-14)
        np.testing.assert_allclose(vectors * values @ vectors.T, A, atol=1e-14 * A.max())


def test_products_are_those_of_numpy() -> None:
    rng = np.random.default_rng(2)
    A, B, root = rng.normal(size=(2, 5)), rng.normal(size=(5, 3)), rng.normal(size=(5, 5))
    product, carried = np.empty((2, 3)), np.empty((2, 2))
    multiply(A, B, product)
    np.testing.assert_allclose(product, A @ B, rtol=1e-13)
    congruence(A, root @ root.T, carried)
    np.testing.assert_allclose(carried, A @ root @ root.T @ A.T, rtol=1e-12)


def test_where_nothing_can_be_kept_it_is_compiled_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object) -> None:
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr("numba.core.dispatcher.Dispatcher.enable_caching", refuse)

    @compiled()
    def double(value: float) -> float:
        return 2 * value

    assert double(1.5) == 3.0
