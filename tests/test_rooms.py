"""The rooms and their one direction of travel: the contracts of pyproject.toml hold, and would catch a break."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]

BREAKS = {
    "The audit never imports what it judges": ("core/audit/tube.py", "from keepout.core.control import law"),
    "The guard never imports the law": ("core/guard/braking.py", "from keepout.core.control.law import Law"),
    "A proof never imports what made the field": ("core/proof/bounds.py", "from keepout.core.learning import losses"),
    "Fields never import control": ("core/fields/grid.py", "from keepout.core.control import law"),
    "A mesh enters at the bottom": ("core/geometry/distance.py", "from keepout.core.mission import scenario"),
    "A storey imports nothing from above": ("core/flight/batches.py", "from keepout.flights.campaign import plan"),
    "No circle of imports": ("core/motion/orbit.py", "from keepout.core.motion import relative"),
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


@pytest.mark.long
def test_each_deliberate_break_is_caught(tmp_path):
    """`make lint` says that all contracts are kept; here each break is found where it was made."""
    package = tmp_path / "src" / "keepout"
    shutil.copytree(REPOSITORY / "src" / "keepout", package, ignore=shutil.ignore_patterns("data", "__pycache__"))
    shutil.copy(REPOSITORY / "pyproject.toml", tmp_path)
    for path, line in BREAKS.values():
        with (package / path).open("a", encoding="utf-8") as source:
            source.write(f"\n{line}\n")
    answer = lint(tmp_path)
    assert answer.returncode != 0
    told = " ".join(answer.stdout.split())
    verdicts, found = told.split("Broken contracts", 1)
    for contract, (path, line) in BREAKS.items():
        verdict = re.search("KEPT|BROKEN", verdicts.partition(contract)[2])
        assert verdict is not None
        assert verdict[0] == "BROKEN", contract
        importer = path.removesuffix(".py").replace("/", ".").removeprefix("core.motion")
        assert f"{importer} -> {line.split()[1].removeprefix('keepout.core.motion')}" in found, contract
