"""Tables of what a scenario can choose by name: estimators, controllers, drivers of sensors.

A block of a scenario is a word or a mapping with the key `type`:

    estimator: kf
    estimator: {type: kf, gate: 12.0}
    estimator: {type: "my_package.filters:MyFilter", horizon: 3}

A name is looked up in the table; `module:Class` names anything that can be imported, so a new
algorithm is a new file and no edit here. The other keys are the constructor's keyword arguments; an
argument named `parameters` that is a dataclass is written flat. What the diagram provides (the
waypoints, the camera, ...) is handed to constructor arguments of that name.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import sys
import typing
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diagrams.schema import Place, check_keys, construct, convert, field_hints, to_plain
from systems.validation import nearest

_SIMPLE = (float, int, bool, str)


@dataclass(frozen=True)
class Choice:
    """A block, resolved: what to construct and the checked arguments.

    Attributes:
        type: the name in the scenario.
        target: the class.
        arguments: checked keyword arguments, the dataclass `parameters` as one.
        place: where the block stands.
    """

    type: str
    target: Any
    arguments: dict[str, Any]
    place: Place

    def build(self, **resources: Any) -> Any:
        """Constructs the block.

        Args:
            resources: what the diagram provides; each goes to the constructor's argument of that
                name, if it has one and the scenario does not give it.

        Raises:
            ScenarioError: the constructor refuses its arguments.
        """
        accepted = _constructor_hints(self.target)
        given = {k: v for k, v in resources.items() if k in accepted}
        return construct(self.target, given | self.arguments, self.place)

    def to_plain(self) -> Any:
        """Returns the block as plain data, defaults filled in."""
        plain: dict[str, Any] = {"type": self.type}
        for key, value in self.arguments.items():
            plain |= to_plain(value) if key == "parameters" else {key: to_plain(value)}
        return plain


@dataclass(frozen=True)
class Table:
    """What can be chosen for one kind of block.

    Attributes:
        kind: what it is, for messages: "estimator".
        entries: name to "module:Class".
        resources: names of constructor arguments that the diagram provides.
    """

    kind: str
    entries: Mapping[str, str]
    resources: frozenset[str] = frozenset()

    def convert(self, value: Any, place: Place) -> Choice:
        """Resolves a block (see the module's docstring).

        Raises:
            ScenarioError: an unknown name or key, a class that cannot be imported, a value of the
                wrong type, an argument that is missing.
        """
        if isinstance(value, str):
            value = {"type": value}
        if not isinstance(value, Mapping) or not isinstance(value.get("type"), str):
            raise place.expected(value, f"the name of a {self.kind} or a mapping with 'type'")
        name = value["type"]
        target = self.target(name, place)
        keys = {key: v for key, v in value.items() if key != "type"}
        hints = _constructor_hints(target)
        parameters = _dataclass_of(hints.get("parameters"))
        flat = field_hints(parameters) if parameters else {}
        direct = {k: h for k, h in hints.items() if k != "parameters" and _is_plain(h)}
        check_keys(keys, {"type": str} | flat | direct, place)
        arguments = {k: convert(keys[k], h, place / k) for k, h in direct.items() if k in keys}
        if parameters:
            arguments["parameters"] = convert(
                {k: v for k, v in keys.items() if k in flat}, parameters, place
            )
        for key, default in _constructor_defaults(target).items():
            if key in arguments or key in self.resources:
                continue
            if default is inspect.Parameter.empty:
                raise place.error(f"{place}: {name} lacks the key {key!r}")
            if key in direct:
                arguments[key] = default
        return Choice(name, target, arguments, place)

    def target(self, name: str, place: Place) -> Any:
        """Returns the class of that name, imported (see `convert` for the errors)."""
        path = self.entries.get(name, name)
        if ":" not in path:
            hint = nearest(name, self.entries)
            raise place.error(
                f"{place} is {name!r}: no such {self.kind}; {hint} (or 'module:Class')"
            )
        module_name, class_name = path.split(":", 1)
        try:
            with _importable_from(place.folders):
                module = importlib.import_module(module_name)
        except Exception as error:  # whatever a user's module raises while it is imported
            raise place.error(
                f"{place} is {name!r}: cannot import {module_name}: {type(error).__name__}: {error}"
            ) from error
        if not hasattr(module, class_name):
            names = [n for n, v in vars(module).items() if inspect.isclass(v)]
            raise place.error(
                f"{place} is {name!r}: {module_name} has no {class_name!r}; "
                f"{nearest(class_name, names)}"
            )
        return getattr(module, class_name)


@contextmanager
def _importable_from(folders: Iterable[Path]) -> Iterator[None]:
    """Lets a user's module lie beside the scenario that names it."""
    before = list(sys.path)
    sys.path += [str(folder.resolve()) for folder in folders]
    try:
        yield
    finally:
        sys.path[:] = before


def _constructor(target: Any) -> Any:
    # Drake's scalar-generic systems are constructed by _construct.
    return getattr(target, "_construct", target.__init__)


def _constructor_hints(target: Any) -> dict[str, Any]:
    if dataclasses.is_dataclass(target):
        return field_hints(typing.cast(type, target))
    function = _constructor(target)
    try:
        hints = typing.get_type_hints(function, include_extras=True)
    except NameError:  # a hint that exists only for type checkers
        hints = {}
    names = inspect.signature(function).parameters
    return {name: hints.get(name, Any) for name in names if name not in ("self", "converter")}


def _constructor_defaults(target: Any) -> dict[str, Any]:
    if dataclasses.is_dataclass(target):
        return {
            f.name: f.default_factory()
            if f.default_factory is not dataclasses.MISSING
            else inspect.Parameter.empty
            if f.default is dataclasses.MISSING
            else f.default
            for f in dataclasses.fields(target)
        }
    return {
        name: parameter.default
        for name, parameter in inspect.signature(_constructor(target)).parameters.items()
        if name not in ("self", "converter")
        and parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
    }


def _dataclass_of(hint: Any) -> type | None:
    """Returns the dataclass in `D` or `D | None`."""
    for candidate in (hint, *typing.get_args(hint)):
        if dataclasses.is_dataclass(candidate):
            return typing.cast(type, candidate)
    return None


def _is_plain(hint: Any) -> bool:
    """Whether a scenario can write a value of this type."""
    if hint in _SIMPLE or hint is Any or dataclasses.is_dataclass(hint):
        return True
    if typing.get_origin(hint) is typing.Literal:
        return True
    arguments = [a for a in typing.get_args(hint) if a is not type(None)]
    if typing.get_origin(hint) is typing.Annotated:
        return True
    return bool(arguments) and all(_is_plain(a) for a in arguments)
