import json
import math
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from keepout.errors import ScenarioError
from keepout.mission.entries import Entry
from keepout.mission.epoch import parse_instant
from keepout.mission.scenario import Scenario, reference
from keepout.mission.schema import schema

REPOSITORY = Path(__file__).parents[2]


def test_defaults_are_the_papers_case_1():
    scenario = Scenario()
    assert scenario.start.position == (0.0, 10.0, 6.0)
    assert scenario.goal.position == (0.0, -10.0, -4.0)
    assert (scenario.chaser.mass, scenario.chaser.force_limit, scenario.chaser.speed_limit) == (20.0, 0.1, 0.1)
    assert scenario.control.period == 1.0
    assert scenario.disturbance.kind == "paper"


@pytest.mark.parametrize("path", sorted((REPOSITORY / "examples").glob("*.toml")), ids=lambda path: path.name)
def test_every_example_is_valid(path: Path):
    assert Scenario.load(path).name == path.stem


@pytest.mark.parametrize(
    ("tree", "said"),
    [
        ({"safety": {"margin": -1}}, ("safety.margin", "-1", "greater than or equal to 0")),
        ({"safty": {}}, ("safty", "did you mean safety?")),
        ({"chaser": {"masss": 3}}, ("chaser.masss", "did you mean mass?")),
        ({"chaser": {"zzz": 3}}, ("chaser.zzz", "valid: mass, radius, force_limit, speed_limit")),
        ({"chaser": {"mass": -20}}, ("chaser.mass", "-20", "greater than 0")),
        ({"chaser": {"mass": math.nan}}, ("chaser.mass", "nan", "finite")),
        ({"start": {"position": [0, math.nan, 1]}}, ("start.position", "nan", "finite")),
        ({"start": {"position": [0, 1]}}, ("start.position", "[0, 1]")),
        ({"duration": 0}, ("duration", "0", "greater than 0")),
        ({"duration": 0.5}, ("0.5", "one control period")),
        ({"orbit": {"eccentricity": 1.2}}, ("orbit.eccentricity", "1.2", "less than 1")),
        ({"orbit": {"eccentricity": 0.9}}, ("perigee", "6.4e6")),
        ({"control": {"profile": "papre"}}, ("control.profile", "'papre'", "'default' or 'paper'")),
        ({"control": {"guidance": "straight", "spacing": 0.2}}, ("control", "spacing 0.2", '"geodesic"')),
        ({"control": {"paper": {"sharpness": 2.0}}}, ("control", "paper.sharpness", '"paper"', '"default"')),
        ({"control": {"profile": "paper", "paper": {"k_p": 2.0}}}, ("control.paper.k_p", "slowing_length")),
        ({"control": {"profile": "paper", "paper": {"slowing_length": 0.0}}}, ("slowing_length", "0.0", "greater")),
        ({"disturbance": {"kind": "constant"}}, ("disturbance", "needs force")),
        ({"disturbance": {"kind": "resonant"}}, ("disturbance", "needs amplitude")),
        ({"disturbance": {"kind": "none", "phase": 1.0}}, ("disturbance", "phase 1.0 rad", '"none" has none')),
        ({"disturbance": {"kind": "constant", "force": [0, 0, 0], "phase": 1.0}}, ("phase", '"constant" has none')),
        ({"disturbance": {"phase": 7.0}}, ("disturbance.phase", "7.0", "6.3")),
        ({"attitude": {"angular_velocity": [0, 0, 0.1]}}, ("attitude", "tumbling")),
        ({"campaign": {"lower": [1, 0, 0], "upper": [0, 0, 0]}}, ("campaign", "must not exceed")),
        ({"target": {"units": "cm", "scale": 0.1}}, ("target", "not both")),
        ({"target": 3}, ("target", "3")),
        ({"faults": {"law": "sideways"}}, ("faults.law", "'sideways'", "'into the body'")),
        ({"faults": {"dropped": 1.0}}, ("faults.dropped", "1.0", "less than 1")),
        ({"faults": {"delay": -1}}, ("faults.delay", "-1", "greater than or equal to 0")),
        ({"faults": {"stuck": "x"}}, ("faults.stuck", "'x'", "'+x'")),
        ({"faults": {"stuck_force": 0.1}}, ("faults", "need stuck")),
        ({"faults": {"stuck": "+x", "stuck_force": 0.2}}, ("faults.stuck_force 0.2", "chaser.force_limit")),
        ({"name": "../x"}, ("name", "'../x'")),
        ({"duration": True}, ("duration", "True", "valid number")),
        ({"duration": "5"}, ("duration", "'5'", "valid number")),
        ({"duration": 10**400}, ("duration", "an integer of 1329 bits", "valid number")),
        ({"seed": 16**5000}, ("seed", "an integer of 20001 bits", "less than")),
        ({"chaser": {"mass": "2_0"}}, ("chaser.mass", "'2_0'", "valid number")),
        ({"seed": True}, ("seed", "True", "valid integer")),
        ({"guard": {"enabled": 1}}, ("guard.enabled", "1", "valid boolean")),
        ({"guard": {"enabled": "no"}}, ("guard.enabled", "'no'", "valid boolean")),
        ({"start": {"position": [0, "1", 2]}}, ("start.position.1", "'1'", "valid number")),
        ({"campaign": {"runs": "7"}}, ("campaign.runs", "'7'", "valid integer")),
        (
            {"campaign": {"dispersions": {"chaser.mass": {"uniform": ["18", 22]}}}},
            ("campaign.dispersions.chaser.mass.uniform", "'18'", "valid number"),
        ),
        ({"target": {"parameters": {"length": True}}}, ("target.parameters.length", "True", "valid number")),
        ({"thrusters": {"own": [{"position": [0, 0, 0], "direction": [1, 0, False]}]}}, ("direction.2", "False")),
    ],
)
def test_bad_entries_are_named_with_value_and_range(tree: dict, said: tuple[str, ...]):
    with pytest.raises(ScenarioError) as refusal:
        Scenario.parse(tree)
    text = str(refusal.value)
    assert "\n" not in text
    for part in said:
        assert part in text


