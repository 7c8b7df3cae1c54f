"""From a scenario's entries to what flies."""

import dataclasses
import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from keepout.commands.mesh import describe_mesh
from keepout.control.profiles import ControlWarning
from keepout.errors import ControlError, MeshError
from keepout.fields.neural import NeuralField
from keepout.fields.shipped import load_shipped
from keepout.geometry.target import Target
from keepout.mission.build import load_target, prepare
from keepout.mission.law import build_law
from keepout.mission.scenario import Scenario

pytestmark = pytest.mark.long


def test_the_body_frame_is_the_users(tmp_path):
    path = tmp_path / "box.stl"
    trimesh.creation.box(extents=(4.0, 3.0, 2.0)).export(path)
    quarter_turn = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    entry = {"source": str(path), "units": "m", "rotation": quarter_turn, "origin": [1.0, 0.0, 0.0]}
    target = load_target(Scenario.parse({"target": entry}).target)
    # File x spans -2 to 2; about an origin at x = 1 it spans -3 to 1, and the turn takes it to body y.
    np.testing.assert_allclose(target.vertices.min(axis=0), [-1.5, -3.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(target.vertices.max(axis=0), [1.5, 1.0, 1.0], atol=1e-12)


def test_a_rotation_that_is_none_is_refused(tmp_path):
    path = tmp_path / "box.stl"
    trimesh.creation.box(extents=(4.0, 3.0, 2.0)).export(path)
    skewed = [[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    with pytest.raises(MeshError, match="rotation"):
        load_target(Scenario.parse({"target": {"source": str(path), "units": "m", "rotation": skewed}}).target)


def test_parameters_reach_the_built_in():
    wide = load_target(Scenario.parse({"target": {"source": "box", "parameters": {"length": 7.0}}}).target)
    assert np.ptp(wide.vertices[:, 0]) == pytest.approx(7.0)
    with pytest.raises(MeshError, match="wings"):
        load_target(Scenario.parse({"target": {"source": "box", "parameters": {"wings": 7.0}}}).target)


def test_a_mesh_report_has_the_sealed_volume(tmp_path):
    summary = describe_mesh({"source": "box"}, tmp_path)
    assert summary["watertight"]
    # The offset solid holds the 4 × 3 × 2 m box and at most a skin of offset and two leaves around it.
    assert 24.0 < summary["sealed_volume"] < (4.0 + 0.22) * (3.0 + 0.22) * (2.0 + 0.22)
    assert (tmp_path / "box.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("target", "goal", "said"),
    [
        ("intelsat30", (0.0, 0.0, 0.0), r"no gap of more than 0\.5 m leads there from outside"),
        ("iss", (-52.7, 0.0, 0.0), r"at least 0\.736 m needed\)"),
    ],
)
def test_a_goal_is_refused_with_the_reason(target, goal, said):
    scenario = Scenario.parse(
        {"target": {"source": target}, "start": {"position": [-60.0, 0.0, 20.0]}, "goal": {"position": goal}}
    )
    with pytest.raises(ControlError, match=rf"goal: .* inside the keep-out zone .*{said}.*") as refused:
        prepare(scenario)
    assert str(refused.value).count("; ") == (0 if "needed" in said else 1)


def test_a_goal_where_the_field_misses_the_room_is_refused_with_both_distances():
    target, shipped = Target.load("intelsat30"), load_shipped("intelsat30")
    field = shipped.field
    assert isinstance(field, NeuralField)
    # A field that says a metre too little everywhere, as one does in a web between two panels.
    last = field.layers.biases[-1]
    low = eqx.tree_at(lambda f: f.layers.biases[-1], field, last - np.float32(1.0 / field.scale))
    certificate = shipped.certificate(0.5)
    model = dataclasses.replace(shipped, field=low, certificates=())
    model = model.with_certificate(dataclasses.replace(certificate, field_sha256=model.sha256))
    goal = target.vertices[target.vertices[:, 1].argmin()] - [0.0, 1.3, 0.0]
    said = float(low.value(jnp.asarray(goal)))
    assert said == pytest.approx(0.27, abs=0.1)
    scenario = Scenario.parse({"target": {"source": "intelsat30"}, "goal": {"position": goal.tolist()}})
    reason = f"the mesh is 1.3 m away there and the field says {said:.3g} m: move the goal"
    with pytest.raises(ControlError, match=rf"goal: .* inside the keep-out zone .*; {re.escape(reason)}"):
        prepare(scenario, target=target, model=model)


def test_what_the_paper_leaves_unprinted_reaches_its_law():
    unprinted = {"slowing_length": 20.0, "sharpness": 3.0, "position_weight": 0.5, "gradient_error": 0.2}
    scenario = Scenario().replace(control={"profile": "paper", "paper": unprinted})
    with pytest.warns(ControlWarning):
        law = build_law(scenario, load_shipped("intelsat30"))
    assert float(law.velocity.guidance.slowing_length) == 20.0
    assert float(law.tracking.sharpness) == 3.0
    np.testing.assert_array_equal(law.tracking.position_weight, 0.5 * np.eye(3))
    assert float(law.tracking.gradient_error) == float(law.velocity.gradient_error) == 0.2
