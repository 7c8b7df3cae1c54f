"""The entries of scenarios: what is valid, and what is refused in which words, in Python, in files, by the schema."""

import json
import math
import tomllib
from datetime import datetime
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from keepout.core.errors import ScenarioError
from keepout.core.mission.entries import Entry
from keepout.core.mission.epoch import parse_instant
from keepout.core.mission.scenario import Scenario, schema

REPOSITORY = Path(__file__).parents[3]
SCHEMA = json.loads(json.dumps(schema()))


def judge(about=SCHEMA):
    return jsonschema.Draft202012Validator(about)


def test_defaults_are_valid_by_the_schema():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    judge().validate(json.loads(Scenario().model_dump_json(exclude_none=True)))


@pytest.mark.parametrize("path", sorted((REPOSITORY / "examples").glob("*.toml")), ids=lambda path: path.name)
def test_every_example_is_valid(path):
    assert Scenario.load(path).name == path.stem
    judge().validate(tomllib.loads(path.read_text(encoding="utf-8")))


def wrong_values(entry):
    """Values of another kind, and beyond the bounds, of what the schema says of an entry."""
    kinds = {"number": (True, "5"), "integer": (True, "5"), "boolean": (1, 0.0, "true"), "string": (5, False)}
    parts = entry.get("anyOf", [entry])
    numbers = any(part.get("type") == "number" for part in parts)
    for part in parts:
        # A time or a word: a number is no word, and right all the same.
        yield from (value for value in kinds.get(part.get("type"), ()) if not (numbers and value in (5, 0.0)))
        whole = part.get("type") == "integer"
        for name, value in part.items():
            if name in ("exclusiveMinimum", "exclusiveMaximum"):
                yield value
            elif name in ("minimum", "maximum"):
                away = -math.inf if name == "minimum" else math.inf
                yield value + round(math.copysign(1.0, away)) if whole else math.nextafter(value, away)


def test_no_entry_takes_a_value_of_another_kind_or_beyond_its_bounds_nor_does_the_schema():
    """Found in the schema, so that an entry that is new is held to it: no flag is a number, and no text is either."""
    tables, tried = {one.__name__: one for one in [Scenario, *Entry.__subclasses__()]}, 0
    for name, about in {"Scenario": SCHEMA, **SCHEMA["$defs"]}.items():
        judged = judge({**about, "$defs": SCHEMA["$defs"]})
        assert not judged.is_valid({"nonsense": 1})
        assert about.get("description")  # what a table is for stands with the table
        for key, entry in about["properties"].items():
            assert entry.get("description") or "$ref" in entry
            numbers = {"number", "integer"} & {part.get("type") for part in entry.get("anyOf", [entry])}
            not_json = (b"5", math.nan, math.inf, -math.inf, *([5.5] if "integer" in numbers else [])) * bool(numbers)
            for value in (*wrong_values(entry), *not_json):
                with pytest.raises(ValidationError) as refusal:
                    tables[name].model_validate({key: value})
                assert key in {one["loc"][0] for one in refusal.value.errors()}
                assert value in not_json or not judged.is_valid({key: value})
                tried += 1
    assert tried > 500


UP = {"position": [0, 0, 0], "direction": [0, 0, 1], "force": 0.2}


