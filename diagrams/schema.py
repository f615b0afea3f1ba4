"""Checks plain data against dataclasses: every complaint names the place, the value, the remedy.

Scenario files become dataclasses here. The checks come before any constructor runs, so that a
wrong key or type is reported with its path in the file and the nearest valid key (the errors of
Drake's `yaml_load_typed` name no path, and it takes no raw blocks).
"""

from __future__ import annotations

import dataclasses
import re
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from systems.validation import nearest

Key = tuple[str | int, ...]

OVERRIDE = "--set "  # begins the origin of what no file says


class ScenarioError(ValueError):
    """Bad input: one line that says what, where and what is allowed."""


@dataclass(frozen=True)
class File:
    """Marks a string as the name of a file: `Annotated[str, File("maps")]`.

    Attributes:
        folder: the folder of bundled files that a bare name is also looked for in.
    """

    folder: str


@dataclass(frozen=True)
class Existing:
    """Marks a string as the path of a file or folder that is there; it becomes absolute."""

    def convert(self, value: Any, place: Place) -> str:
        """Returns the absolute path.

        Raises:
            ScenarioError: there is nothing at the path.
        """
        name = convert(value, str, place)
        for folder in place.search_path():
            if (folder / name).exists():
                return str((folder / name).resolve())
        raise place.error(f"{place} is {name!r}: there is no such file or folder")


@dataclass(frozen=True)
class Place:
    """A place in a scenario: its key path, where each key was written, where files are looked for.

    Attributes:
        key: the path from the top.
        origins: key path to "file:line" or "--set KEY".
        folders: folders of the scenario files, the last layer's first.
    """

    key: Key = ()
    origins: Mapping[Key, str] = dataclasses.field(default_factory=dict)
    folders: tuple[Path, ...] = ()

    def __truediv__(self, step: str | int) -> Place:
        return dataclasses.replace(self, key=(*self.key, step))

    def __str__(self) -> str:
        text = ""
        for step in self.key:
            text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
        return text or "the scenario"

    def origin(self) -> str:
        """Returns where this place, or what it stands in, was written; "" when nobody wrote it."""
        for depth in range(len(self.key), -1, -1):
            if origin := self.origins.get(self.key[:depth]):
                return origin
        return ""

    def search_path(self) -> tuple[Path, ...]:
        """Returns the folders that a relative path written here may start from.

        In a file that is the file's folder, not whatever folder the command is run in.
        """
        here = () if self.folders and not self.origin().startswith(OVERRIDE) else (Path(),)
        return (*here, *self.folders)

    def error(self, message: str) -> ScenarioError:
        """Returns the error, with the origin of this place before it."""
        origin = self.origin()
        return ScenarioError(f"{origin}: {message}" if origin else message)

    def expected(self, value: Any, allowed: str) -> ScenarioError:
        """Returns the error of a value that is not what is `allowed`."""
        return self.error(f"{self} is {value!r}: must be {allowed}")


class Implied(str):
    """The word that a mapping was laid over: a block keeps it as its type, all else forgets it."""


def bundled_folder(name: str) -> Path:
    """Returns the folder of bundled files of that name (in a clone and in a wheel alike)."""
    return Path(__file__).resolve().parent / name


def convert(value: Any, hint: Any, place: Place) -> Any:
    """Returns `value` as the type that `hint` describes.

    Args:
        value: plain data: mappings, lists, strings, numbers, booleans, None.
        hint: dataclass, list[X], dict[str, X], Literal, X | None, X | Y, float, int, bool, str,
            Any, or Annotated with `File` or with an object that has a method
            `convert(value, place)`.
        place: where the value stands.

    Raises:
        ScenarioError: an unknown or missing key, a wrong type, a value that the dataclass refuses,
            a file that is not there.
    """
    origin = typing.get_origin(hint)
    if origin is typing.Annotated:
        return _annotated(value, hint, place)
    if hint is Any:
        return value
    if origin is Literal:
        choices = typing.get_args(hint)
        if value not in choices:
            raise place.expected(value, "one of " + ", ".join(map(str, choices)))
        return value
    if origin in (typing.Union, types.UnionType):
        return _union(value, typing.get_args(hint), place)
    if origin is list:
        if not isinstance(value, list):
            raise place.expected(value, "a list")
        (item,) = typing.get_args(hint)
        return [convert(v, item, place / i) for i, v in enumerate(value)]
    if origin is dict:
        if not isinstance(value, Mapping):
            raise place.expected(value, "a mapping")
        return {k: convert(v, typing.get_args(hint)[1], place / str(k)) for k, v in value.items()}
    if dataclasses.is_dataclass(hint):
        return _dataclass(value, typing.cast(type, hint), place)
    return _scalar(value, hint, place)


