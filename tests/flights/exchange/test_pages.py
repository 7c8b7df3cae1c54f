"""The pages on exports and audit: their commands run, and what they say stands in an answer stands there."""

import re
import shlex
import shutil
from pathlib import Path

import pytest
import trimesh
from truths.command_line import keepout_command
from truths.messages import GEOSTATIONARY, toy_flight

from keepout.core.fields import shipped_path

DOCS = Path(__file__).parents[3] / "docs"


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with the files that the pages name: a toy flight past a box, and a field."""
    folder = tmp_path_factory.mktemp("pages")
    (folder / "out" / "case1").mkdir(parents=True)
    _, record = toy_flight(GEOSTATIONARY, steps=40, goal=(3.0, 4.0, 4.0))
    record.save(folder / "out" / "case1" / "case1.parquet")
    shutil.copy(shipped_path("intelsat30"), folder / "satellite.keepout")
    trimesh.creation.box((2.0, 2.0, 2.0)).export(folder / "satellite.glb")
    (folder / "mission.toml").write_text('[target]\nsource = "satellite.glb"\n')
    return folder


def blocks(page, language):
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.slow  # tests/test_docs.py says of each command that it has these arguments
def test_commands_and_answers_are_as_told(workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    answers = []
    for page in ("export.md", "audit.md"):
        for block in blocks(page, ""):
            for line in block.replace("\\\n", " ").splitlines():
                answers.append(keepout_command(*shlex.split(line)[1:]))
                assert answers[-1].code == 0, answers[-1].err
    assert len(answers) == 6
    [example] = blocks("export.md", "python")
    exec(compile(example, "export.md", "exec"), {})
    answer = answers[-1].json
    assert answer["contact_verdict"] == "no"
    text = (DOCS / "audit.md").read_text(encoding="utf-8")
    table = text.split("## The answer")[1].split("## What is assumed")[0]
    named = re.findall(
        r"`(\w+)`", "\n".join(line.split("|")[1] for line in table.splitlines() if line.startswith("| `"))
    )
    assert named
    assert set(named) <= answer.keys()
    for name in ("turning_acceleration_kind", "least_acceleration_of_samples_mps2", "path_uncertainty_m"):
        assert name in text
        assert name in answer["assumptions"]
