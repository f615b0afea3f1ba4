from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest

from diagrams.schema import (
    Existing,
    File,
    Place,
    ScenarioError,
    construct,
    convert,
    is_plain,
    to_plain,
)
from systems.validation import require


@dataclass
class Leg:
    length: float
    joints: int = 2
    stiff: bool = False

    def __post_init__(self) -> None:
        require(self.length > 0, "length", self.length, "greater than 0")


@dataclass
class Animal:
    name: str
    legs: list[Leg] = field(default_factory=list)
    gait: Literal["walk", "trot"] = "walk"
    mate: Leg | None = None
    friends: dict[str, Leg] = field(default_factory=dict)
    food: str | Leg = "hay"
    weights: list[float] | None = None
    notes: Any = None


def animal(**content: Any) -> Animal:
    return convert({"name": "rex", **content}, Animal, Place())


def complaint(content: Any, hint: Any = Animal, place: Place | None = None) -> str:
    with pytest.raises(ScenarioError) as caught:
        convert(content, hint, place or Place())
    return str(caught.value)


def test_plain_data_become_the_dataclass_and_back() -> None:
    made = animal(
        legs=[{"length": 1}, {"length": 2.5, "joints": 3, "stiff": True}],
        gait="trot",
        mate={"length": 4},
        friends={"max": {"length": 5}},
        food={"length": 6},
        weights=[1, 2],
        notes={"anything": [1, "two"]},
    )
    assert made == Animal(
        name="rex",
        legs=[Leg(1.0), Leg(2.5, 3, True)],
        gait="trot",
        mate=Leg(4.0),
        friends={"max": Leg(5.0)},
        food=Leg(6.0),
        weights=[1.0, 2.0],
        notes={"anything": [1, "two"]},
    )
    assert convert(to_plain(made), Animal, Place()) == made


def test_whole_numbers_are_numbers_but_nothing_else_is() -> None:
    assert isinstance(animal(legs=[{"length": 3}]).legs[0].length, float)
    for wrong in (True, "3", None, [3]):
        assert complaint({"length": wrong}, Leg) == f"length is {wrong!r}: must be a number"
    for half in (3.0, True, "3"):
        message = complaint({"length": 1, "joints": half}, Leg)
        assert message == f"joints is {half!r}: must be a whole number"
    assert complaint({"length": 1, "stiff": 1}, Leg) == "stiff is 1: must be true or false"
    assert complaint({"name": 3}) == "name is 3: must be text"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"nam": "rex"}, "nam: unknown key; did you mean 'name'?"),
        ({"name": "rex", "legs": [{"length": 1}, {"lenght": 1}]},
         "legs[1].lenght: unknown key; did you mean 'length'?"),
        ({"name": "rex", "friends": {"max": {"length": "x"}}},
         "friends.max.length is 'x': must be a number"),
        ({"name": "rex", "legs": {"length": 1}}, "legs is {'length': 1}: must be a list"),
        ({"name": "rex", "legs": [3]},
         "legs[0] is 3: must be a mapping with length, joints, stiff"),
        ({"name": "rex", "friends": [1]}, "friends is [1]: must be a mapping"),
        ({"name": "rex", "gait": "fly"}, "gait is 'fly': must be one of walk, trot"),
        ({"name": "rex", "mate": 3}, "mate is 3: must be a mapping with length, joints, stiff"),
        ({"name": "rex", "food": {"lenth": 1}},
         "food.lenth: unknown key; did you mean 'length'?"),
        ({"name": "rex", "food": {}}, "food lacks the key 'length'"),
        ({"name": "rex", "mate": {"length": -1}}, "mate.length is -1.0: must be greater than 0"),
        ({"name": "rex", "weights": ["a"]}, "weights[0] is 'a': must be a number"),
        ({"name": "rex", "weights": 3}, "weights is 3: must be a list"),
        ({}, "the scenario lacks the key 'name'"),
        (3, "the scenario is 3: must be a mapping with name, legs, gait, mate, friends, food, "
            "weights, notes"),
    ],
)  # fmt: skip
def test_a_complaint_names_the_key_the_value_and_what_is_allowed(
    content: Any, message: str
) -> None:
    assert complaint(content) == message


def test_an_unknown_key_that_resembles_none_is_told_all_of_them() -> None:
    message = complaint({"length": 1, "xyz": 1}, Leg)
    assert message == "xyz: unknown key; known: joints, length, stiff"


