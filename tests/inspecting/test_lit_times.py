"""When units are lit: at a window's ends and between the times looked at."""

import numpy as np
import pytest

from keepout.geometry import Target
from keepout.inspecting.equipment import rules_of
from keepout.inspecting.lit_times import LitTimes
from keepout.mission.light import Light
from keepout.mission.scenario import Scenario
from keepout.seeing.cut import cut
from keepout.seeing.sightlines import Sightlines

TIMES = LitTimes(np.array([0.0, 10.0, 20.0, 30.0]), np.array([[0, 1], [1, 1], [1, 0], [0, 1]], dtype=bool), True)


@pytest.mark.parametrize(
    ("time", "lit"),
    [
        (0.0, [0, 1]),
        (5.0, [0, 1]),
        (10.0 - 1e-9, [1, 1]),  # a window begins, and the first unit counts at once
        (10.0, [1, 1]),
        (15.0, [1, 0]),
        (20.0, [1, 0]),
        (25.0, [0, 0]),
        (30.0, [0, 1]),
        (31.0, [0, 0]),
        (-1.0, [0, 0]),
    ],
)
def test_what_is_lit_at_a_time(time, lit):
    assert TIMES.at(time).tolist() == [bool(one) for one in lit]


def test_a_light_that_does_not_change_is_the_same_at_every_time():
    still = LitTimes(np.array([0.0]), np.array([[True, False]]), False)
    assert still.at(1e5).tolist() == [True, False]


class Turning(Light):
    """A light that goes round the z axis once in 3000 s."""

    @property
    def matters(self):
        return True

    def suns(self, times):
        turn = 2.0 * np.pi * np.asarray(times) / 3000.0
        return np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)


def test_the_steps_are_short_where_the_sun_turns_fast():
    box = Target.load("box")
    patches = cut(box, 2.0)
    sight, rules = Sightlines(box.vertices, box.faces, patches), rules_of(Scenario())
    found = LitTimes.of(Turning(Scenario()), sight, rules, patches.counted, 0.0, 6000.0, 5.0)
    assert 360.0 * np.diff(found.times).max() / 3000.0 <= 1.26  # degrees
    assert found.times[[0, -1]].tolist() == [0.0, 6000.0]
    coarse = LitTimes.of(Turning(Scenario()), sight, rules, patches.counted, 0.0, 6000.0, 100.0)
    assert np.diff(coarse.times).min() >= 100.0 - 1e-9
