import json
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from keepout.errors import ScenarioError
from keepout.mission.scenario import Scenario, reference

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
    ],
)
def test_bad_entries_are_named_with_value_and_range(tree: dict, said: tuple[str, ...]):
    with pytest.raises(ScenarioError) as refusal:
        Scenario.parse(tree)
    text = str(refusal.value)
    assert "\n" not in text
    for part in said:
        assert part in text


def test_all_bad_entries_are_named_at_once():
    with pytest.raises(ScenarioError, match=r"chaser\.mass.*orbit\.eccentricity"):
        Scenario.parse({"chaser": {"mass": -1}, "orbit": {"eccentricity": 2}})


@pytest.mark.parametrize("content", [b"", b"not = [toml", b"\xff\xfe\x00", b"duration = 'long'"])
def test_bad_files(tmp_path: Path, content: bytes):
    path = tmp_path / "scenario.toml"
    path.write_bytes(content)
    if content == b"":
        assert Scenario.load(path) == Scenario()
    else:
        with pytest.raises(ScenarioError, match=r"scenario\.toml"):
            Scenario.load(path)


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
