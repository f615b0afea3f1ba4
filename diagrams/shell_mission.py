"""The wired diagram of robots on shells: its outcome, its metrics, its results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context

from diagrams.channels import chain_signal
from diagrams.metrics import nis_mean
from diagrams.mission import Mission, Wiring
from diagrams.shell_calibration import calibration
from diagrams.shell_metrics import ShellLog, shell_metrics
from diagrams.shell_plots import camera_views, plot_shell
from diagrams.shell_robot import ShellRobot
from diagrams.shell_table import write_table
from diagrams.trajectories import write_poses
from plants.snailbot import carried_shell_pose
from systems.drawing.shells import DrawnShell
from systems.estimators.pose_chain import PoseChain
from systems.pose_vector import PoseToVector, rotations_of

if TYPE_CHECKING:
    from diagrams.snailbot import SnailBotScenario

Array = NDArray[np.float64]

_SLIDING = 0.2  # s, that a margin below 1 has to last


class ShellMission(Mission):
    """The wired diagram of a `SnailBotScenario`.

    It is to be made within `aligned`: it has cameras at 60 Hz and inertial sensors at 300.

    Attributes:
        robots: the team, in its order.
    """

    aligned = True

    def __init__(
        self, scenario: SnailBotScenario, *, meshcat: Meshcat | None, out: Path | None
    ) -> None:
        """See `SnailBotScenario.build`."""
        wiring = Wiring(
            scenario, world=scenario.faulty_world(), robots=scenario.robots(), meshcat=meshcat
        )
        self.station = wiring.station
        self._scenario = scenario
        self._wiring = wiring
        self.robots: list[ShellRobot] = []
        for number, member in enumerate(scenario.team, start=1):
            name = list(wiring.station.robots)[number - 1]
            self.robots.append(
                ShellRobot(
                    wiring,
                    scenario,
                    name=name,
                    number=number,
                    legs=member.legs(scenario.iterations),
                    speed=member.speed,
                    carrier=self._named(wiring.station.robots[name].on),
                )
            )
        self._add_chain()
        if meshcat is not None:
            eye, target = scenario.world.view()
            meshcat.SetCameraPose(len(self.robots) * eye, target)  # a team is as much larger
            for robot in self.robots:
                robot.show(meshcat)
        self.recorder = wiring.add_recorder(out)
        self.diagram, self.logs = wiring.build("snailbot")

    def _named(self, name: str) -> ShellRobot | None:
        return next((robot for robot in self.robots if robot.name == name), None)

    def _add_chain(self) -> None:
        """Adds what composes the poses of a team, one on the back of the other."""
        if len(self.robots) == 1:
            return
        wiring, body = self._wiring, self.robots[0].body.body
        mount = carried_shell_pose(body.parameters, self._scenario.world.shell)
        wiring.add(PoseChain(mounts=[mount] * (len(self.robots) - 1)), "chain")
        for k, robot in enumerate(self.robots, start=1):
            for port in ("pose", "covariance"):
                wiring.connect(f"{robot.block('estimator')}.{port}", f"chain.{port}_{k}")
        wiring.add(PoseToVector(), "chain_vector")
        wiring.connect("chain.pose", "chain_vector.pose")
        wiring.log("chain_vector.vector")
        wiring.log("chain.covariance")
        wiring.record("chain.estimate", chain_signal(rate=50.0))

    def outcome(self, context: Context) -> str | None:
        """Returns `detached` when a robot has lost its hold, `reached` when all drove their way.

        A robot has lost its hold when it has come off, or when for a while its adhesion was less
        than it needs: then it slides down. A team that only stands goes on until the time is up.
        """
        if any(robot.detached(context) or self._slides(context, robot) for robot in self.robots):
            return "detached"
        driving = [robot for robot in self.robots if robot.legs]
        done = driving and all(robot.finished(context) for robot in driving)
        return "reached" if done else None

    def unfinished(self, context: Context, word: str) -> str:
        """Returns `reached` for a team that was only to stand."""
        del context
        return word if any(robot.legs for robot in self.robots) else "reached"

    def succeeded(self, outcome: str) -> bool:
        """Whether all routes were driven."""
        return outcome == "reached"

    def metrics(self, context: Context) -> dict[str, Any]:
        """Returns the metrics (see `diagrams.shell_metrics`) of each robot.

        Those of the first bear no name; those of the second begin with `robot_2_`, and so on. The
        `chain_...` ones are of the last robot's pose relative to the reference robot.
        """
        found: dict[str, Any] = {}
        for robot in self.robots:
            prefix = "" if robot is self.robots[0] else f"{robot.name}_"
            log = self.shell_log(context, robot)
            values = dict(shell_metrics(log)) if log is not None else {}
            values["marker_visible_fraction"] = float(robot.value("seen.seen", context)[2])
            values["min_adhesion_margin"] = self._least_margin(context, robot)
            nis = f"{robot.block('estimator')}.nis"
            values["nis_mean"] = nis_mean(self.log(nis, context)[1]) if nis in self.logs else None
            values |= calibration(robot, self.station, context).metrics()
            found |= {f"{prefix}{name}": value for name, value in values.items()}
        chain = self.chain_log(context)
        if chain is not None:
            values = shell_metrics(chain)
            found |= {f"chain_{name}": values[name] for name in _OF_A_CHAIN}
        return found

    def shell_log(self, context: Context, robot: ShellRobot | None = None) -> ShellLog | None:
        """Returns truth and estimate of a robot over time; None when nobody knows the truth.

        Args:
            context: of the diagram.
            robot: one of `robots`; the first one by default.
        """
        robot = robot or self.robots[0]
        if not robot.has_truth:
            return None
        t, estimate = self.log(f"{robot.block('estimate')}.y0", context)
        truth = self.log(f"truth.{robot.name}.pose", context)[1]
        seen = self.log(f"{robot.block('seen')}.seen", context)[1]
        return ShellLog(
            t=t,
            R=rotations_of(truth),
            p=truth[:, 4:],
            R_estimate=rotations_of(estimate),
            p_estimate=estimate[:, 4:7],
            covariance=estimate[:, 7:].reshape(-1, 6, 6),
            iteration=self._iterations(context, robot, len(t)),
            visible=seen[:, 0] > 0,
            markers_met=seen[:, 1].astype(np.int64),
        )

    def _iterations(self, context: Context, robot: ShellRobot, n: int) -> NDArray[np.int64]:
        """Returns (n,) which iteration of its route a robot was in."""
        if not robot.legs:
            return np.zeros(n, np.int64)
        leg = self.log(f"{robot.block('route')}.progress", context)[1][:, 0]
        each = max(1, len(robot.legs) // self._scenario.iterations)
        return np.minimum(leg // each, self._scenario.iterations - 1).astype(np.int64)

    def chain_log(self, context: Context) -> ShellLog | None:
        """Returns truth and estimate of the last robot's pose relative to the reference robot."""
        logs = [self.shell_log(context, robot) for robot in self.robots]
        if len(logs) == 1 or any(log is None for log in logs):
            return None
        known = [log for log in logs if log is not None]
        body = self.robots[0].body.body
        X_BR = carried_shell_pose(body.parameters, self._scenario.world.shell)
        R_BR, p_BR = X_BR.rotation().matrix(), X_BR.translation()
        R, p = known[0].R, known[0].p
        for log in known[1:]:
            p = p + R @ p_BR + np.einsum("nij,nj->ni", R @ R_BR, log.p)
            R = R @ R_BR @ log.R
        t, estimate = self.log("chain_vector.vector", context)
        covariance = self.log("chain.covariance", context)[1].reshape(-1, 6, 6)
        return ShellLog(
            t=t,
            R=R,
            p=p,
            R_estimate=rotations_of(estimate),
            p_estimate=estimate[:, 4:],
            covariance=covariance,
            iteration=known[-1].iteration,
            visible=np.all([log.visible for log in known], axis=0),
            markers_met=np.min([log.markers_met for log in known], axis=0),
        )

    def _slides(self, context: Context, robot: ShellRobot) -> bool:
        name = f"truth.{robot.name}.margin"
        if name not in self.logs:
            return False
        t, margin = self.log(name, context)
        held = t[margin[:, 0] >= 1]
        return len(t) > 0 and t[-1] - (held[-1] if len(held) else t[0]) >= _SLIDING

    def _least_margin(self, context: Context, robot: ShellRobot) -> float | None:
        name = f"truth.{robot.name}.margin"
        if name not in self.logs:
            return None
        return float(self.log(name, context)[1].min())

    def write(self, context: Context, out: Path) -> None:
        """Writes figures, table I, trajectories and what the filters learned.

        The first robot's bear the plain names; the others' have theirs: `summary_robot_2.png`.
        """
        learned = {}
        for robot in self.robots:
            suffix = "" if robot is self.robots[0] else f"_{robot.name}"
            learned[robot.name] = calibration(robot, self.station, context).to_plain()
            t, estimate = self.log(f"{robot.block('estimate')}.y0", context)
            write_poses(out / f"estimate{suffix}.tum", t, estimate[:, :7])
            log = self.shell_log(context, robot)
            if log is None:
                continue
            write_poses(
                out / f"truth{suffix}.tum", t, self.log(f"truth.{robot.name}.pose", context)[1]
            )
            write_table(log, out, suffix)
            plot_shell(
                out / f"summary{suffix}.png",
                log,
                camera_views=self._camera_views(robot, log),
                markers=self.station.marker_map,
                radius=self._scenario.world.shell.radius,
            )
        if "chain_vector.vector" in self.logs:
            write_poses(out / "estimate_chain.tum", *self.log("chain_vector.vector", context))
        (out / "calibration.json").write_text(json.dumps(learned, indent=1) + "\n")

    def _camera_views(self, robot: ShellRobot, log: ShellLog) -> list[Any]:
        world = self._scenario.world
        host = self.station.shells.get(robot.body.on)  # of a recording only the reference's is
        markers = self.station.marker_map if host is None else host.markers
        frame = self.station.scene_graph.world_frame_id()
        shell = DrawnShell(frame, world.shell.radius, markers, parameters=world.looks)
        X_BC = robot.camera.true_mounting(robot.body, self._scenario.seed)
        return list(camera_views(log, robot.camera.model(), X_BC, shell))


# What is said of the composed pose.
_OF_A_CHAIN = (
    "roll_rmse_deg",
    "pitch_rmse_deg",
    "yaw_rmse_deg",
    "max_error_deg",
    "position_rmse_m",
    "nees_mean",
)
