"""A study's folder: what is studied (`study.yaml`) and each run that is done (`runs.jsonl`).

Every finished run is one line, so a study that was killed goes on where it was. A line that was
torn by the kill is dropped and its run done again.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from diagrams.scenario import dump_yaml, parse_value
from diagrams.schema import ScenarioError

Record = dict[str, Any]

DESCRIPTION = "study.yaml"
RUNS = "runs.jsonl"
_RUN_COUNT = "runs"  # the one key of a description that may change
_NOTHING = object()


class StudyFolder:
    """The open folder of a study; a context manager, for one study at a time.

    Args:
        path: of the folder; made if it is not there.
        description: plain data that says what is studied; written to `study.yaml`. What is there
            already must be the same but for the key `runs`.

    Raises:
        ScenarioError: the folder cannot be made, is another study's, or in use.
        OSError: a file in it cannot be written.

    Attributes:
        records: the runs that are done, by variant and seed.
    """

    def __init__(self, path: Path, description: Mapping[str, Any]) -> None:
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ScenarioError(f"--out {path}: {error.strerror}") from error
        _require_same_study(path, description)
        self._file = (path / RUNS).open("ab+")
        try:
            self._lock(path)
            _write_atomically(path / DESCRIPTION, dump_yaml(dict(description)))
            self.records = self._read()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> StudyFolder:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def add(self, record: Record) -> None:
        """Notes a run that is done, with its `variant` and `seed`; it survives a kill."""
        try:
            self._file.write(json.dumps(record, allow_nan=False).encode() + b"\n")
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:  # it names no file itself
            raise OSError(error.errno, error.strerror, self._file.name) from error
        self.records[record["variant"], record["seed"]] = record

    def _lock(self, path: Path) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ScenarioError(f"--out {path}: a study is running in it") from error
        except OSError:  # a file system without locks
            pass

    def _read(self) -> dict[tuple[str, int], Record]:
        self._file.seek(0)
        content = self._file.read()
        whole = content.rfind(b"\n") + 1
        self._file.truncate(whole)
        records = {}
        for line in content[:whole].splitlines():
            try:
                record = json.loads(line)
                records[record["variant"], record["seed"]] = record
            except (ValueError, TypeError, KeyError):  # damaged: done again, and noted again
                continue
        return records


def _require_same_study(path: Path, description: Mapping[str, Any]) -> None:
    file = path / DESCRIPTION
    try:
        text = file.read_text()
    except FileNotFoundError:
        if (path / RUNS).exists():
            raise ScenarioError(f"--out {path}: holds {RUNS} without its {DESCRIPTION}") from None
        return
    try:
        there = parse_value(text)
    except ScenarioError as error:
        raise ScenarioError(f"--out {path}: {DESCRIPTION} is not YAML") from error
    here = parse_value(dump_yaml(dict(description)))  # as it reads once it is written
    if found := _difference(there, here, ""):
        raise ScenarioError(f"--out {path}: another study is there: {found}")


def _difference(there: Any, here: Any, key: str) -> str | None:
    """Returns what differs first between two pieces of plain data, None when nothing does."""
    if isinstance(there, Mapping) and isinstance(here, Mapping):
        for step in [*here, *(step for step in there if step not in here)]:
            if step == _RUN_COUNT and not key:
                continue
            within = f"{key}.{step}" if key else str(step)
            a, b = there.get(step, _NOTHING), here.get(step, _NOTHING)
            if found := _difference(a, b, within):
                return found
        return None
    if isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        for index, (a, b) in enumerate(zip(there, here, strict=True)):
            if found := _difference(a, b, f"{key}[{index}]"):
                return found
        return None
    if repr(there) == repr(here):  # tells 1 from 1.0 and true, and nan is nan
        return None
    words = ["nothing" if value is _NOTHING else repr(value) for value in (there, here)]
    return f"{key or 'it'} is {words[0]} there and {words[1]} here"


def _write_atomically(path: Path, text: str) -> None:
    """Writes a file that is, whatever happens, either the old one or the new one."""
    new = path.with_name(path.name + ".new")
    new.write_text(text)
    os.replace(new, path)
