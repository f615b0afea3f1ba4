from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from plants.formation_arena import formation_arena, known_obstacles
from systems.planners.formation_course import FormationMove, Memory, Report, after
from systems.planners.formation_ground import FormationParameters
from systems.planners.formation_lattice import body_of, fit_lattice, strip
from systems.planners.formation_obstacles import Obstacles, clearance
from systems.planners.formation_planner import RULES, FormationPlanner

FREE = Obstacles(stamp=0.0)
PARAMETERS = FormationParameters()
FAR = np.array([9.0, 4.0])


@dataclass
class World:
    """Robots that do as they are told, with noise, until something happens to them."""

    places: np.ndarray
    destination: np.ndarray = field(default_factory=lambda: FAR.copy())
    obstacles: Obstacles = FREE
    rule: str = "astar"
    noise: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        self.lattice, vertices = fit_lattice(self.places, PARAMETERS.side)
        self.memory = Memory(dict(enumerate(vertices)))
        self.places = self.places.copy()
        self.failed = np.zeros(len(self.places), int)
        self.random = np.random.default_rng(self.seed)
        self.time = 0.0

    def look(self, outcome: int = 0) -> FormationMove:
        """Has the planner look, and holds what it says to what must be."""
        self.time += 0.1
        before = self.memory.move
        noise = self.random.uniform(-self.noise, self.noise, self.places.shape)
        report = Report(
            time=self.time,
            positions=self.places + noise,
            failed=self.failed,
            obstacles=self.obstacles,
            destination=self.destination,
            outcome=outcome,
        )
        self.memory = after(self.memory, report, self.lattice, PARAMETERS, RULES[self.rule])
        move = self.memory.move
        if move is not before and move.status == "moving":
            self._check(move, before)
        return move

    def _check(self, move: FormationMove, before: FormationMove) -> None:
        assert move.number == before.number + 1
        assert move.stamp == self.time
        taking_part = [move.mover, *move.beacons]
        assert len(set(taking_part)) == 4
        assert self.failed[move.mover] == 0
        assert (self.failed[move.beacons] < 2).all()
        assert move.mover not in self.memory.vertices
        standing = set(self.memory.vertices.values())
        beacons = [self.memory.vertices[k] for k in move.beacons]
        assert set(beacons) <= body_of(standing)
        ideal = self.lattice.positions(np.array(beacons))
        np.testing.assert_allclose(
            np.linalg.norm(ideal - move.target, axis=1), 1.5 * np.array([1, 1, math.sqrt(3)])
        )
        assert not self.failed[move.leader]
        assert move.leader != move.mover
        wrecks = [
            [*self.places[k], PARAMETERS.robot_radius]
            for k in np.flatnonzero(self.failed)
            if k not in self.memory.vertices
        ]
        for a, b in zip(move.points, move.points[1:], strict=False):
            room = clearance(self.obstacles.with_circles(wrecks), a, b)
            assert room >= PARAMETERS.room - 2 * self.noise

    def drive(self, part: float = 1.0) -> None:
        """Puts the mover on its way, or at the end of it."""
        move = self.memory.move
        way = np.concatenate([self.places[move.mover][None], move.points])
        lengths = np.hypot(*np.diff(way, axis=0).T)
        at = part * lengths.sum()
        along = np.concatenate([[0.0], np.cumsum(lengths)])
        self.places[move.mover] = [np.interp(at, along, way[:, axis]) for axis in (0, 1)]

    def go_on(self, most: int = 200) -> str:
        """Makes moves until there is none to be made."""
        move = self.look()
        while move.status == "moving":
            assert move.number <= most, "endless"
            self.drive()
            move = self.look(outcome=1)
        return move.status


@pytest.mark.parametrize("rule", ["closest", "astar"])
@pytest.mark.parametrize("robots", [4, 6, 12, 20])
def test_a_formation_gets_there(robots: int, rule: str) -> None:
    world = World(strip(robots, 1.5), rule=rule, noise=0.05)
    assert world.go_on() == "reached"
    assert np.linalg.norm(world.places - FAR, axis=1).min() <= 0.6 * 1.5
    assert world.memory.move.mover == -1
    assert list(world.memory.move.beacons) == [-1, -1, -1]


