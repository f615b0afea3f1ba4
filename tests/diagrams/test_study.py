"""Studies as they run: variants, seeds, processes, errors, resuming."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from diagrams.run import simulate
from diagrams.scenario import load_scenario
from diagrams.schema import ScenarioError
from diagrams.study import ERROR, Study, load_study, run_study, slug
from diagrams.study_folder import StudyFolder

ROOT = Path(__file__).resolve().parents[2]
ROOM = str(Path(__file__).resolve().with_name("study_room.yaml"))
FAST = ("sight=projected", "dynamics=kinematic", "duration=0.5")
SET = tuple(word for text in FAST for word in ("--set", text))
REBASE = ("--sweep", "estimator.rebase=true,false")
WALL = ("wall_seconds",)

Command = Callable[..., Any]
Refuse = Callable[..., str]


def lines(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "runs.jsonl").read_text().splitlines()]


def timeless(record: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in record.items() if key not in WALL}


def results(out: Path) -> list[bytes]:
    return [(out / name).read_bytes() for name in ("summary.json", "table.md", "summary.png")]


@pytest.fixture(scope="module")
def study(tagtrail: Command, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two variants, four seeds, two processes, done without a break."""
    out = tmp_path_factory.mktemp("study") / "done"
    result = tagtrail("study", ROOM, "--runs", "4", "--workers", "2", *REBASE, *SET, "--out", out)
    assert (result.status, result.err) == (0, "")
    assert result.out.endswith(f"results: {out}\n")
    return out


# What is varied


def values(*sweeps: str) -> list[dict[str, Any]]:
    return [variant.values for variant in load_study(ROOM, FAST, sweeps).variants]


def test_several_sweeps_make_the_cross_product_in_order() -> None:
    assert values("estimator.rebase=true,false", "robot.sensors.front_camera.rate=10, 15") == [
        {"estimator.rebase": rebase, "robot.sensors.front_camera.rate": rate}
        for rebase in (True, False)
        for rate in (10, 15)
    ]
    assert values() == [{}]


@pytest.mark.parametrize(
    ("sweep", "wanted"),
    [
        ("waypoints.0=[0,1],[0, -1]", [[0, 1], [0, -1]]),
        ("waypoints=[[0, 1]],[[0, 1], [0, 0.5]]", [[[0, 1]], [[0, 1], [0, 0.5]]]),
        ("robot.start={x: -1, y: -1},{x: 0, y: 1}", [{"x": -1, "y": -1}, {"x": 0, "y": 1}]),
        ("description='a, b',\"c\",it's", ["a, b", "c", "it's"]),
        ("duration=1,2.5,1e-1", [1, 2.5, 0.1]),
        ("dynamics = kinematic , multibody", ["kinematic", "multibody"]),
        ("estimator={type: kf, gate: 5},kf", [{"type": "kf", "gate": 5}, "kf"]),
    ],
)
def test_a_comma_separates_only_outside_brackets_and_quotes(sweep: str, wanted: list[Any]) -> None:
    assert [list(chosen.values()) for chosen in values(sweep)] == [[value] for value in wanted]


def test_every_variant_is_the_scenario_that_run_would_load() -> None:
    study = load_study(ROOM, FAST, ["robot.sensors.front_camera.rate=10,20"])
    assert [variant.name for variant in study.variants] == [
        "robot.sensors.front_camera.rate=10",
        "robot.sensors.front_camera.rate=20",
    ]
    for variant, rate in zip(study.variants, (10, 20), strict=True):
        overrides = [*FAST, "record.bag=false", f"robot.sensors.front_camera.rate={rate}", "seed=7"]
        assert variant.scenario(7) == load_scenario(ROOM, overrides)


def test_a_random_world_is_drawn_from_each_runs_own_seed() -> None:
    (variant,) = load_study(ROOM, FAST, ["world.random.obstacles=6"]).variants
    for seed in (0, 3):
        alone = load_scenario(
            ROOM, [*FAST, "record.bag=false", "world.random.obstacles=6", f"seed={seed}"]
        )
        assert variant.scenario(seed) == alone
    assert variant.scenario(0).waypoints != variant.scenario(3).waypoints


def test_no_override_inside_a_swept_block_is_lost() -> None:
    # A word starts a block anew when its type changes, so the order matters.
    kf = "systems.estimators.planar_kalman:PlanarKalmanFilter"
    study = load_study(ROOM, [*FAST, "estimator.gate=7"], [f"estimator=kf,{kf}"])
    gates = [v.scenario(0).estimator.arguments["parameters"].gate for v in study.variants]
    assert gates == [7.0, 7.0]
    study = load_study(ROOM, FAST, ["estimator.gate=7,9", f"estimator=kf,{kf}"])
    found = [
        (v.scenario(0).estimator.arguments["parameters"].gate, v.scenario(0).estimator.type[-2:])
        for v in study.variants
    ]
    assert found == [(7.0, "kf"), (7.0, "er"), (9.0, "kf"), (9.0, "er")]


