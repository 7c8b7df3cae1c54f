"""What is refused before JAX is imported: at once, and only what would be refused anyway."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from truths.boxes import HALF

from keepout.core.errors import FieldError, KeepoutError, ScenarioError
from keepout.core.geometry.target import Target
from keepout.core.mission.build import load_model, prepare
from keepout.core.mission.first_look import (
    flown_disturbance,
    look,
    require_authority,
    require_certified,
)
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.target import is_enclosed

force = st.floats(1e-4, 1.0)


@st.composite
def disturbances(draw):
    kind = draw(st.sampled_from(["none", "paper", "constant", "bang-bang", "resonant", "random"]))
    entry: dict = {"kind": kind}
    if kind == "constant":
        entry["force"] = draw(st.tuples(force, force, force))
    elif kind not in ("none", "paper"):
        entry["amplitude"] = draw(force)
    if draw(st.booleans()):
        entry["bound"] = draw(force)
    return entry


@given(disturbances(), st.floats(1e-3, 1.0))
def test_disturbances_are_judged_as_their_models_judge_them(entry, limit):
    scenario = Scenario.parse({"disturbance": entry, "chaser": {"force_limit": limit}})
    bound = Surroundings(scenario).disturbance.bound
    assert flown_disturbance(scenario) == pytest.approx(bound, rel=1e-9, abs=0.0)
    try:
        require_authority(scenario)
    except ScenarioError:
        with pytest.raises(ScenarioError, match="no law can hold"):
            _ = Surroundings(scenario).disturbance_bound


@pytest.mark.parametrize("content", [b"", b"\xff" * 64, (3).to_bytes(8, "little") + b"{}}"])
def test_a_damaged_field_is_left_to_what_reads_it(tmp_path, content):
    path = tmp_path / "damaged.keepout"
    path.write_bytes(content)
    require_certified(Scenario.parse({"field": {"source": str(path)}}))
    with pytest.raises(FieldError, match=r"damaged\.keepout"):
        load_model(Scenario.parse({"field": {"source": str(path)}}), Target.load("intelsat30"))


@given(st.tuples(*(st.floats(-3.0, 3.0) for _ in range(3))))
def test_what_a_closed_mesh_winds_around_is_enclosed_and_nothing_else(place):
    point, box = np.array(place), Target.load("box")
    depth = (np.abs(point) - HALF).max()
    assume(abs(depth) > 1e-6)
    assert is_enclosed(box, point) == (depth < 0.0)
    # With a triangle away it is open, and no longer says that nothing leads out; turned inside out it still does.
    assert not is_enclosed(replace(box, faces=box.faces[1:]), point)
    assert is_enclosed(replace(box, faces=box.faces[:, ::-1]), point) == (depth < 0.0)


@pytest.mark.long
@pytest.mark.parametrize(
    ("entries", "alike"),
    [
        ({"chaser": {"radius": 0.3}}, True),
        ({"chaser": {"radius": 0.77}}, True),
        ({"target": {"source": "absent.glb"}}, True),
        ({"field": {"source": "absent.keepout"}}, True),
        ({"target": {"source": "box"}}, True),
        ({"chaser": {"speed_limit": 0.5}}, False),
        ({"start": {"position": (0.0, 1.8, 0.0)}}, False),
        ({"goal": {"position": (0.0, 1.8, 0.0)}}, False),
        ({"start": {"position": (0.0, 0.0, 0.0)}}, True),
        ({"goal": {"position": (0.0, 0.0, 0.0)}}, True),
        ({"disturbance": {"kind": "constant", "force": (0.2, 0.0, 0.0)}}, False),
    ],
)
def test_what_is_refused_at_once_is_refused_in_the_end_and_files_in_the_same_words(entries, alike):
    scenario = Scenario.parse(entries)
    with pytest.raises(KeepoutError) as early:
        look(scenario)
    with pytest.raises(KeepoutError) as late:
        prepare(scenario)
    assert type(early.value) is type(late.value)
    assert not alike or str(early.value) == str(late.value)


def test_what_can_be_flown_is_not_refused():
    assert look(Scenario.parse({"chaser": {"radius": 0.0}})).name == "intelsat30"
    assert look(Scenario.parse({"chaser": {"speed_limit": 0.5}, "control": {"profile": "paper"}})).name == "intelsat30"


@pytest.mark.long
@pytest.mark.parametrize("text", ["[start]\nposition = [0.0, 1.8, 0.0]", "[chaser]\nradius = 0.77\nspeed_limit = 0.05"])
def test_a_refused_file_waits_for_no_jax_and_leaves_nothing_behind(tmp_path, text):
    path = tmp_path / "mission.toml"
    path.write_text(text, encoding="utf-8")
    program = (
        "import sys\nfrom keepout import cli\n"
        f"sys.argv = ['keepout', 'fly', {str(path)!r}, '-o', {str(tmp_path / 'out')!r}]\n"
        "try:\n    cli.main()\nexcept SystemExit as end:\n    print(end.code, 'jax' in sys.modules)"
    )
    compiled = tmp_path.parent / f"{tmp_path.name}-compiled"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(compiled)}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == "1 False\n"
    assert not list(compiled.rglob("*.nbc"))  # nor for numba, which would keep there what it compiled
    assert done.stderr.count("\n") == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["mission.toml"]
