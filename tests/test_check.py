"""Scenarios written by `keepout scenario new`, and what `keepout scenario check` says of them."""

import math
import re
import tomllib

import numpy as np
import pytest
import trimesh
from truths.command_line import keepout_command

from keepout.core.errors import ScenarioError
from keepout.core.geometry.target import Target
from keepout.core.guard.field import guard_field
from keepout.core.mission.approach import require_approach
from keepout.core.mission.build import prepare
from keepout.core.mission.entries import Entry
from keepout.core.mission.scenario import Scenario, with_entries
from keepout.core.mission.surroundings import Surroundings
from keepout.verbs.check import check, number_refusal
from keepout.verbs.draft import commented, draft


def entries(model=Scenario, before=""):
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Entry):
            yield from entries(field.annotation, f"{before}{name}.")
        else:
            yield f"{before}{name}"


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


@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["box", *(pytest.param(n, marks=pytest.mark.slow) for n in ("pocket", "sphere")), "intelsat30"]
)
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


def test_a_mesh_file_is_drafted_in_its_units(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    trimesh.creation.box(extents=(300.0, 200.0, 150.0)).export("satellite.stl")
    made = draft("satellite.stl", units="cm")
    assert made.extents == pytest.approx([3.0, 2.0, 1.5])
    assert Scenario.parse(tomllib.loads(made.text)) == made.scenario
    assert made.scenario.field.source.endswith(".keepout")  # of which the next steps tell how to make it
    assert number_refusal(made.scenario, Target.load("satellite.stl", units="cm")) is None


@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["box", *(pytest.param(n, marks=pytest.mark.slow) for n in ("intelsat30", "tiangong"))]
)
def test_a_drafted_approach_stands_in_no_zone_and_ends_before_the_port(name, tmp_path):
    path = tmp_path / "approach.toml"
    answer = keepout_command("scenario", "new", "--for", name, "--approach", "-o", path)
    assert answer.code == 0
    scenario, target = Scenario.load(path), Target.load(name)
    require_approach(Surroundings(scenario, target))
    [corridor], [sphere] = scenario.corridor, scenario.zone
    port, centre = np.array(corridor.port), np.array(sphere.centre)
    assert target.distance.distance(port[None])[0] < 0.01
    places = np.array([leg.position for leg in scenario.leg])
    assert np.linalg.norm(places[0] - centre) > sphere.radius + scenario.chaser.radius + 1.0
    away = np.linalg.norm(places - port, axis=1)
    assert np.all(np.diff(away) < 0.0)
    np.testing.assert_allclose((places - port) @ np.array(corridor.axis), away, atol=0.02)
    assert target.distance.distance(places).min() > scenario.chaser.radius + scenario.safety.margin + 1.0
    assert scenario.goal.position == scenario.leg[-1].position
    refused = keepout_command("scenario", "new", "--approach", "-o", tmp_path / "other.toml")
    assert "--for" in refused.err


def test_the_command_writes_what_is_not_there_and_replaces_nothing_unasked(tmp_path):
    path = tmp_path / "mission.toml"
    path.write_text("mine", encoding="utf-8")
    answer = keepout_command("scenario", "new", "-o", path)
    assert answer.code == 1
    assert "is there already; --force replaces it" in answer.err
    assert path.read_text(encoding="utf-8") == "mine"
    answer = keepout_command("scenario", "new", "-o", path, "--force")
    assert "next: keepout scenario check" in answer.out
    assert Scenario.load(path) == Scenario(name="mission")


@pytest.fixture(scope="module")
def target():
    return Target.load("box")


@pytest.fixture(scope="module")
def model():
    return guard_field(Target.load("box"), 0.5)


def straight(**entries) -> Scenario:
    around = {"target": {"source": "box"}, "field": {"source": "grid"}, "control": {"guidance": "straight"}}
    return Scenario.parse(around | {"duration": 400.0} | entries)


@pytest.mark.long
def test_what_would_be_flown(target, model):
    scenario = straight()
    found = check(scenario, target=target, model=model)
    assert found.flies
    mission = prepare(scenario, target=target, model=model)
    assert found.conditions == mission.setup.controller.conditions
    assert found.start_certified is mission.start_certified is True
    # The disturbance by quadrature of its closed form, m/s; the speeds by what the guidance may reach.
    t = np.arange(400.0)
    push = np.sqrt(1.0 + np.sin(0.01 * t) ** 2) * 0.01 / 20.0
    expected = found.summary()["expected"]
    assert expected["disturbance_delta_v_mps"] == pytest.approx(push.sum(), rel=1e-9)
    assert expected["speed_delta_v_mps"] == pytest.approx(0.2, rel=1e-3)


