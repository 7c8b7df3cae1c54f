"""Say whether the commands do the same as at another commit: what they print with `--json`, and what they write.

    python benchmarks/unchanged.py de71863                # this tree against that commit
    python benchmarks/unchanged.py de71863 --only fly case1

Each job is run from both sources, in folders of the same name, and compared: JSON and TOML entry by entry, flights and
campaigns column by column, to the last bit; pages and pictures by their names alone. Times, versions and digests of the
scenario's own text are left out. What the other commit gave is kept, so that it is run once.
"""

import argparse
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet

ROOT = Path(__file__).parents[1]
KEPT = ROOT / "out" / "unchanged"
FLIES = ("case1", "faults")
JOBS = {
    "targets": "targets --json",
    "describe": "describe tiangong --json",
    "measure": "measure {fields}/intelsat30.keepout --json",
    "check": "scenario check {examples}/case1.toml --json",
    **{f"fly {name}": f"fly {{examples}}/{name}.toml -o out --json" for name in FLIES},
    "campaign": "campaign {examples}/campaign.toml --runs 64 -o out --json",
    "rare": "rare {examples}/faults.toml --below 0.5 --runs 2 --flights 64 -o out --json",
    "explore": "explore {examples}/explore.toml -o out --json",
    "inspect": "inspect {examples}/inspect.toml -o out --json",
    "reproduce": "reproduce case1 --quick -o out --json",
}
TIMES = re.compile(r"(seconds|_ms$|_us|cpu|version|created|elapsed|(^|_)wall|machine|rate$|per_s|built|saved)")


def differences(one, other, where: str = "") -> Iterator[str]:
    """Name the entries in which two JSON values differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in sorted({*one, *other}):
            if key not in one or key not in other:
                yield f"{where}.{key}: only {'here' if key in one else 'there'}"
            elif not TIMES.search(key):
                yield from differences(one[key], other[key], f"{where}.{key}")
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for place, pair in enumerate(zip(one, other, strict=True)):
            yield from differences(*pair, f"{where}[{place}]")
    elif one != other and not (isinstance(one, float) and isinstance(other, float) and math.isnan(one * other)):
        yield f"{where}: {str(one)[:80]} here, {str(other)[:80]} there"


def table_differences(one: Path, other: Path) -> Iterator[str]:
    """Name the columns in which two Parquet files differ, and the entries of their headers."""
    a, b = pyarrow.parquet.read_table(one), pyarrow.parquet.read_table(other)
    for name in sorted({*a.column_names, *b.column_names}):
        if name not in a.column_names or name not in b.column_names:
            yield f"column {name}: only {'here' if name in a.column_names else 'there'}"
        elif not TIMES.search(name) and not a[name].combine_chunks().equals(b[name].combine_chunks()):
            yield f"column {name}"


def compared(here: Path, there: Path) -> Iterator[str]:
    """Name what differs between two folders of results."""
    names = {path.relative_to(folder) for folder in (here, there) for path in folder.rglob("*") if path.is_file()}
    for name in sorted(names):
        one, other = here / name, there / name
        if not one.exists() or not other.exists():
            yield f"{name}: only {'here' if one.exists() else 'there'}"
        elif name.suffix == ".json":
            said = (json.loads(path.read_text().replace(str(of), "")) for path, of in ((one, here), (other, there)))
            yield from (f"{name}{found}" for found in differences(*said))
        elif name.suffix in (".parquet", ".flight"):
            yield from (f"{name}: {found}" for found in table_differences(one, other))
        elif name.suffix in (".toml", ".txt") and one.read_text() != other.read_text():
            yield f"{name}: other text"


def run(source: Path, words: str, folder: Path) -> None:
    """Run one command from a source tree, with its own cache, and keep what it prints in `stdout.json`."""
    # Records name the mission's file: of both sources it is the same, here.
    shutil.copytree(source / "examples", folder / "examples", ignore=shutil.ignore_patterns("__pycache__"))
    environment = os.environ | {"PYTHONPATH": str(source / "src"), "KEEPOUT_CACHE": str(KEPT / "cache")}
    places = {"examples": "examples", "fields": source / "src/keepout/data/fields"}
    command = [sys.executable, "-m", "keepout.cli", *words.format(**places).split()]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    text = re.sub(re.escape(str(source)), "", done.stdout)
    (folder / "stdout.json").write_text(text if text.strip() else "null")
    (folder / "end.json").write_text(
        json.dumps({"code": done.returncode, "refusal": done.stderr if done.returncode else ""})
    )


def main() -> int:
    """Run all jobs from both sources and print what differs."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("commit", help="the other commit")
    parser.add_argument("--only", nargs="+", metavar="JOB", help=f"these jobs: {', '.join(JOBS)}")
    given = parser.parse_args()
    commit = subprocess.run(["git", "rev-parse", given.commit], cwd=ROOT, check=True, capture_output=True, text=True)
    kept, changed = KEPT / commit.stdout.strip()[:12], 0
    with tempfile.TemporaryDirectory() as temporary:
        other = Path(temporary) / "source"
        subprocess.run(["git", "worktree", "add", "--detach", "--quiet", other, given.commit], cwd=ROOT, check=True)
        try:
            for name in given.only or JOBS:
                there, here = kept / name, KEPT / "here" / name
                if not (there / "end.json").exists():
                    shutil.rmtree(there, ignore_errors=True)
                    run(other, JOBS[name], there)
                shutil.rmtree(here, ignore_errors=True)
                run(ROOT, JOBS[name], here)
                found = list(compared(here, there))
                code = json.loads((here / "end.json").read_text())["code"]
                sys.stdout.write(
                    f"{name}: exit {code}, {len(found)} differences\n" + "".join(f"    {f}\n" for f in found)
                )
                sys.stdout.flush()
                changed += bool(found)
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", other], cwd=ROOT, check=True)
    return changed > 0


if __name__ == "__main__":
    sys.exit(main())
