"""The rooms and their one direction of travel: the contracts of pyproject.toml hold, and would catch a break."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]

BREAKS = {
    "the audit imports a law": ("audit/tube.py", "from keepout.control import law"),
    "the guard imports a law": ("guard/braking.py", "from keepout.control.law import Law"),
    "a proof imports how fields are learned": ("proof/bounds.py", "from keepout.learning import losses"),
    "a field imports control": ("fields/grid.py", "from keepout.control import law"),
    "geometry imports a mission": ("geometry/bvh.py", "from keepout.mission import scenario"),
    "a circle": ("motion/orbit.py", "from keepout.motion import relative"),
}


def lint(folder):
    """Run the contracts over the package in a folder; the exit status is 0 where all are kept."""
    program = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"
    return subprocess.run(
        [sys.executable, "-c", program],
        cwd=folder,
        env={"PYTHONPATH": str(folder / "src"), "PATH": ""},
        capture_output=True,
        text=True,
    )


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rooms")
    shutil.copytree(REPOSITORY / "src" / "keepout", folder / "src" / "keepout")
    shutil.copy(REPOSITORY / "pyproject.toml", folder)
    return folder


def test_all_contracts_are_kept(copy):
    answer = lint(copy)
    assert answer.returncode == 0, answer.stdout
    assert " 0 broken" in answer.stdout


@pytest.mark.parametrize("broken", BREAKS)
def test_a_deliberate_break_is_caught(copy, broken):
    path, line = BREAKS[broken]
    source = copy / "src" / "keepout" / path
    kept = source.read_text(encoding="utf-8")
    source.write_text(kept + f"\n{line}\n", encoding="utf-8")
    try:
        assert lint(copy).returncode != 0
    finally:
        source.write_text(kept, encoding="utf-8")


@pytest.mark.long
def test_the_page_of_rooms_is_of_this_version():
    program = [sys.executable, str(REPOSITORY / "docs" / "offers.py"), "--check"]
    answer = subprocess.run(program, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
