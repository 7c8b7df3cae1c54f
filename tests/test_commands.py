"""Every command as a program calls it: in a process of its own, its `--json` read as strict JSON from standard output.

What a library writes past Python, to the file descriptor, is seen here and nowhere else.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from keepout.cli.options import ORDER

pytestmark = pytest.mark.long

FLIGHT = """
name = "short"
duration = 20.0
[target]
source = "box"
[field]
source = "grid"
[chaser]
radius = 0.4
[start]
position = [0.0, 5.0, 2.0]
[goal]
position = [0.0, -5.0, 2.0]
[control]
guidance = "straight"
[guard]
enabled = false
[faults]
position_noise_std = 0.05
[campaign]
runs = 3
[campaign.dispersions]
"chaser.mass" = {uniform = [18.0, 22.0]}
"""
EXPLORE = """
name = "unknown"
duration = 60.0
[target]
source = "box"
[explore]
towards = "goal"
most_views = 4
[map]
radius = 6.0
spacing = 0.2
[depth_sensor]
width = 40
height = 30
period = 10.0
[chaser]
radius = 0.4
[start]
position = [0.0, 8.0, 2.0]
[goal]
position = [0.0, 4.0, 2.0]
"""
INSPECT = """
name = "look"
duration = 60.0
[target]
source = "box"
[field]
source = "grid"
[chaser]
radius = 0.4
[disturbance]
kind = "none"
[camera]
greatest_range = 6.0
[start]
position = [0.0, 5.0, 2.0]
[inspect]
stand_off = 1.2
patch_size = 1.0
coverage = 0.5
candidates = 100
proof_time = 0.5
"""
ROUGH = """
from dataclasses import replace
from keepout.learning import profile
few = {"samples": 4000, "batch": 400, "steps": 200, "tuning_steps": 50}
profile.PROFILES["quick"] = replace(profile.PROFILES["quick"], **few)
from keepout.cli import main
main()
"""
"""A fit of seconds: the command is the one of every fit."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("commands")
    for name, text in (("mission", FLIGHT), ("explore", EXPLORE), ("inspect", INSPECT)):
        (folder / f"{name}.toml").write_text(text)
    return folder


def never(word: str) -> Any:
    raise AssertionError(f"{word} is no JSON")


def answer(folder, *arguments: str, program: str = "from keepout.cli import main; main()") -> Any:
    """What a command says on standard output: one JSON object, and the command went well."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    said = json.loads(done.stdout, parse_constant=never)
    assert isinstance(said, dict | list)
    return said


@pytest.fixture(scope="module")
def flown(folder):
    return answer(folder, "fly", "mission.toml", "-o", "flight", "--json")


@pytest.fixture(scope="module")
def campaign(folder):
    return answer(folder, "campaign", "mission.toml", "-o", "runs", "--keep", "worst:1", "--json")


@pytest.fixture(scope="module")
def fitted(folder):
    arguments = ("fit", "box", "-o", "box.keepout", "--profile", "quick", "--json")
    return answer(folder, *arguments, program=ROUGH)


def test_every_command_is_here():
    text = Path(__file__).read_text(encoding="utf-8")
    assert len(ORDER) == 15
    for command in ORDER:
        assert f'"{command}", ' in text


def test_targets(folder):
    assert {row["name"] for row in answer(folder, "targets", "--json")["targets"]} >= {"box", "intelsat30"}


def test_describe(folder):
    assert answer(folder, "describe", "box", "-o", "mesh", "--json")["triangles"] == 12
    assert (folder / "mesh" / "box.png").exists()


def test_scenario(folder):
    assert answer(folder, "scenario", "new", "--for", "box", "-o", "new.toml", "--json")["scenario"] == "new.toml"
    assert answer(folder, "scenario", "check", "mission.toml", "--json")["flies"] is True
    assert answer(folder, "scenario", "schema")["title"] == "Keepout scenario"


def test_fit(folder, fitted):
    assert fitted["field"] == "box.keepout"
    assert sorted(path.name for path in folder.glob("box*")) == ["box.keepout"]


def test_certify(folder, fitted):
    said = answer(folder, "certify", fitted["field"], "--chaser-radius", "0.4", "--json")
    assert said["error_bound_m"] >= said["sampled_maximum_m"]


def test_measure(folder, fitted):
    assert answer(folder, "measure", fitted["field"], "--json")["field"] == "box.keepout"


def test_fly(folder, flown):
    assert {path.name for path in (folder / "flight").iterdir()} >= {
        *("short.parquet", "summary.json", "index.html", "replay.html")
    }
    assert json.loads((folder / "flight" / "summary.json").read_text()) == flown


def test_replay(folder, flown):
    said = answer(folder, "replay", flown["flight"], "-o", "again.html", "--title", "Once more", "--json")
    assert said["replay"] == "again.html"
    assert "<title>Once more</title>" in (folder / "again.html").read_text(encoding="utf-8")


def test_export_and_audit(folder, flown):
    for craft in ("chaser", "target"):
        said = answer(folder, "export", flown["flight"], "--to", "oem", "--of", craft, "-o", f"{craft}.oem", "--json")
        assert said["file"] == f"{craft}.oem"
    files = ("--chaser", "chaser.oem", "--target-orbit", "target.oem", "--chaser-radius", "0.4")
    said = answer(folder, "audit", "--target", "box", *files, "--acceleration-bound", "0.02", "--json")
    assert said["contact"] == flown["contact_verdict"] == "no"


def test_campaign_fly(folder, campaign):
    assert json.loads((folder / "runs" / "summary.json").read_text()) == campaign
    assert campaign["runs"] == 3
    assert len(list((folder / "runs" / "kept").glob("*.parquet"))) == 1


def test_campaign_report(folder, campaign):
    page = folder / "runs" / "index.html"
    page.unlink()
    assert answer(folder, "campaign", "report", "runs", "--json")["rates"] == campaign["rates"]
    assert page.exists()


def test_campaign_compare(folder, campaign):
    assert answer(folder, "campaign", "compare", "runs", "runs", "-o", "compared", "--json")["paired"]
    assert (folder / "compared" / "index.html").exists()


def test_campaign_replay(folder, campaign):
    said = answer(folder, "campaign", "replay", "runs", "--run", "1", "--no-figures", "--json")
    assert (said["equal"], said["differences"]) == (True, {})


def test_rare(folder):
    said = answer(
        folder, "rare", "mission.toml", "--below", "3", "--runs", "2", "--flights", "64", "-o", "rare", "--json"
    )
    assert said["grade"] == "measured"


def test_explore(folder):
    said = answer(folder, "explore", "explore.toml", "-o", "explored", "--no-figures", "--json")
    assert json.loads((folder / "explored" / "summary.json").read_text()) == said


def test_inspect(folder):
    said = answer(folder, "inspect", "inspect.toml", "-o", "inspected", "--no-figures", "--json")
    assert json.loads((folder / "inspected" / "summary.json").read_text()) == said


def test_reproduce(folder):
    assert answer(folder, "reproduce", "volumes", "--quick", "-o", "paper", "--json")
    assert (folder / "paper" / "index.html").exists()
