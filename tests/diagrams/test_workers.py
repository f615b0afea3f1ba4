from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from diagrams.workers import Died, available_cores, work

ROOT = Path(__file__).resolve().parents[2]


def evaluated(*tasks: str, workers: int = 2, tasks_per_worker: int = 100) -> dict[str, object]:
    """What becomes of Python expressions in worker processes."""
    pairs = list(work(eval, tasks, workers=workers, tasks_per_worker=tasks_per_worker))
    assert len(pairs) == len(tasks)
    return dict(pairs)


def test_every_task_is_done_once() -> None:
    tasks = [f"{k} ** 2" for k in range(23)]
    assert evaluated(*tasks, workers=3) == {task: eval(task) for task in tasks}
    assert evaluated() == {}


def test_one_process_works_in_order() -> None:
    tasks = ["3", "1", "2"]
    assert [t for t, _ in work(eval, tasks, workers=1, tasks_per_worker=2)] == tasks


def test_a_process_that_dies_takes_only_its_own_task_along() -> None:
    exits = "__import__('os')._exit(3)"
    killed = "__import__('os').kill(__import__('os').getpid(), 9)"
    raises = "1 / 0"  # what the function does not catch ends its process
    tasks = ["1", exits, "2", killed, "3", "4", "5"]
    found = evaluated(*tasks)
    assert found.pop(exits) == Died(3)
    assert found.pop(killed) == Died(-9)
    assert found == {task: int(task) for task in ("1", "2", "3", "4", "5")}
    assert evaluated(raises, workers=1) == {raises: Died(1)}
    assert str(Died(3)) == "the process ended with exit code 3"
    assert str(Died(-11)) == "the process was killed by SIGSEGV"


def test_a_process_is_replaced_after_its_number_of_tasks() -> None:
    tasks = [f"({k}, __import__('os').getpid())" for k in range(7)]
    found = evaluated(*tasks, workers=1, tasks_per_worker=3)
    processes = [found[task][1] for task in tasks]  # type: ignore[index]
    assert [len({*processes[k : k + 3]}) for k in (0, 3, 6)] == [1, 1, 1]
    assert len(set(processes)) == 3
    assert os.getpid() not in processes


def test_a_process_has_one_thread_and_the_caller_keeps_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    tasks = [f"__import__('os').environ['{name}']" for name in names]
    assert set(evaluated(*tasks).values()) == {"1"}
    assert os.environ["OMP_NUM_THREADS"] == "5"
    assert "MKL_NUM_THREADS" not in os.environ


def test_who_stops_looking_leaves_no_process() -> None:
    pid = "__import__('os').getpid()"
    results = work(eval, [pid, f"{pid} or 1", "__import__('time').sleep(600)"], workers=1,
                   tasks_per_worker=9)  # fmt: skip
    _, process = next(results)
    results.close()  # type: ignore[attr-defined]
    with pytest.raises(ProcessLookupError):
        os.kill(int(process), 0)  # type: ignore[arg-type]


def test_a_script_without_its_guard_is_told(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "from diagrams.workers import work\n"
        "print(list(work(eval, ['1'], workers=1, tasks_per_worker=1)))\n"
    )
    finished = subprocess.run(
        [sys.executable, script],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert finished.returncode == 1
    assert "under `if __name__ == '__main__':`" in finished.stderr.splitlines()[-1]


def test_no_process_outlives_a_killed_caller(tmp_path: Path) -> None:
    """Nothing that the caller would do at its end is done when it is killed."""
    script = tmp_path / "script.py"
    busy = "(print(__import__('os').getpid(), flush=True), __import__('time').sleep(60))"
    script.write_text(
        "from diagrams.workers import work\n"
        "if __name__ == '__main__':\n"
        f"    list(work(eval, [{busy!r}], workers=1, tasks_per_worker=1))\n"
    )
    caller = subprocess.Popen(
        [sys.executable, str(script)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert caller.stdout is not None
    worker = int(caller.stdout.readline())
    os.kill(worker, 0)  # it is there
    caller.kill()
    # Its output is at an end once nobody holds it open.
    rest, _ = caller.communicate(timeout=20)
    assert rest == ""


def test_there_is_at_least_one_core() -> None:
    assert 1 <= available_cores() <= (os.cpu_count() or 1)
