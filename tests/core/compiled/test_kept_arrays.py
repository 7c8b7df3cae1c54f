"""Arrays on disk: the same bits as made anew, and only where all that they are made from is the same."""

import os

import jax.numpy as jnp
import numpy as np
import pytest

from keepout.core.compiled.kept_executables import kept_arrays
from keepout.core.compiled.kept_programs import KeptProgramsWarning
from keepout.core.fields.own import SphereField, stated_field

pytestmark = pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners and modes of files here")

SPHERE = SphereField(jnp.zeros(3), jnp.asarray(2.0))


@pytest.fixture
def made():
    """What was made, and what makes it."""
    calls = []

    def make():
        calls.append(1)
        return {"numbers": np.linspace(0.0, 1.0, 7), "few": np.asarray(0.1)}

    return calls, make


def entries(folder):
    return sorted(folder.glob("numbers-*-cache"))


def test_made_once_and_the_same_bits_afterwards(folder, made):
    calls, make = made
    first = kept_arrays("numbers", (SPHERE, 1.0), make)
    again = kept_arrays("numbers", (SPHERE, 1.0), make)
    assert len(calls) == len(entries(folder)) == 1
    assert first.keys() == again.keys()
    for name, array in first.items():
        assert array.dtype == again[name].dtype
        assert array.tobytes() == again[name].tobytes()


@pytest.mark.parametrize(
    "other",
    [
        (SPHERE, 2.0),
        (SphereField(jnp.zeros(3), jnp.asarray(np.nextafter(2.0, 3.0))), 1.0),
        (SphereField(jnp.zeros(3).at[1].set(-0.0), jnp.asarray(2.0)), 1.0),
    ],
    ids=["number", "last bit of a field", "sign of zero"],
)
def test_what_is_made_from_something_else_is_made_anew(folder, made, other):
    calls, make = made
    kept_arrays("numbers", (SPHERE, 1.0), make)
    kept_arrays("numbers", other, make)
    assert len(calls) == len(entries(folder)) == 2


def test_another_version_of_a_library_makes_anew(folder, made, monkeypatch):
    calls, make = made
    kept_arrays("numbers", SPHERE, make, libraries=["scikit-image"])
    monkeypatch.setattr("importlib.metadata.version", lambda _: "0.0")
    kept_arrays("numbers", SPHERE, make, libraries=["scikit-image"])
    assert len(calls) == 2


@pytest.mark.parametrize(
    "damage", [lambda whole: bytes([whole[0] ^ 1]) + whole[1:], lambda whole: whole[:-9], lambda _: b""]
)
def test_a_damaged_file_is_one_warning_and_mended(folder, made, damage):
    calls, make = made
    first = kept_arrays("numbers", SPHERE, make)
    [path] = entries(folder)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.warns(KeptProgramsWarning, match="damaged") as said:
        again = kept_arrays("numbers", SPHERE, make)
    assert len(said) == 1
    assert again["numbers"].tobytes() == first["numbers"].tobytes()
    kept_arrays("numbers", SPHERE, make)
    assert len(calls) == 2


def test_what_cannot_be_told_apart_is_not_kept(folder, made):
    calls, make = made
    own = stated_field(lambda point: jnp.linalg.norm(point) - 2.0, 1.0, lower=(-3.0,) * 3, upper=(3.0,) * 3, samples=10)
    for _ in range(2):
        kept_arrays("numbers", own, make)
    assert len(calls) == 2
    assert entries(folder) == []