@pytest.mark.parametrize(
    ("tree", "said"),
    [
        ({"chaser": {"zzz": 3}}, ("chaser.zzz", "valid: mass, radius, force_limit, speed_limit")),
        ({"start": {"position": [0, "1", 2]}}, ("start.position.1", "'1'", "must be a number")),
        ({"start": {"position": [0, 1]}}, ("start.position: [0, 1] has too few values",)),
        (
            {"start": {"position": 3, "velocity": [0] * 4}},
            ("position: 3 must be a list; ", "at most 3"),
        ),
        ({"guard": {"enabled": 1, "delay": 0.5}}, ("1 must be true or false; ", "0.5 must be a whole number")),
        (
            {"campaign": {"dispersions": {"seed": {"uniform": ["a", 2]}}}},
            ("0: 'a' must be a number or must be a list",),
        ),
        (
            {"thrusters": {"own": [{"position": [0, 0, 0]}]}, "goal": 3},
            ("0.direction: must be given", "be a table"),
        ),
        ({"orbit": {"eccentricity": 0.9}}, ("perigee", "6.4e6")),
        ({"epoch": "{x}"}, ("epoch: '{x}' must be an instant",)),
        ({"control": {"paper": {"sharpness": 2.0}}}, ("control", "paper.sharpness", '"paper"', '"default"')),
        ({"control": {"profile": "paper", "paper": {"k_p": 2.0}}}, ("control.paper.k_p", "slowing_length")),
        ({"disturbance": {"kind": "none", "phase": 1.0}}, ("disturbance", "phase 1.0 rad", '"none" has none')),
        ({"attitude": {"gravity_gradient": True}}, ('gravity_gradient needs kind = "tumbling"',)),
        ({"campaign": {"lower": [1, 0, 0], "upper": [0, 0, 0]}}, ("campaign", "must not exceed")),
        ({"target": {"units": "cm", "scale": 0.1}}, ("target", "not both")),
        ({"target": {"parameters": {"length": True}}}, ("target.parameters.length", "True", "must be a number")),
        ({"faults": {"stuck_force": 0.1}}, ("faults", "need stuck")),
        ({"faults": {"stuck": "+x", "stuck_force": 0.2}}, ("faults.stuck_force 0.2", "chaser.force_limit")),
        ({"faults": {"stuck": "+x"}, "thrusters": {"layout": "six"}}, ("faults.stuck is for", "faults.thruster")),
        ({"name": "../x"}, ("name", "'../x'")),
        ({"duration": 10**400}, ("duration", "an integer of 1329 bits", "must be a number")),
        ({"thrusters": {"layout": "six", "least_on_time": 2.0}}, ("least_on_time 2.0 s", "period, 1.0 s")),
        ({"thrusters": {"layout": "own", "own": [UP | {"direction": [0, 0, 0]}]}}, ("own.0", "must point somewhere")),
        ({"thrusters": {"layout": "own", "own": [UP | {"forc": 1}]}}, ("own.0.forc", "did you mean force")),
        ({"thrusters": {"layout": "six", "own": [UP]}}, ("own: 1 thrusters", '"six"')),
        ({"camera": {"least_range": 5.0, "greatest_range": 5.0}}, ("camera", "least_range 5.0 m", "between them")),
        ({"light": {"kind": "fixed"}}, ("light", 'kind = "fixed" needs direction')),
        ({"inspect": {"delta_v_worth": 5.0}}, ("inspect", "delta_v_worth 5.0", '"both"', '"time"')),
        ({"inspect": {"no_thrust_towards": [{"centre": (0, 0, 0)}]}}, ("no_thrust_towards.0", "centre and radius")),
    ],
)
def test_bad_entries_are_named_with_value_and_range(tree, said):
    with pytest.raises(ScenarioError) as refusal:
        Scenario.parse(tree)
    text = str(refusal.value)
    assert "\n" not in text
    for part in said:
        assert part in text


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[chaser]\nmasss = 3\n", "line 2: chaser.masss: no such entry; did you mean mass?"),
        ("\n# a\nsafty = 1\n", "line 3: safty: no such entry; did you mean safety?"),
        ("[chaser]\n\nmargin = 0.1", "line 3: chaser.margin: no such entry; did you mean safety.margin?"),
        ("[start]\nposition = [\n  0.0, # m\n  nan,\n  1.0,\n]\n", "line 2: start.position: [0.0, nan, 1.0] must be"),
        ("[disturbance]\n# none\nkind = 'constant'\n", 'line 3: disturbance: kind = "constant" needs force'),
        ("[control]\nguidance = 'straight'\nspacing = 0.2", "line 3: control: spacing 0.2 m is for"),
        ("control.paper.k_p = 3", "line 1: control.paper.k_p: no such entry; valid: slowing_length"),
        ('[campaign.dispersions]\n"chaser.mass" = {uniform = [3, 1]}', "line 2: campaign.dispersions.chaser.mass: u"),
        ("[chaser]\nmass = '''\nheavy\n'''\nradius = -1", "line 5: chaser.radius: -1 must be"),
        ("[chaser]\nmass = \n", "not valid TOML: Invalid value (at line 2"),
        (b"\xff\xfe\x00", "not a text file"),
        pytest.param("duration = " + "9" * 5000, "", id="5000 digits"),
        pytest.param("duration = " + "[" * 5000 + "]" * 5000, "", id="deep list"),
        pytest.param("x = " + "{a=" * 5000 + "1" + "}" * 5000, "", id="deep table"),
    ],
)
def test_the_line_of_a_file_is_named(tmp_path, text, said):
    path = tmp_path / "mission.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ScenarioError) as refusal:
        Scenario.load(path)
    assert str(refusal.value).startswith(f"{path}: ")
    assert said in str(refusal.value)
    assert len(str(refusal.value)) < 600
    assert "\n" not in str(refusal.value)


