"""Check a release: build wheel and sdist, look into them, install the wheel alone, and run the first tutorial from it.

python tests/release_check.py [--quick] [--python PROGRAM]...

It needs nothing but Python, Git and a package index. The tutorial runs in an empty folder outside the checkout, as by
somebody who has the wheel alone: once for each `--python`, by default for the Python that runs this. `--quick` learns a
rough shape. Wheel and sdist are left in out/release.
"""

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
DIST = REPOSITORY / "out" / "release"
TUTORIAL = REPOSITORY / "docs" / "tutorial.md"
OURS = {"PYTHONPATH", "VIRTUAL_ENV", "PYTHONDONTWRITEBYTECODE"}
"""Variables that would lead a new environment back to this one."""
ROUGH = ["--profile", "quick", "--at-most", "120"]


def run(*words: str | Path, where: Path = REPOSITORY) -> None:
    """Run a command and say which; stop where it fails."""
    print("+", shlex.join(map(str, words)), flush=True)
    variables = {name: value for name, value in os.environ.items() if name not in OURS}
    subprocess.run([str(word) for word in words], cwd=where, env=variables, check=True)


def environment(python: str, folder: Path) -> Path:
    """Give the folder of programs of a new, empty environment."""
    run(python, "-m", "venv", folder)
    return folder / ("Scripts" if os.name == "nt" else "bin")


def built(tools: Path) -> Path:
    """Build both distributions, check them, and give the wheel."""
    run(tools / "pip", "install", "--quiet", "build", "twine")
    for old in DIST.glob("keepout_gnc-*"):
        old.unlink()
    run(tools / "python", "-m", "build", "--outdir", DIST)
    files = sorted(DIST.glob("keepout_gnc-*"))
    run(tools / "twine", "check", "--strict", *files)
    (wheel,) = (file for file in files if file.suffix == ".whl")
    (source,) = (file for file in files if file.suffix == ".gz")
    look_into(wheel, source)
    return wheel


def look_into(wheel: Path, source: Path) -> None:
    """Compare the wheel's files with those of the package that Git keeps."""
    kept = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "src/keepout"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    wanted = {name.removeprefix("src/") for name in kept if (REPOSITORY / name).is_file()}
    with zipfile.ZipFile(wheel) as opened:
        held = {name for name in opened.namelist() if ".dist-info/" not in name}
    if held != wanted:
        raise SystemExit(f"{wheel.name}: lacks {sorted(wanted - held)}, has besides {sorted(held - wanted)}")
    with tarfile.open(source) as opened:
        tops = {name.split("/")[1] for name in opened.getnames() if "/" in name}
    print(f"{wheel.name}: the package's {len(held)} files and no others; {source.name}: {', '.join(sorted(tops))}")


def tutorial(programs: Path, folder: Path, *, quick: bool) -> None:
    """Run the tutorial's program and commands, and look at what came of the flight."""
    text = TUTORIAL.read_text(encoding="utf-8")
    blocks = re.findall(r"^```(console|python)\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)
    mesh = next(code for language, code in blocks if language == "python")
    (folder / "satellite.py").write_text(mesh, encoding="utf-8")
    run(programs / "python", "satellite.py", where=folder)
    lines = [line for language, block in blocks if language == "console" for line in block.splitlines()]
    for line in lines:
        words = shlex.split(line)
        if words[:1] == ["keepout"]:
            rough = ROUGH if quick and words[1] == "fit" else []
            run(programs / "keepout", *words[1:], *rough, where=folder)
    summary = json.loads((folder / "out" / "mission" / "summary.json").read_text(encoding="utf-8"))
    if summary["contact_verdict"] != "no" or summary["start_certified"] is not True or not summary["reached"]:
        raise SystemExit(f"the tutorial's flight: {summary}")
    print("the tutorial's flight: no contact, proved; certified from its start; goal reached")


def main() -> None:
    """Build, look, install, run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="learn a rough shape")
    parser.add_argument("--python", action="append", metavar="PROGRAM", help="to install into and run with")
    asked = parser.parse_args()
    DIST.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        wheel = built(environment(sys.executable, Path(scratch) / "tools"))
        for number, python in enumerate(asked.python or [sys.executable]):
            programs = environment(python, Path(scratch) / f"empty-{number}")
            run(programs / "pip", "install", "--quiet", wheel)
            folder = Path(scratch) / f"tutorial-{number}"
            folder.mkdir()
            tutorial(programs, folder, quick=asked.quick)


if __name__ == "__main__":
    main()