def test_errors_of_moves_are_not_handed_on() -> None:
    world = World(strip(4, 1.5))
    move = world.look()
    while move.status == "moving":
        world.drive()
        world.places[move.mover] += world.random.normal(0, 0.05, 2)
        move = world.look(outcome=1)
    assert move.status == "reached"
    assert move.number > 6
    vertices = world.memory.vertices
    ideal = world.lattice.positions(np.array([vertices[k] for k in range(4)]))
    assert np.linalg.norm(world.places - ideal, axis=1).max() < 0.25


@pytest.mark.parametrize("rule", ["closest", "astar"])
@pytest.mark.parametrize("which", [0, 1, 2, 3, 4, 5])
def test_one_of_six_fails_and_the_others_go_on(which: int, rule: str) -> None:
    for at in (0, 2, 5):
        world = World(strip(6, 1.5), rule=rule)
        move = world.look()
        for _ in range(at):
            world.drive()
            move = world.look(outcome=1)
        assert move.status == "moving"
        world.drive(part=0.4)
        world.failed[which] = 1
        again = world.look()
        assert (again is not move) == (which == move.mover)
        stays = world.places[which].copy()
        assert world.go_on() == "reached"
        np.testing.assert_array_equal(world.places[which], stays)


def test_a_mover_that_fails_is_replaced_by_another() -> None:
    world = World(strip(6, 1.5))
    move = world.look()
    world.drive(part=0.9)  # beyond the beacons
    world.failed[move.mover] = 1
    again = world.look()
    assert again.status == "moving"
    assert again.mover != move.mover
    assert np.hypot(*(again.target - world.places[move.mover])) >= 2 * PARAMETERS.robot_radius


@pytest.mark.parametrize("which", [0, 1, 2, 3, 4, 5])
def test_one_of_six_is_lost_as_a_beacon_too(which: int) -> None:
    ended = []
    for at in (0, 2, 5):
        world = World(strip(6, 1.5))
        move = world.look()
        for _ in range(at):
            world.drive()
            move = world.look(outcome=1)
        world.drive(part=0.4)
        world.failed[which] = 2
        again = world.look()
        assert (again is not move) == (which in (move.mover, *move.beacons))
        ended.append(world.go_on())
        if ended[-1] == "too_few_robots":  # then it was the middle one of a strip of five
            assert body_of(list(world.memory.vertices.values())) == frozenset()
        assert which not in world.memory.vertices
    assert set(ended) <= {"reached", "too_few_robots"}
    assert "reached" in ended


def test_of_four_none_may_fail() -> None:
    world = World(strip(4, 1.5))
    world.look()
    world.failed[2] = 1
    assert world.look().status == "moving"  # what is under way is brought to an end
    world.drive()
    move = world.look(outcome=1)
    assert move.status == "too_few_robots"
    assert move.mover == -1
    assert world.look() is move  # nothing new to say


def test_five_may_lose_one_but_not_two() -> None:
    world = World(strip(5, 1.5))
    world.look()
    world.failed[0] = 1
    assert world.look().status == "moving"
    world.drive()
    assert world.look(outcome=1).status == "moving"
    world.failed[1] = 1
    world.drive()
    assert world.look(outcome=1).status == "too_few_robots"


def test_a_failed_leader_is_followed_by_the_next_best() -> None:
    world = World(strip(8, 1.5), destination=np.array([14.0, 0.65]))
    move = world.look()
    first = move.leader
    apart = np.linalg.norm(world.places - world.destination, axis=1)
    assert first == int(np.argmin(apart))
    world.failed[first] = 2
    world.drive()
    again = world.look(outcome=1)
    assert again.leader not in (first, again.mover)
    assert world.go_on() == "reached"


def test_who_gives_up_goes_elsewhere_or_another_goes() -> None:
    world = World(strip(6, 1.5))
    move = world.look()
    world.drive(part=0.3)
    again = world.look(outcome=-1)
    assert again.status == "moving"
    assert (again.mover, tuple(again.target)) != (move.mover, tuple(move.target))
    assert world.go_on() == "reached"


