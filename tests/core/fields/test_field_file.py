"""The field file: what goes in comes out, and whatever was done to the file is refused in one line."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from truths.networks import random_field

from keepout.core.errors import FieldError
from keepout.core.fields.model import Certificate, FieldModel, _digest
from keepout.core.geometry.target import Target


@pytest.fixture
def model(box):
    model = FieldModel(random_field(0, dtype=jnp.float32), box.name, box.sha256, 0.03, {"profile": "none"})
    certificate = Certificate(
        "sampled", 0.5, 0.04, 0.01, 0.03, 1.3, "sampled", 0.0, 1.0, model.target_sha256, model.sha256
    )
    return model.with_certificate(certificate)


def rewritten(path, change):
    """Change the header of a field file that something else wrote, with every digest right."""
    with safetensors.safe_open(path, framework="numpy") as file:
        metadata = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    header = json.loads(metadata["header"])
    change(header)
    metadata |= {"header": json.dumps(header), "sha256": _digest(tensors, header)}
    safetensors.numpy.save_file(tensors, path, metadata)


def refused(path, said, target=None):
    with pytest.raises(FieldError, match=said) as refusal:
        FieldModel.load(path, target=target)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_round_trip(tmp_path, model, box):
    path = tmp_path / "a.keepout"
    model.save(path)
    loaded = FieldModel.load(path, target=box)
    assert loaded.certificates == model.certificates
    assert loaded.sha256 == model.sha256
    assert loaded.training == model.training
    for ours, theirs in zip(jax.tree.leaves(loaded.field), jax.tree.leaves(model.field), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert [p.name for p in tmp_path.iterdir()] == ["a.keepout"]
    # What is not of this target, this field or this version is refused.
    refused(path, "not for box", Target.load("box", parameters={"length": 3.3}))
    rewritten(path, lambda header: header.update(version=99))
    refused(path, "version 99")
    dataclasses.replace(model, field=random_field(1, dtype=jnp.float32)).save(path)
    refused(path, "belongs to another field")
    with pytest.raises(FieldError, match="cannot be written"):
        model.save(tmp_path / "none" / "a.keepout")


def test_missing_truncated_foreign_and_edited_files_are_refused(tmp_path, model):
    path = tmp_path / "a.keepout"
    refused(path, "no such file")
    model.save(path)
    whole = path.read_bytes()
    for content in (b"", b"hello", whole[: len(whole) // 2], whole[:-1], b"\xff" * 64):
        path.write_bytes(content)
        refused(path, "damaged, truncated, or not a field file")
    for place in (len(whole) - 5, *np.random.default_rng(0).integers(8, len(whole), size=40)):
        edited = bytearray(whole)
        edited[place] ^= 1
        path.write_bytes(edited)
        refused(path, "field file|damaged|not ")
    safetensors.numpy.save_file({"x": np.zeros(3)}, path)
    refused(path, "not a field file")


def network(model, change):
    """The model's field with one of its arrays changed."""
    first, second, *others = model.field.layers.weights
    layers = model.field.layers._replace(weights=(first, change(second), *others))
    return dataclasses.replace(model.field, layers=layers)


def continued(field, **lengths):
    changed = {name: jnp.asarray(value, jnp.float64) for name, value in lengths.items()}
    return dataclasses.replace(field, continuation=dataclasses.replace(field.continuation, **changed))


def cast(field, dtype):
    layers = field.layers
    return dataclasses.replace(
        field, layers=type(layers)(*(tuple(array.astype(dtype) for array in group) for group in layers))
    )


