"""What a campaign keeps of every flight over time."""

import numpy as np
import pytest

from keepout.errors import ScenarioError
from keepout.mission import series
from keepout.mission.series import SERIES, SeriesKeeper

GOAL = (1.0, -2.0, 3.0)
STEPS = 10


def log(flights, seed=0):
    draw = np.random.default_rng(seed)
    rows = STEPS + 1
    return {
        "position": draw.normal(size=(flights, rows, 3)),
        "velocity": draw.normal(size=(flights, rows, 3)),
        "barrier": draw.normal(size=(flights, rows)),
        "lyapunov": draw.normal(size=(flights, rows)),
    }


def keeper(**options):
    return SeriesKeeper(tuple(SERIES), **{"flights": 5, "steps": STEPS, "period": 0.5, "goal": GOAL, **options})


def test_each_quantity_is_the_logs():
    whole, kept = log(5), keeper()
    assert set(kept.columns) == set(whole)
    kept.land(0, {name: array[:3] for name, array in whole.items()})
    kept.land(3, {name: array[3:] for name, array in whole.items()})
    values = kept.kept().values
    error = np.sqrt(((whole["position"] - GOAL) ** 2).sum(axis=2))
    np.testing.assert_allclose(values["position_error"], error, rtol=1e-6)
    np.testing.assert_allclose(values["speed"], np.sqrt((whole["velocity"] ** 2).sum(axis=2)), rtol=1e-6)
    np.testing.assert_allclose(values["axis_speed"], abs(whole["velocity"]).max(axis=2), rtol=1e-6)
    np.testing.assert_array_equal(values["barrier"], whole["barrier"].astype(np.float32))
    np.testing.assert_array_equal(values["lyapunov"], whole["lyapunov"].astype(np.float32))
    np.testing.assert_array_equal(kept.kept().time, 0.5 * np.arange(STEPS + 1))


def test_a_stride_keeps_the_end():
    whole, kept = log(5), keeper(stride=4)
    kept.land(0, whole)
    np.testing.assert_array_equal(kept.kept().time, [0.0, 2.0, 4.0, 5.0])
    np.testing.assert_array_equal(kept.kept().values["barrier"], whole["barrier"][:, [0, 4, 8, 10]].astype(np.float32))


def test_flights_that_did_not_land_are_not_numbers():
    kept = keeper()
    kept.land(0, log(2))
    assert np.isnan(kept.kept().values["speed"][2:]).all()
    assert np.isfinite(kept.kept().values["speed"][:2]).all()


def test_many_flights_are_kept_at_a_stride(monkeypatch):
    monkeypatch.setattr(series, "MOST_NUMBERS", 5 * 11 * 5 // 2)
    kept = keeper().kept()
    assert kept.stride == 3
    assert sum(values.size for values in kept.values.values()) <= series.MOST_NUMBERS


def test_a_file_reads_back(tmp_path):
    kept = keeper(stride=2)
    kept.land(0, log(5))
    kept.kept().save(tmp_path / "series.npz")
    with np.load(tmp_path / "series.npz", allow_pickle=False) as stored:
        assert set(stored) == {"time", *SERIES}
        for name in SERIES:
            np.testing.assert_array_equal(stored[name], kept.kept().values[name])


def test_what_cannot_be_kept_is_refused():
    with pytest.raises(ScenarioError, match="series: 'thrust' is not known; valid: barrier"):
        SeriesKeeper(("thrust",), flights=1, steps=1, period=1.0, goal=GOAL)
    with pytest.raises(ScenarioError, match="a stride of -1"):
        keeper(stride=-1)
