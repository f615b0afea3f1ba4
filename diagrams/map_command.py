"""The arguments of `tagtrail map`, and what it prints."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds them to the command's parser."""
    parser.add_argument(
        "recording",
        type=Path,
        help="ROS 1 bag, rosbag2 or MCAP with detections or pictures; video; folder of pictures",
    )
    parser.add_argument("--family", help="marker family [what the recording says, else 36h11]")
    parser.add_argument(
        "--size",
        action="append",
        default=[],
        metavar="M",
        help="side of the black square, metres; of single tags: --size ID=M",
    )
    parser.add_argument(
        "--anchor",
        type=int,
        action="append",
        metavar="ID",
        help="the tag that is the map's origin [the one seen most often]",
    )
    parser.add_argument(
        "--camera", type=Path, metavar="FILE", help="camera file [the recording's CameraInfo]"
    )
    parser.add_argument("--topic", help="of detections or pictures, if there are several")
    parser.add_argument(
        "--odometry", metavar="TOPIC", help="nav_msgs/Odometry of the body that smooths the way"
    )
    parser.add_argument(
        "--map", type=Path, metavar="FILE", help="known tags: they stay, new ones are added"
    )
    parser.add_argument(
        "--localize-only", action="store_true", help="with --map: add no tags, only the trajectory"
    )
    parser.add_argument(
        "--connected-only",
        action="store_true",
        help="leave out tags that no picture connects to the others, instead of refusing",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the results [out/map/RECORDING]"
    )
    parser.add_argument("--no-meshcat", action="store_true", help="write no replay")


def run_map(
    options: argparse.Namespace, console: Console, progress: Callable[[float, float], None]
) -> int:
    """Maps, prints the report; returns the exit status."""
    from diagrams.mapping import map_recording
    from diagrams.run import start_meshcat

    anchors = options.anchor or []
    if len(anchors) > 1:
        raise ValueError(f"--anchor: one tag, not {', '.join(map(str, anchors))}")
    size, own_sizes = sizes(options.size)
    known = options.map
    if known is None and size is None and not own_sizes and not anchors:
        known = taught_anchor(options.recording)
        if known is not None:
            console.print(f"the run's {known.name} says where its anchor is and how large tags are")
    out = options.out or Path("out") / "map" / options.recording.resolve().stem
    run = map_recording(
        options.recording,
        out=out,
        family=options.family,
        size=size,
        own_sizes=own_sizes,
        anchor=anchors[0] if anchors else None,
        camera=options.camera,
        topic=options.topic,
        odometry=options.odometry,
        known=known,
        localize_only=options.localize_only,
        connected_only=options.connected_only,
        meshcat=None if options.no_meshcat else start_meshcat(),
        progress=progress,
    )
    for note in run.observed.notes:
        console.print(note)
    _print(run.report, console)
    for reason in run.report["reasons"].values():
        console.print(f"refused: {reason}")
    console.print(f"results: {out}")
    if not options.no_meshcat:
        console.print(f"replay:  {out / 'replay.html'} (opens in a browser)")
    return 0 if run.succeeded else 1


def taught_anchor(recording: Path) -> Path | None:
    """Returns the marker map of the anchor that `tagtrail run teach` writes beside its recording.

    Args:
        recording: the folder `bag` of a run, or the run's own folder.
    """
    folder = recording if recording.is_dir() else recording.parent
    for place in (folder, folder.resolve().parent):
        if (place / "anchor.json").is_file():
            return place / "anchor.json"
    return None


def sizes(words: list[str]) -> tuple[float | None, dict[int, float]]:
    """Returns the usual size and those of single tags out of `M` and `ID=M`."""
    usual: list[float] = []
    own: dict[int, float] = {}
    for word in words:
        name, equals, value = word.rpartition("=")
        try:
            if equals:
                own[int(name)] = float(value)
            else:
                usual.append(float(value))
        except ValueError:
            raise ValueError(f"--size {word}: must be metres, or ID=metres") from None
    if len(usual) > 1:
        raise ValueError(f"--size: one for all, not {', '.join(f'{u:g}' for u in usual)}")
    return (usual[0] if usual else None), own


def _print(report: dict[str, Any], console: Console) -> None:
    table = Table("what", "value", title=f"{report['recording']}: {report['outcome']}")
    rows = dict(report["metrics"])
    rows["solve_seconds"] = report["solve_seconds"]
    rows["held"] = " ".join(map(str, report["map"]["held"][:12])) + (
        " ..." if len(report["map"]["held"]) > 12 else ""
    )
    rows["trajectory of"] = report["map"]["trajectory_of"]
    for where, counts in report["health"].items():
        for name, count in counts.items():
            if count:
                rows[f"dropped: {where}, {name}"] = count
    for key, value in rows.items():
        table.add_row(key, f"{value:.4g}" if isinstance(value, float) else str(value))
    console.print(table)
