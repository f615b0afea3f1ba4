"""The formation's estimator: how exact, honest and fast; the bound of the same runs beside."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiscreteValues

from systems.estimators.formation_filter import FormationFilter
from tests.benchmarks.table import Row, show
from tests.formation_world import AROUND, CAMERA, FRONT_AND_REAR, FormationWorld, travel

SEEDS = range(20)
ONE_PICTURE = (math.radians(0.1), 0.01)
FOUR_PICTURES = (math.radians(0.1) / 2, 0.01 / 2)


def rows() -> Iterator[Row]:
    """Yields the measurements."""
    for name, cameras, lasting, limit in (
        ("four cameras, mean of 4 pictures", AROUND, FOUR_PICTURES, 0.3),
        ("front and rear, mean of 4 pictures", FRONT_AND_REAR, FOUR_PICTURES, math.nan),
        ("four cameras, 1 picture", AROUND, ONE_PICTURE, math.nan),
    ):
        yield from journey_rows(name, cameras, lasting, limit)
    yield from corner_rows()
    yield from speed_rows()


def journey_rows(
    name: str, cameras: np.ndarray, lasting: tuple[float, float], limit: float
) -> Iterator[Row]:
    """A hundred moves, 75 m, by bearings of 0.1 degree and distances of 1 % a picture."""
    worlds = [FormationWorld(seed=s, camera_yaws=cameras, lasting=lasting) for s in SEEDS]
    trips = [travel(world, world.estimator(), 100) for world in worlds]
    rms = math.sqrt(float(np.mean([e @ e for e in (trip.error[-1] for trip in trips)])))
    bounds = []
    for world in worlds[:3]:
        at = 3 * world.epochs[99 % 4]
        P = world.batch_covariance(use_range=True)
        bounds.append(math.sqrt(P[at, at] + P[at + 1, at + 1]))
    said = float(np.mean([trip.deviation[-1] for trip in trips]))
    nees = float(np.mean([trip.nees for trip in trips]))
    what = f"100 moves (75 m), {name}, {len(SEEDS)} runs"
    goal = not math.isnan(limit)
    yield Row(f"{what}: RMS at the end", f"{rms:.2f} m", f"<= {limit:g} m" if goal else "",
              rms <= limit if goal else None, f"the bound: {np.mean(bounds):.3f} m")  # fmt: skip
    yield Row(f"{what}: the filter's own deviation", f"{said:.3f} m")
    yield Row(f"{what}: NEES per dimension", f"{nees:.2f}", "0.8 to 1.25", 0.8 <= nees <= 1.25)
    nis = float(np.mean(np.concatenate([trip.nis for trip in trips])))
    yield Row(f"{what}: NIS", f"{nis:.2f}", "0.8 to 1.25", 0.8 <= nis <= 1.25)


def corner_rows() -> Iterator[Row]:
    """Forty moves by corners with 0.5 px of noise, five pictures a stop, front and rear."""
    for use_range in (True, False):
        destinations, nees = [], []
        for seed in range(10):
            world = FormationWorld(seed=seed, corner_noise=0.5)
            trip = travel(world, world.estimator(use_range=use_range), 40, frames=5)
            destinations.append(trip.destination[-1])
            nees.append(np.mean(trip.nees))
        rms = math.sqrt(float(np.mean(np.square(destinations))))
        name = "bearings and distances" if use_range else "bearings only"
        yield Row(f"40 moves, 0.5 px, {name}: destination error, RMS", f"{1e3 * rms:.0f} mm",
                  "<= 100 mm", rms <= 0.1, f"NEES per dimension {np.mean(nees):.2f}")  # fmt: skip


def speed_rows() -> Iterator[Row]:
    """Time of one update of the block with a new picture by every camera, one thread."""
    for robots, limit in ((4, 2.0), (20, 20.0)):
        for moving in (False, True):
            took = 1e3 * update_time(robots, moving)
            state = "one moves" if moving else "all stand"
            yield Row(f"one update, {robots} robots, {state}", f"{took:.2f} ms", f"<= {limit:g} ms",
                      took <= limit)  # fmt: skip


def update_time(robots: int, moving: bool) -> float:
    """Returns the time of an update, s: median over the least of three runs."""
    world = FormationWorld(robots=robots, seed=1, corner_noise=0.3)
    runs = []
    for _ in range(3):
        times: list[float] = []

        class Timed(FormationFilter):
            def _step(
                self,
                context: Context,
                discrete_state: DiscreteValues,
                times: list[float] = times,
            ) -> None:
                began = time.perf_counter()
                super()._step(context, discrete_state)
                times.append(time.perf_counter() - began)

        block = Timed(start_poses=world.nominal, camera=CAMERA, parameters=world.parameters())
        simulator = Simulator(block)
        context = simulator.get_mutable_context()
        flags = np.zeros(robots)
        flags[robots - 1] = moving
        block.moving_input_port().FixValue(context, flags)
        for tick in range(30):
            for k in range(robots):
                for c, name in enumerate(("front_camera", "rear_camera")):
                    found = world.detections(k, c, 0.1 * tick + 0.001)
                    block.detections_input_port(k, name).FixValue(context, found)
            simulator.AdvanceTo(0.1 * tick + 0.05)
        runs.append(times)
    return float(np.median(np.min(runs, axis=0)[5:]))


if __name__ == "__main__":
    show("Formation estimator", rows())
