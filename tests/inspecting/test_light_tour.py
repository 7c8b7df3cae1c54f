"""Tours in a light that moves, against every order and every moment there is."""

import itertools

import numpy as np
import pytest
from scipy import sparse

from keepout.inspecting.light_cost import Cost
from keepout.inspecting.light_tour import Pace, tour_in_light
from keepout.inspecting.lit_times import LitTimes
from keepout.inspecting.viewpoints import Views

PACE = Pace(speed=0.1, acceleration=1e9, turn_rate=1e3, turn_acceleration=1e9, dwell=0.0)
"""Of a chaser that a corner costs nothing and a camera that turns at once: a leg takes its length over 0.1 m/s."""
AHEAD = np.array([1.0, 0.0, 0.0])
STEP = 20.0


def views_at(places, sees):
    places = np.asarray(places, dtype=float)
    return Views(places, np.tile(AHEAD, (len(places), 1)), sparse.csr_array(np.asarray(sees, dtype=float)), len(places))


def light(rows):
    """Give what is lit in each interval of 20 s, as what is lit at both its ends."""
    spans = np.asarray(rows, dtype=bool)
    lit = np.zeros((len(spans) + 1, spans.shape[1]), dtype=bool)
    lit[:-1] |= spans
    lit[1:] |= spans
    return LitTimes(STEP * np.arange(len(lit)), lit, True)


def made(views, lit, areas, goal=np.inf, **others):
    start = np.zeros(3)

    def lengths(row):
        return np.linalg.norm(views.positions - (start if row < 0 else views.positions[row]), axis=1)

    areas = np.asarray(areas, dtype=float)
    goal = min(goal, areas.sum())
    return tour_in_light(
        views,
        lit,
        areas,
        goal,
        lengths,
        AHEAD,
        PACE,
        0.0,
        **{"start": start, "cost": Cost(), "most_views": 20, "tries": 1500, **others},
    )


def shown(views, lit, rows, times):
    """Give the units that views show at their times, which a chaser of 0.1 m/s must be able to keep."""
    seen, here, now = np.zeros(lit.lit.shape[1], dtype=bool), np.zeros(3), 0.0
    for row, at in zip(rows, times, strict=True):
        assert at >= now + np.linalg.norm(views.positions[row] - here) / PACE.speed - 1e-6
        # A moment after it, so that what goes dark at this very time does not count.
        seen |= (views.sees[[row]].toarray()[0] > 0.0) & lit.at(float(at) + 1e-3)
        here, now = views.positions[row], at
    return seen


def most_there_is(views, lit, areas):
    """Try every order of views and every moment."""
    sees = views.sees.toarray() > 0.0
    both = lit.lit[:-1] & lit.lit[1:]
    best = 0.0
    for order in itertools.permutations(range(len(sees))):
        states = {(0.0, (0.0, 0.0, 0.0)): [np.zeros(len(areas), dtype=bool)]}
        for row in order:
            after = {}
            for (now, here), several in states.items():
                arrival = now + np.linalg.norm(views.positions[row] - np.array(here)) / PACE.speed
                for n in range(int(np.ceil(arrival / STEP - 1e-9)), len(both)):
                    key = (STEP * n, tuple(views.positions[row]))
                    for seen in several:
                        after.setdefault(key, {})[(seen | (sees[row] & both[n])).tobytes()] = seen | (
                            sees[row] & both[n]
                        )
                        best = max(best, float(areas[seen | (sees[row] & both[n])].sum()))
            states = {key: list(several.values()) for key, several in after.items()}
    return best


def test_what_is_lit_for_a_moment_only_comes_before_what_is_nearer_and_larger():
    # 5 m away something small is lit until 60 s; a larger unit 1 m the other way is lit all the time.
    views = views_at([[5.0, 0, 0], [-1.0, 0, 0]], [[1, 0], [0, 1]])
    lit = light([[n < 4, 1] for n in range(12)])
    tour = made(views, lit, [1.0, 3.0])
    assert tour.rows.tolist() == [0, 1]
    assert tour.area == pytest.approx(4.0)
    assert shown(views, lit, tour.rows, tour.times).all()


def test_a_view_is_flown_to_again_when_the_light_shows_the_rest_of_it():
    views = views_at([[1.0, 0, 0]], [[1, 1]])
    lit = light([[n < 3, n > 20] for n in range(25)])
    tour = made(views, lit, [1.0, 1.0])
    assert tour.rows.tolist() == [0, 0]
    assert tour.times[0] <= 60.0
    assert tour.times[1] == pytest.approx(21 * STEP)


