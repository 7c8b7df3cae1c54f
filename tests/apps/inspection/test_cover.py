"""The choice of views against every choice there is: enough is seen, and no bound passes the least number."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse

from keepout.apps.inspection.cover import Covering, fewest_views, merged_units, shortlist


def drawn(seed, views=11, units=22, share=0.22):
    generator = np.random.default_rng(seed)
    sees = sparse.csr_array((generator.random((views, units)) < share).astype(float))
    areas = generator.uniform(0.1, 1.0, units) * (generator.random(units) < 0.9)
    return sees, areas


def seen_by(sees, areas, chosen):
    return areas[(sees.toarray()[chosen] > 0).any(axis=0)].sum()


def least_number(sees, areas, goal):
    for count in range(sees.shape[0] + 1):
        for chosen in itertools.combinations(range(sees.shape[0]), count):
            if seen_by(sees, areas, list(chosen)) >= goal * (1.0 - 1e-12):
                return count
    raise AssertionError("all views together do not see the goal")


@pytest.mark.long
@given(seed=st.integers(0, 2**31), share=st.sampled_from([0.5, 0.9, 0.99, 1.0]))
def test_the_fewest_of_all_choices_is_found_and_proved(seed, share):
    sees, areas = drawn(seed)
    goal = share * seen_by(sees, areas, np.arange(sees.shape[0]))
    cover = fewest_views(sees, areas, goal)
    assert seen_by(sees, areas, cover.chosen) >= goal * (1.0 - 1e-9)
    assert len(cover.chosen) == cover.fewest == least_number(sees, areas, goal)
    assert cover.greedy >= len(cover.chosen)


@pytest.mark.long
@given(seed=st.integers(0, 2**31), share=st.sampled_from([0.5, 0.9, 1.0]), scale=st.floats(0.0, 3.0))
def test_no_bound_passes_the_least_number_whatever_the_prices(seed, share, scale):
    sees, areas = merged_units(*drawn(seed))
    goal = share * areas.sum()
    least = least_number(sees, areas, goal)
    prices = np.random.default_rng(seed + 1).uniform(-0.2, scale, len(areas))
    covering = Covering(sees, areas, goal)
    value, costs = covering.price_value(prices, scale * 0.7)
    assert value <= least + 1e-9
    for view in range(len(costs)):
        with_it = areas * (sees.toarray()[view] == 0.0)
        others = least_number(sees, with_it, goal - (areas.sum() - with_it.sum()))
        assert value + costs[view] <= others + 1 + 1e-9
    order = covering.completed(np.zeros(0, dtype=np.int64))
    assert covering.greedy_bound(order) <= least <= len(covering.pruned(order)) <= len(order)


def test_units_that_the_same_views_see_are_joined_and_no_area_is_lost():
    sees, areas = drawn(5, views=6, units=300, share=0.3)
    joined, sums = merged_units(sees, areas)
    columns = {tuple(column) for column in joined.toarray().T}
    assert len(columns) == joined.shape[1] == len(sums) < 64
    for chosen in itertools.combinations(range(6), 2):
        assert seen_by(joined, sums, list(chosen)) == pytest.approx(seen_by(sees, areas, list(chosen)))


def test_a_short_list_sees_all_that_can_be_seen():
    sees, areas = drawn(7, views=300, units=120, share=0.05)
    few = shortlist(sees, areas, 60)
    assert len(few) < 100
    assert seen_by(sees, areas, few) == pytest.approx(seen_by(sees, areas, np.arange(300)))
