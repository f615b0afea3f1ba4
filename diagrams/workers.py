"""Worker processes: each does one task after another, and a task may kill its worker.

The standard library's pools do not fit: when a process dies, `concurrent.futures` loses all tasks
in hand without telling whose fault it was, and `multiprocessing.Pool` waits for ever; replacing the
processes of a `ProcessPoolExecutor` after some number of tasks can hang it (CPython issue 115634).
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")

# Several processes of one thread each beat one process of several threads. The last is Mesa's
# software renderer.
_ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "LP_NUM_THREADS",
    ),
    "1",
)


@dataclass(frozen=True)
class Died:
    """What comes of a task whose process ended under it.

    Attributes:
        exit_code: of the process; minus the signal, if one killed it.
    """

    exit_code: int

    def __str__(self) -> str:
        if self.exit_code >= 0:
            return f"the process ended with exit code {self.exit_code}"
        try:
            name = signal.Signals(-self.exit_code).name
        except ValueError:  # a real-time signal
            name = f"signal {-self.exit_code}"
        return f"the process was killed by {name}"


def available_cores() -> int:
    """Returns how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):  # Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def work(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    *,
    workers: int,
    tasks_per_worker: int,
) -> Iterator[tuple[Task, Result | Died]]:
    """Yields every task with its result, in the order in which they get done.

    Processes are spawned, one thread each, and killed when the iterator is closed. Ctrl-C reaches
    the caller only.

    Args:
        function: can be imported from its module; catches the exceptions that it expects.
        tasks: what it is called with; they and the results can be pickled.
        workers: how many processes.
        tasks_per_worker: a process is replaced after so many, which frees what it has hoarded.

    Raises:
        RuntimeError: the processes cannot be started.
    """
    waiting = deque(tasks)
    crew: dict[Connection, _Worker] = {}
    try:
        while waiting or crew:
            starting = sum(not worker.held for worker in crew.values())
            while len(crew) < workers and starting < len(waiting):
                worker = _Worker(function)
                crew[worker.connection] = worker
                starting += 1
            for connection in wait(list(crew)):
                worker = crew[connection]  # type: ignore[index]
                held = worker.held
                try:
                    result = worker.connection.recv()
                except (EOFError, OSError):
                    del crew[worker.connection]
                    result = worker.end()
                    if not held:
                        raise RuntimeError(
                            f"worker processes cannot start ({result}); a script must call this "
                            "under `if __name__ == '__main__':`"
                        ) from None
                else:
                    if waiting and worker.given < tasks_per_worker:
                        worker.give(waiting.popleft())
                    else:
                        del crew[worker.connection]
                        worker.connection.close()  # it sees that and ends
                if held:
                    yield held[0], result
    finally:
        for worker in crew.values():
            worker.process.kill()
            worker.end()


class _Worker:
    """A process and what it has in hand: nothing only while it starts."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, function), daemon=True)
        self.held: tuple[Any, ...] = ()
        self.given = 0
        with _inherited_by_workers():
            self.process.start()
        theirs.close()  # else its end would never be noticed

    def give(self, task: Any) -> None:
        self.held = (task,)
        self.given += 1
        with suppress(OSError):  # it has died; the next look at its connection says so
            self.connection.send(task)

    def end(self) -> Died:
        self.connection.close()
        self.process.join()
        assert self.process.exitcode is not None
        return Died(self.process.exitcode)


def _serve(connection: Connection, function: Callable[[Any], Any]) -> None:
    """Works until the other end is closed; ends at once when whoever started this process dies."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    result = None  # the first message only says that the process is up
    while True:
        try:
            connection.send(result)
            task = connection.recv()
        except (EOFError, OSError):
            return
        result = function(task)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)  # nobody wants the task in hand any more


@contextmanager
def _inherited_by_workers() -> Iterator[None]:
    """What a process that is started inside has: one thread, and no ear for Ctrl-C."""
    resource_tracker.ensure_running()  # unblocks SIGINT when it starts
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(_ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
