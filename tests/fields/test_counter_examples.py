"""Counter-examples: a small over-statement planted where the chaser touches is found and learned from."""

import numpy as np
import pytest

from keepout.fields.counter_examples import JITTER, ROUNDS_KEPT, WORST, Hunt
from keepout.fields.sampling import Domain
from keepout.geometry.offset_solid import OffsetSolid
from keepout.geometry.target import Target

HEIGHT, WIDTH, WEBS = 0.2, 0.04, 300


@pytest.fixture(scope="module")
def solid():
    return OffsetSolid.build(Target.load("box", parameters={"length": 2.0, "width": 1.0, "height": 1.0}).distance)


@pytest.mark.parametrize(("peak", "level"), [((1.0, 0.12, 0.31), 0.0), ((1.3, -0.22, 0.17), 0.3)])
def test_a_planted_peak_is_climbed(solid, peak, level):
    domain = Domain.around(solid.distance)
    hunt = Hunt.prepare(solid, domain, 0.3, WEBS, np.random.default_rng(0))

    def values(points):
        bump = HEIGHT * np.exp(-((points - peak) ** 2).sum(axis=1) / WIDTH**2)
        return solid.distance.distance(points) - 0.05 + bump

    batch, largest = hunt.worst(values, np.random.default_rng(1))
    assert largest == pytest.approx(HEIGHT - 0.05, abs=2e-3)
    assert len(batch.x) * ROUNDS_KEPT == hunt.kept
    found = np.asarray(batch.x, np.float64) * domain.learned_radius + domain.centre
    near = np.linalg.norm(found - peak, axis=1) < 2.0 * WIDTH + 4.0 * JITTER
    assert near.sum() > WORST // 2
    # Their labels are the truth, not what the field said.
    truth = solid.distance.distance(found[near]) - solid.offset
    inside = np.asarray(batch.hidden)[near]
    assert np.allclose(np.asarray(batch.distance)[near][~inside], truth[~inside], atol=1e-5)


def test_a_point_chaser_is_hunted_on_the_surface_alone(solid):
    hunt = Hunt.prepare(solid, Domain.around(solid.distance), 0.0, WEBS, np.random.default_rng(0))
    assert len(hunt.contact) == 0
    assert hunt.kept == ROUNDS_KEPT * (2 * WORST + WEBS)


def test_a_web_is_found(solid):
    """A field that says too little in one place off the surface, where it endangers nothing."""
    hunt = Hunt.prepare(solid, Domain.around(solid.distance), 0.0, WEBS, np.random.default_rng(0))
    web = np.array([1.3, 0.8, 0.2])

    def values(points):
        true = solid.distance.distance(points) - solid.offset
        return true - 0.4 * np.exp(-((points - web) ** 2).sum(axis=1) / 0.1**2)

    batch, _ = hunt.worst(values, np.random.default_rng(1))
    found = np.asarray(batch.x, np.float64)[-WEBS:] * hunt.domain.learned_radius + hunt.domain.centre
    near = np.linalg.norm(found - web, axis=1) < 0.25
    assert near.sum() > 10
    assert near.sum() >= 0.9 * (np.linalg.norm(hunt.near.points - web, axis=1) < 0.15).sum()
    truth = solid.distance.distance(found[near]) - solid.offset
    assert np.allclose(np.asarray(batch.distance)[-WEBS:][near], truth, atol=1e-5)
