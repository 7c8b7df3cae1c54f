"""Scenarios written by `keepout scenario new`: every entry explained, valid, free, and flown."""

import re
import tomllib

import numpy as np
import pytest
import trimesh
from truths.command_line import keepout_command

from keepout.errors import MeshError, ScenarioError
from keepout.geometry.target import Target
from keepout.guard.field import guard_field
from keepout.mission.commented import commented
from keepout.mission.draft import draft
from keepout.mission.entries import Entry
from keepout.mission.nearest import number_refusal
from keepout.mission.scenario import Scenario


def entries(model=Scenario, before=""):
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Entry):
            yield from entries(field.annotation, f"{before}{name}.")
        else:
            yield f"{before}{name}"


def test_without_a_target_it_is_the_built_in_mission(tmp_path):
    path = tmp_path / "first.toml"
    answer = keepout_command("scenario", "new", "-o", path)
    assert answer.code == 0, answer.err
    assert Scenario.load(path) == Scenario(name="first")
    assert "next: keepout scenario check" in answer.out


def test_every_entry_is_there_and_what_is_commented_out_is_valid():
    lines = draft().text.split("\n")
    table, named, tried, live = "", set(), 0, 0
    for place, line in enumerate(lines):
        header = re.fullmatch(r"\[(.*)\]", line)
        if header:
            table = f"{header[1]}."
        told = re.match(r"(# )?([a-z0-9_]+)(\.\S+)? = ", line)
        if not told:
            continue
        named.add(f"{table}{told[2]}")
        if told[1] is None:
            live += 1
        else:
            trial = [*lines[:place], line[2:], *lines[place + 1 :]]
            tree = tomllib.loads("\n".join(trial))
            if told[2] == "parameters":  # of a built-in; which it has is the built-in's own matter
                continue
            Scenario.parse(tree)
            tried += 1
    assert named == set(entries())
    assert tried + live + 1 == len(named)
    assert tried > 50
    assert max(len(line) for line in lines) <= 130


def test_words_of_all_kinds_survive_the_file():
    odd = 'a "b" \\ c\té\x7f.glb'
    assert tomllib.loads(commented({"target.source": odd}))["target"]["source"] == odd
    with pytest.raises(ScenarioError, match=r"chaser\.mass"):
        commented({"chaser.mass": -1.0})


@pytest.mark.parametrize("name", ["box", "pocket", "sphere", "intelsat30"])
def test_a_draft_is_free_and_honoured(name):
    made = draft(name)
    target = Target.load(name)
    places = np.array([made.scenario.start.position, made.scenario.goal.position])
    # Outside the bounding box by more than chaser, margin and 3 m: by closed form, with no distance of the package.
    outside = np.maximum(target.vertices.min(axis=0) - places, places - target.vertices.max(axis=0)).max(axis=1)
    assert (outside > 0.6 + 2.9).all()
    assert made.extents == pytest.approx(np.ptp(target.vertices, axis=0))
    assert number_refusal(made.scenario, target) is None
    assert made.honoured_speed is not None
    faster = made.scenario.replace(chaser={"speed_limit": 1.02 * made.honoured_speed})
    assert number_refusal(faster, target) is not None
    assert made.scenario.duration * made.scenario.chaser.speed_limit > np.linalg.norm(places[0] - places[1])


@pytest.mark.long
@pytest.mark.parametrize("kind", [pytest.param("box", marks=pytest.mark.slow), "mesh"])
def test_what_is_written_is_checked_and_flown(tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    source, options = "box", []
    if kind == "mesh":
        (tmp_path / "meshes").mkdir()
        trimesh.creation.box(extents=(300.0, 200.0, 150.0)).export("meshes/satellite.stl")
        source, options = "meshes/satellite.stl", ["--units", "cm"]
    answer = keepout_command("scenario", "new", "--for", source, *options, "-o", "mission.toml", "--json").json
    learn, *_ = steps = [step.split()[1:] for step in answer["next"]]
    assert [step[0] for step in steps] == ["fit", "scenario", "fly"]
    assert "--certify" in learn  # so that it can be flown by what these lines make
    scenario = Scenario.load("mission.toml")
    # Its field, instead of one that takes minutes to learn: the grid of exact distances, certified for this chaser.
    entry = scenario.target
    target = Target.load(entry.source, units=entry.units)
    assert answer["extents_m"] == pytest.approx([4.0, 3.0, 2.0] if kind == "box" else [3.0, 2.0, 1.5])
    guard_field(target, scenario.chaser.radius).save(scenario.field.source)
    checked = keepout_command("scenario", "check", "mission.toml", "--json").json
    assert checked["flies"] is True
    assert checked["start_certified"] is True
    assert 0.0 < checked["expected"]["duration_s"] < scenario.duration
    flown = keepout_command("fly", "mission.toml", "-o", "out", "--no-figures", "--json").json
    assert flown["reached"] is True
    assert flown["contact"] is False
    # The estimates are of this flight.
    assert flown["delta_v_mps"] == pytest.approx(checked["expected"]["delta_v_mps"], rel=0.25)
    assert flown["time_to_reach_s"] == pytest.approx(checked["expected"]["duration_s"], rel=0.25)


def test_a_file_that_is_there_is_not_replaced(tmp_path):
    path = tmp_path / "mission.toml"
    path.write_text("mine", encoding="utf-8")
    answer = keepout_command("scenario", "new", "-o", path)
    assert answer.code == 1
    assert "is there already; --force replaces it" in answer.err
    assert path.read_text(encoding="utf-8") == "mine"
    assert keepout_command("scenario", "new", "-o", path, "--force").code == 0
    assert Scenario.load(path).name == "mission"


@pytest.mark.parametrize(
    ("arguments", "said", "code"),
    [
        (("-o", "mission.json"), "ends in .toml", 2),
        (("-o", "absent/mission.toml"), "the folder absent does not exist", 1),
        (("--profile", "papre"), "'papre'; it must be 'default' or 'paper'", 2),
        (("--units", "cm"), "--units: only with --for", 2),
        (("--for", "absent.glb"), "absent.glb: no such file", 1),
        (("--for", "box", "--units", "cm"), "a built-in is in metres", 1),
    ],
)
def test_what_cannot_be_written_is_refused(tmp_path, monkeypatch, arguments, said, code):
    monkeypatch.chdir(tmp_path)
    answer = keepout_command("scenario", "new", *arguments)
    assert answer.code == code
    assert said in answer.err
    assert answer.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_target_that_nothing_can_be_flown_around_is_refused():
    with pytest.raises(MeshError, match="no such file"):
        draft("absent.glb")


def test_the_schema_is_written(tmp_path):
    path = tmp_path / "schema.json"
    assert keepout_command("scenario", "schema", "-o", path).code == 0
    assert path.read_text(encoding="utf-8") == keepout_command("scenario", "schema").out
    refused = keepout_command("scenario", "schema", "-o", tmp_path / "schema.json" / "x.json")
    assert refused.code == 1
    assert "cannot be written" in refused.err
