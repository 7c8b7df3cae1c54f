"""The viewer that comes with the package: what its manifest says of it, and that it is made from its source."""

import hashlib
import json
from pathlib import Path

import pytest

from keepout.flights.pages.replay_page import viewer

SOURCE = Path(__file__).parents[3] / "viewer"
MANIFEST = json.loads(viewer("manifest.json"))


def sha256(text):
    return hashlib.sha256(text.encode()).hexdigest()


@pytest.mark.parametrize("name", ["replay.js", "replay.css", "LICENCES.txt"])
def test_the_bundle_is_the_one_its_manifest_names(name):
    assert sha256(viewer(name)) == MANIFEST["sha256"][name]


def test_the_bundle_ends_no_element_that_it_stands_in():
    assert "</script" not in viewer("replay.js").lower()
    assert "<!--" not in viewer("replay.js")
    assert "</style" not in viewer("replay.css").lower()


def test_the_bundle_is_made_from_the_source_beside_it():
    there = {"build.mjs", "package-lock.json", *(f"src/{path.name}" for path in (SOURCE / "src").iterdir())}
    assert set(MANIFEST["source"]) == there
    for name, digest in MANIFEST["source"].items():
        assert sha256((SOURCE / name).read_text(encoding="utf-8")) == digest, f"{name}: make replay-bundle"


def test_the_libraries_are_those_that_are_locked_and_their_licences_are_there():
    locked = json.loads((SOURCE / "package-lock.json").read_text(encoding="utf-8"))["packages"]
    assert [entry["name"] for entry in MANIFEST["libraries"]] == ["three", "uplot"]
    for entry in MANIFEST["libraries"]:
        assert locked[f"node_modules/{entry['name']}"]["version"] == entry["version"]
        assert entry["licence"] == "MIT"
        for text in (viewer("LICENCES.txt"), viewer("replay.js")):
            assert f"{entry['name']} {entry['version']}" in text
    assert viewer("LICENCES.txt").count("Permission is hereby granted") == 2
    assert viewer("replay.js").count("Permission is hereby granted") == 2