def _scalar(value: Any, hint: Any, place: Place) -> Any:
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if hint is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if hint in (bool, str) and isinstance(value, hint):
        return value
    names = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}
    raise place.expected(value, names.get(hint, str(hint)))


def _union(value: Any, hints: tuple[Any, ...], place: Place) -> Any:
    if value is None and type(None) in hints:
        return None
    hints = tuple(h for h in hints if h is not type(None))
    for hint in hints[:-1]:
        # A mapping can only be the dataclass, a list only the list: errors then speak of that one.
        core = typing.get_args(hint)[0] if typing.get_origin(hint) is typing.Annotated else hint
        is_mapping = dataclasses.is_dataclass(core) or typing.get_origin(core) is dict
        is_list = typing.get_origin(core) is list
        if is_mapping == isinstance(value, Mapping) and is_list == isinstance(value, list):
            return convert(value, hint, place)
    return convert(value, hints[-1], place)


def _annotated(value: Any, hint: Any, place: Place) -> Any:
    core, *notes = typing.get_args(hint)
    for note in notes:
        if isinstance(note, File):
            return _file(convert(value, core, place), note, place)
        if hasattr(note, "convert"):
            return note.convert(value, place)
    return convert(value, core, place)


def _file(name: str, note: File, place: Place) -> str:
    """Returns a bundled file's bare name, or another file's absolute path."""
    folders = place.search_path()
    for folder in folders:
        if (folder / name).is_file():
            return str((folder / name).resolve())
    bundled = bundled_folder(note.folder)
    if (bundled / name).is_file():
        return name
    have = sorted(path.name for path in bundled.iterdir())
    where = " or ".join(str(folder) for folder in folders)
    raise place.error(f"{place} is {name!r}: no such file in {where}; bundled: {', '.join(have)}")


def file_path(name: str, folder: str) -> Path:
    """Returns the path of a file that `convert` has found: bundled in `folder`, or anywhere."""
    bundled = bundled_folder(folder) / name
    return bundled if bundled.is_file() else Path(name)


def _dataclass(value: Any, cls: type, place: Place) -> Any:
    hints = field_hints(cls)
    if not isinstance(value, Mapping):
        raise place.expected(value, "a mapping with " + ", ".join(hints))
    value = {key: v for key, v in value.items() if not isinstance(v, Implied)}
    check_keys(value, hints, place)
    arguments = {key: convert(v, hints[key], place / key) for key, v in value.items()}
    for field in dataclasses.fields(cls):
        required = (
            field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        )
        if required and field.name not in arguments:
            raise place.error(f"{place} lacks the key {field.name!r}")
    return construct(cls, arguments, place)


def construct(target: Any, arguments: Mapping[str, Any], place: Place) -> Any:
    """Calls a constructor; a `ValueError` of its own gets the place in front.

    The message of such an error begins with the argument ("gate is -1", "waypoints[2] is ..."), so
    the place is that argument's.
    """
    try:
        return target(**arguments)
    except ScenarioError:
        raise
    except ValueError as error:
        name, *indices = re.findall(r"\w+", str(error).split(" ")[0]) or [""]
        within = name in arguments
        prefix = f"{place}{'.' if within else ': '}" if place.key else ""
        if within:
            place /= name
            for index in indices:
                place /= int(index) if index.isdigit() else index
        raise place.error(f"{prefix}{error}") from error


def field_hints(cls: type) -> dict[str, Any]:
    """Returns the type hints of a dataclass' fields, by name."""
    hints = typing.get_type_hints(cls, include_extras=True)
    return {f.name: hints[f.name] for f in dataclasses.fields(cls) if f.init}


def check_keys(value: Mapping[str, Any], known: Mapping[str, Any], place: Place) -> None:
    """Raises `ScenarioError` for a key that is not among the known ones."""
    for key in value:
        if key not in known:
            raise (place / str(key)).error(
                f"{place / str(key)}: unknown key; {nearest(str(key), known)}"
            )


def is_plain(value: Any) -> bool:
    """Whether a scenario file can hold a value."""
    if dataclasses.is_dataclass(value) or isinstance(value, Mapping):
        return True
    if isinstance(value, list | tuple):
        return all(map(is_plain, value))
    return value is None or isinstance(value, bool | int | float | str)


def to_plain(value: Any) -> Any:
    """Returns plain data that `convert` turns into `value` again."""
    if hasattr(value, "to_plain"):
        return value.to_plain()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): to_plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(v) for v in value]
    if isinstance(value, bool):
        return value
    for kind in (int, float, str):  # a YAML parser's own kinds of number and text too
        if isinstance(value, kind):
            return kind(value)
    return value