def test_no_entry_takes_a_value_of_another_kind():
    """Found in the schema, so that an entry that is new is held to it: no flag is a number, and no text is either."""
    wrong = {"number": (True, "5", b"5"), "integer": (True, "5", 5.0), "boolean": (1, 0.0, "true"), "string": (5, b"x")}
    made = schema()
    tried = 0
    for name, model in {"Scenario": made, **made["$defs"]}.items():
        table = next(one for one in [Scenario, *Entry.__subclasses__()] if one.__name__ == name)
        for key, entry in model["properties"].items():
            for kind in {part.get("type") for part in entry.get("anyOf", [entry])} & wrong.keys():
                for value in wrong[kind]:
                    with pytest.raises(ValidationError) as refusal:
                        table.model_validate({key: value})
                    assert key in {one["loc"][0] for one in refusal.value.errors()}
                    tried += 1
    assert tried > 300


def test_whole_numbers_are_numbers_and_lists_are_vectors():
    made = Scenario.parse({"duration": 20, "start": {"position": [0, 9, 5]}, "chaser": {"mass": np.float64(21.0)}})
    assert (made.duration, made.start.position, made.chaser.mass) == (20.0, (0.0, 9.0, 5.0), 21.0)
    assert isinstance(made.duration, float)


def test_a_scenario_of_python_is_refused_in_one_line():
    with pytest.raises(ScenarioError, match=r"^scenario: chaser\.mass: -1 must be greater than 0$"):
        Scenario(chaser={"mass": -1})  # pyright: ignore[reportArgumentType]
    assert Scenario.parse({"seed": 3}) == Scenario(seed=3)


def test_all_bad_entries_are_named_at_once():
    with pytest.raises(ScenarioError, match=r"chaser\.mass.*orbit\.eccentricity"):
        Scenario.parse({"chaser": {"mass": -1}, "orbit": {"eccentricity": 2}})


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"not = [toml",
        b"\xff\xfe\x00",
        b"duration = 'long'",
        pytest.param(b"duration = " + b"9" * 5000, id="5000 digits"),
        pytest.param(b"seed = 0x" + b"f" * 5000, id="5000 hexadecimal digits"),
        pytest.param(b"duration = " + b"[" * 5000 + b"]" * 5000, id="deep list"),
        pytest.param(b"x = " + b"{a=" * 5000 + b"1" + b"}" * 5000, id="deep table"),
    ],
)
def test_bad_files(tmp_path: Path, content: bytes):
    path = tmp_path / "scenario.toml"
    path.write_bytes(content)
    if content == b"":
        assert Scenario.load(path) == Scenario()
    else:
        with pytest.raises(ScenarioError, match=r"scenario\.toml") as refusal:
            Scenario.load(path)
        assert len(str(refusal.value)) < 600
        assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "instant", ["2262-04-12T00:00:00", "9999-12-31T23:59:59.9", "1677-09-20T00:00:00", "0001-001T00:00:00"]
)
def test_an_instant_that_64_bits_cannot_count_is_refused(instant):
    with pytest.raises(ValueError, match="from 1677-09-22 to 2262-04-11") as refusal:
        parse_instant(instant)
    assert "\n" not in str(refusal.value)


@given(st.datetimes(min_value=datetime(1677, 9, 22), max_value=datetime(2262, 4, 11)))
def test_an_instant_between_is_counted_as_numpy_counts_it(moment):
    counted = np.datetime64(moment, "ns").astype(np.int64)
    assert np.int64(parse_instant(moment.isoformat())) == counted


def test_missing_file_and_folder(tmp_path: Path):
    for path in (tmp_path / "absent.toml", tmp_path):
        with pytest.raises(ScenarioError, match="cannot be read"):
            Scenario.load(path)


def test_file_names_are_relative_to_the_scenario(tmp_path: Path):
    path = tmp_path / "mission.toml"
    path.write_text('[target]\nsource = "models/a.glb"\n[field]\nsource = "a.keepout"\n')
    scenario = Scenario.load(path)
    assert scenario.target.source == str(tmp_path / "models" / "a.glb")
    assert scenario.field.source == str(tmp_path / "a.keepout")


def test_the_reference_in_the_docs_is_this_version():
    assert (REPOSITORY / "docs" / "scenario.md").read_text(encoding="utf-8") == reference()


def test_replace_validates():
    assert Scenario().replace(goal={"position": (1.0, 2.0, 3.0)}).goal.position == (1.0, 2.0, 3.0)
    assert Scenario().replace(goal={"position": (1.0, 2.0, 3.0)}).goal.tolerance == Scenario().goal.tolerance
    with pytest.raises(ScenarioError, match="seed"):
        Scenario().replace(seed=-1)


json_like = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


@given(st.dictionaries(st.sampled_from([*Scenario.model_fields, "other"]), json_like, max_size=4))
def test_any_tree_is_a_scenario_or_a_refusal_in_one_line(tree: dict):
    try:
        scenario = Scenario.parse(tree)
    except ScenarioError as refusal:
        said = str(refusal)
    else:
        assert Scenario.parse(json.loads(scenario.model_dump_json())) == scenario
        said = ""
    assert "\n" not in said
