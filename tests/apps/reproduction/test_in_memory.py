"""A campaign in memory: where its flights start, and what is kept of them over time."""

import numpy as np
import pytest
import trimesh

from keepout.apps.reproduction import in_memory
from keepout.apps.reproduction.in_memory import SERIES, FlightSeries, draw_starts
from keepout.core.errors import ScenarioError
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario


@pytest.fixture(scope="module")
def shell(tmp_path_factory):
    """A hollow cube of 6 m: its inside has room for the chaser, and no way out."""
    path = tmp_path_factory.mktemp("mesh") / "shell.stl"
    trimesh.creation.box(extents=(6.0, 6.0, 6.0)).export(path)
    return Target.load(path, units="m")


def drawn(target, **campaign):
    return draw_starts(Scenario().replace(campaign=campaign), target)[0]


@pytest.mark.long
def test_starts_are_seeded_outside_and_roomy(shell):
    starts = drawn(shell, runs=50, lower=(-5.0, -5.0, -5.0), upper=(5.0, 5.0, 5.0))
    # Not in the hollow, and away from the walls.
    assert np.abs(starts).max(axis=1).min() > 3.0 + 0.8 / 3**0.5
    assert shell.distance.distance(starts).min() > 0.8
    with pytest.raises(ScenarioError, match="only 0 lie outside"):
        drawn(shell, runs=5, lower=(-2.0, -2.0, -2.0), upper=(2.0, 2.0, 2.0))


@pytest.mark.long
def test_starts_that_are_drawn_again_are_counted(shell):
    entries = {"runs": 50, "lower": (-5.0, -5.0, 3.0), "upper": (5.0, 5.0, 5.0)}
    scenario = Scenario().replace(campaign=entries)
    draws = np.random.default_rng(scenario.seed).uniform(entries["lower"], entries["upper"], (1000, 3))
    # Distance to the cube in closed form: every draw lies at or above its upper face.
    away = np.linalg.norm(np.maximum(np.abs(draws) - 3.0, 0.0), axis=1)
    fiftieth = np.flatnonzero(away > 0.8)[49]
    starts, drawn_again = draw_starts(scenario, shell)
    np.testing.assert_array_equal(starts, draws[: fiftieth + 1][away[: fiftieth + 1] > 0.8])
    assert drawn_again == fiftieth + 1 - 50 > 0


END = (1.0, -2.0, 3.0)
ROWS = 10


def log(flights):
    draw, rows = np.random.default_rng(0), ROWS + 1
    vectors = {name: draw.normal(size=(flights, rows, 3)) for name in ("position", "velocity")}
    return vectors | {name: draw.normal(size=(flights, rows)) for name in ("barrier", "lyapunov")}


def keeper(names=tuple(SERIES), flights=5, steps=ROWS, stride=None):
    return FlightSeries.empty(names, flights, steps, 0.5, stride)


def land(kept, first, log):
    flights = len(log["barrier"])
    kept.land(range(first, first + flights), log, np.broadcast_to(END, (flights, 3)), 0.5)


def test_each_quantity_is_the_logs():
    whole, kept = log(5), keeper()
    assert set(kept.columns) == set(whole)
    land(kept, 0, {name: array[:3] for name, array in whole.items()})
    land(kept, 3, {name: array[3:] for name, array in whole.items()})
    values = kept.values
    error = np.sqrt(((whole["position"] - END) ** 2).sum(axis=2))
    np.testing.assert_allclose(values["position_error"], error, rtol=1e-6)
    np.testing.assert_allclose(values["speed"], np.sqrt((whole["velocity"] ** 2).sum(axis=2)), rtol=1e-6)
    np.testing.assert_allclose(values["axis_speed"], abs(whole["velocity"]).max(axis=2), rtol=1e-6)
    for name in ("barrier", "lyapunov"):
        np.testing.assert_array_equal(values[name], whole[name].astype(np.float32))
    np.testing.assert_array_equal(kept.time, 0.5 * np.arange(ROWS + 1))


def test_a_stride_keeps_the_end_and_flights_that_did_not_land_are_not_numbers():
    whole, kept = log(2), keeper(stride=4)
    land(kept, 0, whole)
    np.testing.assert_array_equal(kept.time, [0.0, 2.0, 4.0, 5.0])
    np.testing.assert_array_equal(kept.values["barrier"][:2], whole["barrier"][:, [0, 4, 8, 10]].astype(np.float32))
    assert np.isnan(kept.values["speed"][2:]).all()


def test_many_flights_are_kept_at_a_stride(monkeypatch):
    monkeypatch.setattr(in_memory, "MOST_NUMBERS", 5 * 11 * 5 // 2)
    kept = keeper()
    assert sum(values.size for values in kept.values.values()) <= in_memory.MOST_NUMBERS


def test_what_cannot_be_kept_is_refused():
    with pytest.raises(ScenarioError, match="series: 'thrust' is not known; valid: barrier"):
        keeper(("thrust",))
    with pytest.raises(ScenarioError, match="a stride of -1"):
        keeper(stride=-1)