def test_who_is_not_found_where_it_should_be_is_no_beacon() -> None:
    """Before the next move: it is not built upon, and goes on when it has been found."""
    world = World(strip(6, 1.5))
    move = world.look()
    world.drive()
    where = world.places[move.mover].copy()
    world.places[move.mover] = math.nan
    again = world.look(outcome=1)
    assert world.memory.unplaced == 1
    assert again.status == "moving"
    assert move.mover not in (again.mover, *again.beacons)
    world.places[move.mover] = where
    assert world.go_on() == "reached"
    assert world.memory.unplaced == 1


def test_of_four_none_may_be_missing() -> None:
    world = World(strip(4, 1.5))
    move = world.look()
    world.drive()
    world.places[move.mover] = math.nan
    assert world.look(outcome=1).status == "blocked"


def test_what_turns_up_in_the_way_turns_the_robot_back() -> None:
    world = World(strip(4, 1.5), rule="closest")
    move = world.look()
    world.drive(part=0.3)
    beside = world.obstacles = Obstacles(stamp=1.0, circles=np.array([[5.0, -3.0, 0.2]]))
    assert world.look() is move
    x, y = move.target
    world.obstacles = replace(beside, stamp=2.0, circles=np.array([[x, y, 0.2]]))
    again = world.look()
    assert again is not move
    assert again.mover == move.mover  # it stands between vertices: it goes first
    assert again.beacons.tolist() != move.beacons.tolist()
    assert np.hypot(*(again.target - move.target)) > 1.0


def test_what_turns_up_before_a_beacon_turns_the_robot_back() -> None:
    """A post beside the way, in the line of sight from the target to the anchor or to another."""
    for beacon in range(3):
        world = World(strip(4, 1.5), rule="closest")
        move = world.look()
        world.drive(part=0.3)
        stands = world.places[move.beacons[beacon]]
        post = stands + 0.2 * (move.target - stands)
        away = clearance(Obstacles(circles=np.array([[*post, 0.02]])), *move.points[-2:])
        assert away > PARAMETERS.room or beacon == 2  # it is not in the way itself
        world.obstacles = Obstacles(stamp=1.0, circles=np.array([[*post, 0.02]]))
        assert world.look() is not move


def test_a_block_that_goes_away_lets_them_go_on() -> None:
    ring = np.array([[1.1 + 3.0 * math.cos(a), 0.65 + 3.0 * math.sin(a), 0.6] for a in range(63)])
    world = World(strip(4, 1.5), obstacles=Obstacles(stamp=0.0, circles=ring))
    assert world.look().status == "blocked"
    assert world.look().status == "blocked"
    world.obstacles = FREE
    assert world.go_on() == "reached"


def test_another_destination_is_gone_to_after_the_present_move() -> None:
    world = World(strip(4, 1.5))
    move = world.look()
    world.destination = np.array([-8.0, 0.0])
    assert world.look() is move
    assert world.go_on() == "reached"
    assert np.linalg.norm(world.places - world.destination, axis=1).min() <= 0.9
    world.destination = FAR.copy()
    assert world.look().status == "moving"  # and from where it has arrived


def test_a_beacon_far_from_its_vertex_breaks_the_formation() -> None:
    world = World(strip(4, 1.5))
    move = world.look()
    world.places[move.beacons[0]] += [0.7, 0.0]
    broken = world.look()
    assert broken.status == "broken"
    assert world.look() is broken


@pytest.mark.parametrize("seed", range(6))
def test_clutter_is_crossed_on_noisy_estimates(seed: int) -> None:
    made = formation_arena(seed)
    world = World(made.start, made.destination, known_obstacles(made.arena), noise=0.01)
    assert world.go_on() == "reached"


