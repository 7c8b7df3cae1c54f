"""The field file: what goes in comes out, and whatever was done to the file is refused in one line."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from truths.networks import random_field

from keepout.errors import FieldError
from keepout.fields.model import Certificate, FieldModel, _digest
from keepout.geometry.target import Target


@pytest.fixture(scope="module")
def box():
    return Target.load("box")


@pytest.fixture
def model(box):
    model = FieldModel(random_field(0, dtype=jnp.float32), box.name, box.sha256, 0.03, {"profile": "none"})
    certificate = Certificate(
        "sampled", 0.5, 0.04, 0.01, 0.03, 1.3, "sampled", 0.0, 1.0, model.target_sha256, model.sha256
    )
    return model.with_certificate(certificate)


@pytest.mark.long
def test_round_trip(tmp_path, model, box):
    path = tmp_path / "a.keepout"
    model.save(path)
    loaded = FieldModel.load(path, target=box)
    assert loaded.certificates == model.certificates
    assert loaded.sha256 == model.sha256
    assert loaded.training == model.training
    points = np.random.default_rng(0).normal(size=(20, 3))
    np.testing.assert_array_equal(loaded.field.value(jnp.asarray(points)), model.field.value(jnp.asarray(points)))
    assert [p.name for p in tmp_path.iterdir()] == ["a.keepout"]
    plain = tmp_path / "plain"
    plain.touch()
    assert path.stat().st_mode == plain.stat().st_mode


def test_another_radius_is_refused_with_the_list(model):
    assert model.certificate(0.5).error_bound == 0.04
    with pytest.raises(FieldError, match=r"chaser radius 0\.3 m.*certified for: 0\.5 m"):
        model.certificate(0.3)


def test_another_target_is_refused(tmp_path, model):
    model.save(tmp_path / "a.keepout")
    other = Target.load("box", parameters={"length": 3.3})
    with pytest.raises(FieldError, match="not for box"):
        FieldModel.load(tmp_path / "a.keepout", target=other)


def test_missing_truncated_foreign_and_edited_files_are_refused(tmp_path, model):
    path = tmp_path / "a.keepout"
    with pytest.raises(FieldError, match="no such file"):
        FieldModel.load(path)
    model.save(path)
    whole = path.read_bytes()
    bad = tmp_path / "b.keepout"
    for content in (b"", b"hello", whole[: len(whole) // 2], whole[:-1], b"\xff" * 64):
        bad.write_bytes(content)
        with pytest.raises(FieldError, match="damaged, truncated, or not a field file"):
            FieldModel.load(bad)
    rng = np.random.default_rng(0)
    for place in rng.integers(8, len(whole), size=40):
        edited = bytearray(whole)
        edited[place] ^= 1
        bad.write_bytes(edited)
        with pytest.raises(FieldError) as refusal:
            FieldModel.load(bad)
        assert "\n" not in str(refusal.value)
    safetensors.numpy.save_file({"x": np.zeros(3)}, bad)
    with pytest.raises(FieldError, match="not a field file"):
        FieldModel.load(bad)


def test_a_certificate_of_another_field_is_refused(tmp_path, model):
    foreign = dataclasses.replace(model, field=random_field(1, dtype=jnp.float32))
    foreign.save(tmp_path / "a.keepout")
    with pytest.raises(FieldError, match="belongs to another field"):
        FieldModel.load(tmp_path / "a.keepout")


def test_a_later_version_is_refused(tmp_path, model):
    path = tmp_path / "a.keepout"
    model.save(path)
    with safetensors.safe_open(path, framework="numpy") as file:
        metadata = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    header = {**json.loads(metadata["header"]), "version": 99}
    safetensors.numpy.save_file(tensors, path, {**metadata, "header": json.dumps(header)})
    with pytest.raises(FieldError, match="version 99"):
        FieldModel.load(path)


def test_a_folder_that_does_not_exist_is_refused(tmp_path, model):
    with pytest.raises(FieldError, match="cannot be written"):
        model.save(tmp_path / "none" / "a.keepout")


def network(model, change, name="weights", layer=1):
    """The model's field with one of its arrays changed."""
    arrays = list(getattr(model.field.layers, name))
    arrays[layer] = change(arrays[layer])
    return dataclasses.replace(model.field, layers=model.field.layers._replace(**{name: tuple(arrays)}))


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
    "brain": (lambda m: cast(m.field, jnp.bfloat16), r"W0 is bfloat16; a network must be float32 or float64"),
    "mixed": (lambda m: network(m, lambda a: a.astype(jnp.float64)), r"W1 float64.*all must be of one type"),
    "nan weight": (
        lambda m: network(m, lambda a: a.at[2, 3].set(jnp.nan)),
        r"W1: 1 of \d+ .*not finite.*nan",
    ),
    "inf bias": (lambda m: network(m, lambda a: a.at[0].set(jnp.inf), "biases", 0), r"b0: 1 of \d+ .*not finite.*inf"),
    "scale": (lambda m: dataclasses.replace(m.field, scale=jnp.asarray(jnp.nan)), r"scale is nan; it must be finite"),
    "beta": (lambda m: dataclasses.replace(m.field, beta=-1.0), r"beta is -1; it must be finite and above 0"),
    "tiny scale": (
        lambda m: dataclasses.replace(m.field, scale=jnp.asarray(1e-300)),
        r"scale is 1e-300 m; in its domain",
    ),
    "allowance": (lambda m: continued(m.field, allowance=-0.25), r"allowance is -0\.25 m; it must be at least 0"),
    "centre": (lambda m: continued(m.field, centre=[0.0, jnp.nan, 0.0]), r"continuation\.centre: 1 of 3 numbers"),
    "radii": (lambda m: continued(m.field, domain_radius=20.0), r"domain_radius 20 m, outer_radius 13 m; each must"),
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
        unchecked.setattr("keepout.fields.model.require_admissible", lambda field: None)
        dataclasses.replace(model, field=make(model), certificates=()).save(path)
    # Half floats do not get as far as the network: the file's own types are refused.
    stored = {"half": "W0 is F16", "brain": "W0 is BF16"}.get(case, message)
    with pytest.raises(FieldError, match=stored) as refusal:
        FieldModel.load(path, target=box)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


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
    ],
)
def test_a_certificate_that_bounds_nothing_is_refused(tmp_path, monkeypatch, model, name, value):
    good = model.certificates[0]
    shown = "gradient_bound is 1.3 and gradient_found" if name == "gradient_found" else f"{name} is"
    with pytest.raises(FieldError, match=f"certificate: {shown}"):
        dataclasses.replace(good, **{name: value})
    with monkeypatch.context() as unchecked:
        unchecked.setattr(Certificate, "__post_init__", lambda self: None)
        model.with_certificate(dataclasses.replace(good, **{name: value})).save(tmp_path / "a.keepout")
    with pytest.raises(FieldError, match=f"certificate: {shown}"):
        FieldModel.load(tmp_path / "a.keepout")


def test_a_proof_has_no_allowance_and_a_radius_one_certificate(model):
    good = model.certificates[0]
    with pytest.raises(FieldError, match=r"allowance is 0\.01 m"):
        dataclasses.replace(good, kind="certified")
    with pytest.raises(FieldError, match=r"two are for the chaser radius 0\.5 m"):
        dataclasses.replace(model, certificates=(good, good))


@pytest.mark.parametrize("value", [True, "0.04", None, [0.04], 10**400])
@pytest.mark.parametrize("name", ["error_bound", "chaser_radius"])
def test_a_certificate_whose_numbers_are_none_is_refused(tmp_path, model, name, value):
    """A file that something else wrote, with every digest right."""
    path = tmp_path / "a.keepout"
    model.save(path)
    with safetensors.safe_open(path, framework="numpy") as file:
        metadata = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    header = json.loads(metadata["header"])
    header["certificates"][0][name] = value
    metadata |= {"header": json.dumps(header), "sha256": _digest(tensors, header)}
    safetensors.numpy.save_file(tensors, path, metadata)
    with pytest.raises(FieldError, match=name) as refusal:
        FieldModel.load(path)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)
