"""The fields that come with the package belong to the built-in targets and keep what their certificates say."""

import numpy as np
import pytest

from keepout.errors import FieldError
from keepout.fields.evaluate import values
from keepout.fields.shipped import load_shipped, shipped_names
from keepout.fields.shipped import shipped_folder as _folder
from keepout.geometry.level_points import onto_level, surface_points
from keepout.geometry.target import Target
from keepout.learning.shipped import CHASER_RADII
from keepout.proof.certificate import certify


def test_there_is_a_field_and_all_are_small():
    assert "intelsat30" in shipped_names()
    assert sum(path.stat().st_size for path in _folder().glob("*.keepout")) <= 1_000_000
    with pytest.raises(FieldError, match="'sputnik': there is none"):
        load_shipped("sputnik")


@pytest.mark.parametrize("name", shipped_names())
def test_samples_stay_below_the_certificates(name):
    target = Target.load(name)
    model = load_shipped(name, target=target)
    rng = np.random.default_rng(11)
    for radius in CHASER_RADII:
        proof = model.certificate(radius)
        assert proof.kind == "certified"
        start = surface_points(target.distance, 20_000, rng, by_area=0.3)
        direction = rng.normal(size=start.shape)
        start = start + radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        points = onto_level(target.distance, start, radius)
        assert (values(model.field, points) - radius).max() <= proof.error_bound


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped_names())
@pytest.mark.parametrize("radius", CHASER_RADII)
def test_the_proof_can_be_repeated(name, radius):
    target = Target.load(name)
    model = load_shipped(name, target=target)
    again = certify(model, target, chaser_radius=radius).certificate(radius)
    assert again.error_bound == pytest.approx(model.certificate(radius).error_bound, abs=1e-4)