def test_what_python_gives_is_taken_or_refused_without_a_line():
    made = Scenario.parse({"duration": 20, "start": {"position": [0, 9, 5]}, "chaser": {"mass": np.float64(21.0)}})
    assert (made.duration, made.start.position, made.chaser.mass) == (20.0, (0.0, 9.0, 5.0), 21.0)
    with pytest.raises(ScenarioError, match=r"^scenario: chaser\.mass: -1 must be greater than 0$"):
        Scenario(chaser={"mass": -1})  # pyright: ignore[reportArgumentType]
    moved = made.replace(goal={"position": (1.0, 2.0, 3.0)})
    assert (moved.goal.position, moved.goal.tolerance) == ((1.0, 2.0, 3.0), made.goal.tolerance)
    with pytest.raises(ScenarioError, match="seed"):
        made.replace(seed=-1)


def test_files(tmp_path):
    for path in (tmp_path / "absent.toml", tmp_path):
        with pytest.raises(ScenarioError, match="cannot be read"):
            Scenario.load(path)
    path = tmp_path / "mission.toml"
    path.write_text("")
    assert Scenario.load(path) == Scenario()
    path.write_text(
        '[target]\nsource = "models/a.glb"\n[field]\nsource = "a.keepout"\n'
        "[[inspect.hold_points]]\nposition = [20, 0, 0]\n"
    )
    scenario = Scenario.load(path)
    assert scenario.target.source == str(tmp_path / "models" / "a.glb")  # relative to the file
    assert scenario.field.source == str(tmp_path / "a.keepout")
    assert [hold.seconds for hold in scenario.inspect.hold_points] == [60.0]
    assert Scenario.parse(scenario.model_dump()) == scenario


@pytest.mark.parametrize("instant", ["2262-04-12T00:00:00", "9999-12-31T23:59:59.9", "1677-09-20T00:00:00"])
def test_an_instant_that_64_bits_cannot_count_is_refused(instant):
    with pytest.raises(ValueError, match=r"\A[^\n]*from 1677-09-22 to 2262-04-11[^\n]*\Z"):
        parse_instant(instant)


@given(st.datetimes(min_value=datetime(1677, 9, 22), max_value=datetime(2262, 4, 11)))
def test_an_instant_between_is_counted_as_numpy_counts_it(moment):
    counted = np.datetime64(moment, "ns").astype(np.int64)
    assert np.int64(parse_instant(moment.isoformat())) == counted


json_like = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


def said_of(read, *given):
    """The refusal of what is read, or nothing."""
    try:
        read(*given)
    except ScenarioError as refusal:
        return str(refusal)
    return ""


@given(st.dictionaries(st.sampled_from([*Scenario.model_fields, "other"]), json_like, max_size=4), st.text(max_size=60))
def test_any_tree_and_any_text_is_a_scenario_or_a_refusal_in_one_line(tmp_path_factory, tree, text):
    refusal = said_of(Scenario.parse, tree)
    if not refusal:
        scenario = Scenario.parse(tree)
        assert Scenario.parse(json.loads(scenario.model_dump_json())) == scenario
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_text(text, encoding="utf-8", errors="surrogatepass", newline="")
    assert "\n" not in refusal + said_of(Scenario.load, path)