def test_a_complaint_begins_with_the_deepest_known_origin() -> None:
    origins = {(): "zoo.yaml", ("legs",): "zoo.yaml:4", ("legs", 1): "zoo.yaml:6"}
    place = Place(origins=origins)
    deep = {"name": "rex", "legs": [{"length": 1}, {"length": 0}]}
    assert complaint(deep, place=place) == (
        "zoo.yaml:6: legs[1].length is 0.0: must be greater than 0"
    )
    shallow = {"name": "rex", "legs": [{"length": 0}]}
    assert complaint(shallow, place=place).startswith("zoo.yaml:4: legs[0].length is")
    assert complaint({}, place=place) == "zoo.yaml: the scenario lacks the key 'name'"


def test_a_constructors_refusal_stands_where_its_argument_was_written() -> None:
    class Herd:
        def __init__(self, size: int, members: list[int]) -> None:
            if size > 3:
                raise ValueError(f"size is {size}: must be at most 3")
            raise ValueError(f"members[1] = {members[1]} does not fit")

    origins = {("herd",): "zoo.yaml:2", ("herd", "members", 1): "--set herd.members.1"}
    place = Place(("herd",), origins)
    with pytest.raises(ScenarioError) as caught:
        construct(Herd, {"size": 4, "members": []}, place)
    assert str(caught.value) == "zoo.yaml:2: herd.size is 4: must be at most 3"
    with pytest.raises(ScenarioError) as caught:
        construct(Herd, {"size": 1, "members": [7, 8]}, place)
    assert str(caught.value) == "--set herd.members.1: herd.members[1] = 8 does not fit"


def test_a_refusal_that_names_no_argument_keeps_its_words() -> None:
    def refuse() -> None:
        raise ValueError("these two do not go together")

    with pytest.raises(ScenarioError, match=r"^herd: these two do not go together$"):
        construct(refuse, {}, Place(("herd",)))


def test_a_file_lies_beside_the_scenario_or_is_bundled(tmp_path: Path) -> None:
    hint = Annotated[str, File("maps")]
    place = Place(("map",), folders=(tmp_path,))
    assert convert("navigation.json", hint, place) == "navigation.json"  # bundled: by its name
    (tmp_path / "mine.json").write_text("{}")
    (tmp_path / "navigation.json").write_text("{}")
    assert convert("mine.json", hint, place) == str((tmp_path / "mine.json").resolve())
    assert convert("navigation.json", hint, place) == str((tmp_path / "navigation.json").resolve())
    assert complaint("nope.json", hint, place) == (
        f"map is 'nope.json': no such file in {tmp_path}; bundled: circuit.json, navigation.json, "
        "snailbot.json"
    )
    assert complaint(7, hint, place) == "map is 7: must be text"


def test_a_file_beats_the_current_folder_and_an_override_starts_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, beside = tmp_path / "here", tmp_path / "beside"
    for folder in (here, beside):
        folder.mkdir()
        (folder / "both.json").write_text("{}")
    (here / "mine.json").write_text("{}")
    monkeypatch.chdir(here)
    hint = Annotated[str, File("maps")]
    written = Place(("map",), {("map",): "scene.yaml:1"}, (beside,))
    given = Place(("map",), {("map",): "--set map"}, (beside,))
    assert convert("both.json", hint, written) == str(beside / "both.json")
    assert convert("both.json", hint, given) == str(here / "both.json")
    assert "no such file" in complaint("mine.json", hint, written)
    assert convert("mine.json", hint, given) == str(here / "mine.json")


def test_an_existing_path_becomes_absolute(tmp_path: Path) -> None:
    hint = Annotated[str, Existing()]
    (tmp_path / "bag").mkdir()
    place = Place(("recording",), folders=(tmp_path,))
    assert convert("bag", hint, place) == str((tmp_path / "bag").resolve())
    assert complaint("gab", hint, place) == ("recording is 'gab': there is no such file or folder")


def test_plain_data_are_what_a_file_can_hold() -> None:
    assert all(map(is_plain, (None, True, 1, 2.0, "x", [1, [2]], (1, 2), {"a": 1}, Leg(1.0))))
    assert not any(map(is_plain, (np.zeros(3), object(), [np.zeros(3)])))
    assert to_plain(np.float64(3.5)) == 3.5
    assert type(to_plain(np.float64(3.5))) is float
