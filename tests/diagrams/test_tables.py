from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.systems.framework import LeafSystem

from diagrams.scenario import load_scenario, save_scenario
from diagrams.schema import Place, ScenarioError
from diagrams.tables import Table

CONTROLLER = """
import numpy as np
from pydrake.systems.framework import LeafSystem


class Carrot(LeafSystem):
    def __init__(self, *, speed: float, gain=1.0, table=np.zeros(3), waypoints):
        super().__init__()
        if speed > 1:
            raise ValueError(f"speed is {speed}: must be at most 1")
        self.arguments = speed, gain, waypoints
        self.DeclareVectorInputPort("pose", 3)
        self.DeclareVectorOutputPort("command", 2, lambda _, out: out.SetFromVector([speed, 0]))


class Silent(LeafSystem):
    def __init__(self):
        super().__init__()


class Wide(LeafSystem):
    def __init__(self):
        super().__init__()
        self.DeclareVectorOutputPort("command", 3, lambda _, out: None)


class Broken(LeafSystem):
    def __init__(self):
        super().__init__()
        raise KeyError("speed")


class Inherited(LeafSystem):
    pass


NOT_A_CLASS = 3
"""


@pytest.fixture(autouse=True)
def forget_modules() -> Iterator[None]:
    """Modules that a test imported do not stay for the next."""
    before = set(sys.modules)
    path = list(sys.path)
    yield
    for name in set(sys.modules) - before:
        if "tmp" in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]
    assert sys.path == path


@pytest.fixture
def scene(tmp_path: Path) -> Callable[[str], Path]:
    """Writes a scenario with that controller, own_controllers.py beside it."""
    (tmp_path / "own_controllers.py").write_text(CONTROLLER)

    def write(controller: str) -> Path:
        path = tmp_path / "scene.yaml"
        path.write_text(
            f"extends: navigation_open\nsight: projected\ncontroller:\n  {controller}\n"
        )
        return path

    return write


def refusal(path: Path) -> str:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(str(path)).build()
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_a_class_beside_the_scenario_becomes_the_block(scene: Callable[[str], Path]) -> None:
    scenario = load_scenario(str(scene("{type: own_controllers:Carrot, speed: 0.5}")))
    assert scenario.controller.arguments == {"speed": 0.5, "gain": 1.0}
    mission = scenario.build()
    controller = mission.diagram.GetSubsystemByName("controller")
    speed, gain, waypoints = controller.arguments
    assert (speed, gain) == (0.5, 1.0)
    # What the diagram provides is handed to the argument of that name.
    np.testing.assert_array_equal(waypoints, scenario.waypoints)


@pytest.mark.parametrize(
    ("controller", "message"),
    [
        ("{type: own_controllers:Carrot}", ":3: controller: Carrot lacks the key 'speed'"),
        ("{type: own_controllers:Carrot, sped: 1}",
         ":4: controller.sped: unknown key; did you mean 'speed'?"),
        ("{type: own_controllers:Carrot, speed: fast}",
         ":4: controller.speed is 'fast': must be a number"),
        ("{type: own_controllers:Carrot, speed: 2}",
         ":4: controller.speed is 2.0: must be at most 1"),
        ("own_controllers:Carot",
         ":3: controller is 'own_controllers:Carot': own_controllers has no 'Carot'; did you mean "
         "'Carrot'?"),
        ("{type: own_controllers:Carot}",
         ":4: controller.type is 'own_controllers:Carot': own_controllers has no 'Carot'; did you "
         "mean 'Carrot'?"),
        ("own_controlers:Carrot",
         ":3: controller is 'own_controlers:Carrot': cannot import own_controlers: "
         "ModuleNotFoundError: No module named 'own_controlers'"),
        ("lib/own_controllers:Carrot",
         ":3: controller is 'lib/own_controllers:Carrot': cannot import lib/own_controllers: "),
        ("own_controllers:NOT_A_CLASS",
         ":3: controller is 'own_controllers:NOT_A_CLASS': must be the controller's class, with a "
         "method GetOutputPort"),
        ("json:JSONDecoder",
         ":3: controller is 'json:JSONDecoder': must be the controller's class, with a method "
         "GetOutputPort"),
        ("pydrake.systems.primitives:Gain",
         ":3: controller is 'pydrake.systems.primitives:Gain': Gain has no constructor written in "
         "Python that says what its arguments are"),
        ("own_controllers:Inherited",
         ":3: controller is 'own_controllers:Inherited': Inherited has no constructor written in "
         "Python that says what its arguments are"),
        ("own_controllers:Broken", ":3: controller: Broken raises KeyError: 'speed'"),
        ("carrot", ":3: controller is 'carrot': no such controller; known: waypoint (or "
                   "'module:Class')"),
        ("3", ":3: controller is 3: must be a name (of the controller) or a mapping with 'type'"),
        ("{type: 3}",
         ":3: controller is {'type': 3}: must be a name (of the controller) or a mapping with "
         "'type'"),
    ],
)  # fmt: skip
def test_a_block_that_cannot_be_is_refused_with_its_line(
    scene: Callable[[str], Path], controller: str, message: str
) -> None:
    path = scene(controller)
    assert refusal(path).startswith(f"{path}{message}")


def test_a_module_that_does_not_import_is_refused_with_its_own_error(
    scene: Callable[[str], Path], tmp_path: Path
) -> None:
    (tmp_path / "divides.py").write_text("1 / 0\n")
    (tmp_path / "misspelt.py").write_text("def f(:\n")
    assert refusal(scene("divides:X")).endswith(
        "cannot import divides: ZeroDivisionError: division by zero"
    )
    assert "cannot import misspelt: SyntaxError" in refusal(scene("misspelt:X"))


