"""Pages of campaigns whose numbers a test wrote: links, escapes, commands, tables."""

import csv
import html
import json
import re
import shlex

import numpy as np
import pytest
from truths.campaigns import drawn, flown, scenario, write_campaign

from keepout.core.errors import ScenarioError
from keepout.flights.pages.campaign_page import PLACE, compare_campaigns, replay_command, report_campaign

pytestmark = pytest.mark.as_used

FIGURES = ("distributions", "bands", "influences")
TABLES = ("rates", "quantiles", "distributions", "bands", "influences", "scatter", "worst", "refused")


def links(page):
    return re.findall(r'(?:href|src)="([^"]+)"', page.read_text(encoding="utf-8"))


def check_links(page):
    found = [link.partition("#")[0] for link in links(page) if not link.startswith("data:")]
    assert found
    for link in found:
        assert (page.parent / link).is_file(), link


def campaign(folder, runs=200, *, sampling="random", done=None, **columns):
    generator = np.random.default_rng(1)
    made = drawn(runs) | flown(runs, **({"minimum_clearance": generator.random(runs)} | columns))
    return write_campaign(folder, scenario(runs, sampling=sampling), made, chunk=64, done=done)


@pytest.mark.long
def test_page_figures_and_tables_stand(tmp_path):
    folder = campaign(tmp_path / "out", delta_v=np.arange(200.0))
    answer = report_campaign(folder)
    assert answer["page"] == str(folder / "index.html")
    check_links(folder / "index.html")
    for name in FIGURES:
        assert (folder / PLACE / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert "<svg" in (folder / PLACE / f"{name}.svg").read_text(encoding="utf-8")
    for name in TABLES:
        assert (folder / PLACE / f"{name}.csv").is_file()
    with open(folder / PLACE / "rates.csv", encoding="utf-8") as stream:
        rows = {row["what"]: row for row in csv.DictReader(stream)}
    assert float(rows["contact"]["high"]) == pytest.approx(1.0 - 0.025 ** (1.0 / 200))
    assert "No contact in 200 flights" in (folder / "index.html").read_text(encoding="utf-8")
    json.dumps(answer, allow_nan=False)


@pytest.mark.long
def test_what_a_file_says_is_text_on_the_page(tmp_path):
    evil = '<script>alert("x")</script>'
    status = np.where(np.arange(200) < 3, "refused", "flown")
    reason = np.where(np.arange(200) < 3, evil, "")
    folder = campaign(tmp_path / "out", status=status, reason=reason, remarks=evil)
    report_campaign(folder)
    page = (folder / "index.html").read_text(encoding="utf-8")
    assert "<script" not in page
    assert page.count("&lt;script&gt;") >= 2


@pytest.mark.long
def test_the_command_flies_the_run_of_that_folder(tmp_path):
    folder = campaign(tmp_path / "a b'c <d>")
    worst = report_campaign(folder)["worst_runs"]
    words = shlex.split(replay_command(folder, worst[0]))
    assert words == ["keepout", "campaign", "replay", str(folder.absolute()), "--run", str(worst[0])]
    page = (folder / "index.html").read_text(encoding="utf-8")
    commands = re.findall(r'<code class="line">(.*?)</code>', page)
    assert [html.unescape(command) for command in commands] == [replay_command(folder, run) for run in worst]
    # A command in a cell would wrap, and make its row as tall as itself.
    [table] = [part for part in re.findall(r"<div class=wide>(.*?)</div>", page) if "least clearance, m" in part]
    assert "<code" not in table
    assert re.findall(r"<tr><td>(\d+)</td>", table) == [str(run) for run in worst]


def test_two_campaigns_compared(tmp_path):
    first = campaign(tmp_path / "a", delta_v=np.arange(200.0))
    second = campaign(tmp_path / "b", delta_v=np.arange(200.0) + 1.0)
    out = tmp_path / "compared"
    answer = compare_campaigns(first, second, out)
    json.dumps(answer, allow_nan=False)
    assert answer["paired"] == 200
    [row] = [row for row in answer["by_run"] if row["figure"].startswith("Δv")]
    assert row["mean A - B"] == -1.0
    check_links(out / "index.html")
    with pytest.raises(ScenarioError, match="holds a campaign"):
        compare_campaigns(first, second, first)