def test_runs_keep_no_bag_unless_it_is_asked_for() -> None:
    assert load_scenario(ROOM).record.bag
    assert not load_study(ROOM).variants[0].scenario(0).record.bag
    assert load_study(ROOM, ["record.bag=true"]).variants[0].scenario(0).record.bag


def test_different_variants_have_different_folders() -> None:
    names = ["a=1, b=2", "a=1,b=2", "a=1/b=2", "a=1%2Fb=2", "a=[0, 1]", "a='x, y'"]
    folders = [slug(name) for name in names]
    assert folders[0] == "a=1,b=2"
    assert len(set(folders)) == len(names)
    assert not any("/" in folder for folder in folders)


# What is refused, before anything is run


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("--runs", "0"), "--runs is 0: must be 1 or greater"),
        (("--workers", "0"), "--workers is 0: must be 1 or greater"),
        (("--runs", "few"), "argument --runs: invalid int value: 'few'"),
        (("--sweep", "sihgt=rendered,projected"),
         "--sweep sihgt: sihgt: unknown key; did you mean 'sight'?"),
        (("--sweep", "estimator.gat=1,2"),
         "--sweep estimator.gat: estimator.gat: unknown key; did you mean 'gate'?"),
        (("--sweep", "estimator.gate=9,high"),
         "--sweep estimator.gate: estimator.gate is 'high': must be a number"),
        (("--sweep", "estimator=kf,ukf"),
         "--sweep estimator: estimator is 'ukf': no such estimator;"),
        (("--sweep", "duration=1,-2"), "--sweep duration: duration is -2.0: must be greater than"),
        # Only the driver's constructor knows this one.
        (("--sweep", "robot.sensors.front_camera.rate=15,0"),
         "--sweep robot.sensors.front_camera.rate: robot.sensors.front_camera.rate is 0.0: must"),
        (("--sweep", "duration"), "--sweep duration: must be KEY=A,B,C"),
        (("--sweep", "duration="), "--sweep duration=: must be KEY=A,B,C"),
        (("--sweep", "duration=1,"), "--sweep duration=1,: must be KEY=A,B,C"),
        (("--sweep", "=1,2"), "--sweep =1,2: must be KEY=A,B,C"),
        (("--sweep", "duration=1,,2"), "--sweep duration=1,,2: '1,,2' is no list of YAML values"),
        (("--sweep", "waypoints=[[1,2]"),
         "--sweep waypoints=[[1,2]: '[[1,2]' is no list of YAML values"),
        (("--sweep", "duration=1,2", "--sweep", "duration=3"), "--sweep duration: given twice"),
        (("--sweep", "duration=1,2,1"), "--sweep duration: has 1 twice"),
        (("--sweep", "duration=1,1.0"), "--sweep: duration=1 and duration=1.0 are the same"),
        (("--sweep", "seed=1,2"), "--sweep seed: the runs of a study have the seeds 0, 1, 2, ..."),
        (("--set", "seed=4"), "--set seed: the runs of a study have the seeds 0, 1, 2, ..."),
        (("--set", "sihgt=projected"), "--set sihgt: sihgt: unknown key; did you mean 'sight'?"),
        (("--set", "record.bag=true"), "record.bag is True: must be false without --keep"),
    ],
)  # fmt: skip
def test_a_study_that_cannot_be_is_refused_in_one_line(
    refuse: Refuse, workshop: Path, arguments: tuple[str, ...], line: str
) -> None:
    said = refuse("study", ROOM, *SET, *arguments)
    assert said.removeprefix("tagtrail study: ").startswith(line)
    assert list(workshop.iterdir()) == []


def test_a_folder_that_cannot_be_used_is_refused(
    refuse: Refuse, workshop: Path, study: Path
) -> None:
    def said(out: str) -> str:
        return refuse("study", ROOM, "--runs", "1", *SET, "--out", out)

    (workshop / "file").write_text("in the way")
    assert said("file") == "--out file: File exists"
    assert said("file/sub") == "--out file/sub: Not a directory"
    (workshop / "half").mkdir()
    (workshop / "half" / "runs.jsonl").write_text("")
    assert said("half") == "--out half: holds runs.jsonl without its study.yaml"
    (workshop / "odd").mkdir()
    (workshop / "odd" / "study.yaml").write_text("[")
    assert said("odd") == "--out odd: study.yaml is not YAML"
    (workshop / "blocked" / "runs.jsonl").mkdir(parents=True)
    (workshop / "blocked" / "study.yaml").write_bytes((study / "study.yaml").read_bytes())
    assert "blocked" in said("blocked")