@pytest.mark.parametrize("seed", range(10))
def test_whatever_happens_moves_stay_legal_and_come_to_an_end(seed: int) -> None:
    random = np.random.default_rng(seed)
    world = World(strip(8, 1.5), destination=random.uniform(-12, 12, 2), noise=0.02, seed=seed)
    move = world.look()
    posts: list[list[float]] = []
    while move.status == "moving":
        assert move.number < 150, "endless"
        event = random.random()
        if event < 0.1 and (world.failed > 0).sum() < 3:
            world.drive(part=random.random())
            world.failed[random.integers(8)] = random.integers(1, 3)
            move = world.look()
        elif event < 0.2:
            world.drive(part=0.5 * random.random())
            move = world.look(outcome=-1)
        elif event < 0.3 and len(posts) < 6:
            world.drive(part=0.5 * random.random())
            posts.append([*random.uniform(-8, 8, 2), 0.15])
            apart = np.linalg.norm(world.places - posts[-1][:2], axis=1)
            if apart.min() < 0.8:
                posts.pop()  # none falls on a robot
            world.obstacles = Obstacles(stamp=world.time, circles=np.array(posts).reshape(-1, 3))
            move = world.look()
        else:
            world.drive()
            move = world.look(outcome=1)
    assert move.status in ("reached", "blocked", "too_few_robots")
    if move.status == "too_few_robots":
        able = [k for k in range(8) if not world.failed[k] and k in world.memory.vertices]
        assert len(body_of([world.memory.vertices[k] for k in able])) < 3


# --- The block ---


def simulated(planner: FormationPlanner, **inputs: object) -> Simulator:
    simulator = Simulator(planner)
    context = simulator.get_mutable_context()
    values = {
        "positions": strip(4, 1.5).ravel(),
        "failed": np.zeros(4),
        "obstacles": FREE,
        "destination": FAR,
        "progress": np.zeros(2),
        **inputs,
    }
    for name, value in values.items():
        planner.GetInputPort(name).FixValue(context, value)
    return simulator


def said_by(planner: FormationPlanner, simulator: Simulator) -> FormationMove:
    said = planner.move_output_port().Eval(simulator.get_context())
    assert isinstance(said, FormationMove)
    return said


def test_the_block_makes_moves_as_they_are_done() -> None:
    planner = FormationPlanner(start=strip(4, 1.5), rule="astar", rate=10.0)
    simulator = simulated(planner)
    context = simulator.get_mutable_context()
    places, t = strip(4, 1.5), 0.05
    simulator.AdvanceTo(t)
    while (move := said_by(planner, simulator)).status == "moving":
        assert move.number < 50
        places[move.mover] = move.target
        planner.positions_input_port().FixValue(context, places.ravel())
        planner.progress_input_port().FixValue(context, [move.number - 1.0, 1.0])  # of the last
        simulator.AdvanceTo(t + 0.1)
        assert said_by(planner, simulator).number == move.number
        planner.progress_input_port().FixValue(context, [float(move.number), 1.0])
        t += 0.2
        simulator.AdvanceTo(t)
    assert move.status == "reached"
    assert move.frame_id == "map"
    assert np.linalg.norm(places - FAR, axis=1).min() <= 0.9


@pytest.mark.parametrize(
    ("port", "value", "reason"),
    [
        ("positions", np.full(8, math.nan), "bad_position"),
        ("destination", np.array([math.inf, 0.0]), "bad_destination"),
        ("obstacles", Obstacles(circles=np.full((1, 3), math.nan)), "bad_obstacles"),
    ],
)
def test_what_cannot_be_used_is_counted(port: str, value: object, reason: str) -> None:
    planner = FormationPlanner(start=strip(4, 1.5), rate=10.0)
    simulator = simulated(planner)
    simulator.AdvanceTo(0.05)
    move = said_by(planner, simulator)
    assert move.status == "moving"
    planner.GetInputPort(port).FixValue(simulator.get_mutable_context(), value)
    simulator.AdvanceTo(0.25)
    health = planner.health_output_port().Eval(simulator.get_context())
    assert health.counts == dict.fromkeys(health.counts, 0) | {reason: 2}
    assert said_by(planner, simulator) is move


def test_without_a_destination_it_waits() -> None:
    planner = FormationPlanner(start=strip(4, 1.5), rate=10.0)
    simulator = simulated(planner, destination=np.full(2, math.nan))
    simulator.AdvanceTo(0.25)
    assert said_by(planner, simulator).status == "waiting"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start": strip(3, 1.5)}, r"start is .*: must be places of at least four robots"),
        ({"start": strip(4, 2.5)}, r"triangles of 1.5 m"),
        ({"start": strip(4, 1.5), "rule": "best"}, r"rule is 'best': must be closest or astar"),
        ({"start": strip(4, 1.5), "rate": 0.0}, r"rate is 0.0"),
    ],
)
def test_nonsense_is_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FormationPlanner(**arguments)  # type: ignore[arg-type]
