"""`keepout describe` shows all that its reading left out, in the table and as JSON."""

import json
import sys

import pytest
import trimesh
from rich.console import Console
from truths.messy_meshes import messy_satellite

from keepout import cli
from keepout.report import terminal


def describe(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["keepout", "describe", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    return int(stop.value.code or 0)


@pytest.mark.long
def test_every_action_is_shown(monkeypatch, capsys, tmp_path):
    mesh = messy_satellite(tmp_path)
    assert describe(monkeypatch, mesh.path, "--drop-stray", "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    actions = [*mesh.left_out, "left out 17 duplicate faces", "left out 1 stray parts, 12 triangles"]
    assert summary["actions"] == actions
    assert summary["triangles"] == mesh.triangles - mesh.duplicates - 12
    console = Console(width=80, record=True)
    console.print(terminal.facts_table("Mesh", summary))
    shown = " ".join(console.export_text().replace("│", " ").split())
    for line in actions:
        assert line in shown


def test_a_damaged_mesh_is_one_line(monkeypatch, capsys, tmp_path):
    (tmp_path / "bad.stl").write_bytes(b"\x93\x80not a mesh" * 100)
    assert describe(monkeypatch, tmp_path / "bad.stl") != 0
    output = capsys.readouterr()
    assert output.out == ""
    assert "not a valid STL" in output.err
    assert output.err.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "no --units or --scale was given"),
        (["--units", "mm"], "the file's numbers are in mm"),
        (["--scale", "0.342"], "one unit of the file is 0.342 m"),
    ],
)
def test_the_report_says_what_its_numbers_were_taken_for(monkeypatch, capsys, tmp_path, options, said):
    trimesh.creation.box(extents=(3.0, 2.0, 1.0)).export(tmp_path / "box.stl")
    assert describe(monkeypatch, tmp_path / "box.stl", *options, "--json") == 0
    assert said in json.loads(capsys.readouterr().out)["lengths"]
