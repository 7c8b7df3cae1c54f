"""The paper's profile end to end, shortened: both readings of its loss, and the certificate of what comes out."""

import dataclasses

import numpy as np
import pytest
from truths import small_box

from keepout.core.fields.model import FieldModel
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.learning.losses import PROFILES
from keepout.core.learning.training import fit
from keepout.core.measures.quality import distance_errors, surface_errors
from keepout.core.proof.certificate import certify

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def target() -> Target:
    return small_box.target()


@pytest.fixture(scope="module")
def solid() -> OffsetSolid:
    return small_box.solid()


def shortened(name: str):
    return dataclasses.replace(PROFILES[name], width=24, depth=2, samples=2000, batch=2000, steps=750)


@pytest.fixture(scope="module")
def pinball(target, solid) -> FieldModel:
    return fit(target, profile=shortened("paper"), solid=solid)


def test_the_pinball_reading_learns_the_distance(pinball, target, solid):
    errors = distance_errors(pinball.field, solid, nearest=0.3, farthest=2.0)
    assert errors.mean_absolute < 0.3
    assert surface_errors(pinball.field, target, count=20_000).epsilon < 0.3


def test_the_printed_loss_lets_the_field_sink(pinball, target, solid):
    """L_P = (κ-1) max(e, 0) does not mind understatement: only the eikonal term holds the field up."""
    printed = fit(target, profile=shortened("paper_printed"), solid=solid)
    high = distance_errors(pinball.field, solid, nearest=0.3, farthest=2.0).mean_absolute
    assert distance_errors(printed.field, solid, nearest=0.3, farthest=2.0).mean_absolute > 3.0 * high
    assert surface_errors(printed.field, target, count=20_000).epsilon_plus < 0.1


def test_a_field_of_the_paper_is_certified_like_any_other(pinball, target):
    certificate = certify(pinball, target, chaser_radius=0.0).certificate(0.0)
    assert certificate.kind == "certified"
    assert certificate.sampled_maximum <= certificate.error_bound
    # The paper's Table I is a mean over samples, which the proved bound exceeds.
    assert certificate.error_bound > surface_errors(pinball.field, target, count=20_000).epsilon_plus


def test_the_training_curve_follows_the_field(pinball, target, solid):
    """The last point of the curve is the mean error of the field itself, as measured elsewhere."""
    curve = pinball.training["curve"]
    assert curve["steps"] == [250, 500, 750]
    assert np.all(np.isfinite([curve[name] for name in ("value_term", "gradient_term", "mean_error_m")]))
    assert curve["value_term"][-1] < 0.5 * curve["value_term"][0]
    errors = distance_errors(pinball.field, solid, nearest=0.3, farthest=2.0)
    assert abs(curve["mean_error_m"][-1]) < 2.0 * errors.mean_absolute
