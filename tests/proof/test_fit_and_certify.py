"""A small fit, end to end: certified, reproducible, and the same after a kill."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time

import jax.numpy as jnp
import numpy as np
import pytest

from keepout.cli import main
from keepout.errors import FieldError
from keepout.fields import mlp
from keepout.fields.domain import Domain
from keepout.fields.evaluate import values
from keepout.fields.model import FieldModel
from keepout.geometry.level_points import onto_level
from keepout.geometry.offset_solid import OffsetSolid
from keepout.geometry.target import Target
from keepout.learning.profile import TrainingProfile
from keepout.learning.training import fit
from keepout.measures.quality import curvature, distance_errors, margin_cost, surface_errors
from keepout.proof import certificate
from keepout.proof.certificate import certify

# One worker fits the box for all of them.
pytestmark = [pytest.mark.xdist_group("fit_and_certify"), pytest.mark.long]

TINY = TrainingProfile(width=24, depth=2, samples=20_000, batch=512, steps=1250, tuning_steps=500)


@pytest.fixture(scope="module")
def target():
    return Target.load("box", parameters={"length": 2.0, "width": 1.0, "height": 1.0})


@pytest.fixture(scope="module")
def solid(target):
    return OffsetSolid.build(target.distance)


@pytest.fixture(scope="module")
def model(target, solid):
    return fit(target, profile=TINY, solid=solid)


@pytest.fixture(scope="module")
def certified(model, target):
    return certify(certify(model, target), target, chaser_radius=0.3)


def test_the_fit_resembles_the_box(model, solid, target):
    errors = surface_errors(model.field, target, count=20_000)
    assert errors.epsilon < 0.1
    band = distance_errors(model.field, solid, nearest=0.05, farthest=1.0, count=5000)
    assert band.mean_absolute < 0.1
    assert band.eikonal < 0.2
    bend = curvature(model.field, solid, 0.3, count=1000)
    assert 0.0 < bend.median <= bend.percentile_99 <= bend.maximum


@pytest.mark.parametrize("radius", [0.0, 0.3])
def test_no_search_beats_the_certificate(certified, target, radius):
    proof = certified.certificate(radius)
    assert proof.kind == "certified"
    rng = np.random.default_rng(5)
    # The box's own parametrisation: exact points at distance R from its surface, not from the package's sampler.
    points = rng.uniform(-1.0, 1.0, (200_000, 3)) * (np.array([1.0, 0.5, 0.5]) + 1.2 * radius)
    points = onto_level(target.distance, points, radius)
    half = 0.5 * (target.vertices.max(axis=0) - target.vertices.min(axis=0))
    middle = 0.5 * (target.vertices.max(axis=0) + target.vertices.min(axis=0))
    q = np.abs(points - middle) - half
    exact = np.where((q > 0).any(axis=1), np.linalg.norm(np.maximum(q, 0.0), axis=1), -q.max(axis=1))
    np.testing.assert_allclose(exact, radius, atol=1e-8)
    worst = values(certified.field, points).max() - radius
    assert worst <= proof.error_bound
    assert proof.sampled_maximum <= proof.error_bound <= proof.sampled_maximum + 0.02
    assert worst > proof.error_bound - 0.1


def checked(arguments, monkeypatch, capsys):
    """What `keepout certify --check` prints and exits with."""
    monkeypatch.setattr(sys, "argv", ["keepout", "certify", "--check", *map(str, arguments), "--json"])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code or 0, json.loads(capsys.readouterr().out)


def test_a_file_is_proved_again_and_a_forged_one_is_not(certified, tmp_path, monkeypatch, capsys):
    path = tmp_path / "a.keepout"
    located = {"source": "box", "parameters": {"length": 2.0, "width": 1.0, "height": 1.0}}
    certified = certified.with_training(target=located)
    certified.save(path)
    before = path.read_bytes()
    code, said = checked([path], monkeypatch, capsys)
    assert (code, said["proved"]) == (0, True)
    for row, stated in zip(said["certificates"], certified.certificates, strict=True):
        assert row["error_bound_now_m"] <= row["error_bound_m"] == stated.error_bound
    assert path.read_bytes() == before

    true = certified.certificate(0.3)
    for forged in (
        {"error_bound": -5.0, "sampled_maximum": -6.0},
        {"error_bound": true.sampled_maximum - 1e-3, "sampled_maximum": -6.0},
        {"evaluation_error": 0.0},
        {"kind": "sampled"},
    ):
        dataclasses.replace(certified, certificates=(dataclasses.replace(true, **forged),)).save(path)
        # An evaluation error of zero would be sought until the limit of elements.
        monkeypatch.setattr(certificate, "MOST_ELEMENTS", 50_000)
        before = path.read_bytes()
        code, said = checked([path], monkeypatch, capsys)
        assert (code, said["proved"]) == (1, False), forged
        (row,) = said["certificates"]
        assert row["error_bound_m"] == forged.get("error_bound", true.error_bound)
        assert row["error_bound_now_m"] >= true.sampled_maximum - 1e-3
        assert path.read_bytes() == before
    dataclasses.replace(certified, certificates=()).save(path)
    monkeypatch.setattr(sys, "argv", ["keepout", "certify", "--check", str(path)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code not in (0, None)
    assert "no certificate to check" in capsys.readouterr().err


def test_a_planted_violation_is_found(model, certified, target):
    W, b = model.field.layers
    spoiled = mlp.Layers(W, (*b[:-1], b[-1] + jnp.float32(0.5 / float(model.field.scale))))
    field = dataclasses.replace(model.field, layers=spoiled)
    before = certified.certificate(0.0).error_bound
    after = certify(dataclasses.replace(model, field=field), target).certificate(0.0).error_bound
    assert after == pytest.approx(before + 0.5, abs=0.03)


def test_margin_and_far_field(certified, solid):
    cost = margin_cost(certified.field, solid, error_bound=certified.certificate(0.0).error_bound, count=2000)
    assert cost.count > 500
    assert -1e-2 < cost.mean <= cost.percentile_95 < 0.5
    # From the domain's edge out to ten times the target's size nothing is over-stated.
    domain = Domain.around(solid.distance)
    generator = np.random.default_rng(0)
    direction = generator.normal(size=(5000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    low, high = np.log(domain.domain_radius), np.log(20.0 * domain.target_radius)
    points = domain.centre + np.exp(generator.uniform(low, high, size=(5000, 1))) * direction
    assert np.max(values(certified.field, points) - solid.signed_distance(points)) <= 0.0


def test_refusals(model, target):
    with pytest.raises(FieldError, match="the field was made for box"):
        certify(model, Target.load("box"))
    with pytest.raises(FieldError, match="chaser radius 40 m"):
        certify(model, target, chaser_radius=40.0)
    with pytest.raises(FieldError, match="profile 'best'"):
        fit(target, profile="best")


def test_splitting_that_runs_out_stays_sound(model, certified, target, monkeypatch):
    full = certified.certificate(0.0)
    monkeypatch.setattr(certificate, "MOST_ELEMENTS", 20)
    rough = certify(model, target).certificate(0.0)
    assert rough.error_bound >= full.error_bound


_SCRIPT = """
import sys
from pathlib import Path
from keepout.learning.profile import TrainingProfile
from keepout.geometry.level_points import onto_level
from keepout.learning.training import fit
from keepout.geometry.target import Target
target = Target.load("box", parameters={"length": 2.0, "width": 1.0, "height": 1.0})
profile = TrainingProfile(width=24, depth=2, samples=20_000, batch=512, steps=1250, tuning_steps=500)
fit(target, profile=profile, checkpoint=Path(sys.argv[1])).save(sys.argv[2])
"""


@pytest.mark.slow  # tests/test_journey.py goes on from a checkpoint of a fit that was interrupted
def test_a_killed_fit_goes_on_to_the_same_field(tmp_path, model):
    checkpoint, out = tmp_path / "c", tmp_path / "f.keepout"
    command = [sys.executable, "-c", _SCRIPT, str(checkpoint), str(out)]
    process = subprocess.Popen(command)
    deadline = time.monotonic() + 240.0
    while not checkpoint.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)
    assert checkpoint.exists()
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not out.exists()
    subprocess.run(command, check=True)
    assert not checkpoint.exists()
    assert FieldModel.load(out).sha256 == model.sha256


def test_a_checkpoint_of_another_fit_is_refused(tmp_path, target, solid):
    path = tmp_path / "c"
    path.write_bytes(b"nothing")
    with pytest.raises(FieldError, match="damaged checkpoint"):
        fit(target, profile=TINY, solid=solid, checkpoint=path)


@pytest.mark.parametrize("radius", [-0.1, float("nan"), 50.0])
def test_a_radius_that_cannot_touch_is_refused(target, solid, radius):
    with pytest.raises(FieldError, match=r"chaser radius .* must be 0 to"):
        fit(target, profile=TINY, chaser_radius=radius, solid=solid)
