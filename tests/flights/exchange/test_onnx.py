"""A field as ONNX: the same function in another runtime, and a file that says how far it is from the package."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
import pytest
from truths.command_line import keepout_command
from truths.networks import random_field

from keepout.core.fields import load_shipped, neural, shipped_path
from keepout.core.fields.field import values_and_gradients
from keepout.core.fields.model import FieldModel
from keepout.flights.exchange.onnx_field import export_onnx, field_graph, measure, sample_points

MANY = 60_000


def in_double(field):
    """The same network with its weights in float64: nothing but rounding at 1e-16 is left."""
    wide = [tuple(jnp.asarray(np.asarray(part), jnp.float64) for part in parts) for parts in field.layers]
    return eqx.tree_at(lambda f: f.layers, field, neural.Layers(*wide))


def run(field, points):
    session = onnxruntime.InferenceSession(field_graph(field).SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(["value", "gradient"], {"points": points})


def apart(field, points):
    value, gradient = values_and_gradients(field, points)
    here, slope = run(field, points)
    return np.abs(here - value).max(), np.linalg.norm(slope - gradient, axis=1).max()


@pytest.mark.long
def test_the_graph_is_the_field_to_rounding_within_and_beyond_its_domain():
    """Without the rounding of float32, value, gradient, bend and continuation agree to 1e-11; far away to 1e-8."""
    field = random_field(3)
    points = sample_points(field, MANY, seed=1)
    away = np.linalg.norm(points - np.asarray(field.continuation.centre), axis=1)
    assert away.min() < 1.0  # the domain's radius is 11 m, the outer one 13 m
    assert min(np.sum(away < 11.0), np.sum((away > 11.0) & (away < 13.0)), np.sum(away > 13.0)) >= MANY // 3
    assert away.max() > 51.0
    assert max(apart(field, points)) < 1e-11
    ring = field.continuation
    radii = [float(r) for r in (ring.target_radius, ring.domain_radius, ring.outer_radius)]
    radii += [np.nextafter(r, np.inf) for r in radii] + [0.0, 1e-12, 1e3, 1e6]
    assert max(apart(field, np.asarray(ring.centre) + np.multiply.outer(radii, [0.6, 0.0, -0.8]))) < 1e-8


@pytest.mark.slow  # the test above compares its values
def test_the_file_tells_the_certificate_with_the_measured_difference_added(tmp_path):
    model = load_shipped("intelsat30")
    out = tmp_path / "a.onnx"
    answer = keepout_command(
        *("export", shipped_path("intelsat30"), "--to", "onnx", "--chaser-radius", 0.5, "-o", out, "--json")
    ).json
    told = {entry.key: entry.value for entry in onnx.load(out).metadata_props}
    certificate = model.certificate(0.5)
    said = ("keepout.target_sha256", "keepout.field_sha256", "keepout.certificate_kind", "keepout.chaser_radius_m")
    assert [told[name] for name in said] == [model.target_sha256, model.sha256, "certified", "0.5"]
    assert int(told["keepout.measured_points"]) >= 100_000
    difference = float(told["keepout.measured_value_difference_m"])
    session = onnxruntime.InferenceSession(out, providers=["CPUExecutionProvider"])
    points = sample_points(model.field, MANY, seed=0)
    value, gradient = values_and_gradients(model.field, points)
    here, slope = session.run(None, {"points": points})
    assert difference == pytest.approx(np.abs(here - value).max(), rel=0.5)
    assert float(told["keepout.error_bound_m"]) == certificate.error_bound
    assert float(told["keepout.error_bound_with_measured_difference_m"]) == certificate.error_bound + difference
    assert difference > 0.0
    slopes = float(told["keepout.measured_gradient_difference"])
    assert slopes == pytest.approx(np.linalg.norm(slope - gradient, axis=1).max(), rel=0.5)
    assert float(told["keepout.gradient_bound_with_measured_difference"]) == certificate.gradient_bound + slopes
    assert answer["measured_value_difference_m"] == difference
    exact = values_and_gradients(in_double(model.field), points)
    assert answer["package_rounding_m"] == pytest.approx(np.abs(value - exact[0]).max(), rel=0.5)


def small_model():
    return FieldModel(random_field(2, dtype=jnp.float32), "ball", "0" * 64, 0.03, {})


@pytest.mark.long
def test_a_field_without_certificates_tells_none_and_a_graph_that_is_wrong_is_measured_so(tmp_path):
    """The measurement is of the file that is written: a field whose graph has another allowance is far off."""
    model = small_model()
    told = export_onnx(model, tmp_path / "a.onnx", certificate=None, points=3000)
    assert 0.0 < told["measured_value_difference_m"] < 1e-4
    assert not [key for key in told if "bound" in key or "certificate" in key]
    ring = model.field.continuation
    other = dataclasses.replace(ring, allowance=ring.allowance + 0.25)
    wrong = eqx.tree_at(lambda f: f.continuation, model.field, other)
    found = measure(field_graph(wrong).SerializeToString(), model.field, sample_points(model.field, 3000, 0))
    assert found.value == pytest.approx(0.25, rel=1e-3)
