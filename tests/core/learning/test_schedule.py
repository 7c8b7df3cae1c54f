"""When a fit ends: by bound, by time, after its steps; and that a first field begins where it was."""

import dataclasses
import time

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from keepout.core.errors import FieldError
from keepout.core.fields import load_shipped
from keepout.core.fields.continuation import Domain
from keepout.core.fields.field import values
from keepout.core.fields.grid_build import build_grid
from keepout.core.fields.model import FieldModel
from keepout.core.fields.neural import NeuralField
from keepout.core.geometry.target import Target
from keepout.core.learning.losses import PROFILES, ROUND, TrainingProfile
from keepout.core.learning.samples import MOST_WRONG, where_wrong
from keepout.core.learning.schedule import (
    BLOCK,
    POLISH,
    POLISH_RATE,
    SECOND_ROUND,
    TUNING_RATE,
    Ending,
    Pace,
    block_lengths,
    learning_rates,
    phase_of,
    shortened,
)
from keepout.core.learning.training import Learned, layers_of

PROFILE = TrainingProfile(steps=12 * BLOCK, tuning_steps=8 * BLOCK, polish_steps=4 * ROUND)


def test_the_first_phase_ends_where_the_second_begins_and_the_others_come_to_rest():
    profile = TrainingProfile(steps=3 * BLOCK, tuning_steps=2 * BLOCK, polish_steps=4 * ROUND)
    assert block_lengths(profile) == [BLOCK] * 5 + [ROUND] * 4
    rates = [learning_rates(profile, block) for block in range(9)]
    assert [len(rate) for rate in rates] == block_lengths(profile)
    for first, last, top, least in ((0, 3, 1.0, TUNING_RATE), (3, 5, TUNING_RATE, 0.01), (5, 9, POLISH_RATE, 0.01)):
        phase = np.concatenate(rates[first:last])
        assert phase.max() == pytest.approx(top, rel=1e-3)
        assert phase[-1] / top == pytest.approx(least, rel=0.01)
        assert np.all(np.diff(phase[phase.argmax() :]) < 0.0)
    alone = TrainingProfile(steps=3 * BLOCK, tuning_steps=0)
    assert learning_rates(alone, 2)[-1] == pytest.approx(0.01, rel=0.01)
    for size in (1.0, 100.0):
        default, fine = (PROFILES[name].for_size(size) for name in ("default", "fine"))
        work = [each.batch * (each.steps + each.tuning_steps + each.polish_steps) for each in (fine, default)]
        assert 1.9 < work[0] / work[1] < 4.1  # "two to four times the work"


class Clock:
    """A fit on a clock of its own: each step and each hunt takes so long, and each hunt finds what it is told."""

    def __init__(self, monkeypatch, ending, profile=PROFILE, *, step=0.01, hunt=1.0, worst=lambda place: 1.0):
        self.now, self.places = 0.0, []
        monkeypatch.setattr(time, "perf_counter", lambda: self.now)
        pace, place = Pace(profile, ending, 0.0), 0
        while place < pace.blocks and len(self.places) < 1000:
            hunts = hunt * (phase_of(profile, place) > 0)
            steps = step * block_lengths(profile)[place]
            self.now += hunts + steps
            self.places.append(place)
            pace.found(worst(place), place)
            pace.took(place, hunts, steps)
            place = pace.onward(place)
        self.pace = pace


def test_with_nothing_asked_for_every_block_is_taken(monkeypatch):
    flown = Clock(monkeypatch, Ending())
    assert flown.places == list(range(24))
    assert flown.pace.ended == "steps"


@pytest.mark.long
@given(st.floats(15.0, 100.0), st.floats(1e-3, 0.02), st.floats(0.0, 3.0))
def test_it_ends_in_time_with_its_last_block_and_what_it_leaves_out_is_spread(at_most, step, hunt):
    with pytest.MonkeyPatch.context() as patch:
        flown = Clock(patch, Ending(at_most=at_most), step=step, hunt=hunt)
    longest = BLOCK * step + hunt
    assert flown.now <= at_most + 2.0 * longest
    gaps = np.diff(flown.places)
    assert (gaps > 0).all()
    if flown.now < at_most:
        assert flown.places[-1] == 23
    if flown.pace.ended == "steps":
        assert flown.places == list(range(24))
    needed = step * sum(block_lengths(PROFILE)) + 12 * hunt
    if needed > at_most + longest:
        assert flown.pace.ended == "time"