def test_a_block_whose_ports_do_not_fit_is_refused_by_name(scene: Callable[[str], Path]) -> None:
    said = refusal(scene("own_controllers:Silent"))
    assert said == "controller (Silent): has no output port 'command'; none is known"
    said = refusal(scene("own_controllers:Wide"))
    assert said.startswith("controller.command does not fit search.command: ")
    assert "size 3" in said
    assert "size 2" in said


def test_the_saved_scenario_finds_the_class_from_anywhere(
    scene: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = load_scenario(str(scene("{type: own_controllers:Carrot, speed: 0.5}")))
    elsewhere = tmp_path / "results"
    elsewhere.mkdir()
    save_scenario(scenario, elsewhere / "scenario.yaml")
    monkeypatch.chdir("/")
    del sys.modules["own_controllers"]
    again = load_scenario(str(elsewhere / "scenario.yaml"))
    assert again.controller.type == f"{tmp_path.resolve()}/own_controllers:Carrot"
    assert again.controller.target.__module__ == "own_controllers"
    assert again.controller.arguments == scenario.controller.arguments


def test_a_folder_may_stand_before_the_module(scene: Callable[[str], Path], tmp_path: Path) -> None:
    package = tmp_path / "lib" / "my_package"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "parts.py").write_text(CONTROLLER)
    (package / "whole.py").write_text("from my_package.parts import Carrot\n")
    path = scene("{type: lib/my_package.whole:Carrot, speed: 0.5}")
    scenario = load_scenario(str(path))
    assert scenario.controller.type == f"{(tmp_path / 'lib').resolve()}/my_package.whole:Carrot"
    save_scenario(scenario, tmp_path / "saved.yaml")
    assert load_scenario(str(tmp_path / "saved.yaml")).controller == scenario.controller


def test_a_module_of_the_same_name_elsewhere_is_not_taken_for_it(tmp_path: Path) -> None:
    paths = []
    for speed in (0.1, 0.2):
        folder = tmp_path / str(speed)
        (folder / "lib").mkdir(parents=True)
        (folder / "lib" / "twins.py").write_text(CONTROLLER)
        paths.append(folder / "scene.yaml")
        paths[-1].write_text(
            f"extends: navigation_open\ncontroller: {{type: lib/twins:Carrot, speed: {speed}}}\n"
        )
    load_scenario(str(paths[0]))
    with pytest.raises(ScenarioError, match="twins was imported already, from another place"):
        load_scenario(str(paths[1]))


def test_an_override_names_a_module_in_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_controllers.py").write_text(CONTROLLER)
    monkeypatch.chdir(tmp_path)
    block = "controller={type: own_controllers:Carrot, speed: 0.25}"
    assert load_scenario("navigation_open", [block]).controller.arguments["speed"] == 0.25


# Tables alone


@dataclass
class Numbers:
    a: float = 1.0
    b: list[float] = field(default_factory=lambda: [1.0, 2.0])


class Block(LeafSystem):
    def __init__(
        self, *, parameters: Numbers | None = None, rate: float = 10.0, unused: Any = None
    ):
        super().__init__()
        self.parameters = parameters or Numbers()
        self.rate = rate
        self.unused = unused


TABLE = Table("block", {"plain": f"{__name__}:Block"})


def test_parameters_are_written_flat_beside_the_other_arguments() -> None:
    choice = TABLE.convert({"type": "plain", "b": [3], "rate": 5}, Place())
    assert choice.arguments == {
        "parameters": Numbers(1.0, [3.0]),
        "rate": 5.0,
        "unused": None,
    }
    assert choice.to_plain() == {"type": "plain", "a": 1.0, "b": [3.0], "rate": 5.0, "unused": None}
    assert TABLE.convert(choice.to_plain(), Place()) == choice
    block = choice.build(unused="not asked for by name in the file", rate=7.0)
    # What the scenario says wins over what the diagram provides.
    assert (block.parameters.b, block.rate) == ([3.0], 5.0)


def test_each_build_has_defaults_of_its_own() -> None:
    first = TABLE.convert("plain", Place()).build()
    second = TABLE.convert("plain", Place()).build()
    first.parameters.b.append(9.0)
    assert second.parameters.b == [1.0, 2.0]


def test_drakes_scalar_generic_systems_are_blocks_like_any_other() -> None:
    table = Table("controller", {"waypoint": "systems.controllers.waypoints:WaypointController"})
    choice = table.convert({"type": "waypoint", "k_a": 3}, Place())
    assert choice.build().parameters.k_a == 3.0


def test_a_block_may_be_left_out_where_it_is_optional() -> None:
    place = Place(("avoider",))
    table = Table("avoider", {"sector": "systems.controllers.search:SearchWhenLost"}, optional=True)
    for value in ("none", None, {"type": "none"}):
        assert table.convert(value, place) is None
    chosen = table.convert("sector", place)
    assert chosen is not None
    assert chosen.type == "sector"
    with pytest.raises(ScenarioError, match=r"no such avoider; did you mean 'none'\?"):
        table.convert("nome", place)
    with pytest.raises(ScenarioError, match="no such estimator; known: kf"):
        Table("estimator", {"kf": "systems.estimators.planar_kalman:PlanarKalmanFilter"}).convert(
            "none", place
        )