def test_the_shadow_of_the_earth_is_waited_for_no_longer_than_it_lasts():
    views = views_at([[1.0, 0, 0], [2.0, 0, 0]], [[1, 0], [0, 1]])
    lit = light([[n >= 50, n >= 50] for n in range(80)])
    tour = made(views, lit, [1.0, 1.0])
    assert tour.times[0] == pytest.approx(50 * STEP)
    assert tour.end == pytest.approx(50 * STEP + STEP)
    assert shown(views, lit, tour.rows, tour.times).all()


@pytest.mark.parametrize("seed", range(6))
def test_small_tours_see_as_much_as_any_order_at_any_moments_does(seed):
    generator = np.random.default_rng(seed)
    views = views_at(generator.uniform(-4.0, 4.0, (4, 3)), generator.random((4, 6)) < 0.5)
    begins = generator.integers(0, 10, 6)
    spans = np.arange(14)[:, None]
    lit = light((spans >= begins) & (spans <= begins + generator.integers(0, 4, 6)))
    areas = generator.uniform(0.5, 2.0, 6)
    tour = made(views, lit, areas)
    assert float(areas[shown(views, lit, tour.rows, tour.times)].sum()) == pytest.approx(tour.area)
    assert tour.area >= most_there_is(views, lit, areas) - 1e-9


def test_no_more_views_than_asked_for_and_none_where_nothing_is_lit():
    views = views_at([[1.0, 0, 0], [2.0, 0, 0]], [[1, 0], [0, 1]])
    always = light(np.ones((10, 2)))
    assert len(made(views, always, [1.0, 1.0], most_views=1).rows) == 1
    assert len(made(views, always, [1.0, 1.0], goal=1.0).rows) == 1
    assert len(made(views, light(np.zeros((10, 2))), [1.0, 1.0]).rows) == 0


def every_order(views):
    """Give end and Δv of each order, flown through at 0.1 m/s and looked at on the next of the moments."""
    found = []
    for order in itertools.permutations(range(len(views.positions))):
        here, moving, now, delta_v = np.zeros(3), np.zeros(3), 0.0, 0.0
        for row in order:
            way = float(np.linalg.norm(views.positions[row] - here))
            onwards = PACE.speed * (views.positions[row] - here) / way
            delta_v += float(np.linalg.norm(onwards - moving))
            now = STEP * np.ceil((now + way / PACE.speed) / STEP - 1e-9)
            here, moving = views.positions[row], onwards
        found.append((now, delta_v + PACE.speed))
    return np.array(found)


def test_an_objective_is_made_nearly_as_small_as_by_any_order():
    """Six views, each alone with what it sees, in a light that is always there."""
    apart = 0
    for seed in (0, 2, 3):
        generator = np.random.default_rng(seed)
        views = views_at(generator.uniform(-15.0, 15.0, (6, 3)), np.eye(6))
        always, truth = light(np.ones((160, 6))), every_order(views)
        quick, cheap, both = (
            made(views, always, np.ones(6), cost=Cost.of(objective, 500.0)) for objective in ("time", "delta_v", "both")
        )
        assert quick.end == pytest.approx(truth[:, 0].min())
        assert cheap.delta_v <= 1.03 * truth[:, 1].min()
        assert both.end + 500.0 * both.delta_v <= 1.03 * (truth @ [1.0, 500.0]).min()
        for tour in (quick, cheap, both):
            assert tour.area == pytest.approx(6.0)
            assert [tour.end, tour.delta_v] == pytest.approx(
                truth[np.argmin(np.abs(truth - [tour.end, tour.delta_v]).sum(axis=1))]
            )
        apart += cheap.delta_v < quick.delta_v - 0.02 and quick.end < cheap.end
    assert apart >= 2


def test_a_stop_for_light_is_paid_for():
    """Two views ahead: the first in light at once, or after a minute at the place; then the chaser sets out anew."""
    views = views_at([[10.0, 0, 0], [20.0, 0, 0]], [[1, 0], [0, 1]])
    through = made(views, light(np.ones((60, 2))), [1.0, 1.0])
    assert through.delta_v == pytest.approx(2.0 * PACE.speed)
    late = made(views, light([[n >= 9, n >= 14] for n in range(60)]), [1.0, 1.0])
    assert late.rows.tolist() == [0, 1]
    assert late.delta_v == pytest.approx(4.0 * PACE.speed)
