"""Sampled certificates: what a search finds, never above what is proved, and said to prove nothing."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from keepout.errors import FieldError
from keepout.fields.analytic import SphereField
from keepout.fields.model import FieldModel
from keepout.fields.shipped import load_shipped
from keepout.geometry.target import Target
from keepout.measures.quality import surface_errors
from keepout.proof.certificate import certify
from keepout.proof.sampled import sample_certificate

pytestmark = pytest.mark.long


class Unchecked(FieldModel):
    """A model of a field that has no file form."""

    def __post_init__(self) -> None:
        """Take any field."""


@pytest.fixture(scope="module")
def target() -> Target:
    return Target.load("intelsat30")


@pytest.mark.parametrize("radius", [0.0, 0.5])
def test_search_stays_below_what_is_proved_and_reaches_what_samples_reach(target, radius):
    model = load_shipped("intelsat30")
    proved = model.certificate(radius)
    assert proved.kind == "certified"
    sampled = sample_certificate(model, target, chaser_radius=radius, allowance=0.01, seed=3).certificate(radius)
    assert sampled.kind == sampled.gradient_kind == "sampled"
    assert sampled.error_bound == pytest.approx(sampled.sampled_maximum + 0.01)
    assert sampled.sampled_maximum <= proved.error_bound
    assert sampled.gradient_found <= proved.gradient_bound
    assert sampled.gradient_bound > sampled.gradient_found
    if radius == 0.0:
        assert sampled.sampled_maximum >= surface_errors(model.field, target, count=20_000).maximum


@pytest.mark.parametrize(
    ("numbers", "said"),
    [({"chaser_radius": -0.1}, "chaser radius -0.1 m"), ({"allowance": np.inf}, "allowance inf m")],
)
def test_bad_numbers_are_named(target, numbers, said):
    with pytest.raises(FieldError, match=said):
        sample_certificate(load_shipped("intelsat30"), target, **numbers)


def test_another_target_is_refused():
    with pytest.raises(FieldError, match="made for intelsat30"):
        sample_certificate(load_shipped("intelsat30"), Target.load("pocket"))


@pytest.mark.parametrize(("certifies", "where"), [(certify, "certify"), (sample_certificate, "sampled certificate")])
def test_what_is_no_network_or_no_mesh_is_refused(target, tmp_path, certifies, where):
    model = load_shipped("intelsat30")
    ball = SphereField(jnp.zeros(3), jnp.asarray(1.0))
    with pytest.raises(FieldError, match=f"{where}: a SphereField is no network"):
        certifies(Unchecked(ball, target.name, target.sha256, 0.03, {}, ()), target)
    path = tmp_path / "cloud.ply"
    trimesh.PointCloud(target.vertices).export(path)
    cloud = Target.load(path, units="m", thickness=0.1)
    with pytest.raises(FieldError, match=f"{where}: cloud is a point cloud"):
        certifies(dataclasses.replace(model, target_name=cloud.name, target_sha256=cloud.sha256), cloud)
