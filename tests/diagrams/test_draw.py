from __future__ import annotations

import re
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, ConstantVectorSource, LogVectorOutput, Multiplexer

from diagrams.draw import to_dot, write_diagram
from diagrams.scenario import load_scenario

needs_dot = pytest.mark.skipif(shutil.which("dot") is None, reason="graphviz is not installed")


def little() -> Diagram:
    """Two sources, one of them in a diagram of its own, an adder, and what is left unconnected."""
    inside = DiagramBuilder()
    source = inside.AddNamedSystem("first <a & b>", ConstantVectorSource([1.0]))
    inside.ExportOutput(source.get_output_port(), "out of the box")
    builder = DiagramBuilder()
    box = builder.AddNamedSystem("box", inside.Build())
    second = builder.AddNamedSystem("second", ConstantVectorSource([2.0]))
    adder = builder.AddNamedSystem("adder", Adder(3, 1))
    lone = builder.AddNamedSystem("lone", Multiplexer([1, 1]))
    builder.ExportInput(adder.get_input_port(2), "third")
    builder.Connect(box.get_output_port(), adder.get_input_port(0))
    builder.Connect(second.get_output_port(), adder.get_input_port(1))
    LogVectorOutput(adder.get_output_port(), builder, 0.1).set_name("a log")
    builder.ExportOutput(lone.get_output_port(), "of lone")
    diagram = builder.Build()
    diagram.set_name("little")
    return diagram


def edges(dot: str) -> set[tuple[str, str]]:
    """The drawing's arrows, by the blocks' names."""
    names = dict(re.findall(r"^(\w+) \[label=<.*?<b>(.*?)</b>", dot, re.MULTILINE))
    arrows = re.findall(r"^(\w+):\w+:e -> (\w+):\w+:w;", dot, re.MULTILINE)
    return {(names[a], names[b]) for a, b in arrows}


def test_connections_are_drawn_between_the_blocks_inside() -> None:
    dot = to_dot(little())
    assert edges(dot) == {("first &lt;a &amp; b&gt;", "adder"), ("second", "adder")}
    assert 'subgraph "cluster_box"' in dot


def test_what_is_connected_to_nothing_or_to_a_log_is_left_out() -> None:
    dot = to_dot(little())
    assert "lone" not in dot
    assert "a log" not in dot
    assert ">u0<" in dot
    assert ">u1<" in dot
    assert ">u2<" not in dot


def test_the_drawing_is_the_same_each_time() -> None:
    assert to_dot(little()) == to_dot(little())


def text_of(svg: Path) -> list[str]:
    tree = ElementTree.parse(svg)
    return ["".join(t.itertext()) for t in tree.iter("{http://www.w3.org/2000/svg}text")]


@needs_dot
def test_the_svg_shows_every_connected_port_by_name(
    tagtrail: Callable[..., Any], workshop: Path
) -> None:
    result = tagtrail("diagram", "navigation_open", "-o", "nav.svg")
    assert (result.status, result.err) == (0, "")
    words = text_of(workshop / "nav.svg")
    mission = load_scenario("navigation_open").build()
    diagrams, connected, blocks = [mission.diagram], set(), set()
    while diagrams:
        diagram = diagrams.pop()
        diagrams += [s for s in diagram.GetSystems() if isinstance(s, Diagram)]
        for (system, index), (origin, output) in diagram.connection_map().items():
            if system.get_name().startswith("log of "):
                continue
            for owner, port in (
                (system, system.get_input_port(index)),
                (origin, origin.get_output_port(output)),
            ):
                if not isinstance(owner, Diagram):
                    connected.add(port.get_name())
                    blocks.add(owner.get_name())
    assert {"marker_pose", "detections", "spatial_velocity", "covariance"} <= connected
    assert {"estimator", "localizer", "robot.front_camera", "plant"} <= blocks
    missing = (connected | blocks) - set(words)
    assert not missing


def test_the_source_of_the_drawing_needs_no_program(
    tagtrail: Callable[..., Any], workshop: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(workshop))
    result = tagtrail("diagram", "navigation_open", "--set", "sight=projected", "-o", "nav.dot")
    assert (result.status, result.err) == (0, "")
    dot = (workshop / "nav.dot").read_text()
    assert ("localizer", "estimator") in edges(dot)
    assert ("estimator", "controller") in edges(dot)
    assert ("controller", "search") in edges(dot)
    assert ("search", "robot.drive") in edges(dot)


@needs_dot
def test_without_a_name_the_drawing_is_called_after_the_scenario(
    tagtrail: Callable[..., Any], workshop: Path
) -> None:
    result = tagtrail("diagram", "navigation_open", "--set", "sight=projected")
    assert result.out == "navigation_open.svg\n"
    assert (workshop / "navigation_open.svg").is_file()


def test_a_drawing_is_written_to_files_of_two_kinds_only(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"must end in \.svg or \.dot"):
        write_diagram(little(), tmp_path / "x.png")
