"""`keepout/Approach-v0`: as Gymnasium asks, of one seed the same, one by one as many at once, held by the guard."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import keepout.gym  # noqa: F401
from keepout.apps.gym.environment import MISSION
from keepout.core.errors import KeepoutError
from keepout.core.geometry.target import Target

pytestmark = pytest.mark.long
AROUND = ("box", (-6.0, -7.0, -6.0), (6.0, 7.0, 6.0))
AHEAD = ("box", (0.0, 6.4, 0.0), (0.0, 6.4, 0.0))
"""Before the box, the goal behind it. One compiled step is of both."""
BOXED = {**MISSION, "target": {"source": "box"}}
"""The box's guard is that of other tests."""


@pytest.fixture(scope="module")
def guarded():
    return gymnasium.make("keepout/Approach-v0", mission=BOXED, starts=AROUND).unwrapped


@pytest.mark.filterwarnings("ignore:.*Box observation space:UserWarning")
def test_it_is_an_environment_and_a_seed_is_an_episode_to_the_bit(guarded):
    check_env(guarded)
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, (30, 3)).astype(np.float32)
    flown = [[guarded.reset(seed=7), *(guarded.step(action) for action in actions)] for _ in range(2)]
    assert repr(flown[0]) == repr(flown[1])
    starts = [guarded.reset(seed=seed)[0] for seed in (7, None, 7, None, 8)]
    np.testing.assert_array_equal(starts[:2], starts[2:4])
    assert not np.array_equal(starts[0], starts[1])
    assert not np.array_equal(starts[0], starts[4])


@pytest.mark.slow  # batches beside single flights are in core/flight/test_batches
def test_many_are_one_by_one_through_the_ends_of_episodes():
    """Towards the goal: some arrive, some are held before the pocket until the time is over, and all begin anew."""
    several = {"num_envs": 3, "vectorization_mode": "vector_entry_point"}
    envs = gymnasium.make_vec("keepout/Approach-v0", **several, starts=AROUND)
    guarded = gymnasium.make("keepout/Approach-v0", starts=AROUND).unwrapped
    towards = [-0.5 * np.eye(3), -6.0 * np.eye(3), np.zeros((1, 3))]
    seen = envs.reset(seed=40)[0]
    rows = [(seen, np.zeros(3), np.zeros(3, bool), np.zeros(3, bool), {})]
    for _ in range(150):
        rows.append(envs.step(np.clip(rows[-1][0] @ np.concatenate(towards), -1.0, 1.0)))
    ends = [row[2] | row[3] for row in rows]
    assert np.any([row[2] for row in rows])
    assert np.any([row[3] for row in rows])
    for place in range(3):
        seen = guarded.reset(seed=40 + place)[0]
        for before, row, over in zip(rows, rows[1:], ends):
            if over[place]:
                seen = guarded.reset()[0]
                assert not row[1][place]
                assert not row[2][place]
            else:
                action = np.clip(before[0][place] @ np.concatenate(towards), -1.0, 1.0)
                seen, reward, terminated, truncated, info = guarded.step(action)
                assert (terminated, truncated) == (row[2][place], row[3][place])
                assert reward == pytest.approx(row[1][place], abs=1e-6)
                assert info["interventions"] == row[4]["interventions"][place]
            np.testing.assert_allclose(seen, row[0][place], atol=1e-5)


def test_the_shield_prevents_a_contact_that_the_bare_action_causes():
    box, goal = Target.load("box").distance, np.array([0.0, -4.0, 0.0])
    ended = {}
    for guard in (False, True):
        env = gymnasium.make("keepout/Approach-v0", mission=BOXED, guard=guard, starts=AHEAD).unwrapped
        env.reset(seed=0)
        nearest, counted = np.inf, 0
        while True:
            seen, _, terminated, truncated, info = env.step(np.array([0.0, -1.0, 0.0]))
            away = box.distance(seen[None, :3].astype(float) + goal)[0] - 0.5
            assert info["clearance_m"] <= away + 1e-6
            assert info["cost"] == pytest.approx(np.clip(1.0 - info["clearance_m"] / 0.1, 0.0, 1.0))
            nearest, counted = min(nearest, away), counted + info["intervened"]
            assert info["certified"] is guard
            if terminated or truncated:
                break
        ended[guard] = info["contact"], nearest > 0.0, truncated
        assert info["interventions"] == counted
        assert (counted > 0) is guard
    assert ended == {False: (True, False, False), True: (False, True, True)}


def test_what_cannot_be_is_refused(guarded):
    cases = {
        r"starts: \('shell', 9.0, 6.0\); it must be": {"starts": ("shell", 9.0, 6.0)},
        r"starts: 0 % of the places drawn are free": {"starts": ("box", [0.0, -1.9, 0.0], [0.0, -1.8, 0.0])},
        "no such entry": {"mission": {"chaser": {"weight": 1.0}}},
        "num_envs: 0": {"num_envs": 0},
    }
    for said, options in cases.items():
        with pytest.raises(KeepoutError, match=said):
            gymnasium.make_vec("keepout/Approach-v0", **{"mission": BOXED, **options})
    guarded.reset(seed=0)
    with pytest.raises(KeepoutError, match=r"action: shape \(1, 2\)"):
        guarded.step(np.zeros(2))
    absent = "import sys; sys.modules['gymnasium'] = None; import keepout.gym"
    said = subprocess.run([sys.executable, "-c", absent], capture_output=True, text=True).stderr
    assert "KeepoutError: keepout.gym: gymnasium is not installed; pip install 'keepout-gnc[gym]'" in said
