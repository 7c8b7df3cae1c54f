"""The command line as a user meets it: one-line refusals, nothing left behind, help with an example, quick starts."""

import importlib
import json
import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from truths.boxes import LEARNED
from truths.command_line import Answer, keepout_command

from keepout import cli
from keepout.cli import mesh, options
from keepout.cli.options import ORDER
from keepout.core.fields import shipped_path
from keepout.core.fields.model import FieldModel
from keepout.core.mission.scenario import Scenario

REPOSITORY = Path(__file__).parents[1]
EXAMPLES = REPOSITORY / "examples"
CASE = EXAMPLES / "case1.toml"

COMMANDS = [(name,) for name in ORDER if name != "scenario"]
COMMANDS += [("scenario", name) for name in ("new", "check", "schema")]


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_command_has_help_with_an_example(command):
    help_of = keepout_command(*command, "--help")
    assert help_of.code == 0
    assert "Example" in help_of.out
    assert f"keepout {' '.join(command)}" in help_of.out
    assert "--json" in help_of.out or command == ("scenario", "schema")


USAGE = 2
SHIPPED = shipped_path("intelsat30")
AUDIT = (
    *("audit", "--target", "box", "--chaser", "a.oem", "--target-orbit", "b.oem"),
    *("--chaser-radius", "0.5", "--acceleration-bound", "0.1"),
)
CANNOT_BE_MEANT = [
    (("nonsense",), "nonsense"),
    (("fly", "a.toml", "--seed", "4294967296"), "4294967296"),
    (("fly", CASE, "--set", "chaser.mass"), "--set chaser.mass: no value; give ENTRY=VALUE"),
    (("scenario", "check", CASE, "--set", "chaser.mass=-1", "--set", "seed=a"), "chaser.mass: -1 must be greater than"),
    (("rare", CASE, "--set", "goal.positon=3"), "goal.positon: no such entry; did you mean position?"),
    (("campaign", CASE, "--set", "start.position.z=high"), "start.position.2: 'high' must be a number"),
    (("explore", EXAMPLES / "explore.toml", "--set", "= 3"), "nothing is no name of an entry"),
    (("scenario", "new", "-o", "mission.yaml"), ".toml"),
    (("scenario", "new", "--units", "cm"), "--for"),
    (("fit", "box", "-o", "out.keepout", "--profile", "papre"), "papre"),
    (("fit", "box", "-o", "out.keepout", "--units", "furlong"), "furlong"),
    (("fit", "box", "-o", "out.keepout", "--chaser-radius", "inf"), "inf"),
    (("fit", "box", "-o", "out.txt"), ".keepout"),
    (("measure", "pocket", "--shipped"), "'pocket': there is none"),
    (("measure", "box"), "box is not a .keepout file; `keepout describe box`"),
    (("describe", "box.keepout"), "box.keepout is a field; `keepout measure box.keepout`"),
    (("describe", "box", "--scale", "-1"), "keepout: --scale: -1"),
    (("describe", "mission.toml", "--units", "mm"), "--units: not with the scenario mission.toml"),
    (("replay", "a.parquet", "-o", "page.txt"), ".html"),
    (("campaign", "absent.toml", "--runs", "1000000001"), "1000000001"),
    (("campaign", CASE, "--keep", "best:3"), "best:3"),
    (("campaign", CASE, "--scheduler", "near"), "near"),
    (("rare", "absent.toml", "--flights", "100"), "multiple of 8"),
    (("rare", "absent.toml", "--below", "nan"), "nan"),
    (("reproduce", "case7"), "case1"),
    (("export", "flight.txt", "--to", "oem", "-o", "a.oem"), "a flight file ends in .parquet or .npz, a field file in"),
    (("export", "a.npz", "--to", "omm", "-o", "a"), "--to omm: valid for a flight: oem, aem, czml, csv, parquet, npz"),
    (("export", "a.npz", "--to", "aem", "--of", "target", "-o", "a"), "--of: only for --to oem, not --to aem"),
    (("export", "a.npz", "--to", "oem", "--of", "moon", "-o", "a"), "--of moon: valid: chaser, target"),
    (("export", "a.npz", "--to", "oem", "--chaser-radius", "1", "-o", "a"), "--chaser-radius: only for a field"),
    (("export", SHIPPED, "--to", "czml", "-o", "a"), "--to czml: valid for a field: onnx, glb"),
    (("audit", "--target", "box", "--chaser", "a"), "--target-orbit"),
    ((*AUDIT, "--target-fixed-in", "ecef"), "--target-fixed-in ecef: valid: vvlh, inertial"),
    ((*AUDIT, "--acceleration-bound", "inf"), "inf is not valid"),
    ((*AUDIT, "--target", "mission.toml", "--target-units", "mm"), "--target-units: not with the scenario"),
    ((*AUDIT, "--set", "chaser.mass=3"), "--set chaser.mass=3: only with a scenario file"),
    ((*AUDIT, "--target", "a.stl", "--target-units", "mm", "--target-scale", "2"), "either units or scale"),
]
REFUSED = [
    (("fly", "absent.toml"), "absent.toml"),
    (("scenario", "check", "absent.toml"), "absent.toml"),
    (("fit", "absent.glb", "-o", "out.keepout"), "absent.glb"),
    (("fit", "box", "-o", "absent-folder/out.keepout"), "absent-folder"),
    (("measure", "absent.keepout", "-o", "picture"), "absent.keepout"),
    (("describe", "absent.glb", "-o", "picture"), "absent.glb"),
    (("campaign", "absent.toml", "-o", "runs"), "absent.toml"),
    (("campaign", "replay", "a", "--run", "3", "-o", "run"), "campaign.json"),
    (("rare", "absent.toml", "-o", "rare"), "absent.toml"),
    (("replay", "absent.parquet", "-o", "page/replay.html"), "absent.parquet"),
    (("reproduce", "case1", "--fields", "absent", "-o", "paper"), "absent"),
    (("export", "absent.npz", "--to", "oem", "-o", "a.oem"), "absent.npz"),
    (("export", SHIPPED, "--to", "onnx", "-o", "a"), "the field has certificates for 0, 0.5 m; name one of them"),
    (("export", SHIPPED, "--to", "onnx", "--chaser-radius", "0.7", "-o", "a"), "chaser radius 0.7 m"),
    (("export", SHIPPED, "--to", "glb", "--mesh", "box", "--chaser-radius", "0", "-o", "a"), "made for intelsat30"),
    (AUDIT, "a.oem: cannot be read"),
    ((*AUDIT, "--target-fixed-in", "vvlh", "--target-attitude", "a.aem"), "not with --target-attitude"),
    ((*AUDIT, "--target", "absent.glb"), "absent.glb"),
    ((*AUDIT, "--target-rotation", *"100010002"), "rotation: [[1.0, 0.0, 0.0]"),
    # Who means a mesh or a field is told what the commands are called now.
    (("inspect", "intelsat30"), "keepout describe intelsat30"),
    (("inspect", "absent.keepout"), "keepout measure"),
]


