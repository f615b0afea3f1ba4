"""Studies: many seeded runs of a scenario and its variants, in several processes.

Run k of every variant has the seed k, so two variants are compared on the same noise and the same
random arenas. What comes out does not depend on how many processes did it or in which order.
"""

from __future__ import annotations

import copy
import gc
import importlib.metadata
import itertools
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np

from diagrams.run import simulate
from diagrams.scenario import (
    Layers,
    check,
    find_scenario,
    parse_override,
    parse_value,
    read_layers,
    set_value,
)
from diagrams.schema import OVERRIDE, ScenarioError, to_plain
from diagrams.study_folder import Record, StudyFolder
from diagrams.workers import Died, available_cores, work
from systems.validation import require

ERROR = "error"  # the outcome of a run that raised

# A diagram leaves 3 MB behind, 28 MB if it renders (Drake 1.51), even when cycles are collected.
_RUNS_PER_WORKER = 10
_TRIED_SEEDS = 3  # one seed's random arena may be refused without the scenario being wrong


@dataclass(frozen=True)
class Variant:
    """One combination of the values that a study sweeps over.

    Attributes:
        name: "KEY=VALUE, KEY=VALUE"; the scenario's when nothing is swept.
        values: value by key.
        layers: the scenario as it was read, with overrides and values laid over it.
    """

    name: str
    values: dict[str, Any]
    layers: Layers

    def scenario(self, seed: int) -> Any:
        """Returns the checked scenario of one run (see `load_scenario` for the errors)."""
        layers = copy.deepcopy(self.layers)
        set_value(layers, "seed", seed)
        try:
            return check(layers)
        except ScenarioError as error:
            raise self._named(error) from error

    def _named(self, error: ValueError) -> ScenarioError:
        """Returns an error that speaks of `--sweep` where the value came from there."""
        line = str(error)
        for key in self.values:
            if line.startswith(f"{OVERRIDE}{key}"):
                line = "--sweep " + line.removeprefix(OVERRIDE)
                break
        return ScenarioError(line)

    def example(self) -> Any:
        """Returns the scenario of the first seed that there is one of.

        Raises:
            ScenarioError: it is refused for several seeds.
        """
        return self._first(lambda scenario: scenario)

    def try_out(self) -> None:
        """Wires the diagram once, since blocks refuse some values only then.

        Raises:
            ScenarioError: it is refused for several seeds.
        """

        def build(scenario: Any) -> None:
            try:
                scenario.build()
            except ValueError:
                raise
            except Exception:  # a run that raises is a result of the study
                return

        self._first(build)
        gc.collect()  # a diagram is in reference cycles

    def _first(self, function: Callable[[Any], Any]) -> Any:
        refusal: ScenarioError | None = None
        for seed in range(_TRIED_SEEDS):
            try:
                return function(self.scenario(seed))
            except ValueError as error:
                refusal = refusal or self._named(error)
        assert refusal is not None
        raise refusal


@dataclass(frozen=True)
class Study:
    """What is to be run.

    Attributes:
        scenario: its name.
        sweep: values by key.
        variants: all combinations, the last key's values changing fastest.
    """

    scenario: str
    sweep: dict[str, list[Any]]
    variants: list[Variant]

    def description(self, runs: int) -> dict[str, Any]:
        """Returns what two studies must have in common to share a folder, and how many runs."""
        return {
            "tagtrail": _version("tagtrail"),
            "drake": _version("drake"),
            "scenario": self.scenario,
            "runs": runs,
            "sweep": to_plain(self.sweep),
            "variants": {v.name: to_plain(v.example()) for v in self.variants},
        }


def load_study(name: str, overrides: Iterable[str] = (), sweeps: Iterable[str] = ()) -> Study:
    """Loads a scenario and all its variants, and checks them.

    Args:
        name: bundled name or path of the scenario.
        overrides: "KEY=VALUE", as `--set` takes them. One inside a block that is swept over
            (`avoider.gap=0.5` with `avoider=sector,dwa`) holds for every variant. A study's runs
            keep no recording, unless `record.bag=true` is among these.
        sweeps: "KEY=A,B,C"; several make the cross product. The values are YAML, so a comma in
            brackets or quotes separates none.

    Raises:
        ScenarioError: a line that says what, where and what is allowed.
    """
    given = [parse_override(text) for text in ("record.bag=false", *overrides)]
    sweep = _parse_sweeps(sweeps)
    for option, keys in (("--set", [key for key, _ in given]), ("--sweep", sweep)):
        if "seed" in keys:
            raise ScenarioError(f"{option} seed: the runs of a study have the seeds 0, 1, 2, ...")
    path = find_scenario(name)
    base = read_layers(path)
    base.data.setdefault("name", path.stem)
    variants = []
    for values in itertools.product(*sweep.values()):
        chosen = dict(zip(sweep, values, strict=True))
        layers = copy.deepcopy(base)
        for key, value in _in_order(given, chosen):
            set_value(layers, key, value)
        label = ", ".join(f"{key}={value_text(value)}" for key, value in chosen.items())
        variants.append(Variant(label or str(base.data["name"]), chosen, layers))
    study = Study(variants[0].example().name, sweep, variants)
    _require_different(study)
    return study