def test_a_bound_that_is_found_leads_to_the_polish_and_without_it_there_is_polish_as_long_as_time(
    monkeypatch,
):
    found = Clock(monkeypatch, Ending(until_bound=0.0), worst=lambda place: -1.0 if place >= 14 else 1.0)
    assert found.places == [*range(15), 20, 21, 22, 23]
    assert found.pace.ended == "bound"
    never = Clock(monkeypatch, Ending(until_bound=0.0, at_most=100.0))
    assert never.places[:24] == list(range(24))
    assert never.places[24:28] == [20, 21, 22, 23]
    assert 90.0 < never.now <= 100.0
    assert never.pace.ended == "time"
    without_time = Clock(monkeypatch, Ending(until_bound=0.0))
    assert without_time.places == list(range(24))


def test_what_falls_with_the_rate_is_expected_to_come_to_where_the_rate_is_none(monkeypatch):
    rate = {place: float(learning_rates(PROFILE, place)[0]) for place in range(20)}
    flown = Clock(monkeypatch, Ending(), worst=lambda place: -0.02 + 0.5 * rate.get(place, 0.0))
    assert flown.pace.expected == pytest.approx(-0.02)
    assert "about -0.02 m to be expected" in flown.pace.told(19, 20)
    noise = Clock(monkeypatch, Ending(), worst=lambda place: 0.1 + 0.01 * place)
    assert noise.pace.expected == pytest.approx(0.1 + 0.01 * 16.0)


@pytest.mark.parametrize(
    ("ends", "said"),
    [
        ({"until_bound": float("nan")}, "until_bound: nan m"),
        ({"at_most": 0.0}, "at_most: 0.0 s"),
        ({"at_most": -1.0}, "at_most: -1.0 s"),
        ({"at_most": float("inf")}, "at_most: inf s"),
    ],
)
def test_an_end_that_is_none_is_refused(ends, said):
    with pytest.raises(FieldError, match=said):
        Ending(**ends)


def test_an_end_by_bound_or_time_has_a_polish_and_a_profile_without_hunts_knows_no_bound():
    default = dataclasses.replace(PROFILE, polish_steps=0)
    assert Ending().of_profile(default) == default
    assert Ending(at_most=9.0).of_profile(default).polish_steps == POLISH
    assert Ending(at_most=9.0).of_profile(PROFILE) == PROFILE
    with pytest.raises(FieldError, match="until_bound: 0 m; the profile searches"):
        Ending(until_bound=0.0).of_profile(PROFILES["paper"])


@pytest.mark.parametrize(("error", "blocks"), [(0.01, 1), (0.06, 2), (0.2, 4), (1.0, 5)])
def test_a_second_fit_has_no_first_phase_and_the_fewer_steps_the_less_the_first_field_is_wrong(error, blocks):
    second = shortened(PROFILE, error)
    assert (second.steps, second.tuning_steps) == (0, blocks * BLOCK)
    assert phase_of(second, 0) == 1
    assert block_lengths(second)[blocks:] == [SECOND_ROUND] * 2


def test_a_second_fit_learns_half_its_points_where_the_first_field_is_wrong_and_half_everywhere():
    error = np.zeros(1000)
    error[:300], error[:10] = 1.0, 100.0
    drawn = np.bincount(where_wrong(error, 200_000, np.random.default_rng(0)), minlength=1000) / 200_000
    assert drawn[300:].mean() == pytest.approx(0.5 / 1000, rel=0.02)
    mean = 1.29  # one that is more wrong than MOST_WRONG of it counts as so much
    assert drawn[:10].mean() == pytest.approx(0.0005 + 0.5 * MOST_WRONG / (10 * MOST_WRONG + 290 / mean), rel=0.02)
    exact = where_wrong(np.zeros(10), 5000, np.random.default_rng(0))
    assert np.bincount(exact).min() > 400


@pytest.mark.long
def test_a_first_field_is_the_same_function_in_the_coordinates_of_another_mesh():
    model = load_shipped("intelsat30")
    assert isinstance(model.field, NeuralField)
    numbers = PROFILES["default"]
    domain = Domain(np.array([0.3, -0.2, 0.7]), 14.0, 17.0, 21.0)
    layers = layers_of(model, domain, numbers)
    points = np.random.default_rng(0).normal(size=(500, 3)) * 4.0
    inside = np.linalg.norm(points - np.asarray(model.field.continuation.centre), axis=1) < 10.0
    moved = Learned(layers, numbers.beta, domain).value(points)
    lowered = np.asarray(model.field.continuation._lowering(jnp.asarray(points))[0])
    np.testing.assert_allclose((moved - lowered)[inside], values(model.field, points)[inside], atol=1e-4)
    with pytest.raises(FieldError, match="4 layers of 96, sharpness 100; the profile asks for 3 layers of 48"):
        layers_of(model, domain, PROFILES["quick"])
    box = Target.load("box")
    grid = FieldModel(build_grid(box, spacing=0.5).field, "box", box.sha256, 0.03, {})
    with pytest.raises(FieldError, match="no network"):
        layers_of(grid, domain, numbers)
