"""The README's Python, run as it stands but for the time it takes, and its scenario."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

import keepout
from keepout.mission.scenario import Scenario

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    [found] = re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)
    return found


@pytest.mark.long
def test_the_ten_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.chdir(tmp_path)
    trimesh.creation.box(extents=(4.0, 3.0, 2.0)).export("satellite.glb")
    code = block("python")
    for printed, quick in (("seed=0)", 'seed=0, profile="quick")'), ("duration=1200.0", "duration=500.0")):
        assert code.count(printed) == 1
        code = code.replace(printed, quick)
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


def test_the_scenario(tmp_path: Path):
    path = tmp_path / "mission.toml"
    path.write_text(block("toml"), encoding="utf-8")
    scenario = Scenario.load(path)
    assert scenario.goal.position == (0.0, -10.0, -4.0)
