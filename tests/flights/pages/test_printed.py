"""The printed report of a folder: four sheets that say what the flight file and the tables say."""

import json
import re
import zlib

import numpy as np
import pytest
from truths.campaigns import drawn, flown, scenario, write_campaign
from truths.passing import box_scenario, pass_record

from keepout.core.errors import KeepoutError, ScenarioError
from keepout.flights.pages.printed import print_report

pytestmark = pytest.mark.long
SHEETS = ("Mission and assumptions", "What is proved", "What was", "Requirements")  # ligatures have no letters


def read(path):
    """How many sheets a PDF has, and the lines of text on them, with what is not ASCII left out."""
    content = path.read_bytes()
    streams = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", content, re.DOTALL)
    drawn = b"\n".join(zlib.decompressobj().decompress(stream) for stream in streams if stream.startswith(b"x"))
    lines = re.findall(rb"BT\n(.*?)\nET", drawn, re.DOTALL)
    text = ["".join(part.decode("latin-1") for part in re.findall(rb"\(((?:\\.|[^()\\])*)\)", line)) for line in lines]
    return len(re.findall(rb"/Type /Page\b", content)), "\n".join(text)


def test_a_flight_on_four_sheets(tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    of = box_scenario(tmp_path, 3.0, "passing", chaser={"radius": 0.5, "mass": 31.25})
    pass_record(of, 3.0).save(tmp_path / "passing.parquet")
    summary = {
        **{"flight": "elsewhere/passing.parquet", "reached": True, "start_certified": False, "delta_v_mps": 0.125},
        # Worked out anew from the flight file, whatever this says.
        **{"contact_verdict": "yes", "minimum_clearance_m": -1.0, "guard": {"range_limit_m": 46.5}},
    }
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    path = print_report(tmp_path)
    first = path.read_bytes()
    sheets, text = read(path)
    assert (path, sheets) == (tmp_path / "report.pdf", 4)
    for words in (*SHEETS, "No contact, proved: the clearance is at least 1.49", "31.25 kg", "chaser.mass", "0.125"):
        assert words in text
    assert "does not hold: the start" in text
    assert "46.5" in text
    assert "1970-01-02 00:00 UTC" in text
    print_report(tmp_path)
    assert path.read_bytes() == first


def test_a_campaign_on_four_sheets(tmp_path):
    made = drawn(200) | flown(200, minimum_clearance=np.random.default_rng(1).random(200))
    folder = write_campaign(tmp_path / "out", scenario(200), made, chunk=64)
    sheets, text = read(print_report(folder, tmp_path / "many.pdf"))
    assert sheets == 4
    for words in (*SHEETS, "No contact, proved, in each of 200", "0 of 200", "campaign.runs"):
        assert words in text


def test_another_folder_is_refused(tmp_path):
    for content in (None, "[]", '{"flight": "gone.parquet"}', "no JSON"):
        if content is not None:
            (tmp_path / "summary.json").write_text(content)
        with pytest.raises(KeepoutError if content and "gone" in content else ScenarioError, match=str(tmp_path)):
            print_report(tmp_path)
    assert not (tmp_path / "report.pdf").exists()