@pytest.mark.parametrize(
    ("arguments", "difference"),
    [
        ((*REBASE, *SET, "--set", "duration=0.6"),
         "variants.estimator.rebase=true.duration is 0.5 there and 0.6 here"),
        (SET, "sweep.estimator.rebase is [True, False] there and nothing here"),
        (("--sweep", "estimator.rebase=false", *SET), "sweep.estimator.rebase is [True, False]"),
        ((*REBASE, *SET, "--set", "waypoints.1.0=0.5"),
         "variants.estimator.rebase=true.waypoints[1][0] is 0.6 there and 0.5 here"),
    ],
)  # fmt: skip
def test_another_studys_folder_is_refused_and_left_as_it_is(
    refuse: Refuse, study: Path, arguments: tuple[str, ...], difference: str
) -> None:
    before = {path: path.read_bytes() for path in study.iterdir()}
    said = refuse("study", ROOM, "--runs", "4", *arguments, "--out", study)
    assert said.startswith(f"--out {study}: another study is there: {difference}")
    assert before == {path: path.read_bytes() for path in study.iterdir()}


def test_two_studies_at_once_do_not_share_a_folder(refuse: Refuse, study: Path) -> None:
    loaded = load_study(ROOM, FAST, [REBASE[1]])
    with StudyFolder(study, loaded.description(4)):
        said = refuse("study", ROOM, "--runs", "4", *REBASE, *SET, "--out", study)
    assert said == f"--out {study}: a study is running in it"


# What is run


def test_each_run_is_the_one_that_simulate_makes_of_its_seed(study: Path) -> None:
    records = lines(study)
    assert sorted((r["variant"], r["seed"]) for r in records) == [
        (f"estimator.rebase={word}", seed) for word in ("false", "true") for seed in range(4)
    ]
    for record in records:
        run = simulate(load_scenario(ROOM, [*FAST, record["variant"],
                                                    f"seed={record['seed']}"]))  # fmt: skip
        assert record["metrics"] == run.report["metrics"]
        assert record["health"] == run.report["health"]
        assert (record["outcome"], record["succeeded"]) == ("timeout", False)
    # Seeds make a difference, or the pairing would prove nothing.
    assert len({r["metrics"]["position_rmse_m"] for r in records}) == len(records)


def test_results_do_not_depend_on_the_number_of_processes(
    study: Path, tagtrail: Command, tmp_path: Path
) -> None:
    arguments = ("--runs", "4", "--workers", "1", *REBASE, *SET, "--out", tmp_path / "alone")
    assert tagtrail("study", ROOM, *arguments).status == 0
    assert results(tmp_path / "alone") == results(study)
    # One process works in order; several finish as they may.
    order = [(r["seed"], r["variant"]) for r in lines(tmp_path / "alone")]
    assert order == [(s, f"estimator.rebase={w}") for s in range(4) for w in ("true", "false")]


def test_results_do_not_depend_on_the_order_of_completion(
    study: Path, tagtrail: Command, tmp_path: Path
) -> None:
    out = tmp_path / "shuffled"
    out.mkdir()
    (out / "study.yaml").write_bytes((study / "study.yaml").read_bytes())
    content = (study / "runs.jsonl").read_text().splitlines(keepends=True)
    (out / "runs.jsonl").write_text("".join(content[::-1]))
    tagtrail("study", ROOM, "--runs", "4", *REBASE, *SET, "--out", out)
    assert results(out) == results(study)


def test_a_run_that_raises_is_recorded_and_the_study_goes_on(
    tagtrail: Command, write_scenario: Callable[..., Path], tmp_path: Path
) -> None:
    (tmp_path / "moody.py").write_text(MOODY)
    path = write_scenario("mission: moody:Moody\n", extends=ROOM)
    out = tmp_path / "out"
    result = tagtrail("study", path, "--runs", "8", "--workers", "2", *SET, "--out", out)
    assert (result.status, result.err) == (0, "")
    records = {record["seed"]: record for record in lines(out)}
    assert {seed: record.get("error") for seed, record in records.items()} == {
        0: None,
        1: "RuntimeError: bad luck with seed 1",
        2: None,
        3: "the process ended with exit code 7",
        4: "bad input of seed 4",
        5: "the process was killed by SIGKILL",
        6: None,
        7: "RuntimeError: bad luck with seed 7",
    }
    wrong = [seed for seed, record in records.items() if record["outcome"] == ERROR]
    assert sorted(wrong) == [1, 3, 4, 5, 7]
    summary = json.loads((out / "summary.json").read_text())
    (variant,) = summary["variants"]
    assert variant["outcomes"] == {"error": 5, "timeout": 3}
    assert variant["metrics"]["sim_seconds"]["all"]["n"] == 3
    assert "bad luck with seed 7" in result.out
    assert "| bad input of seed 4 | 4 |" in (out / "table.md").read_text()
    # Who asks again gets the same: these are results.
    before = (out / "runs.jsonl").read_bytes()
    assert tagtrail("study", path, "--runs", "8", *SET, "--out", out).status == 0
    assert (out / "runs.jsonl").read_bytes() == before


