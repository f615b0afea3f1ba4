"""Sensors that fail under a robot on a shell: it goes on, says less surely, and counts them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from diagrams.run import Run
from diagrams.shell_metrics import ShellLog
from tests.diagrams.snailbot_runs import FAR, at, deviations, errors, fault, log_of, run

Array = NDArray[np.float64]

START, LASTED = 1.7, 1.2  # s: after the second marker; the third is in it
END = START + LASTED
DURATION = f"duration={END + 0.1:g}"


def failing(signal: str, kind: str) -> Run:
    return run(FAR, DURATION, fault(signal, kind, START, LASTED))


def check_finite(log: ShellLog) -> None:
    for values in (log.R_estimate, log.p_estimate, log.covariance):
        assert np.isfinite(values).all()
    assert np.linalg.eigvalsh(log.covariance).min() > -1e-12


def within(log: ShellLog, sigmas: float) -> bool:
    """Whether each axis' error from the fault on is within so many of the filter's deviations."""
    late = slice(at(log, START), None)
    variance = np.diagonal(log.covariance[late, :3, :3], axis1=1, axis2=2)
    return bool((np.abs(log.errors()[late]) < sigmas * np.degrees(np.sqrt(variance))).all())


@pytest.fixture(scope="module")
def sound() -> Run:
    """The same drive when nothing fails."""
    return run(FAR, DURATION)


def test_without_a_fault_the_third_marker_makes_it_surer(sound: Run) -> None:
    log = log_of(sound)
    said = deviations(log)
    assert said[at(log, END)] < 0.9 * said[at(log, 2.6)]


# --- The camera ---


# What a picture's markers are lost as, and what counts them.
@pytest.mark.parametrize(
    ("kind", "reasons"),
    [
        ("unknown_ids", ["unknown_id"]),
        ("nan", ["bad_corners"]),
        ("garbled", ["bad_corners", "too_small", "inconsistent"]),
    ],
)
def test_without_markers_it_goes_on_less_surely(sound: Run, kind: str, reasons: list[str]) -> None:
    finished = failing("camera.detections", kind)
    log = log_of(finished)
    check_finite(log)
    said, otherwise = deviations(log), deviations(log_of(sound))
    # It grows all the while by what flow and gyro lose, instead of falling at the third marker.
    assert (np.diff(said[at(log, START + 0.1) : at(log, END) : 10]) > 0).all()
    assert said[at(log, END)] > 1.12 * said[at(log, START)]
    assert said[at(log, END)] > 1.2 * otherwise[at(log, END)]
    assert errors(log)[at(log, START) :].max() < 2.0
    assert within(log, 3.0)
    counts = [each.report["health"]["estimator"]["accepted"] for each in (sound, finished)]
    lost = counts[0] - counts[1]
    assert lost >= 4
    assert sum(finished.report["health"]["marker_pose"][reason] for reason in reasons) >= lost


def test_a_quarter_of_the_routine_without_a_marker() -> None:
    # One iteration, twice half around the sphere and the turns, takes some 20 s: 5 s of it.
    quiet = fault("camera.detections", "silent", START, 5.0)
    log = log_of(run(FAR, f"duration={START + 5:g}", quiet, "seed=2"))
    check_finite(log)
    dark = slice(at(log, START + 0.1), None)
    assert not log.visible[dark].any()
    begin, end = log.p[dark][0], log.p[-1]
    cosine = begin @ end / np.linalg.norm(begin) / np.linalg.norm(end)
    assert np.degrees(np.arccos(cosine)) > 90  # past three markers, over the pole, unseen
    assert errors(log)[dark].max() < 2.0
    assert within(log, 3.0)
    said = deviations(log)[dark]
    assert said[-1] > 1.3 * said[0]


def test_a_marker_that_seems_to_go_along_is_refused_or_hardly_believed() -> None:
    # Frozen while one is in view: it stays where it was in the picture, under new stamps.
    finished = run(FAR, "duration=2.6", fault("camera.detections", "frozen", 1.45, 1.0))
    log = log_of(finished)
    check_finite(log)
    assert finished.report["health"]["estimator"]["gated"] > 20
    assert errors(log)[at(log, 1.45) :].max() < 3.0


def test_a_camera_that_hangs_is_found_out() -> None:
    # Drawn: the same picture again and again, for the flow and for the detector.
    finished = run(FAR, "sight=drawn", "duration=1.1", fault("camera.image", "frozen", 0.5, 0.5))
    log = log_of(finished)
    check_finite(log)
    assert finished.report["health"]["robot.camera.flow"]["frozen"] >= 28  # of 30
    said = deviations(log)
    assert said[at(log, 1.0)] > 1.1 * said[at(log, 0.5)]
    assert errors(log)[-1] < 2.0
    # And then it goes on with the flow.
    counts = finished.report["health"]["estimator"]
    assert counts["flow_accepted"] > 60 * 0.6 - 8


def test_without_pictures_the_gyro_carries_on() -> None:
    both = [fault(f"camera.{name}", "silent", START, LASTED) for name in ("detections", "matches")]
    joined = both[0].removesuffix("]") + ", " + both[1].removeprefix("robot.faults=[")
    finished = run(FAR, DURATION, joined)
    log = log_of(finished)
    check_finite(log)
    said = deviations(log)
    assert said[at(log, END)] > 1.2 * said[at(log, START)]
    assert errors(log)[at(log, START) :].max() < 3.0
    assert within(log, 3.0)
    accepted = finished.report["health"]["estimator"]["flow_accepted"]
    assert accepted == pytest.approx(60 * (END + 0.1 - LASTED), abs=8)


def test_a_flow_of_rubbish_is_dropped() -> None:
    finished = run(FAR, "duration=1.5", fault("camera.matches", "garbled", 0.6, 0.8))
    log = log_of(finished)
    check_finite(log)
    health = finished.report["health"]
    assert sum(health["sphere_flow"].values()) + health["estimator"]["flow_gated"] > 40
    assert errors(log)[10:].max() < 2.0


# --- The inertial sensor ---


@pytest.mark.parametrize(
    ("kind", "lasted"),
    [("frozen", 2.0), ("nan", 0.5), ("garbled", 0.5)],
)
def test_without_a_gyro_the_pictures_carry_on(kind: str, lasted: float) -> None:
    end = START + lasted
    finished = run(FAR, f"duration={end + 0.2:g}", fault("imu.sample", kind, START, lasted))
    log = log_of(finished)
    check_finite(log)
    # A gyro that is stuck is found out after 50 ms; rubbish may be a small number now and then.
    assert finished.report["health"]["estimator"]["bad_imu"] >= 0.9 * 300 * (lasted - 0.05)
    said = deviations(log)
    # It does not know how it turns between a picture and now.
    assert said[at(log, START + 0.3)] > 2 * said[at(log, START)]
    assert said[at(log, end - 0.1)] > 2 * said[at(log, START)]
    assert said[-1] < said[at(log, end - 0.1)] / 2  # and when it does again
    assert errors(log)[at(log, START) :].max() < 3.0
    assert within(log, 3.0)


@pytest.mark.parametrize(
    ("signal", "block", "reason"),
    [
        ("imu.sample", "estimator", "bad_imu"),
        ("camera.detections", "marker_pose", "bad_corners"),
    ],
)
def test_the_rule_lives_through_it_too(signal: str, block: str, reason: str) -> None:
    finished = run(FAR, "duration=1.8", "estimator=rule", fault(signal, "nan", 1.1, 0.6))
    log = log_of(finished)
    check_finite(log)
    assert errors(log)[10:].max() < 5.0
    assert finished.report["health"][block][reason] >= 5
