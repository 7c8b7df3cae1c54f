"""Case 1: pairs, counts and kept batches; its flights are those of tests/apps/reproduction/test_reproduce_all.py."""

import numpy as np
import pytest

from keepout.apps.reproduction import flown as flying
from keepout.apps.reproduction.flown import Passage, fly_passages
from keepout.apps.reproduction.work import Work
from keepout.core.mission.scenario import Scenario

SCENARIO = Scenario().replace(name="some", control={"profile": "paper"})


def test_a_stopped_run_loses_only_the_batch_under_way(tmp_path, monkeypatch):
    passages = [Passage((float(i), 10.0, 0.0), (0.0, -10.0, 0.0), 20.0) for i in range(150)]
    work, asked, stops_at = Work(tmp_path), [], [3]

    def batch(mission, part, size, guidances, logs):
        asked.append((len(part), size, logs))
        if len(asked) in stops_at:
            raise KeyboardInterrupt
        columns = {name: np.array([one.start[0] for one in part]) for name in ("trapped", "contact")}
        return columns | {"log_time": np.array([[one.start[0]] for one in part[:logs]]).reshape(logs, 1)}

    def fly(made_with="field"):
        # No mission is asked for, and so none is prepared.
        return fly_passages(work, SCENARIO, passages, lambda: None, made_with=[made_with], logs=2)

    monkeypatch.setattr(flying, "_fly", batch)
    monkeypatch.setattr(flying, "_own_guidances", lambda mission: None)
    with pytest.raises(KeyboardInterrupt):
        fly()
    landed = fly()
    # Every batch is as large as the first, so that one program serves all; the last is flown again, the others not.
    assert asked == [(60, 60, 2), (60, 60, 0), (30, 60, 0), (30, 60, 0)]
    np.testing.assert_array_equal(landed["trapped"], np.arange(150.0))
    np.testing.assert_array_equal(landed["log_time"], [[0.0], [1.0]])
    fly()
    assert len(asked) == 4
    fly("another field")
    assert len(asked) == 7
