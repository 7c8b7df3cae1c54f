"""Counter-examples: a small over-statement planted where the chaser touches is found and learned from."""

import functools

import numpy as np
import pytest

from keepout.core.fields.continuation import Domain
from keepout.core.learning import samples
from keepout.core.learning.losses import TrainingProfile
from keepout.core.learning.samples import COPIES, HIGHEST, JITTER, ON_LEVEL, ROUNDS_KEPT, Hunt

pytestmark = pytest.mark.long

HEIGHT, WIDTH, WEBS = 0.2, 0.04, 300
PROFILE = TrainingProfile(webs=WEBS, room_share=0.0)


@pytest.fixture(autouse=True)
def _fewer_candidates(monkeypatch):
    monkeypatch.setattr(samples, "NEAR", 60_000)


@functools.cache
def prepared(solid, chaser_radius):
    domain = Domain.around(solid.distance)
    points = samples.training_points(solid.distance, domain, 100_000, np.random.default_rng(0), PROFILE)
    return Hunt.prepare(solid, domain, chaser_radius, PROFILE, samples.label(solid, points))


NOTHING_KNOWN = np.zeros((0, 3))


class Wrong:
    """The distance less `less`, with a bump of a height and width in one place."""

    def __init__(self, distance, less, place, height, width):
        self.distance, self.less, self.place, self.height, self.width = distance, less, place, height, width

    def _bump(self, points):
        return self.height * np.exp(-((points - self.place) ** 2).sum(axis=1) / self.width**2)

    def value(self, points):
        return self.distance.distance(points) - self.less + self._bump(points)

    def gradient(self, points):
        bump = self._bump(points)[:, None] * -2.0 * (points - self.place) / self.width**2
        return self.distance.distance_and_gradient(points)[1] + bump


@pytest.mark.parametrize(("peak", "level"), [((1.0, 0.12, 0.31), 0.0), ((1.3, -0.22, 0.17), 0.3)])
@pytest.mark.parametrize("width", [WIDTH, 0.2 * WIDTH])
def test_a_planted_peak_is_climbed(solid, peak, level, width):
    hunt = prepared(solid, 0.3)
    domain = hunt.domain
    assert hunt.levels == (0.0, 0.3)
    batch, largest = hunt.worst(
        Wrong(solid.distance, 0.05, peak, HEIGHT, width), NOTHING_KNOWN, np.random.default_rng(1)
    )
    assert largest == pytest.approx(HEIGHT - 0.05, abs=2e-3)
    assert len(batch.x) * ROUNDS_KEPT == hunt.kept
    found = np.asarray(batch.x, np.float64) * domain.learned_radius + domain.centre
    near = np.linalg.norm(found - peak, axis=1) < 2.0 * width + 4.0 * JITTER
    assert near.sum() >= 4 * COPIES
    # The highest counts most, and what is not over-stated once.
    weight = np.asarray(batch.weight)
    assert weight[near].max() == pytest.approx(HIGHEST)
    assert np.all(weight[:-WEBS][~near[:-WEBS]] == 1.0)
    # Their labels are the truth, not what the field said.
    truth = solid.distance.distance(found[near]) - solid.offset
    inside = np.asarray(batch.hidden)[near]
    assert np.allclose(np.asarray(batch.distance)[near][~inside], truth[~inside], atol=1e-5)


def test_every_search_has_new_candidates_where_the_chaser_touches(solid):
    """A spike is narrower than the points of one search lie apart: more searches must see more places."""

    class Asked(Wrong):
        def value(self, points):
            asked.append(points)
            return super().value(points)

    hunt, rounds = prepared(solid, 0.3), []
    for seed in (1, 2):
        asked = []
        wrong = Asked(solid.distance, 0.05, (1.0, 0.12, 0.31), HEIGHT, WIDTH)
        hunt.worst(wrong, NOTHING_KNOWN, np.random.default_rng(seed))
        assert np.allclose(solid.distance.distance(asked[1]), 0.3, atol=1e-8)
        rounds.append(set(map(tuple, asked[1])))
        assert len(rounds[-1]) > 0.5 * ON_LEVEL
    # Some that start at a corner end in one place.
    assert len(rounds[0] & rounds[1]) < 0.05 * ON_LEVEL


def test_a_peak_known_before_is_found_again(solid):
    """One too narrow to be met by chance, but near a counter-example of an earlier round."""
    hunt = prepared(solid, 0.0)
    peak = np.array([1.0, 0.12, 0.31])
    wrong = Wrong(solid.distance, 0.05, peak, HEIGHT, 1e-3)
    heights = [
        hunt.worst(wrong, known, np.random.default_rng(1))[1]
        for known in (NOTHING_KNOWN, peak[None] + [0.0, 5e-4, 0.0])
    ]
    assert heights[0] < 0.0
    assert heights[1] > 0.5 * HEIGHT - 1e-9