MOODY = """
import os, signal
from dataclasses import dataclass
from diagrams.navigation import NavigationScenario

@dataclass(kw_only=True)
class Moody(NavigationScenario):
    def build(self, **resources):
        if self.seed in (1, 7):
            raise RuntimeError(f"bad luck\\n  with seed {self.seed}")
        if self.seed == 3:
            os._exit(7)
        if self.seed == 4:
            raise ValueError("bad input of seed 4")
        if self.seed == 5:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().build(**resources)
"""


def test_a_block_that_raises_while_it_runs_is_recorded(
    write_scenario: Callable[..., Path], tmp_path: Path
) -> None:
    (tmp_path / "fussy.py").write_text(FUSSY)
    path = write_scenario("controller: fussy:Fussy\n", extends=ROOM)
    study = load_study(str(path), FAST)

    def alone(seed: int) -> str | None:
        try:
            simulate(study.variants[0].scenario(seed))
        except FloatingPointError as error:
            return f"FloatingPointError: {error}"
        return None

    wanted = [alone(seed) for seed in range(5)]
    assert None in wanted
    assert set(wanted) != {None}
    records = run_study(study, runs=5, out=tmp_path / "out", workers=2)
    assert [record.get("error") for record in records] == wanted


FUSSY = """
from pydrake.systems.framework import LeafSystem

class Fussy(LeafSystem):
    def __init__(self):
        super().__init__()
        self.pose = self.DeclareVectorInputPort("pose", 3)
        self.DeclareVectorOutputPort("command", 2, lambda context, output: None)
        self.DeclarePeriodicPublishEvent(0.4, 0.1, self.look)

    def look(self, context):
        y = self.pose.Eval(context)[1]  # noisy in its last digits, so another one for every seed
        if int(abs(y) * 1e9) % 3 == 0:
            raise FloatingPointError(f"y is {y}")
"""


def test_the_scenario_may_be_edited_while_its_study_runs(
    write_scenario: Callable[..., Path], tmp_path: Path
) -> None:
    path = write_scenario("duration: 0.2\n", extends=ROOM)
    study = load_study(str(path), FAST[:2])
    path.write_text("not: a scenario\n")
    (record,) = run_study(study, runs=1, out=tmp_path / "out", workers=1)
    assert record["sim_seconds"] == 0.2


def test_progress_counts_the_runs(tmp_path: Path) -> None:
    seen: list[tuple[float, float]] = []
    study = load_study(ROOM, [*FAST, "duration=0.1"])

    def run(runs: int) -> None:
        seen.clear()
        run_study(
            study, runs=runs, out=tmp_path, workers=1, progress=lambda *pair: seen.append(pair)
        )

    run(2)
    assert seen == [(0, 2), (1, 2), (2, 2)]
    run(3)
    assert seen == [(2, 3), (3, 3)]


def test_keep_keeps_each_runs_folder(tagtrail: Command, tmp_path: Path) -> None:
    arguments = ("--runs", "2", "--workers", "1", *REBASE, *SET, "--keep", "--out", tmp_path)
    assert tagtrail("study", ROOM, *arguments).status == 0
    for record in lines(tmp_path):
        folder = tmp_path / "runs" / record["variant"] / str(record["seed"])
        report = json.loads((folder / "report.json").read_text())
        assert report["seed"] == record["seed"]
        assert report["metrics"] == record["metrics"]
        assert (folder / "summary.png").exists()
        assert not (folder / "bag").exists()


# Interrupted, killed, continued


def arguments(out: Path, runs: int = 4) -> list[str]:
    return ["study", ROOM, "--runs", str(runs), *REBASE, *SET, "--out", str(out)]