@pytest.mark.long
@pytest.mark.parametrize(
    ("entries", "entry"),
    [
        ({"chaser": {"speed_limit": 0.5}}, "chaser.speed_limit"),
        ({"chaser": {"force_limit": 0.01}}, "chaser.force_limit"),
        ({"attitude": {"kind": "tumbling", "angular_velocity": (0.0, 0.0, 0.02)}}, "chaser.force_limit"),
    ],
)
def test_the_nearest_number_is_not_refused_and_nearly_nothing_beyond_is(entries, entry, target, model):
    scenario = straight(**entries)
    found = check(scenario, target=target, model=model)
    assert not found.flies
    [refusal] = found.refusals
    assert str(number_refusal(scenario, target)) == refusal.said
    near = {nearest.entry: nearest.value for nearest in refusal.nearest}
    table, key = entry.split(".")
    value, was = float(near[entry]), getattr(getattr(scenario, table), key)  # pyright: ignore[reportArgumentType]
    assert number_refusal(with_entries(scenario, {entry: value}), target) is None
    beyond = value + 0.02 * (was - value) if abs(was - value) < abs(value) else value * (1.02 if was > value else 0.98)
    assert number_refusal(with_entries(scenario, {entry: beyond}), target) is not None


@pytest.mark.long
@pytest.mark.parametrize(("name", "place"), [("start", (0.0, 1.8, 0.0)), ("goal", (0.0, 0.5, 0.0))])
def test_the_nearest_place_is_flown_from(name, place, target, model):
    scenario = straight(**{name: {"position": place}})
    found = check(scenario, target=target, model=model)
    [refusal] = found.refusals
    [near] = refusal.nearest
    assert near.entry == f"{name}.position"
    mended = scenario.replace(**{name: {"position": near.value}})
    prepare(mended, target=target, model=model)
    assert isinstance(near.value, tuple)
    assert math.dist(near.value, place) < 4.0
    assert target.distance.distance(np.array([near.value]))[0] > 0.6


@pytest.mark.long
def test_several_refusals_are_told_at_once(target, model):
    inside = {"position": (0.0, 1.8, 0.0)}
    found = check(straight(chaser={"speed_limit": 0.5}, start=inside, goal=inside), target=target, model=model)
    entries = ("chaser.speed_limit", "start.position", "goal.position")
    assert len(found.refusals) == 3
    for entry, refusal in zip(entries, found.refusals):
        assert entry.removeprefix("chaser.") in refusal.said
        assert entry in [near.entry for near in refusal.nearest]


@pytest.mark.long
def test_what_a_campaign_varies_is_looked_at(target, model):
    entries = {"chaser.mass": {"uniform": [-1.0, 22.0]}, "attitude.kind": {"choice": ["vvlh", "star"]}}
    varied = straight(campaign={"dispersions": entries}, inspect={"stand_off": 2.0})
    found = check(varied, target=target, model=model)
    assert found.flies
    assert found.remarks[0].startswith("[inspect] is flown by `keepout inspect`; what stands here is of a flight")
    assert "A campaign of 100 flights varies attitude.kind, chaser.mass (random)." in found.words
    assert [remark.split(" are refused")[0] for remark in found.remarks if "campaign" in remark] == [
        "runs of the campaign with attitude.kind = star",
        "runs of the campaign with chaser.mass = -1.0",
    ]
    wrong = straight(campaign={"dispersions": {"chaser.mas": entries["chaser.mass"]}})
    refused = check(wrong, target=target, model=model)
    assert not refused.flies
    assert "chaser.mas: no such entry" in refused.refusals[0].said


@pytest.mark.long
def test_the_command_says_it_and_fails(tmp_path):
    path = tmp_path / "fast.toml"
    path.write_text("[chaser]\nspeed_limit = 0.5\n", encoding="utf-8")
    answer = keepout_command("scenario", "check", path)
    assert answer.code == 1
    assert "chaser.speed_limit at most 0.1" in answer.out
    assert list(tmp_path.iterdir()) == [path]
