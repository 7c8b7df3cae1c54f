"""The certificate broken on purpose: the searches that hold it to its word must notice each break.

Every break is one that a slip of the pen could make. The search is the one that passes without it.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from truths.bound_attacks import check_random_networks_are_never_above_their_bound
from truths.boxes import contact_with_box
from truths.networks import random_field

from keepout.errors import FieldError
from keepout.fields import mlp
from keepout.fields.evaluate import values
from keepout.fields.model import FieldModel
from keepout.geometry.target import Target
from keepout.proof import bounds, certificate, relaxation
from keepout.proof.certificate import certify

SEEDS = (0, 1, 2)


@pytest.fixture(scope="module")
def box():
    return Target.load("box")


def random_model(box: Target, radius: float, seed: int) -> FieldModel:
    """A network that never saw the box: its largest value can be anywhere around it, and is made R to the millimetre.

    The certificate is tight only where it matters to a chaser, near zero.
    """
    field = random_field(seed, dtype=jnp.float32)
    weights, biases = field.layers
    largest = values(field, contact_with_box(50_000, radius)).max() - radius
    lowered = biases[-1] - jnp.float32(largest / float(field.scale))
    field = dataclasses.replace(field, layers=mlp.Layers(weights, (*biases[:-1], lowered)))
    return FieldModel(field, box.name, box.sha256, 0.03, {})


def excess(box: Target, radius: float, seed: int) -> float:
    """Metres by which a search beats the bound that `certify` gives a random network; not positive where it is true."""
    model = random_model(box, radius, seed)
    bound = certify(model, box, chaser_radius=radius).certificate(radius).error_bound
    return float(values(model.field, contact_with_box(200_000, radius)).max()) - radius - bound


def check_no_search_beats_the_bound(box: Target, radius: float) -> None:
    """The property: whatever the network, no point at distance R has a value above R + e_h."""
    assert max(excess(box, radius, seed) for seed in SEEDS) <= 0.0


@pytest.mark.long
@pytest.mark.parametrize("radius", [0.0, 0.5])
def test_without_a_break_no_search_beats_the_bound(box, radius):
    check_no_search_beats_the_bound(box, radius)


def lose_pieces(monkeypatch):
    """Splitting goes on with the first of two halves only, or with one cube in eight."""
    split = certificate._split

    def without(elements, distance, radius):
        pieces = split(elements, distance, radius)
        return pieces[: len(pieces) // 2] if radius == 0.0 else pieces[::8]

    monkeypatch.setattr(certificate, "_split", without)


def lose_elements(monkeypatch):
    """The cover stops after a quarter of the target."""
    cover = certificate._cover

    def without(*arguments):
        elements = cover(*arguments)
        return elements[: len(elements) // 4]

    monkeypatch.setattr(certificate, "_cover", without)


def bound_the_middle(monkeypatch):
    """Elements are bounded over the inner half of themselves."""
    bounded = certificate._bounded

    def without(network, piece, distance, radius, *rest):
        if radius == 0.0:
            smaller = 0.5 * (piece + piece.mean(axis=1, keepdims=True))
        else:
            smaller = piece * np.array([1.0, 0.5])[None, :, None]
        return bounded(network, smaller, distance, radius, *rest)

    monkeypatch.setattr(certificate, "_bounded", without)


@pytest.mark.long
@pytest.mark.parametrize("radius", [0.0, 0.5])
@pytest.mark.parametrize("broken", [lose_pieces, lose_elements, bound_the_middle])
def test_a_broken_cover_is_noticed(box, radius, broken, monkeypatch):
    broken(monkeypatch)
    # The certificate's own sampling may notice first.
    with pytest.raises((AssertionError, FieldError), match=r"a bound is at least what was found|<= 0\.0"):
        check_no_search_beats_the_bound(box, radius)


def forget_the_remainder(monkeypatch):
    """What a layer's relaxation loses, r, is not carried on to the next layer."""
    relax = relaxation.relax

    def without(layer, columns, carried, *rest):
        answer = relax(layer, columns, carried, *rest)
        carried[0] = 0.0
        return answer

    monkeypatch.setattr(relaxation, "relax", without)


def forget_the_chord(monkeypatch):
    """The softplus is taken for its tangent from above too."""
    relax = relaxation.relax

    def without(layer, *rest):
        answer = relax(layer, *rest)
        layer.chord[...], layer.above[...] = layer.tangent, layer.below
        return answer

    monkeypatch.setattr(relaxation, "relax", without)


def forget_float32(monkeypatch):
    """The network is bounded as if it were evaluated in float64."""
    of = bounds.Network.of

    def without(layers, beta):
        return of(layers, beta)._replace(single=False)

    monkeypatch.setattr(bounds.Network, "of", without)


@pytest.mark.parametrize("kind", ["triangle", "box"])
@pytest.mark.parametrize("broken", [forget_the_remainder, forget_the_chord, forget_float32])
def test_a_broken_relaxation_is_noticed(kind, broken, monkeypatch):
    broken(monkeypatch)
    with pytest.raises(AssertionError):
        check_random_networks_are_never_above_their_bound(kind)


def test_a_field_altered_after_its_proof_beats_the_bound_and_is_refused(box, tmp_path):
    model = certify(random_model(box, 0.0, 0), box)
    bound = model.certificate(0.0).error_bound
    weights, biases = model.field.layers
    raised = mlp.Layers(weights, (*biases[:-1], biases[-1] + jnp.float32(0.01 / float(model.field.scale))))
    altered = dataclasses.replace(model, field=dataclasses.replace(model.field, layers=raised))
    assert values(altered.field, contact_with_box(200_000, 0.0)).max() > bound
    altered.save(tmp_path / "altered.keepout")
    with pytest.raises(FieldError, match="belongs to another field"):
        FieldModel.load(tmp_path / "altered.keepout", target=box)
