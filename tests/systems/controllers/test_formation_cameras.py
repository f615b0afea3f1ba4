"""Which cameras of a formation take pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator

from systems.controllers.formation_cameras import FormationCameras
from systems.messages import Detections

BOTH = ("front_camera", "rear_camera")


def picture(stamp: float, *ids: int) -> AbstractValue:
    return AbstractValue.Make(
        Detections(
            stamp=stamp,
            ids=np.array(ids, np.int64),
            corners=np.zeros((len(ids), 4, 2)),
            hamming=np.zeros(len(ids), np.int64),
            decision_margin=np.zeros(len(ids)),
        )
    )


class Watch:
    """Two robots; what they show and whether they are needed is set from outside."""

    def __init__(self, **arguments: Any) -> None:
        self.system = FormationCameras(robots=2, **arguments)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.look(1.0, 1.0)
        for robot in (0, 1):
            for camera in BOTH:
                self.show(robot, camera, picture(float("nan")))

    def look(self, *looking: float) -> None:
        self.system.looking_input_port().FixValue(self.context, looking)

    def show(self, robot: int, camera: str, value: AbstractValue) -> None:
        self.system.detections_input_port(robot, camera).FixValue(self.context, value)

    def at(self, t: float) -> list[list[float]]:
        self.simulator.AdvanceTo(t)
        return [
            [self.system.active_output_port(k, name).Eval(self.context)[0] for name in BOTH]
            for k in (0, 1)
        ]


def test_all_begin_awake() -> None:
    assert Watch().at(0.3) == [[1, 1], [1, 1]]


def test_a_camera_that_shows_nobody_rests_and_looks_again() -> None:
    watch = Watch(rest=0.5)
    watch.show(0, "rear_camera", picture(0.1))
    watch.show(0, "front_camera", picture(0.1, 4))
    assert watch.at(0.3) == [[1, 0], [1, 1]]
    assert watch.at(0.58) == [[1, 0], [1, 1]]
    assert watch.at(0.66) == [[1, 1], [1, 1]]
    watch.show(0, "rear_camera", picture(0.7))
    assert watch.at(0.8) == [[1, 0], [1, 1]]


def test_one_that_shows_somebody_again_goes_on() -> None:
    watch = Watch()
    watch.show(1, "front_camera", picture(0.1))
    assert watch.at(0.3)[1] == [0, 1]
    watch.show(1, "front_camera", picture(0.25, 8))  # one that was under way
    assert watch.at(0.4)[1] == [1, 1]


def test_no_camera_of_a_robot_that_is_not_needed_is_on() -> None:
    watch = Watch()
    watch.look(0.0, 1.0)
    assert watch.at(0.2) == [[0, 0], [1, 1]]


def test_without_rest_all_pictures_are_taken() -> None:
    watch = Watch(rest=0.0)
    watch.show(0, "front_camera", picture(0.1))
    assert watch.at(0.2) == [[1, 1], [1, 1]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"robots": 0}, "robots is 0: must be 1 or more"),
        ({"robots": 4, "cameras": ()}, r"cameras is \[\]: must be names of one or more"),
        ({"robots": 4, "rest": -0.1}, "rest is -0.1: must be 0 or greater"),
        ({"robots": 4, "rate": 0.0}, "rate is 0.0: must be greater than 0"),
    ],
)
def test_nonsense_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FormationCameras(**arguments)
