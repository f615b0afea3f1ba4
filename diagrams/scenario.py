"""Scenario files: found by name or path, layered, checked, saved with each run.

Later layers override earlier ones: the defaults of the dataclasses, the file that `extends` names,
the file, `--set KEY=VALUE`. Mappings are merged key by key; everything else is replaced. A block
whose `type` changes starts anew; a word overrides a block's type alone. A world that comes from the
seed is drawn when all layers are there (see `diagrams.random_world`).
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydrake.geometry import Meshcat
from ruamel.yaml import YAML, YAMLError

from diagrams.random_world import ROOM, RandomWorld, asks_for_random, draw_world, make_way
from diagrams.schema import (
    OVERRIDE,
    Existing,
    Implied,
    Key,
    Place,
    ScenarioError,
    bundled_folder,
    convert,
    field_hints,
    to_plain,
)
from diagrams.tables import Table
from systems.validation import nearest, require, require_positive

MISSIONS = Table(
    "mission",
    {
        "formation": "diagrams.formation:FormationScenario",
        "navigation": "diagrams.navigation:NavigationScenario",
        "replay": "diagrams.replay:ReplayScenario",
        "snailbot": "diagrams.snailbot:SnailBotScenario",
        "tag_frames": "diagrams.tag_frames:TagFramesScenario",
        "teach": "diagrams.teach:TeachScenario",
        "teach_replay": "diagrams.teach_replay:TeachReplayScenario",
    },
    method="build",
)


@dataclass
class RecordParameters:
    """What a run writes to its recording.

    Attributes:
        bag: write one at all.
        images: pictures too (PNG), not only what was detected in them.
    """

    bag: bool = True
    images: bool = False


@dataclass(kw_only=True)
class Scenario:
    """What every scenario has. A mission's own scenario class adds to it.

    Attributes:
        mission: name of the mission, or "module:Class" of its scenario class.
        name: of the scenario; its file's, unless given.
        description: one line for `tagtrail list`.
        seed: of all noise.
        duration: the run ends by then, s; of missions that go round, for each time.
        time_step: of the multibody plant, s.
        dynamics: `multibody` (wheels, contact, slip) or `kinematic` (the robots' kinematic twins).
        sight: what the cameras' detections come from: `rendered` pictures, pictures `drawn` without
            shadows (a run takes two thirds of the time), or markers `projected` from the true poses
            with pixel noise (hundreds of times faster than a picture).
        recording: a recording whose sensors are played back instead of simulated ones.
        record: what the run writes.
        random_world: which kind of world comes from the seed, of all scenarios of the class.
    """

    random_world: ClassVar[RandomWorld] = ROOM

    mission: str
    name: str = ""
    description: str = ""
    seed: int = 0
    duration: float = 60.0
    time_step: float = 0.005
    dynamics: Literal["multibody", "kinematic"] = "multibody"
    sight: Literal["rendered", "drawn", "projected"] = "rendered"
    recording: Annotated[str, Existing()] | None = None
    record: RecordParameters = field(default_factory=RecordParameters)

    def __post_init__(self) -> None:
        require(0 <= self.seed < 2**53, "seed", self.seed, "a whole number from 0 to 2^53 - 1")
        require_positive(duration=self.duration, time_step=self.time_step)

    @property
    def time_limit(self) -> float:
        """When the run ends at the latest, s."""
        return self.duration

    def prepared(
        self,
        *,
        meshcat: Meshcat | None = None,
        out: Path | None = None,
        progress: Callable[[float, float], None] | None = None,
    ) -> Self:
        """Does what has to be done before the run; returns the scenario that is then built.

        Args:
            meshcat: where it is shown, if anywhere.
            out: folder of the run; None writes nothing.
            progress: called with what is done and the whole, s.
        """
        del meshcat, out, progress
        return self

    @property
    def realtime_rate(self) -> float:
        """How many times real time the run is held to, unless it is told; 0: as fast as it goes."""
        return 0.0


@dataclass
class Layers:
    """Plain data with the origin of each key.

    Attributes:
        data: merged.
        origins: key path to "file:line" or "--set KEY".
        folders: folders of the files, the last layer's first.
    """

    data: dict[str, Any] = field(default_factory=dict)
    origins: dict[Key, str] = field(default_factory=dict)
    folders: list[Path] = field(default_factory=list)

    def place(self) -> Place:
        """Returns the place of the top."""
        return Place(origins=self.origins, folders=tuple(self.folders))


def bundled_scenarios() -> dict[str, Path]:
    """Returns the bundled scenario files by name."""
    return {path.stem: path for path in sorted(bundled_folder("scenarios").glob("*.yaml"))}


def find_scenario(name: str, folders: Iterable[Path] = ()) -> Path:
    """Returns the file of a scenario: a path, or a bundled name.

    Args:
        name: as the user wrote it.
        folders: where else a relative path may start, besides the current folder.

    Raises:
        ScenarioError: there is none.
    """
    bundled = bundled_scenarios()
    if name in bundled:
        return bundled[name]
    for folder in (*folders, Path()):
        if (path := folder / name).is_file():
            return path
    if "/" in name or name.endswith((".yaml", ".yml")):
        raise ScenarioError(f"scenario {name}: no such file")
    raise ScenarioError(
        f"scenario {name!r}: no such file or bundled name; {nearest(name, bundled)}"
    )


def load_scenario(name: str, overrides: Iterable[str] | Mapping[str, Any] = ()) -> Any:
    """Loads and checks a scenario.

    Args:
        name: bundled name or path.
        overrides: "KEY=VALUE" strings as `--set` takes them, or a mapping from dotted key to
            value.

    Returns:
        The scenario, of its mission's class (a subclass of `Scenario`).

    Raises:
        ScenarioError: a line that says what, where and what is allowed.
    """
    path = find_scenario(name)
    layers = read_layers(path)
    layers.data.setdefault("name", path.stem)
    items = (
        overrides.items()
        if isinstance(overrides, Mapping)
        else [parse_override(text) for text in overrides]
    )
    for key, value in items:
        set_value(layers, key, value)
    return check(layers)


def check(layers: Layers) -> Any:
    """Returns the scenario that the merged data describes (see `load_scenario`)."""
    place = layers.place()
    if "mission" not in layers.data:
        raise place.error("the scenario lacks the key 'mission'")
    mission = convert(layers.data["mission"], str, place / "mission")
    # The mission's scenario class says which other keys there are.
    name, target = MISSIONS.target(mission, place / "mission")
    data = layers.data | {"mission": name}
    if asks_for_random(data):
        data, place = draw_world(data, field_hints(target), place, target.random_world)
    return convert(data, target, place)


def read_layers(path: Path, seen: tuple[Path, ...] = ()) -> Layers:
    """Reads a scenario file and those it extends.

    Raises:
        ScenarioError: a file that is missing, is not YAML, is no mapping, or extends itself.
    """
    resolved = path.resolve()
    if resolved in seen:
        raise ScenarioError(f"{path}: extends itself")
    try:
        content = YAML(typ="rt", pure=True).load(path.read_text())
    except OSError as error:
        raise ScenarioError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path}: not a text file") from error
    except YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{path}:{mark.line + 1}" if mark else str(path)
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise ScenarioError(f"{where}: not YAML: {problem}") from error
    if not isinstance(content, dict):
        raise ScenarioError(f"{path}: must be a mapping")
    layers = Layers()
    base = content.pop("extends", None)
    if base is not None:
        if not isinstance(base, str):
            raise ScenarioError(f"{path}: extends is {base!r}: must be a name or path")
        try:
            extended = find_scenario(base, [path.parent])
        except ScenarioError as error:
            raise ScenarioError(f"{path}: extends: {error}") from error
        layers = read_layers(extended, (*seen, resolved))
    layers.folders.insert(0, path.parent)
    origins: dict[Key, str] = {(): str(path)}
    _note_lines(content, (), str(path), origins)
    top = to_plain(content)
    below = make_way(layers.data, top, lambda: _random_world(layers.data | top, layers.place()))
    layers.data = merge(below, top)
    layers.origins |= origins
    return layers


def _random_world(data: Mapping[str, Any], place: Place) -> RandomWorld:
    """Returns what kind of random world the mission of some layers has."""
    try:
        mission = convert(data.get("mission"), str, place / "mission")
        kind: RandomWorld = MISSIONS.target(mission, place / "mission")[1].random_world
    except ScenarioError:  # said when all layers are there
        return ROOM
    return kind


def merge(base: Any, top: Any) -> Any:
    """Returns `base` with `top` laid over it (see the module's docstring)."""
    if isinstance(base, Mapping) and isinstance(top, str) and "type" in base:
        return dict(base) if base["type"] == top else {"type": top}
    if isinstance(base, str) and isinstance(top, Mapping) and top.get("type", base) == base:
        base = {"type": Implied(base)}
    if not isinstance(base, Mapping) or not isinstance(top, Mapping):
        return top
    if "type" in top and top["type"] != base.get("type", top["type"]):
        return dict(top)
    merged = dict(base)
    for key, value in top.items():
        merged[key] = merge(merged[key], value) if key in merged else value
    return merged


def save_scenario(scenario: Scenario, path: Path) -> None:
    """Writes the resolved scenario, all defaults filled in; loading it gives the same scenario."""
    path.write_text(dump_yaml(to_plain(scenario)))


def dump_yaml(data: Any) -> str:
    """Returns plain data as YAML; lists of numbers stay on one line."""
    yaml = YAML(typ="rt", pure=True)
    yaml.width = 100
    stream = io.StringIO()
    yaml.dump(_flow(data), stream)
    return stream.getvalue()


def parse_value(text: str) -> Any:
    """Returns the value that a text denotes in YAML 1.2: `3`, `1e-3`, `[1, 2]`, `true`, `word`."""
    try:
        return to_plain(YAML(typ="safe", pure=True).load(text)) if text else ""
    except YAMLError as error:
        raise ScenarioError(f"--set: {text!r} is not YAML") from error


def _flow(data: Any) -> Any:
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    if isinstance(data, dict):
        return CommentedMap((key, _flow(value)) for key, value in data.items())
    if isinstance(data, list):
        sequence = CommentedSeq(_flow(value) for value in data)
        if not any(isinstance(value, dict) for value in data):
            sequence.fa.set_flow_style()
        return sequence
    return data


def _note_lines(content: Any, key: Key, file: str, origins: dict[Key, str]) -> None:
    """Notes the line of every key; ruamel keeps lines beside its mappings and sequences."""
    if isinstance(content, dict):
        for name, value in content.items():
            # A key that YAML's merge key `<<` brought has no line of its own.
            if position := (content.lc.data or {}).get(name):  # type: ignore[attr-defined]
                origins[(*key, str(name))] = f"{file}:{position[0] + 1}"
                if isinstance(value, str):  # it may override a block's type
                    origins[(*key, str(name), "type")] = f"{file}:{position[0] + 1}"
            _note_lines(value, (*key, str(name)), file, origins)
    elif isinstance(content, list):
        for index, value in enumerate(content):
            line = content.lc.item(index)[0]  # type: ignore[attr-defined]
            origins[(*key, index)] = f"{file}:{line + 1}"
            _note_lines(value, (*key, index), file, origins)


def _note_override(value: Any, key: Key, text: str, origins: dict[Key, str]) -> None:
    """Notes an override as the origin of its key and of all that its value holds."""
    origins[key] = text
    if isinstance(value, str):  # it may override a block's type
        origins[(*key, "type")] = text
    inner = value if isinstance(value, Mapping) else {}
    if isinstance(value, list):
        inner = dict(enumerate(value))
    for step, item in inner.items():
        _note_override(item, (*key, step), text, origins)


def parse_override(text: str) -> tuple[str, Any]:
    """Returns key and value of an override KEY=VALUE.

    Raises:
        ScenarioError: it has not that form, or the value is not YAML.
    """
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise ScenarioError(f"--set {text}: must be KEY=VALUE")
    return key.strip(), parse_value(value.strip())


def set_value(layers: Layers, dotted: str, value: Any) -> None:
    """Lays one override over the data; numbers in the key are indices of lists."""
    steps: list[str | int] = [int(s) if s.isdigit() else s for s in dotted.split(".")]
    text = f"{OVERRIDE}{dotted}"
    for depth in range(1, len(steps)):
        layers.origins.setdefault(tuple(steps[:depth]), text)
    _note_override(value, tuple(steps), text, layers.origins)
    top = value
    for step in reversed(steps):
        top = {str(step): top}
    below = make_way(layers.data, top, lambda: _random_world(layers.data | top, layers.place()))
    layers.data = _set_in(below, steps, value, text)


def _set_in(data: Any, steps: list[str | int], value: Any, what: str) -> Any:
    if not steps:
        return merge(data, value)
    step, rest = steps[0], steps[1:]
    if isinstance(data, list):
        if not isinstance(step, int) or not 0 <= step < len(data):
            raise ScenarioError(f"{what}: {step!r} must be an index from 0 to {len(data) - 1}")
        return [_set_in(v, rest, value, what) if i == step else v for i, v in enumerate(data)]
    key = str(step)
    inner = _set_in(data.get(key) if isinstance(data, Mapping) else None, rest, value, what)
    return merge(data, {key: inner})
