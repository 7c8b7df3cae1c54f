"""Tours in a light that moves, against every order and every moment there is."""

import itertools
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from scipy import sparse
from truths.lights import Round

from keepout.apps.inspection.candidates import Views
from keepout.apps.inspection.light import Camera, LitTimes
from keepout.apps.inspection.light_tour import LightTours
from keepout.apps.inspection.plan import Task
from keepout.apps.inspection.problem import Problem, rules_of
from keepout.apps.inspection.seeing.patches import cut
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.apps.inspection.ways import Ways
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario

SPEED = 0.1
"""A tour is made at nine tenths of the chaser's limit, m/s."""
CHASER = SimpleNamespace(speed_limit=SPEED / 0.9, force_limit=1e9, mass=1.0)
CAMERA = SimpleNamespace(turn_rate=1e3, turn_acceleration=1e9)
"""A corner costs that chaser nothing, and that camera turns at once: a leg takes its length over 0.1 m/s."""
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


def made(views, lit, areas, goal=np.inf, most_views=20, tries=1500, **inspect):
    def lengths(row):
        return np.linalg.norm(views.positions - (np.zeros(3) if row < 0 else views.positions[row]), axis=1)

    areas = np.asarray(areas, dtype=float)
    asked = {"objective": "time", "delta_v_worth": 1.0, "dwell": 0.0, "most_views": most_views} | inspect
    scenario = Mock(spec=Scenario, chaser=CHASER, camera=CAMERA, inspect=SimpleNamespace(**asked))
    problem, goal = Mock(spec=Problem, scenario=scenario), float(min(goal, areas.sum()))
    task = Task(problem, lit, areas, goal, Mock(spec=Ways), np.zeros(3), AHEAD, 0.0)
    return LightTours(task, views, lengths).best(tries)


def shown(views, lit, rows, times):
    """Give the units that views show at their times, which a chaser of 0.1 m/s must be able to keep."""
    seen, here, now = np.zeros(lit.lit.shape[1], dtype=bool), np.zeros(3), 0.0
    for row, at in zip(rows, times, strict=True):
        assert at >= now + np.linalg.norm(views.positions[row] - here) / SPEED - 1e-6
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
                arrival = now + np.linalg.norm(views.positions[row] - np.array(here)) / SPEED
                for n in range(int(np.ceil(arrival / STEP - 1e-9)), len(both)):
                    key = (STEP * n, tuple(views.positions[row]))
                    for before in several:
                        seen = before | (sees[row] & both[n])
                        after.setdefault(key, {})[seen.tobytes()] = seen
                        best = max(best, float(areas[seen].sum()))
            states = {key: list(several.values()) for key, several in after.items()}
    return best


@pytest.mark.long
@pytest.mark.parametrize(
    ("places", "sees", "lit", "areas", "rows", "times"),
    [
        # 5 m away something small is lit until 60 s; a larger unit 1 m the other way is lit all the time.
        ([[5.0, 0, 0], [-1.0, 0, 0]], np.eye(2), [[n < 4, 1] for n in range(12)], [1.0, 3.0], [0, 1], [60.0, None]),
        # A view is flown to again when the light shows the rest of it.
        ([[1.0, 0, 0]], [[1, 1]], [[n < 3, n > 20] for n in range(25)], [1.0, 1.0], [0, 0], [20.0, 420.0]),
        # The shadow of the Earth is waited for no longer than it lasts.
        ([[1.0, 0, 0], [2, 0, 0]], np.eye(2), [[n >= 50] * 2 for n in range(80)], [1.0, 1.0], [0, 1], [1000.0, 1020.0]),
    ],
)
def test_what_is_lit_for_a_moment_decides_the_order(places, sees, lit, areas, rows, times):
    views, when = views_at(places, sees), light(lit)
    tour = made(views, when, areas)
    assert (tour.order - 1).tolist() == rows
    assert tour.area == pytest.approx(sum(areas))
    assert shown(views, when, tour.order - 1, tour.times).all()
    for at, latest in zip(tour.times, times, strict=True):
        assert latest is None or at <= latest + 1e-6


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_small_tours_see_as_much_as_any_order_at_any_moments_does(seed):
    generator = np.random.default_rng(seed)
    views = views_at(generator.uniform(-4.0, 4.0, (4, 3)), generator.random((4, 6)) < 0.5)
    begins = generator.integers(0, 10, 6)
    spans = np.arange(14)[:, None]
    lit = light((spans >= begins) & (spans <= begins + generator.integers(0, 4, 6)))
    areas = generator.uniform(0.5, 2.0, 6)
    tour = made(views, lit, areas)
    assert float(areas[shown(views, lit, tour.order - 1, tour.times)].sum()) == pytest.approx(tour.area)
    assert tour.area >= most_there_is(views, lit, areas) - 1e-9


