"""field.source = "grid": the law flies by exact distances where no field was learned."""

import numpy as np
import pytest

from keepout.errors import FieldError
from keepout.fields.evaluate import values
from keepout.mission.build import load_model
from keepout.mission.first_look import require_certified, require_files
from keepout.mission.scenario import Scenario
from keepout.mission.target import load_target

HALF = np.array([2.0, 1.5, 1.0])
"""Of the built-in box, m."""


def test_it_is_the_exact_distance_less_a_little_and_certified_for_the_chaser():
    scenario = Scenario.parse({"target": {"source": "box"}, "field": {"source": "grid"}})
    require_files(scenario)
    require_certified(scenario)
    model = load_model(scenario, load_target(scenario.target))
    assert model.certificate(scenario.chaser.radius).kind == "certified"
    generator = np.random.default_rng(0)
    points = generator.uniform(-6.0, 6.0, (4000, 3))
    apart = np.linalg.norm(np.maximum(np.abs(points) - HALF, 0.0), axis=1)
    error = values(model.field, points) - apart
    outside, near = apart > 0.3, (apart > 0.3) & (apart < 1.5)
    assert error[outside].max() < 0.02
    assert error[near].min() > -0.1
    assert np.median(np.abs(error[near])) < 0.05


def test_without_a_shipped_field_the_refusal_names_it():
    scenario = Scenario.parse({"target": {"source": "box"}})
    with pytest.raises(FieldError, match='"grid"'):
        require_files(scenario)
    with pytest.raises(FieldError, match='"grid"'):
        load_model(scenario, load_target(scenario.target))


def test_a_scenario_file_keeps_the_word(tmp_path):
    path = tmp_path / "mission.toml"
    path.write_text('[target]\nsource = "box"\n[field]\nsource = "grid"\n')
    assert Scenario.load(path).field.source == "grid"
