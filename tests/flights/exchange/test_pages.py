"""The page on exports and audit: its commands run, and what it says stands in an answer stands there."""

import re
import shlex
import shutil
from pathlib import Path

import pytest
import trimesh
from truths.command_line import keepout_command
from truths.messages import GEOSTATIONARY, toy_flight

from keepout.core.fields import shipped_path

PAGE = Path(__file__).parents[3] / "docs" / "flights-out.md"


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with the files that the page names: a toy flight past a box, and a field."""
    folder = tmp_path_factory.mktemp("pages")
    (folder / "out" / "case1").mkdir(parents=True)
    _, record = toy_flight(GEOSTATIONARY, steps=40, goal=(3.0, 4.0, 4.0))
    record.save(folder / "out" / "case1" / "case1.parquet")
    shutil.copy(shipped_path("intelsat30"), folder / "satellite.keepout")
    trimesh.creation.box((2.0, 2.0, 2.0)).export(folder / "satellite.glb")
    return folder


@pytest.mark.slow  # tests/test_docs.py says of each command that it has these arguments
def test_commands_and_answers_are_as_told(workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    text, answers = PAGE.read_text(encoding="utf-8"), []
    for block in re.findall(r"```console\n(.*?)```", text, re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            if re.match("keepout (export|audit) ", line):
                told = line.replace("--target intelsat30", "--target satellite.glb --target-units m")  # the toy's box
                answers.append(keepout_command(*shlex.split(told)[1:]))
                assert answers[-1].code == 0, answers[-1].err
    assert len(answers) == 5
    answer = answers[-1].json
    assert answer["contact_verdict"] == "no"
    table = text.split("| look at |")[1].split("What you state")[0]
    rows = [line for line in table.splitlines() if line.startswith("| `")]
    named = re.findall(r"`(\w+)`", "\n".join(row.split("|")[1] for row in rows))
    assert len(named) == 5
    assert set(named) <= answer.keys()