@pytest.mark.long
def test_no_more_views_than_asked_for_and_none_where_nothing_is_lit():
    views = views_at([[1.0, 0, 0], [2.0, 0, 0]], [[1, 0], [0, 1]])
    always = light(np.ones((10, 2)))
    assert len(made(views, always, [1.0, 1.0], most_views=1).order) == 1
    assert len(made(views, always, [1.0, 1.0], goal=1.0).order) == 1
    assert len(made(views, light(np.zeros((10, 2))), [1.0, 1.0]).order) == 0


def every_order(views):
    """Give end and Δv of each order, flown through at 0.1 m/s and looked at on the next of the moments."""
    found = []
    for order in itertools.permutations(range(len(views.positions))):
        here, moving, now, delta_v = np.zeros(3), np.zeros(3), 0.0, 0.0
        for row in order:
            way = float(np.linalg.norm(views.positions[row] - here))
            onwards = SPEED * (views.positions[row] - here) / way
            delta_v += float(np.linalg.norm(onwards - moving))
            now = STEP * np.ceil((now + way / SPEED) / STEP - 1e-9)
            here, moving = views.positions[row], onwards
        found.append((now, delta_v + SPEED))
    return np.array(found)


@pytest.mark.long
def test_an_objective_is_made_nearly_as_small_as_by_any_order():
    """Six views, each alone with what it sees, in a light that is always there."""
    views = views_at(np.random.default_rng(2).uniform(-15.0, 15.0, (6, 3)), np.eye(6))
    always, truth = light(np.ones((160, 6))), every_order(views)
    quick, cheap, both = (
        made(views, always, np.ones(6), tries=400, objective=objective, delta_v_worth=500.0)
        for objective in ("time", "delta_v", "both")
    )
    assert quick.end == pytest.approx(truth[:, 0].min())
    assert cheap.delta_v <= 1.03 * truth[:, 1].min()
    assert both.end + 500.0 * both.delta_v <= 1.03 * (truth @ [1.0, 500.0]).min()
    for tour in (quick, cheap, both):
        assert tour.area == pytest.approx(6.0)
        nearest = truth[np.argmin(np.abs(truth - [tour.end, tour.delta_v]).sum(axis=1))]
        assert [tour.end, tour.delta_v] == pytest.approx(nearest)
    assert cheap.delta_v < quick.delta_v - 0.02
    assert quick.end < cheap.end


# ---- when units are lit: at a window's ends and between the times looked at

TIMES = LitTimes(np.array([0.0, 10.0, 20.0, 30.0]), np.array([[0, 1], [1, 1], [1, 0], [0, 1]], dtype=bool), True)


def test_what_is_lit_at_a_time():
    """A window begins at 10 s, and the first unit counts at once."""
    times = (-1.0, 0.0, 5.0, 10.0 - 1e-9, 10.0, 15.0, 20.0, 25.0, 30.0, 31.0)
    lit = [[0, 0], [0, 1], [0, 1], [1, 1], [1, 1], [1, 0], [1, 0], [0, 0], [0, 1], [0, 0]]
    assert [TIMES.at(time).tolist() for time in times] == lit
    still = LitTimes(np.array([0.0]), np.array([[True, False]]), False)
    assert still.at(1e5).tolist() == [True, False]


def test_windows_are_the_times_in_which_all_is_lit():
    lit = np.array([[1, 1], [1, 0], [1, 1], [1, 1], [0, 1]], dtype=bool)
    times = LitTimes(np.arange(5) * 10.0, lit, True)
    assert times.windows(np.array([0])) == [(0.0, 30.0)]
    assert times.windows(np.array([0, 1])) == [(0.0, 0.0), (20.0, 30.0)]


@pytest.mark.long
def test_the_steps_are_short_where_the_sun_turns_fast():
    box = Target.load("box")
    patches = cut(box, 2.0)
    turning = Round(Scenario(), (1, 0, 0), (0, 1, 0), 3000.0)
    camera = Camera(Sightlines(box.vertices, box.faces, patches), rules_of(Scenario()), turning)
    found = LitTimes.of(camera, patches.counted, 0.0, 6000.0, 5.0)
    assert 360.0 * np.diff(found.times).max() / 3000.0 <= 1.26  # degrees
    assert found.times[[0, -1]].tolist() == [0.0, 6000.0]
    coarse = LitTimes.of(camera, patches.counted, 0.0, 6000.0, 100.0)
    assert np.diff(coarse.times).min() >= 100.0 - 1e-9
