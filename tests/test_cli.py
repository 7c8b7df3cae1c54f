"""The command line as a user meets it: one-line refusals, JSON on standard output, help with an example."""

import json
import subprocess
import sys
import warnings

import pytest

from keepout import cli
from keepout.commands import mesh

COMMANDS = (
    *("targets", "describe", "fit", "certify", "measure", "fly", "explore", "inspect"),
    *("campaign", "rare", "reproduce", "export"),
)


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


@pytest.mark.parametrize("command", ["new", "check", "schema"])
def test_every_scenario_command_has_help_with_an_example(command, monkeypatch, capsys):
    assert run(monkeypatch, "scenario", command, "--help") == 0
    text = capsys.readouterr().out
    assert "Example" in text
    assert f"keepout scenario {command}" in text


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("nonsense",), "nonsense"),
        (("fly",), "scenario"),
        (("fly", "absent.toml"), "absent.toml"),
        (("scenario", "check", "absent.toml"), "absent.toml"),
        (("scenario", "nonsense"), "nonsense"),
        (("fit", "absent.glb", "-o", "out.keepout"), "absent.glb"),
        (("fit", "box", "-o", "absent-folder/out.keepout"), "absent-folder"),
        (("fit", "box", "-o", "out.keepout", "--profile", "papre"), "papre"),
        (("fit", "box", "-o", "out.keepout", "--units", "furlong"), "furlong"),
        (("fit", "box", "-o", "out.txt"), ".keepout"),
        (("certify", "absent.keepout"), "absent.keepout"),
        (("certify", "field.keepout", "--chaser-radius", "-1"), "-1"),
        (("measure", "absent.keepout"), "absent.keepout"),
        (("measure", "pocket", "--shipped"), "'pocket': there is none"),
        (("measure", "box"), "box is not a .keepout file; `keepout describe box`"),
        (("describe", "absent.glb"), "absent.glb"),
        (("describe", "box.keepout"), "box.keepout is a field; `keepout measure box.keepout`"),
        (("describe", "box", "--scale", "-1"), "keepout: --scale: -1"),
        (("campaign", "absent.toml", "--runs", "0"), "0"),
        (("rare", "absent.toml", "--runs", "1"), "1"),
        (("rare", "absent.toml", "--flights", "8"), "8"),
        (("reproduce", "case7"), "case1"),
        (("export", "absent.npz", "--to", "oem", "-o", "a.oem"), "absent.npz"),
        (("audit", "--target", "box", "--chaser", "a"), "--target-orbit"),
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


def test_a_folder_that_cannot_be_made_is_told_before_anything_is_drawn(monkeypatch, capsys, tmp_path):
    (tmp_path / "taken").write_text("", encoding="utf-8")
    assert run(monkeypatch, "targets", "--pictures", tmp_path / "taken") == 1
    assert f"{tmp_path / 'taken'}: cannot be made a folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"), [("", ""), ("Unable to allocate\n469. MiB", " (Unable to allocate 469. MiB)")]
)
def test_memory_that_does_not_suffice_is_one_line_too(words, told, monkeypatch, capsys):
    def full(*_, **__):
        raise MemoryError(words)

    monkeypatch.setattr(cli, "app", full)
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 1
    assert capsys.readouterr().err == f"keepout: out of memory{told}; a smaller or coarser target would fit\n"


def test_no_command_shows_the_help_and_nothing_else(monkeypatch, capsys):
    assert run(monkeypatch) == 2
    output = capsys.readouterr()
    assert "Usage" in output.out + output.err
    assert "keepout:" not in output.err


def test_the_module_runs_as_a_program():
    done = subprocess.run(
        [sys.executable, "-m", "keepout.cli", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("keepout ")


HEAVY = ("jax", "equinox", "matplotlib", "trimesh", "optax", "skimage")


@pytest.mark.parametrize(
    ("arguments", "unneeded"),
    [
        (["--help"], (*HEAVY, "numpy", "scipy", "numba", "pyarrow")),
        (["--version"], (*HEAVY, "numpy", "scipy", "numba", "pyarrow")),
        (["fly", "--help"], (*HEAVY, "numpy", "scipy", "numba", "pyarrow")),
        (["targets"], HEAVY),
        (["fly", "absent.toml"], (*HEAVY, "numpy", "scipy")),
        (["scenario", "new"], (*HEAVY, "numpy", "scipy", "numba", "pyarrow")),
        (["scenario", "schema"], (*HEAVY, "numpy", "scipy", "numba", "pyarrow")),
        (["scenario", "check", "absent.toml"], (*HEAVY, "numpy", "scipy")),
        pytest.param(["describe", "box"], ("matplotlib", "trimesh", "optax", "skimage"), marks=pytest.mark.long),
        (["export", "--help"], (*HEAVY, "numpy", "scipy", "numba", "pyarrow", "onnx", "czml3")),
        (["audit", "--help"], (*HEAVY, "numpy", "scipy", "numba", "pyarrow", "lxml")),
    ],
)
def test_light_commands_import_nothing_heavy(arguments, unneeded):
    program = (
        "import sys\nfrom keepout import cli\n"
        f"sys.argv = ['keepout', *{arguments}]\n"
        "try:\n    cli.main()\nexcept SystemExit:\n    pass\n"
        f"print('LOADED', [name for name in {unneeded} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "LOADED []"


@pytest.mark.parametrize(
    "imports",
    [
        "import keepout, jax",
        "import jax, keepout",
        "import keepout, jax.numpy",
        pytest.param("from keepout import Scenario, fly", marks=pytest.mark.long),
    ],
)
def test_jax_computes_in_double_precision_whichever_is_imported_first(imports):
    program = f"{imports}\nimport jax.numpy as jnp\nprint(jnp.ones(1).dtype)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "float64\n"


def test_the_same_warning_is_said_once(monkeypatch, capsys):
    def warned(*_, **__):
        for number in (1, 2, 1):
            with warnings.catch_warnings():  # as each of many flights would warn anew
                warnings.simplefilter("always")
                warnings.warn(f"condition {number} does not hold", UserWarning, stacklevel=1)
        return []

    monkeypatch.setattr(mesh, "describe_targets", warned)
    assert run(monkeypatch, "targets", "--json") == 0
    assert capsys.readouterr().err.splitlines() == [
        f"keepout: warning: condition {number} does not hold" for number in (1, 2)
    ]
