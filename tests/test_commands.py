"""Commands on flights, as a person calls them: each does its work, says so, and leaves the files that it names."""

import json

import pytest
from truths.command_line import keepout_command

pytestmark = pytest.mark.long

MISSION = """
name = "short"
duration = 20.0
[control]
guidance = "straight"
[guard]
enabled = false
[campaign]
runs = 3
[campaign.dispersions]
"chaser.mass" = {uniform = [18.0, 22.0]}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("commands")
    (folder / "mission.toml").write_text(MISSION)
    return folder


@pytest.fixture(scope="module")
def flown(folder):
    return keepout_command("fly", folder / "mission.toml", "-o", folder / "flight")


@pytest.fixture(scope="module")
def campaign(folder):
    return keepout_command("campaign", "fly", folder / "mission.toml", "-o", folder / "runs", "--keep", "worst:1")


def done(answer, *said):
    """What a command said; it went well, and said nothing on standard error but how far it was."""
    assert answer.code == 0, answer.err
    assert "keepout:" not in answer.err
    for words in said:
        assert words in answer.out
    return answer.out


def test_fly(folder, flown):
    done(flown, "short", "written to")
    assert {path.name for path in (folder / "flight").iterdir()} >= {
        *("short.parquet", "summary.json", "index.html", "replay.html")
    }


def test_replay(folder, flown):
    done(flown)
    page = folder / "again.html"
    out = done(keepout_command("replay", folder / "flight" / "short.parquet", "-o", page, "--title", "Once more"))
    assert out == f"open {page}\n"
    assert "<title>Once more</title>" in page.read_text(encoding="utf-8")


def test_campaign_fly(folder, campaign):
    done(campaign, "Campaign", "no contact", "open ")
    summary = json.loads((folder / "runs" / "summary.json").read_text())
    assert summary["runs"] == 3
    assert len(list((folder / "runs" / "kept").glob("*.parquet"))) == 1


def test_campaign_report(folder, campaign):
    done(campaign)
    page = folder / "runs" / "index.html"
    page.unlink()
    done(keepout_command("campaign", "report", folder / "runs"), "no contact", f"open {page}")
    assert page.exists()


def test_campaign_compare(folder, campaign):
    done(campaign)
    compared = folder / "compared"
    done(keepout_command("campaign", "compare", folder / "runs", folder / "runs", "-o", compared), "open ")
    assert (compared / "index.html").exists()


def test_campaign_replay(folder, campaign):
    done(campaign)
    done(keepout_command("campaign", "replay", folder / "runs", "--run", 1), "run 1: equal to its row in the campaign")
    summary = json.loads((folder / "runs" / "run-1" / "summary.json").read_text())
    assert summary["equal"] is True
    assert summary["differences"] == {}
