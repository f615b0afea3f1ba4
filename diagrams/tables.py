"""Tables of what a scenario can choose by name: estimators, controllers, drivers of sensors.

A block of a scenario is a word or a mapping with the key `type`:

    estimator: kf
    estimator: {type: kf, gate: 12.0}
    estimator: {type: "my_package.filters:MyFilter", horizon: 3}

A name is looked up in the table; `module:Class` names anything that can be imported, so a new
algorithm is a new file and no edit here. The module may lie beside the scenario's file, or in a
folder named before it, relative to that file: `filters/my_module:Class`. The other keys are the
constructor's keyword arguments; an argument named `parameters` that is a dataclass is written flat.
What the diagram provides (the waypoints, ...) is handed to constructor arguments of that name.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.machinery
import inspect
import math
import sys
import typing
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from diagrams.schema import (
    Place,
    ScenarioError,
    check_keys,
    construct,
    convert,
    field_hints,
    is_plain,
    to_plain,
)
from systems.validation import nearest

_SIMPLE = (float, int, bool, str)


@dataclass(frozen=True)
class Choice:
    """A block, resolved: what to construct and the checked arguments.

    Attributes:
        type: the name in the scenario; of a module found beside it, with the absolute folder.
        target: the class.
        arguments: checked keyword arguments, the dataclass `parameters` as one.
        place: where the block stands.
    """

    type: str
    target: Any
    arguments: dict[str, Any]
    place: Place = dataclasses.field(compare=False, repr=False)

    def build(self, **resources: Any) -> Any:
        """Constructs the block.

        Args:
            resources: what the diagram provides; each goes to the constructor's argument of that
                name, if it has one and the scenario does not give it.

        Raises:
            ScenarioError: the constructor refuses its arguments, or raises anything else.
        """
        accepted = _constructor_hints(self.target)
        given = {k: v for k, v in resources.items() if k in accepted}
        try:
            return construct(self.target, given | self.arguments, self.place)
        except ScenarioError:
            raise
        except Exception as error:  # whatever a user's class raises
            raise self.place.error(
                f"{self.place}: {self.target.__name__} raises {type(error).__name__}: {error}"
            ) from error

    def has(self, name: str) -> bool:
        """Whether the class has a field, or anything else, of that name."""
        fields = getattr(self.target, "__dataclass_fields__", {})
        return hasattr(self.target, name) or name in fields

    def changed(self, **arguments: Any) -> Choice:
        """Returns the block with some arguments others than they are.

        Raises:
            ScenarioError: it has no such argument.
        """
        for name in arguments:
            if not self.has(name) and name not in _constructor_hints(self.target):
                raise ScenarioError(f"{self.place}: {self.type} has no {name}")
        return dataclasses.replace(self, arguments=self.arguments | arguments)

    def told(self, deviations: Mapping[str, float], argument: str = "parameters") -> Choice:
        """Returns the block, expecting errors at least so large where it is not told otherwise.

        Args:
            deviations: by name; those that the block has not got, and those that the scenario
                gives, are left as they are.
            argument: the dataclass among its arguments that has them.
        """
        kind = _dataclass_of(_constructor_hints(self.target).get(argument))
        if kind is None:
            return self
        expected = self.arguments.get(argument) or kind()
        key = self.place.key if argument == "parameters" else (*self.place.key, argument)
        wider = {
            name: deviation
            for name, deviation in deviations.items()
            if deviation > getattr(expected, name, math.inf)
            and (*key, name) not in self.place.origins
        }
        return self.changed(**{argument: dataclasses.replace(expected, **wider)}) if wider else self

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
        method: what every class of this kind has; it tells what cannot be one at all.
        optional: whether the word `none` leaves the block out.
    """

    kind: str
    entries: Mapping[str, str]
    resources: frozenset[str] = frozenset()
    method: str = "GetOutputPort"
    optional: bool = False

    def convert(self, value: Any, place: Place) -> Choice | None:
        """Resolves a block (see the module's docstring); None for one that is left out.

        Raises:
            ScenarioError: an unknown name or key, a class that cannot be imported, a value of the
                wrong type, an argument that is missing.
        """
        if self.optional and value in (None, "none", {"type": "none"}):
            return None
        name_place = place
        if isinstance(value, str):
            value = {"type": value}
        elif (*place.key, "type") in place.origins:
            name_place = place / "type"
        if not isinstance(value, Mapping) or not isinstance(value.get("type"), str):
            raise place.expected(value, f"a name (of the {self.kind}) or a mapping with 'type'")
        name, target = self.target(value["type"], name_place)
        keys = {key: v for key, v in value.items() if key != "type"}
        hints = _constructor_hints(target)
        parameters = _dataclass_of(hints.get("parameters"))
        flat = field_hints(parameters) if parameters else {}
        direct = {k: h for k, h in hints.items() if k != "parameters" and _is_plain_hint(h)}
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
                raise place.error(f"{place}: {target.__name__} lacks the key {key!r}")
            if key in direct and is_plain(default):
                arguments[key] = default
        in_order = {key: arguments[key] for key in hints if key in arguments}
        return Choice(name, target, in_order, place)

    def target(self, name: str, place: Place) -> tuple[str, Any]:
        """Returns a name as `Choice.type` has it and its class (see `convert` for the errors)."""
        path = self.entries.get(name, name)
        if ":" not in path:
            hint = nearest(name, [*self.entries, *["none"] * self.optional])
            raise place.error(
                f"{place} is {name!r}: no such {self.kind}; {hint} (or 'module:Class')"
            )
        location, class_name = path.rsplit(":", 1)
        try:
            module, folder = _import(location, place)
        except Exception as error:  # whatever a user's module raises while it is imported
            raise place.error(
                f"{place} is {name!r}: cannot import {location}: {type(error).__name__}: {error}"
            ) from error
        target = getattr(module, class_name, None)
        if target is None:
            names = [n for n, v in vars(module).items() if inspect.isclass(v)]
            raise place.error(
                f"{place} is {name!r}: {location} has no {class_name!r}; "
                f"{nearest(class_name, names)}"
            )
        if not inspect.isclass(target) or not hasattr(target, self.method):
            raise place.error(
                f"{place} is {name!r}: must be the {self.kind}'s class, with a method {self.method}"
            )
        try:
            _constructor_parameters(target)
        except ValueError as error:
            raise place.error(
                f"{place} is {name!r}: {class_name} has no constructor written in Python that says "
                "what its arguments are"
            ) from error
        if folder is not None and name not in self.entries:
            name = f"{folder}/{module.__name__}:{class_name}"
        return str(name), target


