"""The command line as a user meets it: one-line refusals, JSON on standard output, help with an example."""

import json
import sys

import pytest

from keepout import cli

COMMANDS = ("targets", "fit", "certify", "fly", "campaign", "reproduce", "inspect")


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["keepout", *(str(argument) for argument in arguments)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    return int(stop.value.code or 0)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(command, monkeypatch, capsys):
    assert run(monkeypatch, command, "--help") == 0
    text = capsys.readouterr().out
    assert "Example" in text
    assert f"keepout {command}" in text
    for option in ("--json", "--seed"):
        assert option in text


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("nonsense",), "nonsense"),
        (("fly",), "scenario"),
        (("fly", "absent.toml"), "absent.toml"),
        (("fit", "absent.glb", "-o", "out.keepout"), "absent.glb"),
        (("fit", "box", "-o", "absent-folder/out.keepout"), "absent-folder"),
        (("fit", "box", "-o", "out.keepout", "--profile", "papre"), "papre"),
        (("fit", "box", "-o", "out.keepout", "--units", "furlong"), "furlong"),
        (("fit", "box", "-o", "out.txt"), ".keepout"),
        (("certify", "absent.keepout"), "absent.keepout"),
        (("certify", "field.keepout", "--chaser-radius", "-1"), "-1"),
        (("inspect", "absent.keepout"), "absent.keepout"),
        (("inspect", "pocket", "--shipped"), "'pocket': there is none"),
        (("campaign", "absent.toml", "--runs", "0"), "0"),
        (("reproduce", "case7"), "case1"),
        (("targets", "--seed", "-1"), "-1"),
    ],
)
def test_bad_input_is_one_line_and_a_non_zero_exit(arguments, said, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, *arguments) != 0
    output = capsys.readouterr()
    assert output.out == ""
    assert said in output.err
    assert output.err.count("\n") == 1
    assert not list(tmp_path.iterdir()), "a refused command leaves nothing behind"


def test_targets_as_json(monkeypatch, capsys):
    assert run(monkeypatch, "targets", "--json") == 0
    rows = json.loads(capsys.readouterr().out)["targets"]
    by_name = {row["name"]: row for row in rows}
    assert {"intelsat30", "box", "sphere", "pocket"} <= by_name.keys()
    assert by_name["intelsat30"]["triangles"] > 100


def test_version(monkeypatch, capsys):
    assert run(monkeypatch, "--version") == 0
    assert capsys.readouterr().out.startswith("keepout ")
