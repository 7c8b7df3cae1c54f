"""The JSON Schema of scenarios, judged by a validator of its own (the `jsonschema` package)."""

import copy
import json
import tomllib
from pathlib import Path

import jsonschema
import pytest

from keepout.mission.scenario import Scenario
from keepout.mission.schema import schema

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.toml"))


@pytest.fixture(scope="module")
def validator():
    made = json.loads(json.dumps(schema()))
    jsonschema.Draft202012Validator.check_schema(made)
    return jsonschema.Draft202012Validator(made)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_examples_are_valid(path, validator):
    validator.validate(tomllib.loads(path.read_text(encoding="utf-8")))


def test_all_defaults_are_valid(validator):
    validator.validate(json.loads(Scenario().model_dump_json(exclude_none=True)))


@pytest.mark.parametrize(
    "tree",
    [
        {"chaser": {"masss": 3.0}},
        {"safty": {}},
        {"chaser": {"mass": -20.0}},
        {"chaser": {"mass": 0.0}},
        {"chaser": {"mass": "heavy"}},
        {"start": {"position": [0.0, 1.0]}},
        {"start": {"position": [0.0, 1.0, 2.0, 3.0]}},
        {"orbit": {"eccentricity": 1.0}},
        {"control": {"profile": "papre"}},
        {"guard": {"delay": 9}},
        {"name": "../x"},
        {"seed": -1},
        {"duration": 2e6},
        {"campaign": {"dispersions": {"chaser.mass": {"unifrom": [1, 2]}}}},
    ],
)
def test_what_a_scenario_refuses_the_schema_refuses(tree, validator):
    with pytest.raises(jsonschema.ValidationError):
        validator.validate(tree)


def test_every_entry_says_what_it_is():
    made = schema()
    tables = {name: copy.deepcopy(table) for name, table in made["$defs"].items()} | {"Scenario": made}
    silent = [
        f"{name}.{key}"
        for name, table in tables.items()
        for key, entry in table["properties"].items()
        if not entry.get("description") and "$ref" not in entry
    ]
    assert silent == []
    # What a table is for stands with the table.
    assert all(table.get("description") for table in tables.values())


def test_units_and_bounds_are_there():
    mass = schema()["$defs"]["ChaserEntry"]["properties"]["mass"]
    assert mass["exclusiveMinimum"] == 0.0
    assert mass["description"] == "kg"
    assert mass["default"] == 20.0
    delay = schema()["$defs"]["GuardEntry"]["properties"]["delay"]
    assert (delay["minimum"], delay["maximum"]) == (0, 8)