def run_study(
    study: Study,
    *,
    runs: int,
    out: Path,
    workers: int | None = None,
    keep: bool = False,
    progress: Callable[[float, float], None] | None = None,
) -> list[Record]:
    """Does the runs that the folder lacks.

    A run that raises, or kills its process, is recorded with the outcome `error`. Ctrl-C leaves
    what is done; so does a kill.

    Args:
        study: as `load_study` gives it.
        runs: of each variant; the seeds are 0 to runs - 1.
        out: folder of the study.
        workers: processes; None is one for each core.
        keep: keep each run's folder, `runs/VARIANT/SEED`.
        progress: called with how many runs are done and how many there are.

    Returns:
        The record of each run, by variant and seed: variant, seed, outcome, succeeded,
        sim_seconds, wall_seconds, metrics, health, or, of an `error`, its line.

    Raises:
        ValueError: bad input; nothing has been run.
    """
    require(runs >= 1, "--runs", runs, "1 or greater")
    require(workers is None or workers >= 1, "--workers", workers, "1 or greater")
    for variant in study.variants:
        recording = variant.example().record.bag
        require(keep or not recording, "record.bag", recording, "false without --keep")
        variant.try_out()
    with StudyFolder(out, study.description(runs)) as folder:
        wanted = [(variant, seed) for seed in range(runs) for variant in study.variants]
        tasks = [
            _Task(variant, seed, out / "runs" / slug(variant.name) / str(seed) if keep else None)
            for variant, seed in wanted
            if (variant.name, seed) not in folder.records
        ]
        if keep:
            for folder_of_variant in {task.out.parent for task in tasks if task.out}:
                folder_of_variant.mkdir(parents=True, exist_ok=True)
        done = len(wanted) - len(tasks)
        report = progress or (lambda *_: None)
        report(done, len(wanted))
        for task, result in work(
            _do, tasks, workers=workers or available_cores(), tasks_per_worker=_RUNS_PER_WORKER
        ):
            record = _error(str(result)) if isinstance(result, Died) else result
            folder.add({"variant": task.variant.name, "seed": task.seed} | record)
            done += 1
            report(done, len(wanted))
        return [folder.records[v.name, seed] for v in study.variants for seed in range(runs)]


def slug(name: str) -> str:
    """Returns a variant's name as the name of a folder; different names stay different."""
    return quote(name, safe="=[]+").replace("%2C%20", ",")


def value_text(value: Any) -> str:
    """Returns a value as a person writes it after `--set KEY=`."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{k}: {value_text(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(value_text, value)) + "]"
    return value if isinstance(value, str) else json.dumps(value, default=str)


@dataclass(frozen=True)
class _Task:
    variant: Variant
    seed: int
    out: Path | None


def _do(task: _Task) -> Record:
    """Does one run, in a worker process."""
    try:
        return _simulate(task)
    except ValueError as error:  # our own complaints
        return _error(str(error))
    except Exception as error:  # whatever a user's block raises
        return _error(f"{type(error).__name__}: {error}")
    finally:
        gc.collect()  # a diagram is in reference cycles, and Drake's memory is invisible to Python


def _simulate(task: _Task) -> Record:
    cv2.setNumThreads(1)
    run = simulate(task.variant.scenario(task.seed), out=task.out)
    keys = ("outcome", "sim_seconds", "wall_seconds", "metrics", "health")
    record = {key: run.report[key] for key in keys} | {"succeeded": run.succeeded}
    # What is not finite becomes null, as in a run's own report.
    return dict(json.loads(json.dumps(record, default=_number), parse_constant=lambda _: None))


def _number(value: Any) -> Any:
    """Returns a NumPy number, which a user's mission may count with, as Python's."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{value!r} in the report is no JSON")


def _error(line: str) -> Record:
    return {"outcome": ERROR, "succeeded": False, "error": " ".join(line.split())}


def _parse_sweeps(texts: Iterable[str]) -> dict[str, list[Any]]:
    sweep: dict[str, list[Any]] = {}
    for text in texts:
        key, equals, listed = (part.strip() for part in text.partition("="))
        if not equals or not key or not listed or listed.endswith(","):
            raise ScenarioError(f"--sweep {text}: must be KEY=A,B,C")
        try:
            values = parse_value(f"[{listed}]")
        except ScenarioError as error:
            raise ScenarioError(f"--sweep {text}: {listed!r} is no list of YAML values") from error
        if key in sweep:
            raise ScenarioError(f"--sweep {key}: given twice")
        labels = [value_text(value) for value in values]
        for label in labels:
            if labels.count(label) > 1:
                raise ScenarioError(f"--sweep {key}: has {label} twice")
        sweep[key] = values
    return sweep


def _in_order(given: list[tuple[str, Any]], chosen: Mapping[str, Any]) -> Iterable[tuple[str, Any]]:
    """Yields overrides so that none is lost: a block that changes its type starts anew."""
    inside = [item for item in given if any(item[0].startswith(f"{key}.") for key in chosen)]
    yield from (item for item in given if item not in inside)
    yield from sorted(chosen.items(), key=lambda item: item[0].count("."))
    yield from inside


def _require_different(study: Study) -> None:
    """Raises `ScenarioError` for two variants that are the same scenario: nothing is compared."""
    seen: dict[str, str] = {}
    for variant in study.variants:
        content = json.dumps(to_plain(variant.example()), default=str)
        if content in seen:
            raise ScenarioError(f"--sweep: {seen[content]} and {variant.name} are the same")
        seen[content] = variant.name


def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"  # run from a clone
