"""What a study found: success rates with their intervals, quantiles of every metric, as tables.

A run that raised counts as not successful, and in no metric. Wall times are left out, so the same
study gives the same summary on any machine.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from diagrams.study import ERROR, Study, value_text
from diagrams.study_folder import Record

_Z95 = 1.959963984540054  # two-sided 95 % quantile of the normal distribution


@dataclass(frozen=True)
class TextTable:
    """A table of words.

    Attributes:
        title: a line above it.
        header: one word a column.
        rows: as many words each.
        groups: lengths of the groups of rows that belong together.
    """

    title: str
    header: list[str]
    rows: list[list[str]]
    groups: list[int]


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Returns the 95 % score interval of a success rate.

    Unlike the usual p +- 2 sigma it is right for few trials and for rates of 0 and 1.
    Source: Wilson, "Probable inference, the law of succession, and statistical inference", JASA
    22 (1927); without continuity correction.
    """
    if trials == 0:
        return 0.0, 1.0
    p = successes / trials
    spread = _Z95**2 / trials
    middle = (p + spread / 2) / (1 + spread)
    half = math.sqrt(p * (1 - p) * spread + spread**2 / 4) / (1 + spread)
    # At a rate of 0 or 1 the bound is exact, but for rounding.
    low = 0.0 if successes == 0 else middle - half
    high = 1.0 if successes == trials else middle + half
    return low, high


def distribution(values: Sequence[float]) -> dict[str, float | int | None]:
    """Returns count, mean, range, median and the 10 and 90 % quantiles (linearly interpolated).

    The quantiles are NumPy's default, type 7 of Hyndman and Fan, "Sample quantiles in statistical
    packages", The American Statistician 50 (1996). All but the count are None without a value.
    """
    names = ("mean", "min", "q10", "median", "q90", "max")
    if len(values) == 0:
        return {"n": 0} | dict.fromkeys(names)
    x = np.asarray(values, dtype=float)
    quantiles = np.quantile(x, [0.0, 0.1, 0.5, 0.9, 1.0])
    found = map(float, (math.fsum(x) / len(x), *quantiles))
    return {"n": len(x)} | dict(zip(names, found, strict=True))


def metric_values(records: Iterable[Record], *, succeeded_only: bool) -> dict[str, list[float]]:
    """Returns the values of every numeric metric, in the order of the reports.

    Args:
        records: of runs.
        succeeded_only: leave the others out; else only those that raised are.
    """
    values: dict[str, list[float]] = {}
    for record in records:
        if record["outcome"] == ERROR:
            continue
        for name, value in run_metrics(record).items():
            counted = values.setdefault(name, [])
            if record["succeeded"] or not succeeded_only:
                counted.append(value)
    return values


def run_metrics(record: Record) -> dict[str, float]:
    """Returns the numbers that a run reports; null and words are none."""
    reported = {"sim_seconds": record.get("sim_seconds")} | record.get("metrics", {})
    return {
        name: value
        for name, value in reported.items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }


def by_variant(study: Study, records: Iterable[Record]) -> dict[str, list[Record]]:
    """Returns the records of each variant by seed, whatever order they come in."""
    sorted_records: dict[str, list[Record]] = {variant.name: [] for variant in study.variants}
    for record in sorted(records, key=lambda record: int(record["seed"])):
        sorted_records[record["variant"]].append(record)
    return sorted_records


def summarize(study: Study, records: Iterable[Record]) -> dict[str, Any]:
    """Returns what `summary.json` holds: by variant, success rate, outcomes, metrics, errors."""
    groups = by_variant(study, records)
    variants = [
        {"variant": v.name, "values": v.values} | _summary(groups[v.name]) for v in study.variants
    ]
    return {"scenario": study.scenario, "sweep": study.sweep, "variants": variants}


def _summary(records: Sequence[Record]) -> dict[str, Any]:
    successes = sum(record["succeeded"] for record in records)
    succeeded = metric_values(records, succeeded_only=True)
    ended = metric_values(records, succeeded_only=False)
    errors: dict[str, list[int]] = {}
    for record in records:
        if record["outcome"] == ERROR:
            errors.setdefault(record["error"], []).append(record["seed"])
    outcomes = Counter(record["outcome"] for record in records)
    return {
        "runs": len(records),
        "successes": successes,
        "success_rate": successes / len(records) if records else None,
        "success_rate_95": list(wilson_interval(successes, len(records))),
        "outcomes": dict(sorted(outcomes.items(), key=lambda item: (-item[1], item[0]))),
        "metrics": {
            name: {"successful": distribution(succeeded[name]), "all": distribution(ended[name])}
            for name in ended
        },
        "health": _health(records),
        "errors": [{"error": line, "seeds": seeds} for line, seeds in errors.items()],
    }


def _health(records: Iterable[Record]) -> dict[str, dict[str, int]]:
    """Returns what the blocks counted, summed over the runs."""
    total: dict[str, Counter[str]] = {}
    for record in records:
        for block, counts in record.get("health", {}).items():
            total.setdefault(block, Counter()).update(counts)
    return {block: dict(sorted(counts.items())) for block, counts in sorted(total.items())}