def start(out: Path, runs: int) -> subprocess.Popen[str]:
    """Starts a study as a shell does, in a process group of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "tagtrail", *arguments(out, runs), "--workers", "2"],
        cwd=out.parent,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def wait_for_runs(process: subprocess.Popen[str], out: Path, count: int) -> None:
    deadline = time.monotonic() + 120
    file = out / "runs.jsonl"
    while not (file.exists() and file.read_bytes().count(b"\n") >= count):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


def group_exists(number: int) -> bool:
    try:
        os.killpg(number, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_killed_study_goes_on_where_it_was(
    study: Path, tagtrail: Command, tmp_path: Path
) -> None:
    out = tmp_path / "killed"
    process = start(out, runs=4)
    wait_for_runs(process, out, 2)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    before = (out / "runs.jsonl").read_bytes()
    whole = before[: before.rfind(b"\n") + 1]
    assert 2 <= whole.count(b"\n") < 8
    assert not (out / "summary.json").exists()
    assert tagtrail(*arguments(out)).status == 0
    assert (out / "runs.jsonl").read_bytes().startswith(whole)
    assert len(lines(out)) == 8
    assert results(out) == results(study)


def test_ctrl_c_leaves_what_is_done(study: Path, tmp_path: Path) -> None:
    out = tmp_path / "interrupted"
    process = start(out, runs=1000)
    wait_for_runs(process, out, 2)
    os.killpg(process.pid, signal.SIGINT)  # a terminal sends it to the whole group
    said = process.communicate(timeout=60)
    assert (process.returncode, *said) == (1, "", "tagtrail: interrupted\n")
    deadline = time.monotonic() + 20
    while group_exists(process.pid):  # no process is left behind
        assert time.monotonic() < deadline
        time.sleep(0.05)
    done = lines(out)
    assert len(done) >= 2
    first = {(r["variant"], r["seed"]): timeless(r) for r in lines(study)}
    for record in done[:2]:
        assert timeless(record) == first[record["variant"], record["seed"]]


@pytest.mark.parametrize("torn", [40, -1])
def test_a_torn_line_is_dropped_and_its_run_done_again(
    study: Path, tagtrail: Command, tmp_path: Path, torn: int
) -> None:
    out = tmp_path / "torn"
    out.mkdir()
    (out / "study.yaml").write_bytes((study / "study.yaml").read_bytes())
    content = (study / "runs.jsonl").read_bytes().splitlines(keepends=True)
    # All of the line but its end (-1) would still be JSON: it is not trusted either.
    (out / "runs.jsonl").write_bytes(b"".join(content[:7]) + content[7][:torn])
    assert tagtrail(*arguments(out)).status == 0
    now = (out / "runs.jsonl").read_bytes().splitlines(keepends=True)
    assert now[:7] == content[:7]
    assert timeless(json.loads(now[7])) == timeless(json.loads(content[7]))
    assert len(now) == 8
    assert results(out) == results(study)


def test_a_damaged_line_is_done_again(study: Path, tagtrail: Command, tmp_path: Path) -> None:
    out = tmp_path / "damaged"
    out.mkdir()
    (out / "study.yaml").write_bytes((study / "study.yaml").read_bytes())
    content = (study / "runs.jsonl").read_bytes().splitlines(keepends=True)
    (out / "runs.jsonl").write_bytes(b"\0" * 30 + b"\n[]\n3\n" + b"".join(content[1:]))
    assert tagtrail(*arguments(out)).status == 0
    assert results(out) == results(study)
    assert len((out / "runs.jsonl").read_bytes().splitlines()) == 3 + 7 + 1


def test_runs_may_be_added_later_and_fewer_looked_at(
    study: Path, tagtrail: Command, tmp_path: Path
) -> None:
    out = tmp_path / "grown"
    assert tagtrail(*arguments(out, runs=1)).status == 0
    small = results(out)
    first = (out / "runs.jsonl").read_bytes()
    assert first.count(b"\n") == 2
    assert tagtrail(*arguments(out, runs=4)).status == 0
    assert (out / "runs.jsonl").read_bytes().startswith(first)
    assert len(lines(out)) == 8
    assert results(out) == results(study)
    # Fewer are summed up from what is there, and nothing is thrown away.
    assert tagtrail(*arguments(out, runs=1)).status == 0
    assert results(out) == small
    assert len(lines(out)) == 8


def test_study_of_a_library_user_refuses_as_the_command_does(tmp_path: Path) -> None:
    study: Study = load_study(ROOM, FAST)
    with pytest.raises(ValueError, match="--runs is 0"):
        run_study(study, runs=0, out=tmp_path / "none")
    assert not (tmp_path / "none").exists()
    with pytest.raises(ScenarioError, match="no such file or bundled name"):
        load_study("navigatoin")
