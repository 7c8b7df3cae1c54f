"""What the command `keepout describe` says of a mesh's reading, in its table and as JSON."""

import json
import sys

import pytest
import trimesh
from rich.console import Console

from keepout import cli
from keepout.report import terminal


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "no --units or --scale was given"),
        (["--units", "m"], "the file's numbers are in m"),
        (["--scale", "0.342"], "one unit of the file is 0.342 m"),
    ],
)
def test_what_was_left_out_and_what_the_numbers_were_taken_for(monkeypatch, capsys, tmp_path, options, said):
    box = trimesh.creation.box(extents=(3.0, 2.0, 1.0))
    box.export(tmp_path / "box.obj")
    with (tmp_path / "box.obj").open("a") as file:
        file.write("\nl 1 2 3\np 1\nf 1 2 3 4\n")
    monkeypatch.setattr(sys, "argv", ["keepout", "describe", str(tmp_path / "box.obj"), *options, "--json"])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert not stop.value.code
    summary = json.loads(capsys.readouterr().out)
    assert said in summary["lengths"]
    assert len(summary["actions"]) >= 3
    console = Console(width=80, record=True)
    console.print(terminal.facts_table("Mesh", summary))
    shown = " ".join(console.export_text().replace("│", " ").split())
    for line in summary["actions"]:
        assert line in shown
