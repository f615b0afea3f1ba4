"""What the replay is told of objects that move, jump, vanish and come back."""

from typing import Any

import numpy as np
import pytest
from pydrake.geometry import Rgba, Sphere

from diagrams.surroundings_viewer import _Pool

FRAME = 0.05  # s


class Replay:
    """Keeps keyframes as Meshcat's recording does and plays them as three.js does."""

    def __init__(self) -> None:
        self.keys: dict[tuple[str, str], dict[int, Any]] = {}
        self.calls = 0

    def SetObject(self, path: str, shape: Any, colour: Any) -> None:
        pass

    def SetTransform(self, path: str, X: Any, t: float) -> None:
        self._key(path, "place", np.array(X.translation()), t)

    def SetProperty(self, path: str, name: str, value: bool, t: float) -> None:
        self._key(path, name, value, t)

    def _key(self, path: str, name: str, value: Any, t: float) -> None:
        self.calls += 1
        self.keys.setdefault((path, name), {})[int(t / FRAME)] = value

    def visible(self, path: str, t: float) -> bool:
        keys = self.keys[path, "visible"]
        before = [k for k in keys if k * FRAME <= t + 1e-9]
        return bool(keys[max(before) if before else min(keys)])

    def place(self, path: str, t: float) -> Any:
        keys = self.keys[path, "place"]
        frames = sorted(keys)
        rows = np.array([keys[k] for k in frames])
        return [np.interp(t / FRAME, frames, rows[:, i]) for i in range(3)]


def pool(replay: Replay, jumps: bool, count: int = 2) -> _Pool:
    return _Pool(
        replay,  # type: ignore[arg-type]  # what the pool uses of Meshcat
        "dots",
        count,
        Sphere(0.01),
        Rgba(0, 0, 0, 1),
        frame=FRAME,
        jumps=jumps,
    )


def at(*xs: float) -> np.ndarray:
    return np.array([[x, 0.0, 0.1, 0.0] for x in xs])


def test_what_jumps_stays_where_it_was_until_it_does() -> None:
    replay = Replay()
    dots = pool(replay, jumps=True)
    dots.show(at(1.0), 0.0)
    dots.show(at(5.0), 10.0)
    for t in (0.0, 5.0, 9.9):
        assert replay.place("view/dots/0", t)[0] == pytest.approx(1.0)
    assert replay.place("view/dots/0", 10.0)[0] == pytest.approx(5.0)


def test_what_glides_goes_there_straight() -> None:
    replay = Replay()
    dots = pool(replay, jumps=False)
    dots.show(at(1.0), 0.0)
    dots.show(at(2.0), 0.2)
    assert replay.place("view/dots/0", 0.1)[0] == pytest.approx(1.5)


@pytest.mark.parametrize("jumps", [True, False])
def test_what_vanishes_and_comes_back_does_not_wander_before(jumps: bool) -> None:
    replay = Replay()
    dots = pool(replay, jumps)
    dots.show(at(1.0), 1.0)
    dots.show(at(np.nan), 3.0)
    dots.show(at(7.0), 8.0)
    assert not replay.visible("view/dots/0", 0.5)
    assert replay.visible("view/dots/0", 2.0)
    assert replay.place("view/dots/0", 2.9)[0] == pytest.approx(1.0)
    assert not replay.visible("view/dots/0", 5.0)
    assert replay.visible("view/dots/0", 8.0)
    assert replay.place("view/dots/0", 8.0)[0] == pytest.approx(7.0)


def test_what_is_not_named_is_hidden_and_what_does_not_fit_left_out() -> None:
    replay = Replay()
    dots = pool(replay, jumps=True)
    dots.show(at(1.0, 2.0, 3.0), 1.0)
    dots.show(at(1.0), 2.0)
    assert [replay.visible(f"view/dots/{k}", 2.5) for k in range(2)] == [True, False]
    assert ("view/dots/2", "place") not in replay.keys


def test_what_stays_is_not_sent_again() -> None:
    replay = Replay()
    dots = pool(replay, jumps=False)
    dots.show(at(1.0, 2.0), 0.0)
    sent = replay.calls
    for k in range(1, 20):
        dots.show(at(1.0, 2.0), k * FRAME)
    assert replay.calls == sent


def test_every_frame_gets_its_key_though_multiples_of_its_length_are_rounded_down() -> None:
    replay = Replay()
    dots = pool(replay, jumps=False)
    for k in range(200):
        dots.show(at(float(k)), k * FRAME)
    assert sorted(replay.keys["view/dots/0", "place"]) == list(range(200))
