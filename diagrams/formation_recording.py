"""What of a formation goes into the recording beside what its station sends: the estimates."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import System
from pydrake.systems.primitives import MatrixGain, Multiplexer

from diagrams.channels import Signal, estimate_signal, planar_frames
from diagrams.mission import Wiring

Array = NDArray[np.float64]

RATE = 5.0  # Hz, of the estimates: moves take half a minute
_FASTEST = 200.0  # Hz, at which a recorder looks


def record_estimates(wiring: Wiring, names: Sequence[str]) -> None:
    """Records where the robots are believed to be, if there is an estimator.

    Each robot's `{name}.estimate` with its covariance, and all of them in /tf.

    Args:
        wiring: with the block `estimator`.
        names: of the robots.
    """
    if not wiring.has_block("estimator"):
        return
    n = len(names)
    joint = wiring.add(Multiplexer([3 * n, 9 * n * n]), "joint_estimate")
    for index, port in enumerate(("poses", "covariance")):
        wiring.builder.Connect(wiring.output(f"estimator.{port}"), joint.get_input_port(index))
    for k, name in enumerate(names):
        part = wiring.add(MatrixGain(part_of(k, n)), f"{name}_estimate")
        wiring.builder.Connect(joint.get_output_port(), part.get_input_port())
        wiring.record(f"{name}_estimate.y0", estimate_signal(name, rate=RATE))

    wiring.record(
        "estimator.poses",
        Signal(
            port="tf",
            topic="/tf",
            encode=planar_frames([f"{name}/base_link" for name in names]),
            decode=None,
            model=3 * n,
            rate=RATE,
            played=False,
        ),
    )


def look_rate(blocks: Iterable[System]) -> float:
    """Returns the least rate (Hz) of which the rates of all blocks are whole parts.

    A recorder that looks so often sees all messages when the blocks do, so that played back each
    sees what it saw; and it adds no steps to those that the blocks take, so that a recorded run is
    the same as one that is not. Rates of which there is no such one up to 200 Hz get 200 Hz.

    Args:
        blocks: those without a single period of discrete updates do not count.
    """
    common = Fraction(0)
    for block in blocks:
        timing = block.GetUniquePeriodicDiscreteUpdateAttribute()
        if timing is not None:
            rate = Fraction(1 / timing.period_sec()).limit_denominator(1000)
            both = math.lcm(common.numerator, rate.numerator)
            common = Fraction(both, math.gcd(common.denominator, rate.denominator)) or rate
    return min(float(common) or _FASTEST, _FASTEST)


def part_of(robot: int, robots: int) -> Array:
    """Returns the matrix from poses and covariance of all robots to those of one.

    Args:
        robot: which, from 0.
        robots: n, how many there are.

    Returns:
        (12, 3 n + 9 n n); both in rows, the poses before the covariance.
    """
    own = np.arange(3 * robot, 3 * robot + 3)
    rows, columns = np.meshgrid(own, own, indexing="ij")
    taken = np.concatenate([own, 3 * robots + (3 * robots * rows + columns).ravel()])
    return np.asarray(np.eye(3 * robots + 9 * robots**2)[taken])