def _import(location: str, place: Place) -> tuple[ModuleType, Path | None]:
    """Imports `module` or `folder/module`; returns it and its folder, if beside the scenario.

    Raises:
        ImportError: the folder's module is hidden by another of the same name.
    """
    before, _, name = location.rpartition("/")
    folders = [(folder / before).resolve() for folder in place.search_path()]
    with _importable_from(folders):
        module = importlib.import_module(name)
    top = sys.modules[name.partition(".")[0]]
    for folder in folders:
        spec = importlib.machinery.PathFinder.find_spec(top.__name__, [str(folder)])
        if spec is not None and spec.origin == getattr(top, "__file__", None):
            return module, folder
        if before and spec is not None:
            raise ImportError(f"{top.__name__} was imported already, from another place: {top}")
    if before:
        raise ImportError(f"no {top.__name__} in {' or '.join(map(str, folders))}")
    return module, None


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


def _constructor_parameters(target: Any) -> dict[str, inspect.Parameter]:
    """Returns the constructor's arguments; raises `ValueError` for one that is not Python's."""
    return {
        name: parameter
        for name, parameter in inspect.signature(_constructor(target)).parameters.items()
        if name not in ("self", "converter")
        and parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
    }


def _constructor_hints(target: Any) -> dict[str, Any]:
    if dataclasses.is_dataclass(target):
        return field_hints(typing.cast(type, target))
    try:
        hints = typing.get_type_hints(_constructor(target), include_extras=True)
    except NameError:  # a hint that exists only for type checkers
        hints = {}
    return {name: hints.get(name, Any) for name in _constructor_parameters(target)}


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
    return {name: p.default for name, p in _constructor_parameters(target).items()}


def _dataclass_of(hint: Any) -> type | None:
    """Returns the dataclass in `D` or `D | None`."""
    for candidate in (hint, *typing.get_args(hint)):
        if dataclasses.is_dataclass(candidate):
            return typing.cast(type, candidate)
    return None


def _is_plain_hint(hint: Any) -> bool:
    """Whether a scenario can write a value of this type."""
    if hint in _SIMPLE or hint is Any or dataclasses.is_dataclass(hint):
        return True
    if typing.get_origin(hint) is typing.Literal:
        return True
    arguments = [a for a in typing.get_args(hint) if a is not type(None)]
    if typing.get_origin(hint) is typing.Annotated:
        return True
    return bool(arguments) and all(_is_plain_hint(a) for a in arguments)
