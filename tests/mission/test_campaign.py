"""Where a campaign's flights start."""

import numpy as np
import pytest
import trimesh

from keepout.errors import ScenarioError
from keepout.geometry.target import Target
from keepout.mission.campaign import draw_starts, plan_campaign
from keepout.mission.scenario import Scenario


@pytest.fixture(scope="module")
def shell(tmp_path_factory):
    """A hollow cube of 6 m: its inside has room for the chaser, and no way out."""
    path = tmp_path_factory.mktemp("mesh") / "shell.stl"
    trimesh.creation.box(extents=(6.0, 6.0, 6.0)).export(path)
    return Target.load(path, units="m")


def drawn(target, **campaign):
    return draw_starts(Scenario().replace(campaign=campaign), target).position


def test_starts_are_seeded_outside_and_roomy(shell):
    starts = drawn(shell, runs=50, lower=(-5.0, -5.0, -5.0), upper=(5.0, 5.0, 5.0))
    assert starts.shape == (50, 3)
    assert np.abs(starts).max(axis=1).min() > 3.0 + 0.8 / 3**0.5
    assert shell.distance.distance(starts).min() > 0.8
    np.testing.assert_array_equal(starts, drawn(shell, runs=50, lower=(-5.0, -5.0, -5.0), upper=(5.0, 5.0, 5.0)))


def test_a_box_without_a_way_out_is_refused(shell):
    with pytest.raises(ScenarioError, match="only 0 lie outside"):
        drawn(shell, runs=5, lower=(-2.0, -2.0, -2.0), upper=(2.0, 2.0, 2.0))


def test_starts_that_are_drawn_again_are_counted(shell):
    campaign = {"runs": 50, "lower": (-5.0, -5.0, 3.0), "upper": (5.0, 5.0, 5.0)}
    scenario = Scenario().replace(campaign=campaign)
    draws = np.random.default_rng(scenario.seed).uniform(campaign["lower"], campaign["upper"], (1000, 3))
    # Distance to the cube in closed form: every draw lies at or above its upper face.
    away = np.linalg.norm(np.maximum(np.abs(draws) - 3.0, 0.0), axis=1)
    fiftieth = np.flatnonzero(away > 0.8)[49]
    starts = draw_starts(scenario, shell)
    np.testing.assert_array_equal(starts.position, draws[: fiftieth + 1][away[: fiftieth + 1] > 0.8])
    assert starts.drawn_again == fiftieth + 1 - 50 > 0


def test_starts_without_a_way_out_are_counted(shell):
    generous = drawn_again(shell, runs=50, lower=(-6.0, -6.0, -6.0), upper=(6.0, 6.0, 6.0))
    near = (8.0**3 - 4.4**3) / 12.0**3  # too near the walls, from either side, but for rounded corners
    inside = 4.4**3 / 12.0**3
    assert 0.3 * 50 * (near + inside) < generous < 3.0 * 50 * (near + inside) / (1.0 - near - inside)


def test_dispersions_are_refused_where_only_starts_vary(shell):
    scenario = Scenario().replace(campaign={"dispersions": {"chaser.mass": {"uniform": (9.0, 11.0)}}})
    with pytest.raises(ScenarioError, match=r"campaign\.dispersions: chaser\.mass; .*keepout campaign"):
        plan_campaign(scenario, target=shell)


def drawn_again(target, **campaign):
    return draw_starts(Scenario().replace(campaign=campaign), target).drawn_again
