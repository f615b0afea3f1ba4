"""The command line. Exit status: 0 fulfilled, 1 ran but failed, 2 bad input (in one line)."""

from __future__ import annotations

import argparse
import itertools
import json
import logging
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table as RichTable

from diagrams.map_command import add_arguments as add_map_arguments
from systems.validation import require

if TYPE_CHECKING:
    from diagrams.model_studies import ModelStudy
    from diagrams.study_report import TextTable

console = Console(highlight=False, soft_wrap=True, markup=False, emoji=False)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; returns the exit status."""
    parser = _parser()
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format="tagtrail: %(message)s")
    logging.getLogger("drake").setLevel(logging.WARNING)
    logging.getLogger("systems.compiled").setLevel(logging.INFO)  # why the first run waits
    try:
        return int(options.function(options))
    except ValueError as error:
        print(f"tagtrail: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except OSError as error:  # a file of the results that cannot be written
        print(f"tagtrail: {error.filename}: {error.strerror}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("tagtrail: interrupted", file=sys.stderr)
        return 1


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line; `--help` shows the usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="tagtrail", description="Robots that find their way by fiducial markers, in Drake."
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(
        name: str, function: Callable[[argparse.Namespace], int], text: str
    ) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text)
        sub.set_defaults(function=function)
        return sub

    command("list", _list, "list the bundled scenarios and studies of models")

    run = command("run", _run, "simulate one run, or play a recording back")
    run.add_argument("scenario", help="bundled name or path of a scenario file")
    run.add_argument("--seed", type=int, help="seed of all noise")
    run.add_argument("--duration", type=float, metavar="S", help="end by then, seconds")
    run.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="override a scenario's key"
    )
    run.add_argument("--out", type=Path, metavar="DIR", help="folder of the results [out/SCENARIO]")
    run.add_argument(
        "--realtime", type=float, default=0.0, metavar="RATE", help="at most this fast, 1 is real"
    )
    run.add_argument("--no-meshcat", action="store_true", help="neither show nor write a replay")
    run.add_argument("--play", metavar="RECORDING", help="sensors come from this recording")

    study = command("study", _study, "do many seeded runs, also of variants, and compare them")
    study.add_argument(
        "scenario", help="bundled name or path of a scenario file, or name of a study of models"
    )
    study.add_argument(
        "--runs", type=int, default=30, metavar="N", help="of each variant, seeds 0 to N-1 [30]"
    )
    study.add_argument("--workers", type=int, metavar="N", help="processes [one for each core]")
    study.add_argument(
        "--sweep",
        action="append",
        default=[],
        metavar="KEY=A,B,C",
        help="a variant for each value; several make all combinations",
    )
    study.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    study.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the results [out/study/SCENARIO]"
    )
    study.add_argument("--keep", action="store_true", help="keep each run's folder too")

    diagram = command("diagram", _diagram, "draw a scenario's block diagram")
    diagram.add_argument("scenario")
    diagram.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    diagram.add_argument("-o", "--out", type=Path, metavar="FILE", help="SVG [SCENARIO.svg]")

    markers = command("markers", _markers, "make printable sheets of a map's markers")
    markers.add_argument("map", help="marker map (JSON), a path or a bundled name")
    markers.add_argument("-o", "--out", type=Path, default=Path("markers.pdf"), metavar="FILE")
    markers.add_argument("--page", default="auto", help="A4, A3, letter or auto")

    add_map_arguments(command("map", _map, "map the tags of a recording"))

    detect = command("detect", _detect, "find markers in pictures, videos, recordings")
    detect.add_argument("source", type=Path, help="picture, folder, video or recording")
    detect.add_argument(
        "--family", required=True, help="marker family, 36h11 or DICT_4X4_50 for example"
    )
    detect.add_argument("--size", type=float, metavar="M", help="side of the black square, metres")
    detect.add_argument("--camera", type=Path, metavar="FILE", help="camera file")
    detect.add_argument("--out", type=Path, default=Path("out/detect"), metavar="DIR")
    route = command("route", _route, "make a drivable route from a map and a taught trajectory")
    route.add_argument("map", type=Path, help="marker map (JSON)")
    route.add_argument("trajectory", type=Path, help="TUM file, of the camera or of the robot")
    route.add_argument("--out", type=Path, default=Path("out/route.json"), metavar="FILE")
    route.add_argument(
        "--set", action="append", default=[], metavar="LIMIT=VALUE", help="change a limit"
    )
    route.add_argument(
        "--camera", type=Path, metavar="FILE", help="camera file [camera.yaml beside the map]"
    )
    route.add_argument(
        "--camera-ahead", type=float, default=0.0, metavar="M",
        help="how far the camera sits ahead of the robot's base_link, metres [0]",
    )  # fmt: skip
    route.add_argument(
        "--camera-height", type=float, default=0.2, metavar="M",
        help="its height above base_link, for a robot's trajectory, metres [0.2]",
    )  # fmt: skip
    ends = route.add_mutually_exclusive_group()
    ends.add_argument("--closed", action="store_true", default=None, help="refuse an open path")
    ends.add_argument("--open", action="store_false", dest="closed", help="do not close the path")
    return parser


def _list(_: argparse.Namespace) -> int:
    from diagrams.model_studies import STUDIES
    from diagrams.scenario import bundled_scenarios, read_layers

    bundled = bundled_scenarios()
    width = max(map(len, [*bundled, *STUDIES]))
    for name, path in bundled.items():
        console.print(f"{name:{width}}  {read_layers(path).data.get('description', '')}")
    for name, study in STUDIES.items():
        console.print(f"{name:{width}}  {study.description} (tagtrail study)")
    return 0


def _run(options: argparse.Namespace) -> int:
    from diagrams.run import simulate, start_meshcat
    from diagrams.scenario import load_scenario

    overrides = list(options.set)
    given = {key: getattr(options, key) for key in ("seed", "duration")}
    overrides += [f"{key}={value}" for key, value in given.items() if value is not None]
    if options.play is not None:
        overrides.append(f"recording={json.dumps(options.play)}")  # text, whatever YAML makes of it
    scenario = load_scenario(options.scenario, overrides)
    out = options.out or Path("out") / scenario.name
    meshcat = None if options.no_meshcat else start_meshcat()
    if meshcat is not None:
        console.print(f"Meshcat: {meshcat.web_url()}")
    with _progress() as progress:
        run = simulate(
            scenario, out=out, meshcat=meshcat, realtime=options.realtime, progress=progress
        )
    _print_report(run.report)
    console.print(f"results: {out}")
    if meshcat is not None:
        console.print(f"replay:  {out / 'replay.html'} (opens in a browser)")
    return 0 if run.succeeded else 1


def _study(options: argparse.Namespace) -> int:
    from diagrams.model_studies import STUDIES

    if options.scenario in STUDIES:
        return _model_study(options, STUDIES[options.scenario])
    return _scenario_study(options)


def _model_study(options: argparse.Namespace, study: ModelStudy) -> int:
    for key in ("sweep", "set", "keep"):
        if getattr(options, key):
            raise ValueError(f"--{key} is not for {options.scenario}, a study of models")
    require(options.runs >= 2, "--runs", options.runs, "2 or more")
    out = options.out or Path("out") / "study" / options.scenario
    out.mkdir(parents=True, exist_ok=True)
    findings = study.run(out, options.runs)
    _print_table(findings.table)
    for note in findings.notes:
        console.print(note)
    console.print(f"results: {out}")
    return 0


def _scenario_study(options: argparse.Namespace) -> int:
    from diagrams.study import load_study, run_study
    from diagrams.study_plots import plot_study
    from diagrams.study_report import summarize, text_tables, write_summary

    study = load_study(options.scenario, options.set, options.sweep)
    out = options.out or Path("out") / "study" / study.scenario
    with _progress(digits=0) as progress:
        records = run_study(
            study,
            runs=options.runs,
            out=out,
            workers=options.workers,
            keep=options.keep,
            progress=progress,
        )
    summary = summarize(study, records)
    write_summary(summary, out)
    plot_study(out / "summary.png", study, records)
    for table in text_tables(summary):
        _print_table(table)
    console.print(f"results: {out}")
    return 0


def _diagram(options: argparse.Namespace) -> int:
    from diagrams.draw import write_diagram
    from diagrams.scenario import load_scenario

    scenario = load_scenario(options.scenario, options.set)
    path = options.out or Path(f"{scenario.name}.svg")
    write_diagram(scenario.build().diagram, path)
    console.print(str(path))
    return 0


def _markers(options: argparse.Namespace) -> int:
    from diagrams.schema import ScenarioError, bundled_folder, file_path
    from systems.markers.layout import load_map
    from systems.markers.sheets import write_sheets

    path = file_path(options.map, "maps")
    if not path.exists():
        bundled = ", ".join(sorted(p.name for p in bundled_folder("maps").iterdir()))
        raise ScenarioError(f"marker map {path}: no such file; bundled: {bundled}")
    marker_map = load_map(path)
    write_sheets(marker_map, options.out, page=options.page)
    console.print(f"{options.out}: {len(marker_map)} markers; print at 100 %")
    return 0


def _detect(options: argparse.Namespace) -> int:
    from diagrams.detect import detect

    with _progress() as progress:
        summary = detect(
            options.source,
            family=options.family,
            size=options.size,
            camera=options.camera,
            out=options.out,
            progress=progress,
        )
    table = RichTable()
    for column in ("picture", "markers", "ids"):
        table.add_column(column, overflow="fold")
    for row in summary:
        table.add_row(*row)
    console.print(table)
    console.print(f"results: {options.out}")
    return 0


def _map(options: argparse.Namespace) -> int:
    from diagrams.map_command import run_map

    with _progress() as progress:
        return run_map(options, console, progress)


def _route(options: argparse.Namespace) -> int:
    from diagrams.route import Mounting, beside, make_route

    plan = make_route(
        options.map,
        options.trajectory,
        out=options.out,
        camera=options.camera,
        mounting=Mounting(options.camera_ahead, options.camera_height),
        closed=options.closed,
        changes=options.set,
    )
    kind = "closed" if plan.route.closed else "open"
    table = RichTable("what", "value", title=f"{kind} route of {plan.route.length:.2f} m")
    for key, value in plan.metrics().items():
        table.add_row(key, f"{value:.4g}")
    for name, share in plan.binds.items():
        table.add_row(f"{name} binds", f"{share:.0%} of the way")
    console.print(table)
    console.print(f"route:  {options.out}")
    console.print(f"report: {beside(options.out, '_report.json')}")
    console.print(f"figure: {beside(options.out, '.png')}")
    return 0


@contextmanager
def _progress(digits: int = 1) -> Iterator[Callable[[float, float], None]]:
    """Shows a progress bar; yields what is called with the amount done and the whole."""
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
        disable=not sys.stderr.isatty(),
    )
    with bar:
        task = bar.add_task("", total=None)

        def show(done: float, whole: float) -> None:
            known = math.isfinite(whole)
            text = f"{done:.{digits}f} / {whole:.{digits}f}" if known else f"{done:.0f}"
            bar.update(task, completed=done, total=whole if known else None, description=text)

        yield show


def _print_table(content: TextTable) -> None:
    table = RichTable(title=content.title)
    for column in content.header:
        table.add_column(column, overflow="fold")
    rows = iter(content.rows)
    for length in content.groups:
        for row in itertools.islice(rows, length):
            table.add_row(*row)
        table.add_section()
    console.print(table)


def _print_report(report: dict[str, object]) -> None:
    table = RichTable("what", "value", title=f"{report['scenario']}: {report['outcome']}")
    rows = {key: report[key] for key in ("seed", "sim_seconds", "real_time_factor")}
    metrics = report["metrics"]
    assert isinstance(metrics, dict)
    for key, value in (rows | metrics).items():
        table.add_row(key, f"{value:.4g}" if isinstance(value, float) else str(value))
    console.print(table)