INADMISSIBLE = {
    "half": (lambda m: cast(m.field, jnp.float16), r"W0 is float16; a network must be float32 or float64"),
    "mixed": (lambda m: network(m, lambda a: a.astype(jnp.float64)), r"W1 float64.*all must be of one type"),
    "nan weight": (
        lambda m: network(m, lambda a: a.at[2, 3].set(jnp.nan)),
        r"W1: 1 of \d+ .*not finite.*nan",
    ),
    "scale": (lambda m: dataclasses.replace(m.field, scale=jnp.asarray(jnp.nan)), r"scale is nan; it must be finite"),
    "beta": (lambda m: dataclasses.replace(m.field, beta=-1.0), r"beta is -1; it must be finite and above 0"),
    "tiny scale": (
        lambda m: dataclasses.replace(m.field, scale=jnp.asarray(1e-300)),
        r"scale is 1e-300 m; in its domain",
    ),
    "allowance": (lambda m: continued(m.field, allowance=-0.25), r"allowance is -0\.25 m; it must be at least 0"),
    "centre": (lambda m: continued(m.field, centre=[0.0, jnp.nan, 0.0]), r"continuation\.centre: 1 of 3 numbers"),
    "radii": (lambda m: continued(m.field, domain_radius=20.0), r"domain_radius 20 m, outer_radius 13 m; each must"),
    "beta too small": (lambda m: dataclasses.replace(m.field, beta=1e-42), "a float32 holds"),
    "no target": (lambda m: continued(m.field, target_radius=0.0), r"target_radius 0 m.*the first above 0"),
}


@pytest.mark.parametrize("case", sorted(INADMISSIBLE))
def test_a_field_of_which_nothing_can_be_proved_is_refused_everywhere(tmp_path, monkeypatch, model, box, case):
    make, message = INADMISSIBLE[case]
    with pytest.raises(FieldError, match=message) as refusal:
        dataclasses.replace(model, field=make(model), certificates=())
    assert "\n" not in str(refusal.value)
    # A file that says so, written by something else: with every digest right.
    path = tmp_path / "a.keepout"
    with monkeypatch.context() as unchecked:
        unchecked.setattr("keepout.core.fields.model.require_admissible", lambda field: None)
        dataclasses.replace(model, field=make(model), certificates=()).save(path)
    # Half floats do not get as far as the network: the file's own types are refused.
    refused(path, "W0 is F16" if case == "half" else message, box)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("error_bound", float("nan")),
        ("error_bound", 0.029),  # found was 0.03
        ("gradient_bound", -1.0),
        ("gradient_found", 1.4),
        ("evaluation_error", float("inf")),
        ("chaser_radius", -0.5),
        ("allowance", -0.01),
        *(
            (name, value)
            for name in ("error_bound", "chaser_radius")
            for value in (True, "0.04", None, [0.04], 10**400)
        ),
    ],
)
def test_a_certificate_that_bounds_nothing_is_refused(tmp_path, model, name, value):
    path = tmp_path / "a.keepout"
    model.save(path)
    rewritten(path, lambda header: header["certificates"][0].update({name: value}))
    refused(path, name)
    if isinstance(value, float):
        with pytest.raises(FieldError, match=f"certificate: .*{name}"):
            dataclasses.replace(model.certificates[0], **{name: value})


def test_a_proof_has_no_allowance_and_a_radius_one_certificate(model):
    good = model.certificates[0]
    with pytest.raises(FieldError, match=r"chaser radius 0\.3 m.*certified for: 0\.5 m"):
        model.certificate(0.3)
    with pytest.raises(FieldError, match=r"allowance is 0\.01 m"):
        dataclasses.replace(good, kind="certified")
    with pytest.raises(FieldError, match=r"two are for the chaser radius 0\.5 m"):
        dataclasses.replace(model, certificates=(good, good))


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16, jnp.float32])
@pytest.mark.parametrize("name", ["centre", "target_radius", "domain_radius", "outer_radius", "allowance"])
def test_a_continuation_of_shorter_floats_is_refused(model, name, dtype):
    """The proof takes its radii as float64 numbers; squared in float16, 300 m is infinite and nothing is outside."""
    ring = model.field.continuation
    short = dataclasses.replace(ring, **{name: jnp.asarray(np.asarray(getattr(ring, name)).astype(dtype))})
    with pytest.raises(FieldError, match=f"continuation.{name} is .*; it must be float64"):
        dataclasses.replace(model, field=dataclasses.replace(model.field, continuation=short), certificates=())
