"""The statistics, tables and figure of a study, on records written by hand."""

from __future__ import annotations

import json
import math
import random
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.stats import binomtest

from diagrams.scenario import Layers
from diagrams.study import ERROR, Study, Variant
from diagrams.study_plots import axis_range, metric_label, plot_study, short_labels, varying_metrics
from diagrams.study_report import (
    distribution,
    markdown,
    metric_values,
    short_keys,
    summarize,
    text_tables,
    wilson_interval,
    write_summary,
)

# Statistics


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    # Newcombe, "Two-sided confidence intervals for the single proportion", Statistics in Medicine
    # 17 (1998), table I, method 3.
    [
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_intervals_are_those_of_the_literature(
    successes: int, trials: int, low: float, high: float
) -> None:
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=6e-5)
    # What counts as a success does not matter.
    assert wilson_interval(trials - successes, trials) == pytest.approx(
        (1 - high, 1 - low), abs=6e-5
    )


def test_wilson_intervals_are_scipys_and_hold_the_rate() -> None:
    for trials in (1, 2, 7, 30, 100, 1000):
        for successes in {0, 1, trials // 3, trials // 2, trials - 1, trials}:
            found = wilson_interval(successes, trials)
            peer = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
            assert found == pytest.approx((peer.low, peer.high), abs=1e-12)
            assert 0 <= found[0] <= successes / trials <= found[1] <= 1
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_quantiles_are_interpolated() -> None:
    values = [float(k) for k in range(11)]
    random.Random(3).shuffle(values)
    assert distribution(values) == {
        "n": 11, "mean": 5.0, "min": 0.0, "q10": 1.0, "median": 5.0, "q90": 9.0, "max": 10.0,
    }  # fmt: skip
    found = distribution([4.0, 1.0, 3.0, 2.0])
    # Position 0.1 (4 - 1) = 0.3 of the way from the first value to the second.
    assert [found[key] for key in ("q10", "median", "q90")] == pytest.approx([1.3, 2.5, 3.7])
    assert distribution([7.0])["q10"] == distribution([7.0])["q90"] == 7.0
    assert distribution([]) == {"n": 0} | dict.fromkeys(
        ("mean", "min", "q10", "median", "q90", "max")
    )


# Tables


def study(**sweep: list[Any]) -> Study:
    """A study of one swept key at most, in variants that nobody runs."""
    variants = [
        Variant(f"{key}={value}", {key: value}, Layers())
        for key, values in sweep.items()
        for value in values
    ]
    return Study("room", dict(sweep), variants or [Variant("room", {}, Layers())])


def run(variant: str, seed: int, outcome: str = "reached", **metrics: Any) -> dict[str, Any]:
    return {
        "variant": variant,
        "seed": seed,
        "outcome": outcome,
        "succeeded": outcome == "reached",
        "sim_seconds": 10.0,
        "wall_seconds": random.random(),
        "metrics": metrics,
        "health": {"estimator": {"gated": 2}},
    }


def failed(variant: str, seed: int, line: str) -> dict[str, Any]:
    return {
        "variant": variant,
        "seed": seed,
        "outcome": ERROR,
        "succeeded": False,
        "error": line,
    }


TWO = study(avoider=["sector", "dwa"])
RECORDS = [
    run("avoider=sector", 0, path_m=4.0, goal_s=8.0, contacts=0, total=5, word="x", flag=True),
    run("avoider=sector", 1, path_m=6.0, goal_s=9.0, contacts=0, total=5),
    run("avoider=sector", 2, "contact", path_m=1.0, goal_s=None, contacts=3, total=5),
    failed("avoider=sector", 3, "ValueError: a|b"),
    run("avoider=dwa", 0, path_m=5.0, goal_s=7.0, contacts=0, total=5),
    run("avoider=dwa", 1, "timeout", path_m=2.0, goal_s=None, contacts=0, total=5),
    run("avoider=dwa", 2, "timeout", path_m=3.0, goal_s=None, contacts=0, total=5),
    run("avoider=dwa", 3, "contact", path_m=0.0, goal_s=None, contacts=1, total=5),
]


def test_the_summary_counts_what_happened() -> None:
    summary = summarize(TWO, RECORDS)
    sector, dwa = summary["variants"]
    assert (sector["variant"], sector["values"]) == ("avoider=sector", {"avoider": "sector"})
    assert (sector["runs"], sector["successes"], sector["success_rate"]) == (4, 2, 0.5)
    assert sector["success_rate_95"] == list(wilson_interval(2, 4))
    assert list(dwa["outcomes"].items()) == [("timeout", 2), ("contact", 1), ("reached", 1)]
    assert sector["errors"] == [{"error": "ValueError: a|b", "seeds": [3]}]
    assert sector["health"] == {"estimator": {"gated": 6}}
    path = sector["metrics"]["path_m"]
    assert (path["successful"]["n"], path["successful"]["median"]) == (2, 5.0)
    assert (path["all"]["n"], path["all"]["median"], path["all"]["min"]) == (3, 4.0, 1.0)
    goal = dwa["metrics"]["goal_s"]
    assert (goal["successful"]["n"], goal["all"]["n"], goal["all"]["max"]) == (1, 1, 7.0)
    assert sector["metrics"]["contacts"]["all"]["max"] == 3.0
    # Words and truth values are no numbers; wall times are nobody's result.
    assert list(sector["metrics"]) == ["sim_seconds", "path_m", "goal_s", "contacts", "total"]
    assert "wall" not in json.dumps(summary)


def test_the_tables_say_so() -> None:
    outcomes, metrics, same, errors = text_tables(summarize(TWO, RECORDS))
    assert outcomes.header == ["avoider", "runs", "success % [95 %]", "outcomes", "errors"]
    assert outcomes.rows == [
        ["sector", "4", "50.0 [15.0, 85.0]", "reached 2, contact 1, error 1", "1"],
        ["dwa", "4", "25.0 [4.6, 69.9]", "timeout 2, contact 1, reached 1", "0"],
    ]
    assert metrics.header == ["metric", "avoider", "n", "successful runs", "n", "all runs"]
    assert metrics.rows == [
        ["path_m", "sector", "2", "5 [4.2, 5.8]", "3", "4 [1.6, 5.6]"],
        ["path_m", "dwa", "1", "5 [5, 5]", "4", "2.5 [0.6, 4.4]"],
        ["goal_s", "sector", "2", "8.5 [8.1, 8.9]", "", ""],  # all runs that have it succeeded
        ["goal_s", "dwa", "1", "7 [7, 7]", "", ""],
        ["contacts", "sector", "2", "0 [0, 0]", "3", "0 [0, 2.4]"],
        ["contacts", "dwa", "1", "0 [0, 0]", "4", "0 [0, 0.7]"],
    ]
    assert metrics.groups == [2, 2, 2]
    assert same.rows == [["sim_seconds", "10"], ["total", "5"]]
    assert errors.rows == [["sector", "ValueError: a|b", "3"]]


def test_tables_do_not_depend_on_the_order_of_the_records() -> None:
    wanted = text_tables(summarize(TWO, RECORDS))
    for seed in range(5):
        shuffled = list(RECORDS)
        random.Random(seed).shuffle(shuffled)
        assert text_tables(summarize(TWO, shuffled)) == wanted
        assert summarize(TWO, shuffled) == summarize(TWO, RECORDS)


def test_columns_that_would_be_empty_are_left_out() -> None:
    one = study()
    tables = text_tables(summarize(one, [run("room", k, path_m=float(k)) for k in range(3)]))
    assert tables[0].header[0] == "scenario"
    assert tables[1].header == ["metric", "n", "successful runs"]
    assert tables[1].rows == [["path_m", "3", "1 [0.2, 1.8]"]]


def test_a_study_of_nothing_but_errors_has_its_tables() -> None:
    one = study()
    outcomes, errors = text_tables(summarize(one, [failed("room", k, "no") for k in (0, 1, 2)]))
    assert outcomes.rows == [["room", "3", "0.0 [0.0, 56.1]", "error 3", "3"]]
    assert errors.rows == [["room", "no", "0, 1, 2"]]
    assert metric_values([failed("room", 0, "no")], succeeded_only=False) == {}


def test_markdown_is_as_wide_in_every_row(tmp_path: Path) -> None:
    text = markdown(text_tables(summarize(TWO, RECORDS)))
    assert "| sector | ValueError: a\\|b | 3 |" in text
    for block in text.split("\n\n")[1::2]:
        columns = {line.replace("\\|", "").count("|") for line in block.strip().splitlines()}
        assert len(columns) == 1, block
    write_summary(summarize(TWO, RECORDS), tmp_path)
    assert (tmp_path / "table.md").read_text() == text
    assert json.loads((tmp_path / "summary.json").read_text()) == summarize(TWO, RECORDS)


# Figure


def test_keys_are_shortened_to_what_tells_them_apart() -> None:
    assert short_keys(["robot.sensors.eye.rate", "robot.sensors.imu.rate", "avoider"]) == [
        "eye.rate", "imu.rate", "avoider",
    ]  # fmt: skip
    assert short_keys(["a.rate", "rate"]) == ["a.rate", "rate"]
    long = "x" * 50
    labels = short_labels(study(avoider=["sector", f"{long}:A"]))
    assert labels[0] == "avoider = sector"
    assert len(labels[1]) < 45
    assert labels[1].endswith(":A")
    # Cut short they would be one and the same.
    assert short_labels(study(avoider=[f"{long}y{long}", f"{long}z{long}"])) == [
        f"avoider={long}y{long}", f"avoider={long}z{long}",
    ]  # fmt: skip


def test_axes_have_units() -> None:
    assert metric_label("position_rmse_m") == "position rmse [m]"
    assert metric_label("heading_rmse_deg") == "heading rmse [degrees]"
    assert metric_label("time_to_goal_s") == "time to goal [s]"
    assert metric_label("integrated_jerk") == "integrated jerk [m²/s⁵]"
    assert metric_label("nees_mean") == "nees mean [-]"
    assert metric_label("m") == "m [-]"


def test_only_metrics_that_vary_are_drawn() -> None:
    values = [metric_values(RECORDS[:4], succeeded_only=False)]
    assert varying_metrics(values) == ["path_m", "goal_s", "contacts"]


def test_an_axis_shows_every_run() -> None:
    low, high, logarithmic = axis_range([1e-3, 2.0, 1e4])
    assert logarithmic
    assert 0 < low < 1e-3 < 1e4 < high < 1e5
    for values in ([0.0, 1e4], [-5.0, 1000.0], [1.0, 99.0], [3.0], [0.0, 0.0]):
        low, high, logarithmic = axis_range(values)
        assert low < min(values) <= max(values) < high
        assert not logarithmic


def random_records(of: Study, runs: int, seed: int) -> list[dict[str, Any]]:
    draw = random.Random(seed)
    return [
        run(
            variant.name,
            k,
            draw.choice(["reached", "reached", "timeout"]),
            path_m=draw.gauss(5, 1),
            nees=math.exp(draw.gauss(0, 4)),
            **{f"metric_{n}_s": draw.random() for n in range(14)},
        )
        for variant in of.variants
        for k in range(runs)
    ]


@pytest.mark.parametrize(
    ("of", "records"),
    [
        (TWO, RECORDS),
        (study(), [run("room", 0, path_m=1.0)]),
        (study(), [failed("room", 0, "no")]),
        (study(), [run("room", k, "timeout", path_m=float(k)) for k in range(3)]),
        (many := study(rate=list(range(12))), random_records(many, 40, 1)),
    ],
)
def test_the_figure_fits_its_study(
    of: Study, records: list[dict[str, Any]], tmp_path: Path
) -> None:
    path = tmp_path / "summary.png"
    plot_study(path, of, records)
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    height, width = image.shape
    assert width <= 1700
    assert 200 <= height <= 3000
    assert (image < 100).any()
    border = np.concatenate([image[:2].ravel(), image[-2:].ravel(), image[:, :2].ravel(),
                             image[:, -2:].ravel()])  # fmt: skip
    assert border.min() > 200  # nothing is cut off
    again = tmp_path / "again.png"
    plot_study(again, of, records[::-1])
    assert again.read_bytes() == path.read_bytes()


def test_successful_and_other_runs_differ_without_colour(tmp_path: Path) -> None:
    def drawn(outcome: str) -> np.ndarray:
        records = [run("room", k, "reached", path_m=float(k % 2)) for k in range(2)]
        records += [run("room", 2 + k, outcome, path_m=5.0 + k) for k in range(5)]
        plot_study(tmp_path / "x.png", study(), records)
        image = cv2.imread(str(tmp_path / "x.png"), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        return image

    assert not np.array_equal(drawn("timeout"), drawn("reached"))