def short_keys(keys: Sequence[str]) -> list[str]:
    """Returns the shortest ends of dotted keys that tell them apart."""
    return [_short_key(key.split("."), keys) for key in keys]


def _short_key(steps: list[str], keys: Sequence[str]) -> str:
    ends = (".".join(steps[start:]) for start in range(len(steps) - 1, 0, -1))
    alone = (end for end in ends if sum(f".{key}".endswith(f".{end}") for key in keys) == 1)
    return next(alone, ".".join(steps))


def text_tables(summary: Mapping[str, Any]) -> list[TextTable]:
    """Returns the summary as tables: outcomes, metrics and, if there are any, errors."""
    keys = short_keys(list(summary["sweep"])) or ["scenario"]
    variants = summary["variants"]
    labels = [
        [value_text(value) for value in variant["values"].values()] or [variant["variant"]]
        for variant in variants
    ]
    tables = [_outcome_table(summary["scenario"], keys, labels, variants)]
    names = list(dict.fromkeys(name for variant in variants for name in variant["metrics"]))
    same = {name: value for name in names if (value := _same(name, variants)) is not None}
    if different := [name for name in names if name not in same]:
        tables.append(_metric_table(different, keys, labels, variants))
    if same:
        rows = [[name, f"{value:.4g}"] for name, value in same.items()]
        tables.append(TextTable("The same in every run", ["metric", "value"], rows, [len(rows)]))
    errors = [
        [*label, error["error"], ", ".join(map(str, error["seeds"]))]
        for label, variant in zip(labels, variants, strict=True)
        for error in variant["errors"]
    ]
    if errors:
        header = [*keys, "error", "seeds"]
        tables.append(TextTable("Runs that raised", header, errors, [len(errors)]))
    return tables


def _same(name: str, variants: Iterable[Mapping[str, Any]]) -> float | None:
    """Returns the value that a metric has in every run, None when it differs or is missing."""
    value = None
    for variant in variants:
        errors = variant["outcomes"].get(ERROR, 0)
        found = variant["metrics"].get(name, {}).get("all", {"n": 0})
        if found["n"] < variant["runs"] - errors:
            return None
        if found["n"] and (found["min"] != found["max"] or value not in (None, found["min"])):
            return None
        value = found["min"] if found["n"] else value
    return value


def _outcome_table(
    scenario: str, keys: list[str], labels: list[list[str]], variants: list[dict[str, Any]]
) -> TextTable:
    rows = []
    for label, variant in zip(labels, variants, strict=True):
        low, high = (100 * bound for bound in variant["success_rate_95"])
        outcomes = ", ".join(f"{word} {count}" for word, count in variant["outcomes"].items())
        rate = f"{100 * variant['success_rate']:.1f} [{low:.1f}, {high:.1f}]"
        errors = str(variant["outcomes"].get(ERROR, 0))
        rows.append([*label, str(variant["runs"]), rate, outcomes, errors])
    header = [*keys, "runs", "success % [95 %]", "outcomes", "errors"]
    return TextTable(f"Study of {scenario}", header, rows, [len(rows)])


def _metric_table(
    names: list[str], keys: list[str], labels: list[list[str]], variants: list[dict[str, Any]]
) -> TextTable:
    rows: list[list[str]] = []
    groups = []
    for name in names:
        before = len(rows)
        for label, variant in zip(labels, variants, strict=True):
            if found := variant["metrics"].get(name):
                good, ended = found["successful"], found["all"]
                # The same again where only successful runs have the metric.
                more = _cells(ended) if ended["n"] != good["n"] else ["", ""]
                rows.append([name, *(label if labels[1:] else []), *_cells(good), *more])
        groups.append(len(rows) - before)
    header = ["metric", *(keys if labels[1:] else []), "n", "successful runs", "n", "all runs"]
    if not any(row[-1] for row in rows):
        header, rows = header[:-2], [row[:-2] for row in rows]
    return TextTable("Metrics: median [10 %, 90 %]", header, rows, groups)


def _cells(found: Mapping[str, Any]) -> list[str]:
    if not found["n"]:
        return ["0", "-"]
    middle, low, high = (f"{found[name]:.4g}" for name in ("median", "q10", "q90"))
    return [str(found["n"]), f"{middle} [{low}, {high}]"]


def markdown(tables: Iterable[TextTable]) -> str:
    """Returns the tables as Markdown."""
    parts = []
    for table in tables:
        rows = [table.header, ["---"] * len(table.header), *table.rows]
        lines = ("| " + " | ".join(_escaped(cell) for cell in row) + " |" for row in rows)
        parts.append(f"{table.title}\n\n" + "\n".join(lines) + "\n")
    return "\n".join(parts)


def _escaped(cell: str) -> str:
    return cell.replace("\\", "\\\\").replace("|", "\\|")


def write_summary(summary: Mapping[str, Any], out: Path) -> None:
    """Writes `summary.json` and `table.md`."""
    (out / "summary.json").write_text(json.dumps(summary, indent=1, default=str) + "\n")
    (out / "table.md").write_text(markdown(text_tables(summary)))
