"""Missions that differ in numbers alone are flown by one compiled program."""

import jax
import numpy as np

from keepout.compiled import kept_executables
from keepout.flight import loop
from keepout.mission.build import prepare
from keepout.mission.scenario import Scenario

TREE = {"target": {"source": "box"}, "field": {"source": "grid"}}
FLOWN = (
    {"start": {"position": [0.0, 6.0, 3.0]}, "goal": {"position": [0.0, -6.0, 3.0]}},
    {"start": {"position": [0.5, 6.5, 3.0]}, "goal": {"position": [0.7, -6.2, 2.5]}, "seed": 3},
    {"start": {"position": [0.1, 6.2, 3.0]}, "goal": {"position": [0.0, -6.1, 2.9]}, "chaser": {"mass": 20.5}},
)


def test_another_start_goal_guard_or_duration_asks_for_no_other_program(tmp_path, monkeypatch):
    made, make = [], kept_executables._program

    def counted(folder, function, *others):
        made.append(function.__name__)
        return make(folder, function, *others)

    monkeypatch.setattr(kept_executables, "_program", counted)
    monkeypatch.setattr(kept_executables, "folder_in_use", lambda: tmp_path)
    for duration, change in zip((20.0, 20.0, 30.0), FLOWN, strict=True):
        mission = prepare(Scenario.parse(TREE | change | {"duration": duration}))
        log = loop.fly(mission.setup, mission.initial, mission.steps, jax.random.key(mission.scenario.seed))
        assert len(log.time) == mission.steps + 1
        assert np.linalg.norm(np.diff(log.position, axis=0), axis=1).max() < 0.2
    assert made.count("_flown") == 1
