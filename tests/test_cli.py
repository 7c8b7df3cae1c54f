"""The command line as a user meets it: one-line refusals, JSON on standard output, help with an example."""

import importlib
import json
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from keepout import cli
from keepout.commands import mesh
from keepout.fields.model import FieldModel

REPOSITORY = Path(__file__).parents[1]
CASE = REPOSITORY / "examples" / "case1.toml"

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


USAGE = 2


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("nonsense",), "nonsense"),
        (("fly",), "scenario"),
        (("fly", "a.toml", "--nonsense"), "--nonsense"),
        (("fly", "a.toml", "--seed", "1.5"), "--seed"),
        (("fly", "a.toml", "--seed", "4294967296"), "4294967296"),
        (("scenario", "nonsense"), "nonsense"),
        (("scenario", "new", "-o", "mission.yaml"), ".toml"),
        (("scenario", "new", "--profile", "papre"), "papre"),
        (("scenario", "new", "--units", "cm"), "--for"),
        (("fit", "box", "-o", "out.keepout", "--profile", "papre"), "papre"),
        (("fit", "box", "-o", "out.keepout", "--units", "furlong"), "furlong"),
        (("fit", "box", "-o", "out.keepout", "--chaser-radius", "nan"), "nan"),
        (("fit", "box", "-o", "out.keepout", "--chaser-radius", "inf"), "inf"),
        (("fit", "box", "-o", "out.txt"), ".keepout"),
        (("certify", "field.keepout", "--chaser-radius", "-1"), "-1"),
        (("measure", "pocket", "--shipped"), "'pocket': there is none"),
        (("measure", "box"), "box is not a .keepout file; `keepout describe box`"),
        (("describe", "box.keepout"), "box.keepout is a field; `keepout measure box.keepout`"),
        (("describe", "box", "--scale", "-1"), "keepout: --scale: -1"),
        (("replay", "a.parquet", "-o", "page.txt"), ".html"),
        (("campaign", "absent.toml", "--runs", "0"), "0"),
        (("campaign", "absent.toml", "--runs", "1000000001"), "1000000001"),
        (("campaign", CASE, "--keep", "best:3"), "best:3"),
        (("campaign", CASE, "--scheduler", "near"), "near"),
        (("rare", "absent.toml", "--runs", "1"), "1"),
        (("rare", "absent.toml", "--flights", "8"), "8"),
        (("rare", "absent.toml", "--flights", "100"), "multiple of 8"),
        (("rare", "absent.toml", "--below", "nan"), "nan"),
        (("reproduce", "case7"), "case1"),
        (("export", "absent.npz", "--to", "omm", "-o", "a.oem"), "omm"),
        (("export", "absent.npz", "--to", "oem", "--of", "moon", "-o", "a.oem"), "moon"),
        (("export", "absent.txt", "--to", "oem", "-o", "a.oem"), "absent.txt"),
        (("audit", "--target", "box", "--chaser", "a"), "--target-orbit"),
        (("targets", "--seed", "-1"), "-1"),
    ],
)
def test_a_command_that_cannot_be_meant_is_one_line_and_exit_code_2(arguments, said, monkeypatch, capsys, tmp_path):
    assert refused(arguments, said, monkeypatch, capsys, tmp_path) == USAGE


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("fly", "absent.toml"), "absent.toml"),
        (("scenario", "check", "absent.toml"), "absent.toml"),
        (("fit", "absent.glb", "-o", "out.keepout"), "absent.glb"),
        (("fit", "box", "-o", "absent-folder/out.keepout"), "absent-folder"),
        (("certify", "absent.keepout"), "absent.keepout"),
        (("measure", "absent.keepout"), "absent.keepout"),
        (("describe", "absent.glb"), "absent.glb"),
        (("describe", "absent.glb", "-o", "picture"), "absent.glb"),
        (("measure", "absent.keepout", "-o", "picture"), "absent.keepout"),
        (("campaign", "absent.toml", "-o", "runs"), "absent.toml"),
        (("campaign", "compare", "a", "b", "-o", "compared"), "campaign.json"),
        (("campaign", "report", "a"), "campaign.json"),
        (("campaign", "replay", "a", "--run", "3", "-o", "run"), "campaign.json"),
        (("rare", "absent.toml", "-o", "rare"), "absent.toml"),
        (("replay", "absent.parquet", "-o", "page/replay.html"), "absent.parquet"),
        (("reproduce", "case1", "--fields", "absent", "-o", "paper"), "absent"),
        (("export", "absent.npz", "--to", "oem", "-o", "a.oem"), "absent.npz"),
    ],
)
def test_what_is_refused_is_one_line_and_exit_code_1(arguments, said, monkeypatch, capsys, tmp_path):
    assert refused(arguments, said, monkeypatch, capsys, tmp_path) == 1


