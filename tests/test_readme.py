"""The Python of README and docs/control.md, run as it stands but for the time it takes, and what the README may be."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from truths.learned import taken

import keepout

REPOSITORY = Path(__file__).parents[1]


def block(language: str, page: str = "README.md") -> str:
    text = (REPOSITORY / page).read_text(encoding="utf-8")
    [found] = re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)
    return found


@pytest.mark.long
def test_the_ten_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.chdir(tmp_path)
    # The built-in's own triangles, 4 × 3 × 2 m, which tests/test_journey.py learns, certifies and flies round, too.
    box = keepout.Target.load("box")
    trimesh.Trimesh(box.vertices, box.faces, process=False).export("satellite.glb")
    code = block("python")
    for printed, quick in (("seed=0)", 'seed=0, profile="quick")'), ("duration=1200.0", "duration=500.0")):
        assert code.count(printed) == 1
        code = code.replace(printed, quick)
    monkeypatch.setattr(keepout, "fit", taken(keepout.fit))
    monkeypatch.setattr(keepout, "certify", taken(keepout.certify))
    names: dict = {}
    exec(code, names)
    flight = names["flight"]
    assert flight.outcome.reached
    assert flight.summary()["contact"] is False
    # The truth, by closed form: distance of every recorded position to the box, less the chaser's radius.
    outside = np.maximum(np.abs(flight.record.position) - [2.0, 1.5, 1.0], 0.0)
    exact = np.linalg.norm(outside, axis=1) - 0.5
    np.testing.assert_allclose(flight.clearance, exact, atol=1e-9)
    assert 0.0 < flight.audit.minimum_clearance <= exact.min()
    np.testing.assert_allclose(names["force"], flight.record.guarded_force[0], rtol=0.0, atol=1e-9)
    assert "'reached': True" in capsys.readouterr().out
    again = keepout.FlightRecord.load("flight.parquet")
    np.testing.assert_array_equal(again.position, flight.record.position)


def test_it_is_read_in_a_minute():
    lines = (REPOSITORY / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 90
    picture = next(number for number, line in enumerate(lines) if line.startswith("!["))
    assert picture < 12
    heading = next(number for number, line in enumerate(lines) if line.startswith("## "))
    assert heading > picture


@pytest.mark.long
def test_a_law_and_a_safety_layer_of_your_own(capsys):
    names: dict = {}
    exec(block("python", "docs/control.md"), names)
    guarded, gated = names["guarded"], names["gated"]
    mesh, radius = guarded.target.distance, guarded.scenario.chaser.radius
    # The law flies into the bus: the guard must act and hold it off, and a layer that is none must not look like one.
    assert guarded.start_certified is True
    assert guarded.summary()["contact"] is False
    assert guarded.outcome.guard_interventions > 0
    assert 0.0 < guarded.audit.minimum_clearance <= (mesh.distance(guarded.record.position) - radius).min()
    assert gated.start_certified is None
    assert gated.guard is None
    assert gated.summary()["contact"] is True
    assert (mesh.distance(gated.record.position) - radius).min() < 0.0
    # What was commanded is the law's own word, by its closed form at each recorded state.
    record, goal = gated.record, np.array(gated.scenario.goal.position)
    away = goal - record.position
    wanted = 0.05 * away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1.0)
    own = np.clip(4.0 * (wanted - record.velocity), -0.1, 0.1)
    np.testing.assert_allclose(record.commanded_force, own, atol=1e-12)
    fast = np.linalg.norm(record.velocity, axis=1) > 0.03
    brake = np.clip(-20.0 * record.velocity, -0.1, 0.1)
    np.testing.assert_allclose(record.guarded_force, np.where(fast[:, None], brake, own), atol=1e-12)
    assert 0 < gated.outcome.guard_interventions == fast[:-1].sum()
    assert np.isnan(record.barrier).all()
    assert capsys.readouterr().out.startswith("False ")