@pytest.mark.parametrize(
    ("arguments", "said", "code"),
    [(*row, USAGE) for row in CANNOT_BE_MEANT] + [(*row, 1) for row in REFUSED],
    ids=lambda part: " ".join(map(str, part)) if isinstance(part, tuple) else "",
)
def test_a_refusal_is_one_line_and_leaves_nothing_behind(arguments, said, code, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    answer = keepout_command(*arguments)
    assert answer.code == code
    assert answer.out == ""
    assert said in answer.err
    assert answer.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("command", "mission"),
    [
        ("rare", "[faults]\ndropped = 0.0"),
        ("fly", "[goal]\nposition = [0.0, 0.0, 0.0]"),
        ("campaign", "[goal]\nposition = [0.0, 0.0, 0.0]"),
        ("explore", "[depth_sensor]\nperiod = 10.0"),
        ("inspect", '[control]\nprofile = "paper"'),
    ],
)
@pytest.mark.long
def test_a_mission_that_is_refused_leaves_no_folder(command, mission, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    settings = 'duration = 5.0\ntarget.source = "box"\nfield.source = "grid"\nguard.enabled = false\n'
    settings += 'control.guidance = "straight"\n' if "control" not in mission else ""
    (tmp_path / "mission.toml").write_text(settings + mission)
    answer = keepout_command(command, "mission.toml", "-o", "out/deep")
    assert (answer.code, answer.out) == (1, "")
    assert answer.err.splitlines()[-1].startswith("keepout: ")
    assert [path.name for path in tmp_path.iterdir()] == ["mission.toml"]


def working(*_, **__):
    raise AssertionError("worked before it tried where the result is to go")


def work_is_watched(monkeypatch, work):
    module, _, name = work.partition(":")
    monkeypatch.setattr(importlib.import_module(module), name, working)


@pytest.mark.parametrize(
    ("command", "file", "work"),
    [
        (("targets", "--pictures"), None, "keepout.core.geometry.target:enclosed_volume"),
        (("describe", "box", "-o"), None, "keepout.verbs.meshes:survey"),
        (("measure", "intelsat30", "--shipped", "-o"), None, "keepout.verbs.measures:measure_model"),
        (("fly", "mission.toml", "-o"), None, "keepout.core.mission.build:fly"),
        (("explore", "explore.toml", "-o"), None, "keepout.apps.unknown.explore:explore"),
        (("inspect", "mission.toml", "-o"), None, "keepout.apps.inspection.inspect:inspect"),
        (("campaign", "mission.toml", "-o"), None, "keepout.flights.campaign.plan:Workshop"),
        (("campaign", "compare", "a", "b", "-o"), None, "keepout.flights.pages.campaign_page:read_campaign"),
        (("rare", "mission.toml", "-o"), None, "keepout.flights.rare_events.event:rare"),
        (("reproduce", "runtime", "-o"), None, "keepout.apps.reproduction:side_by_side"),
        (("fit", "box", "-o"), "box.keepout", "keepout.core.learning.training:fit"),
        (("scenario", "new", "--for", "box", "--force", "-o"), "new.toml", "keepout.verbs.draft:draft"),
        (("scenario", "schema", "-o"), "schema.json", "keepout.core.mission.scenario:schema"),
        (("replay", "a.parquet", "-o"), "page.html", "keepout.verbs.files:of_files"),
        (("export", "a.parquet", "--to", "oem", "-o"), "a.oem", "keepout.verbs.files:export_flight"),
        (("certify",), "box.keepout", "keepout.core.proof.certificate:certify"),
    ],
    ids=lambda part: part[0] if isinstance(part, tuple) else "",
)
@pytest.mark.long
def test_where_nothing_can_be_written_is_refused_before_the_work(command, file, work, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mission.toml").write_text("duration = 5.0")
    shutil.copy(EXAMPLES / "explore.toml", tmp_path)
    (tmp_path / "in its place").mkdir()
    work_is_watched(monkeypatch, work)
    places = ["/proc", "/proc/self/new/folder"]
    if file is not None:
        places = [(tmp_path / "in its place").rename(tmp_path / file), Path("/proc") / file]
    if command == ("certify",):  # which writes into what it reads
        monkeypatch.setattr(FieldModel, "load", staticmethod(lambda *_, **__: None))
        places = places[:1]
    before = sorted(tmp_path.rglob("*"))
    for place in places:
        answer = keepout_command(*command, place)
        assert answer.code == 1
        assert answer.err.splitlines()[-1].startswith(f"keepout: {place}")
        assert "cannot be" in answer.err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.long
def test_a_picture_that_cannot_be_written_is_named_in_one_line(tmp_path):
    (tmp_path / "box.png").mkdir()
    answer = keepout_command("describe", "box", "-o", tmp_path, "--json")
    assert (answer.code, answer.out) == (1, "")
    assert answer.err.splitlines()[-1].startswith("keepout: ")
    assert "box.png" in answer.err.splitlines()[-1]
    assert "Traceback" not in answer.err
    assert [path.name for path in tmp_path.iterdir()] == ["box.png"]


@pytest.mark.long
def test_a_fit_is_told_what_was_asked_for_and_one_that_is_stopped_says_so_in_a_line(monkeypatch, tmp_path):
    told = {}

    def stopped(target, **how):
        told.update(how, target=target)
        raise KeyboardInterrupt

    monkeypatch.setattr("keepout.core.learning.training.fit", stopped)
    asked = ("--from", LEARNED, "--until-bound", 0.02, "--at-most", 60, "--chaser-radius", 0.4, "--batch", 384)
    answer = keepout_command("fit", "box", "-o", tmp_path / "box.keepout", *asked, "--seed", 3, "--json")
    assert (answer.code, answer.out) == (130, "")
    assert told["target"].sha256 == told["first"].target_sha256 == FieldModel.load(LEARNED).target_sha256
    assert told["profile"].batch == 384
    assert [told[name] for name in ("until_bound", "at_most", "chaser_radius", "seed")] == [0.02, 60.0, 0.4, 3]
    assert answer.err.endswith("keepout: stopped\n")
    assert not (tmp_path / "box.keepout").exists()
    keepout_command("fit", "box", "-o", tmp_path / "box.keepout", "--from", "intelsat30")
    assert told["first"].target_name == "intelsat30"
    answer = keepout_command("fit", "box", "-o", tmp_path / "box.keepout", "--from", "intelsat31")
    assert answer.code == 2
    assert "intelsat31: no field; it must be a .keepout file, or one of intelsat30, iss, tiangong" in answer.err


def test_memory_that_does_not_suffice_is_one_line_too(monkeypatch):
    def full(*_, **__):
        raise MemoryError("Unable to allocate\n469. MiB")

    monkeypatch.setattr(cli, "app", full)
    answer = keepout_command()
    said = "keepout: out of memory (Unable to allocate 469. MiB); a smaller or coarser target would fit\n"
    assert (answer.code, answer.err) == (1, said)


def test_set_replaces_entries_of_every_kind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mission.toml").write_text("campaign.dispersions = {'chaser.mass' = {uniform = [1, 2]}}")
    settings = ("control.guidance=straight", "start.position.z = 7", "goal.position=[1, 2.5, 3]", "target.source=a.glb")
    settings += ("campaign.dispersions.'chaser.mass'={normal = [20, 1]}", "guard.enabled=false", "seed=1", "seed=2")
    made = options.mission_of(tmp_path / "mission.toml", settings=settings)
    assert made == Scenario(
        **{"seed": 2, "control": {"guidance": "straight"}, "guard": {"enabled": False}},
        **{"start": {"position": [0, 10, 7]}, "goal": {"position": [1, 2.5, 3]}},
        **{"target": {"source": str(tmp_path / "a.glb")}},
        campaign={"dispersions": {"chaser.mass": {"normal": [20, 1]}}},
    )
    assert options.mission_of(tmp_path / "mission.toml", 5, settings).seed == 5


def test_quiet_says_nothing_and_the_log_has_all_that_was_said(tmp_path):
    log = tmp_path / "all.log"
    assert keepout_command("targets", "--quiet", "--log", log) == Answer(0, "", "")
    assert keepout_command("describe", "absent.glb", "-q", "--log", log).err.startswith("keepout: absent.glb")
    said = log.read_text(encoding="utf-8")
    assert "keepout targets --quiet" in said
    assert "intelsat30" in said
    assert " done after " in said
    assert "s: absent.glb: no such file" in said
    assert "intelsat30" in keepout_command("targets").out  # the next command is heard again


def test_no_command_shows_the_help_and_nothing_else():
    answer = keepout_command()
    assert answer.code == USAGE
    assert "Usage" in answer.out + answer.err
    assert "keepout:" not in answer.err


def test_the_same_warning_is_said_once(monkeypatch):
    def warned(*_, **__):
        for number in (1, 2, 1):
            with warnings.catch_warnings():  # as each of many flights would warn anew
                warnings.simplefilter("always")
                warnings.warn(f"condition {number} does not hold", UserWarning, stacklevel=1)
        return []

    monkeypatch.setattr(mesh, "describe_targets", warned)
    answer = keepout_command("targets", "--json")
    assert answer.code == 0
    assert answer.err.splitlines() == [f"keepout: warning: condition {number} does not hold" for number in (1, 2)]


IN_FORKS = """
import contextlib, io, json, os, sys

for code, names in json.loads(sys.argv[1]):
    read, write = os.pipe()
    if os.fork() == 0:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            with contextlib.suppress(SystemExit):
                exec(code)
        os.write(write, json.dumps([name for name in names if eval(name)]).encode())
        os._exit(0)
    os.close(write)
    print(os.fdopen(read).read(), flush=True)
    os.wait()
"""
"""Runs each piece of code in a process that has imported nothing yet, and tells which expressions then hold."""


def held(rows: list[tuple[str, list[str]]]) -> list[list[str]]:
    command = [sys.executable, "-c", IN_FORKS, json.dumps(rows)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return [json.loads(line) for line in done.stdout.splitlines()]


HEAVY = ("jax", "equinox", "matplotlib", "trimesh", "optax", "skimage")
LIGHT = (*HEAVY, "numpy", "scipy", "numba", "pyarrow", "onnx", "czml3", "lxml")


@pytest.mark.long
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_light_commands_import_nothing_heavy():
    commands = {
        ("--help",): LIGHT,
        ("--version",): LIGHT,
        ("fly", "--help"): LIGHT,
        ("export", "--help"): LIGHT,
        ("audit", "--help"): LIGHT,
        ("scenario", "new"): LIGHT,
        ("scenario", "schema"): LIGHT,
        ("targets",): HEAVY,
        ("fly", "absent.toml"): (*HEAVY, "numpy", "scipy"),
        ("scenario", "check", "absent.toml"): (*HEAVY, "numpy", "scipy"),
        ("describe", "box"): ("matplotlib", "trimesh", "optax", "skimage"),
    }
    rows = []
    for words, unneeded in commands.items():
        code = f"from keepout import cli; sys.argv = {['keepout', *words]}; cli.main()"
        rows.append((code, ["'keepout.cli' in sys.modules", *(f"{name!r} in sys.modules" for name in unneeded)]))
    flies = [f"'keepout.core.{room}' in sys.modules" for room in ("control", "flight", "guard", "mission.build")]
    fits = "from keepout import fit, certify; import keepout.cli.mesh", flies
    campaigns = "import keepout.cli.campaign, keepout.flights.campaign.run", ["'distributed' in sys.modules"]
    *of_commands, of_a_fit, of_a_campaign = held([*rows, fits, campaigns])
    for words, loaded in zip(commands, of_commands, strict=True):
        assert loaded == ["'keepout.cli' in sys.modules"], words
    assert not of_a_fit
    assert not of_a_campaign


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.long
def test_jax_computes_in_double_precision_whichever_is_imported_first():
    double = "sys.modules['jax'].numpy.ones(1).dtype == 'float64'"
    imports = ("import keepout, jax.numpy", "import jax.numpy, keepout", "from keepout import Scenario, fly")
    assert held([(code, [double]) for code in imports]) == [[double]] * len(imports)
