"""What varies in a campaign: the laws that values are drawn by, and that run k is run k whoever asks."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from keepout.core.errors import ScenarioError
from keepout.core.mission.scenario import Scenario, with_entries
from keepout.flights.campaign.dispersion import design

SPREAD = {
    "chaser.mass": {"uniform": [18.0, 22.0]},
    "start.position": {"sphere": [6.0, 12.0], "centre": [1.0, 2.0, 3.0]},
    "start.velocity.x": {"normal": [0.01, 0.002], "within": 2.0},
    "disturbance.kind": {"choice": ["paper", "none", "resonant"], "weights": [3, 1, 0]},
    "goal.position": {"uniform": [[-1.0, -10.0, -4.0], [1.0, -9.0, -4.0]]},
}


def drawn(dispersions, first=0, last=4000, *, seed=0, runs=4000, **campaign):
    entries = {"runs": runs, "dispersions": dispersions, **campaign}
    return design(Scenario().replace(seed=seed, campaign=entries)).values(first, last)


def test_values_follow_their_laws():
    values = drawn(SPREAD)
    assert stats.kstest(values["chaser.mass"], stats.uniform(18.0, 4.0).cdf).pvalue > 1e-3
    normal = stats.truncnorm(-2.0, 2.0, 0.01, 0.002)
    assert stats.kstest(values["start.velocity.x"], normal.cdf).pvalue > 1e-3
    assert np.abs(values["start.velocity.x"] - 0.01).max() <= 0.004
    away = values["start.position"] - [1.0, 2.0, 3.0]
    length = np.linalg.norm(away, axis=1)
    assert stats.kstest(length, stats.uniform(6.0, 6.0).cdf).pvalue > 1e-3
    for axis in (away / length[:, None]).T:  # Archimedes: each coordinate of a direction is uniform
        assert stats.kstest(axis, stats.uniform(-1.0, 2.0).cdf).pvalue > 1e-3
    chosen = values["disturbance.kind"]
    assert chosen.count("resonant") == 0
    assert stats.binomtest(chosen.count("paper"), 4000, 0.75).pvalue > 1e-3
    assert values["goal.position"].min(axis=0)[2] == values["goal.position"].max(axis=0)[2] == -4.0


@given(
    cut=st.integers(1, 39),
    seed=st.integers(0, 2**32 - 1),
    sampling=st.sampled_from(["random", "latin-hypercube", "sobol"]),
)
def test_a_run_is_the_same_in_whatever_piece_it_is_drawn(cut, seed, sampling):
    whole = drawn(SPREAD, 0, 40, seed=seed, runs=40, sampling=sampling)
    pieces = [drawn(SPREAD, *ends, seed=seed, runs=40, sampling=sampling) for ends in ((0, cut), (cut, 40))]
    for name, values in whole.items():
        np.testing.assert_array_equal(np.asarray(values), np.concatenate([np.asarray(p[name]) for p in pieces]))


def test_a_random_run_depends_neither_on_the_number_of_runs_nor_on_what_else_varies():
    few = drawn({"chaser.mass": SPREAD["chaser.mass"]}, 7, 8, runs=8)["chaser.mass"]
    assert few == drawn(SPREAD, 7, 8, runs=1_000_000)["chaser.mass"]
    assert few != drawn(SPREAD, 7, 8, seed=1)["chaser.mass"]


def test_a_start_drawn_again_is_another_and_leaves_the_rest():
    varied = design(Scenario().replace(campaign={"dispersions": SPREAD}))
    again = varied.start_values(3, 1)
    assert set(again) == {"start.position"}
    assert not np.array_equal(again["start.position"], varied.values(3, 4)["start.position"][0])
    np.testing.assert_array_equal(again["start.position"], varied.start_values(3, 1)["start.position"])


@pytest.mark.parametrize("sampling", ["latin-hypercube", "sobol"])
def test_a_design_over_all_runs_fills_every_stratum_of_every_number_once(sampling):
    runs = 64
    entry = {"uniform": [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]}
    values = drawn(
        {"start.position": entry, "chaser.mass": {"uniform": [1.0, 2.0]}}, 0, runs, runs=runs, sampling=sampling
    )
    for column in (*values["start.position"].T, values["chaser.mass"] - 1.0):
        np.testing.assert_array_equal(np.sort(np.floor(column * runs)), np.arange(runs))


@pytest.mark.parametrize(
    ("dispersions", "said"),
    [
        ({"chaser.mas": {"uniform": [1, 2]}}, "chaser.mas: no such entry; did you mean mass"),
        ({"seed": {"uniform": [1, 2]}}, "seed: one for the whole campaign"),
        ({"chaser.mass": {"sphere": 2.0}}, "sphere is for vectors"),
        ({"chaser.mass": {"uniform": [[1, 2, 3], [4, 5, 6]]}}, "needed are two numbers"),
        ({"control.profile": {"uniform": [1, 2]}}, "only choice"),
        ({"start.position": {"sphere": 9.0}, "start.position.x": {"uniform": [1, 2]}}, "a vector or its components"),
    ],
)
def test_what_no_run_could_fly_is_refused_at_once(dispersions, said):
    with pytest.raises(ScenarioError, match=said) as refusal:
        design(Scenario().replace(campaign={"dispersions": dispersions}))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ({}, "needs one of"),
        ({"uniform": [1, 2], "normal": [0, 1]}, "uniform and normal"),
        ({"uniform": [3, 2]}, "first must not exceed"),
        ({"normal": [3, -2]}, "standard deviation"),
        ({"choice": [1, 2], "weights": [1]}, "one for each value"),
        ({"uniform": [1, 2], "within": 2.0}, "within is for normal"),
    ],
)
def test_a_dispersion_that_means_nothing_is_refused_with_its_name(entry, said):
    with pytest.raises(ScenarioError, match=said) as refusal:
        Scenario.parse({"campaign": {"dispersions": {"chaser.mass": entry}}})
    assert "campaign.dispersions.chaser.mass" in str(refusal.value)


def test_a_value_out_of_range_is_refused_with_its_entry():
    with pytest.raises(ScenarioError, match=r"chaser\.mass: -1\.0 must be greater than 0"):
        with_entries(Scenario(), {"chaser.mass": -1.0})
    with pytest.raises(ScenarioError, match=r"disturbance\.force\.x: disturbance\.force is not set"):
        with_entries(Scenario(), {"disturbance.force.x": 1.0})