def refused(arguments, said, monkeypatch, capsys, tmp_path) -> int:
    monkeypatch.chdir(tmp_path)
    code = run(monkeypatch, *arguments)
    output = capsys.readouterr()
    assert output.out == ""
    assert said in output.err
    assert output.err.count("\n") == 1
    assert not list(tmp_path.iterdir()), "a refused command leaves nothing behind"
    return code


@pytest.mark.parametrize(
    ("mission", "command"),
    [
        ("[faults]\ndropped = 0.0", ("rare", "mission.toml", "-o", "out/deep")),
        ("[goal]\nposition = [0.0, 0.0, 0.0]", ("fly", "mission.toml", "-o", "out/deep")),
        ("[goal]\nposition = [0.0, 0.0, 0.0]", ("campaign", "mission.toml", "-o", "out/deep")),
    ],
)
@pytest.mark.long
def test_a_mission_that_is_refused_leaves_no_folder(mission, command, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    settings = 'duration = 5.0\ncontrol.guidance = "straight"\nguard.enabled = false\n'
    (tmp_path / "mission.toml").write_text(settings + mission)
    assert run(monkeypatch, *command) == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith("keepout: ")
    assert [path.name for path in tmp_path.iterdir()] == ["mission.toml"]


def working(*_, **__):
    raise AssertionError("worked before it tried where the result is to go")


@pytest.mark.parametrize("nowhere", ["/proc", "/proc/new", "/proc/self/new/folder"])
@pytest.mark.parametrize(
    ("command", "work"),
    [
        (("targets", "--pictures"), "keepout.geometry.shape:enclosed_volume"),
        (("describe", "box", "-o"), "keepout.geometry.survey:survey"),
        (("measure", "intelsat30", "--shipped", "-o"), "keepout.measures.field_measures:measure_model"),
        (("fly", "mission.toml", "-o"), "keepout.mission.flight:fly"),
        (("explore", "explore.toml", "-o"), "keepout.exploring.explore:explore"),
        (("inspect", "mission.toml", "-o"), "keepout.inspecting.inspect:inspect"),
        (("campaign", "mission.toml", "-o"), "keepout.campaign.plan:Workshop"),
        (("campaign", "compare", "a", "b", "-o"), "keepout.report.comparison_page:read_campaign"),
        (("rare", "mission.toml", "-o"), "keepout.rare_events.event:rare"),
        (("reproduce", "runtime", "-o"), "keepout.experiments:side_by_side"),
    ],
)
@pytest.mark.long
def test_a_folder_that_cannot_be_written_to_is_refused_before_the_work(
    command, work, nowhere, monkeypatch, capsys, tmp_path
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mission.toml").write_text("duration = 5.0")
    shutil.copy(REPOSITORY / "examples" / "explore.toml", tmp_path)
    module, _, name = work.partition(":")
    monkeypatch.setattr(importlib.import_module(module), name, working)
    assert run(monkeypatch, *command, nowhere) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith(f"keepout: {nowhere}")
    assert "cannot be" in said


@pytest.mark.parametrize(
    ("command", "name", "work"),
    [
        (("fit", "box", "-o"), "box.keepout", "keepout.learning.training:fit"),
        (("scenario", "new", "--for", "box", "-o"), "mission.toml", "keepout.mission.draft:draft"),
        (("scenario", "schema", "-o"), "schema.json", "keepout.mission.schema:schema"),
        (("replay", "a.parquet", "-o"), "page.html", "keepout.replay.flights:of_files"),
        (("export", "a.parquet", "--to", "oem", "-o"), "a.oem", "keepout.exchange.export:export_flight"),
        (("certify",), "box.keepout", "keepout.proof.certificate:certify"),
    ],
)
@pytest.mark.long
def test_a_file_that_cannot_be_written_is_refused_before_the_work(command, name, work, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    module, _, worker = work.partition(":")
    monkeypatch.setattr(importlib.import_module(module), worker, working)
    monkeypatch.setattr(FieldModel, "load", staticmethod(lambda *_, **__: None))
    folder = tmp_path / name
    for place in (folder,) if command == ("certify",) else (folder, Path("/proc") / name):
        folder.mkdir(exist_ok=True)
        assert run(monkeypatch, *command, place, *(("--force",) if "new" in command else ())) == 1
        said = capsys.readouterr().err.splitlines()[-1]
        assert said.startswith(f"keepout: {place}: cannot be written: ")
    assert list(tmp_path.iterdir()) == [folder]
    assert not list(folder.iterdir())


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
