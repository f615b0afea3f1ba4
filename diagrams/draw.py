"""Draws a diagram's blocks, ports and connections as SVG.

Graphviz lays it out. Drake's own drawing names ports too, but shows every port of the plant; here a
port or block appears when something is connected to it.
"""

from __future__ import annotations

import html
import shutil
import subprocess
from pathlib import Path

from pydrake.systems.framework import Diagram, InputPort, OutputPort, System
from pydrake.systems.primitives import VectorLogSink

from diagrams.schema import ScenarioError

_HEADER = "#dce6f2"


def write_diagram(diagram: Diagram, path: Path) -> None:
    """Writes the drawing.

    Args:
        diagram: what is drawn; diagrams inside it become frames around their blocks.
        path: ending in .svg, or .dot for the source of the drawing.

    Raises:
        ScenarioError: another ending, a folder that is not there, or Graphviz' `dot` is missing.
    """
    if path.suffix not in (".svg", ".dot"):
        raise ScenarioError(f"--out {path}: must end in .svg or .dot")
    source = to_dot(diagram)
    try:
        if path.suffix == ".dot":
            path.write_text(source)
            return
        dot = shutil.which("dot")
        if dot is None:
            raise ScenarioError(
                "the program 'dot' is missing: install the system package graphviz, "
                "or write the source with -o FILE.dot"
            )
        svg = subprocess.run(
            [dot, "-Tsvg"], input=source, capture_output=True, text=True, check=True
        )
        path.write_text(svg.stdout)
    except OSError as error:
        raise ScenarioError(f"--out {path}: {error.strerror}") from error


def to_dot(diagram: Diagram) -> str:
    """Returns the drawing in Graphviz' language, the same for the same diagram."""
    drawing = _Drawing(diagram)
    return "\n".join(
        [
            "digraph {",
            "rankdir=LR; nodesep=0.25; ranksep=1.0; splines=true; compound=true;",
            f'label="{_escape(diagram.get_name())}"; labelloc=t;',
            'fontname="Helvetica"; fontsize=20;',
            'node [shape=plain, fontname="Helvetica", fontsize=11];',
            'edge [arrowsize=0.6, color="#404040"];',
            *drawing.nodes(diagram),
            *drawing.edges(),
            "}",
            "",
        ]
    )


class _Drawing:
    """Resolves ports of nested diagrams to those of the blocks inside."""

    def __init__(self, diagram: Diagram) -> None:
        self._ids: dict[System, str] = {}
        self._edges: list[tuple[OutputPort, InputPort]] = []
        self._used: set[tuple[str, str, int]] = set()  # block, side, index
        self._number(diagram)
        self._collect(diagram)
        for source, target in self._edges:
            self._used.add((self._ids[source.get_system()], "out", int(source.get_index())))
            self._used.add((self._ids[target.get_system()], "in", int(target.get_index())))

    def _number(self, diagram: Diagram) -> None:
        for system in diagram.GetSystems():
            if isinstance(system, Diagram):
                self._number(system)
            else:
                self._ids[system] = f"n{len(self._ids)}"

    def _collect(self, diagram: Diagram) -> None:
        for (target, input_index), (source, output_index) in diagram.connection_map().items():
            if isinstance(target, VectorLogSink):
                continue  # logs are for the report, not part of the robot
            output = self._origin(source.get_output_port(output_index))
            for port in self._destinations(target.get_input_port(input_index)):
                self._edges.append((output, port))
        for system in diagram.GetSystems():
            if isinstance(system, Diagram):
                self._collect(system)

    def _origin(self, port: OutputPort) -> OutputPort:
        """Returns the block's port behind an exported one."""
        system = port.get_system()
        while isinstance(system, Diagram):
            system, index = system.get_output_port_locator(port.get_index())
            port = system.get_output_port(index)
        return port

    def _destinations(self, port: InputPort) -> list[InputPort]:
        """Returns the blocks' ports that an exported one leads to."""
        system = port.get_system()
        if not isinstance(system, Diagram):
            return [port]
        return [
            inner
            for subsystem, index in system.GetInputPortLocators(port.get_index())
            for inner in self._destinations(subsystem.get_input_port(index))
        ]

    def nodes(self, diagram: Diagram) -> list[str]:
        lines: list[str] = []
        for system in diagram.GetSystems():
            if isinstance(system, Diagram):
                lines += [
                    f'subgraph "cluster_{_escape(system.get_name())}" {{',
                    f'label="{_escape(system.get_name())}"; style=rounded; color="#8090a0";',
                    *self.nodes(system),
                    "}",
                ]
            elif any(self._ids[system] == node for node, _, _ in self._used):
                lines.append(f"{self._ids[system]} [label=<{self._table(system)}>];")
        return lines

    def edges(self) -> list[str]:
        return sorted(
            f"{self._ids[source.get_system()]}:out{int(source.get_index())}:e -> "
            f"{self._ids[target.get_system()]}:in{int(target.get_index())}:w;"
            for source, target in self._edges
        )

    def _table(self, system: System) -> str:
        node = self._ids[system]
        inputs = [
            (f"in{k}", system.get_input_port(k).get_name())
            for k in range(system.num_input_ports())
            if (node, "in", k) in self._used
        ]
        outputs = [
            (f"out{k}", system.get_output_port(k).get_name())
            for k in range(system.num_output_ports())
            if (node, "out", k) in self._used
        ]
        kind = type(system).__name__.split("_\U0001d4e3")[0]  # Drake's mark of a scalar type
        rows = [
            f'<tr><td colspan="2" bgcolor="{_HEADER}"><b>{_escape(system.get_name())}</b>'
            f'<br/><font point-size="9">{_escape(kind)}</font></td></tr>'
        ]
        for k in range(max(len(inputs), len(outputs))):
            left = _cell(inputs, k, "left")
            right = _cell(outputs, k, "right")
            rows.append(f"<tr>{left}{right}</tr>")
        return (
            '<table border="0" cellborder="1" cellspacing="0" cellpadding="4">'
            f"{''.join(rows)}</table>"
        )


def _cell(ports: list[tuple[str, str]], k: int, side: str) -> str:
    if k >= len(ports):
        return "<td></td>"
    key, name = ports[k]
    return f'<td port="{key}" align="{side}">{_escape(name)}</td>'


def _escape(text: str) -> str:
    return html.escape(text, quote=True)
