"""The paper's profile end to end, shortened: both readings of its loss, and the certificate of what comes out."""

import dataclasses

import pytest

from keepout.core.fields.model import FieldModel
from keepout.core.learning.losses import PROFILES
from keepout.core.learning.training import fit
from keepout.core.measures.quality import distance_errors, surface_errors

pytestmark = pytest.mark.long


def shortened(name: str):
    return dataclasses.replace(PROFILES[name], width=24, depth=2, samples=2000, batch=2000, steps=750)


@pytest.fixture(scope="module")
def pinball(target, solid) -> FieldModel:
    return fit(target, profile=shortened("paper"), solid=solid)


@pytest.mark.slow  # a finding, told by the results
def test_the_pinball_reading_learns_the_distance(pinball, target, solid):
    errors = distance_errors(pinball.field, solid, nearest=0.3, farthest=2.0)
    assert errors.mean_absolute < 0.3
    assert surface_errors(pinball.field, target, count=20_000).epsilon < 0.3


@pytest.mark.slow  # a finding, told by the results
def test_the_printed_loss_lets_the_field_sink(pinball, target, solid):
    """L_P = (κ-1) max(e, 0) does not mind understatement: only the eikonal term holds the field up."""
    printed = fit(target, profile=shortened("paper_printed"), solid=solid)
    high = distance_errors(pinball.field, solid, nearest=0.3, farthest=2.0).mean_absolute
    assert distance_errors(printed.field, solid, nearest=0.3, farthest=2.0).mean_absolute > 3.0 * high
    assert surface_errors(printed.field, target, count=20_000).epsilon_plus < 0.1
