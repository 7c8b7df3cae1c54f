"""Break the core on purpose, one slip of the pen at a time, and see which tests notice.

    python benchmarks/mutants.py                     # every mutant against the tests of its room
    python benchmarks/mutants.py --only "left out for ever"
    python benchmarks/mutants.py --then core/mission core/flight --all

A mutant is a text that occurs once in a file of src/keepout and what takes its place: a sign, a bound, a dropped term,
another axis. Each is a real fault, of which some promise of the product no longer holds. The source is copied, the copy
is changed, and the tests run on the copy until one fails: the files most likely to notice, then the room's folder, then
with `--then` further folders and with `--all` everything. A row says which test noticed; rows are kept as they come,
and a later call goes on from them. What survives is a test that is missing.
"""

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from kept_rows import show

ROOT = Path(__file__).parents[1]
KEPT = ROOT / "out" / "mutants.jsonl"
NOTHING_RAN, OUT_OF_TIME = 5, (124, 137)
"""Exit codes of pytest, and of `timeout`."""
ALSO = {
    "core/guard/braking.py": "core/mission",
    "core/control/velocity.py": "core/flight",
}
"""A second room whose tests are about a file."""
BUILT = ("core/fields", "core/geometry", "core/proof")
"""Rooms that fields are built by: nothing that an earlier run built is taken for what a mutant of these would build."""

# For each file (name, text, what takes its place, what is tried first: names of files of tests,
# each with the part of a test's name to look for, where not all of the file is meant).
MUTANTS = {
    "core/guard/guard.py": [
        ("sagitta left out", "(sagitta + moved)", "moved", "mutants_found"),
        ("speed without its radius", "self.braking.velocity_radius + faster", "faster", "invariance:speed"),
        ("segment at half slope", "values[1:] - self.lipschitz", "values[1:] - 0.5 * self.lipschitz", "invariance"),
        ("newest command lost", "chosen[None]])[1:]", "chosen[None]])[:-1]", "invariance:within_their_bounds"),
        ("contradiction flown on", "told & ~wrong", "told", "guard:contradicts"),
        ("left out for ever", "~lost & ~state.left_out", "~lost", "guard:explains"),
        ("safe from one state only", "moved = away + faster", "moved = faster", "mutants_found"),
        ("start by its place alone", "longer * a.velocity_error + joints", "joints", "start"),
        ("flies on when expired", "estimate.time > a.", "estimate.time > 60.0 + a.", "guard:out_of_date"),
    ],
    "core/guard/watch.py": [
        ("window a step too wide", "T * (place + 1) + turned", "T * (place + 2) + turned", "watch"),
        ("region by range alone", "return far |", "return far &", "guard:flags"),
    ],
    "core/guard/observer.py": [
        ("observer begun afar", "most[0] - errors[0],", "most[0],", "guard:begins"),
    ],
    "core/guard/braking.py": [
        ("bow without the reserve", "bow = T**2 / 8.0 * (reserve + D", "bow = T**2 / 8.0 * (D", "invariance:worst"),
        ("turning not in D", "(scale + self.turning_error)", "scale", "assumptions:inertial disturbance_bound"),
    ],
    "core/guard/responses.py": [
        ("stop half a step short", "+ 0.5 * rest * T", "", "invariance"),
        ("past pushes forgotten", "(pushed + pushed_before)[0]", "pushed[0]", "observer_radii"),
    ],
    "core/proof/bounds.py": [
        ("remainder not carried on", "= s * left + 0.5 * (upper - lower)", "= s * left", "bounds"),
        ("float32 as float64", "unit = UNIT32 if network.single else", "unit =", "bounds"),
    ],
    "core/proof/slope.py": [
        (
            "least for largest slope",
            "above = max(above, 1.0 - small",
            "above = min(above, 1.0 - small",
            "slope_bounds:random",
        ),
        ("second order left out", "= size * delta + steepest", "= steepest", "slope_bounds:random"),
        ("cubes by their middles", "+ reach >= clearance", ">= clearance", "mutants_found"),
    ],
    "core/proof/certificate.py": [
        ("slanted box as thin as a plane", "slant[rows, k] = np.abs(thick)", "slant[rows, k] = 0.0", "mutants_found"),
        ("held beyond the target", "np.where(reach < r + beyond,", "np.where(reach < np.inf,", "mutants_found"),
    ],
    "core/proof/grid.py": [
        ("cell without its spread", "np.hypot(radius, h) - radius + (c", "(c", "grid_field grid:contact"),
        ("lowering does not change", "* cells.side * change", "* 0.0", "mutants_found"),
    ],
    "core/audit/tube.py": [
        ("pulses leave no room", "* tau**2 + self.excursion", "* tau**2", "pulsed"),
        ("half of Coriolis", "unknown + 2.0 * rate", "unknown + rate", "audit:tube"),
        ("blocks without travel", "excess[b] = max(excess[b], ", "excess[b] = min(excess[b], ", "mutants_found"),
        ("range at the sample only", "away + fastest * step[k] >", "away >", "mutants_found"),
        ("better end decides", "max(max(sqrt(forwards)", "max(min(sqrt(forwards)", "mutants_found"),
    ],
    "core/audit/audit.py": [
        ("clearance as found", "float(bound.lower[i])", "float(bound.upper[i])", "audit:said"),
        ("balls that overlap walls", "0.9 * free * _D", "1.5 * free * _D", "audit:said"),
    ],
    "flights/exchange/passage.py": [
        ("nearer end for farther", "est = np.maximum(", "est = np.minimum(", "audit_of_files")
    ],
    "flights/thrusters/on_off.py": [
        ("half an excursion", "period**2 / 32.0", "period**2 / 64.0", "thrusters:nearly_met"),
        (
            "fault a step short",
            "None else math.ceil(detection_time",
            "None else math.floor(detection_time",
            "thrusters:stuck",
        ),
    ],
    "core/motion/disturbance.py": [("largest for sum", "np.sum(np.abs(a", "np.max(np.abs(a", "disturbance:sum")],
    "core/motion/chaser.py": [
        ("thrown aside too little", "3.0 * jnp.cross(turn", "1.0 * jnp.cross(turn", "pulses:switch")
    ],
    "core/mission/bounds.py": [("middle inertia for least", "inertia)[0]", "inertia)[1]", "orbit_bounds:torque")],
    "core/mission/surroundings.py": [
        ("gains only added", " + gain_error * self.gain_error", "", "disturbance_bound:compound"),
        ("gravity too far out", "_radius - max(", "_radius + max(", "assumptions:gravity"),
        ("shorter delay unnoticed", "if faults.delay !=", "if faults.delay >", "assumptions:beyond"),
    ],
    "core/fields/continuation.py": [
        ("rises like a distance", "self._rise(r) - self._rise(psi)", "r - psi", "neural_field:continuation"),
        ("allowance added", "added, 0.0) - self._low", "added, 0.0) + self._low", "neural_field:autodiff"),
    ],
    "core/fields/grid.py": [
        ("last cell left out", "jnp.int32), 0, BLOCK - 1)", "jnp.int32), 0, BLOCK - 2)", "grid_field")
    ],
    "apps/unknown/map_field.py": [
        ("half a cell of error", "hypot(radius, float", "hypot(radius, 0.5 * float", "map_field:bound")
    ],
    "apps/unknown/rule.py": [
        ("cube as its inner ball", "0.5 * math.sqrt(3.0) * spacing", "0.5 * spacing", "rule"),
        ("attitude taken as exact", "+ distance * rule.attitude_error", "", "rule"),
        ("window a pixel short", "+ spread) / below) + middle + SLACK", "+ spread) / below) + middle - 1.0", "rule"),
    ],
    "apps/unknown/known_free.py": [("ball by the near face", "- (low + self.spacing)", "- low", "known_free:ball")],
    "apps/inspection/seeing/visible.py": [
        ("steep by its nearest corner", "steepest * far", "steepest * near", "visible:rules")
    ],
    "apps/inspection/seeing/sightlines.py": [
        ("half under is all under", "high <= bottom", "low <= bottom", "sightlines")
    ],
    "apps/inspection/seeing/room.py": [
        ("beam by its far edge", "= max(abs(wx) - half", "= max(abs(wx) + half", "beam")
    ],
    "apps/inspection/seeing/seeable.py": [
        ("shadow of a middle", "- half * (abs(edges", "- 0.0 * (abs(edges", "seeable")
    ],
    "flights/campaign/dataset.py": [
        ("bands of another flight", '"bands": digest(np.frombuffer(sketch, np.uint8))', "", "campaign:torn"),
    ],
    "flights/campaign/results.py": [
        ("undecided not counted", "touched | undecided", "touched & undecided", "results:rates"),
    ],
    "flights/campaign/flying.py": [
        ("best kept for worst", "clearance))][:keep]", "clearance))][::-1][:keep]", "campaign:worst"),
    ],
    "core/control/velocity_program.py": [("wrong side of the plane", "(along + rate)", "(along - rate)", "cone:half")],
    "core/control/velocity.py": [("faster than it can brake", "(2.0 * self.auth", "(4.0 * self.auth", "controller")],
    "core/control/controller.py": [("error adds to the barrier", "barrier - square", "barrier + square", "tracking")],
    "core/geometry/distance.py": [
        ("box by another axis", "y - upper[node, 1]", "y - upper[node, 0]", "exact_distance")
    ],
    "core/geometry/octree.py": [
        ("cells of the inner ball", "half_width * SQRT3", "half_width", "exact_distance:level")
    ],
}


class Mutant(NamedTuple):
    """One change: `text` occurs once in `file` of src/keepout, and `instead` takes its place."""

    file: str
    name: str
    text: str
    instead: str
    first: str

    def write(self, source: Path) -> None:
        """Change the copy of the source.

        Raises:
            SystemExit: the text does not occur once, or what it becomes is not Python.

        """
        path = source / "keepout" / self.file
        before = path.read_text(encoding="utf-8")
        if before.count(self.text) != 1:
            sys.exit(f"mutant {self.name!r}: {self.text!r} occurs {before.count(self.text)} times in {self.file}")
        after = before.replace(self.text, self.instead)
        compile(after, str(path), "exec")
        path.write_text(after, encoding="utf-8")

    def stages(self, tests: Path, then: list[str], everything: bool) -> list[str]:
        """Give what is run after what: files, with ":" and a part of a name perhaps, and folders that are there."""
        room = str(Path(*Path(self.file).parts[:2]))
        # A room's own file comes before another's of the same name.
        paths = sorted(tests.rglob("test_*.py"), key=lambda path: path.is_relative_to(tests / room))
        named = {path.stem.removeprefix("test_"): str(path.relative_to(tests)) for path in paths}
        first = [hint.partition(":") for hint in self.first.split()]
        rooms = [folder for folder in (room, ALSO.get(self.file), *then) if folder and (tests / folder).exists()]
        files = [named[name] + colon + part for name, colon, part in first if name in named]
        return [*files, *rooms, *(["."] if everything else [])]


def mutants() -> list[Mutant]:
    """All of them."""
    return [Mutant(file, *numbers) for file, some in MUTANTS.items() for numbers in some]


class Bench:
    """A copy of the source and how tests are run on it.

    Args:
        tests: folder of tests; beside it stands the source that they are of.
        limit: seconds that a stage may take.

    """

    def __init__(self, tests: Path, limit: float):
        self.tests, self.limit, self.original = tests, limit, tests.parent / "src"
        # Always the same place, with the files' own times: numba and Python know again what they compiled.
        self.folder = Path(tempfile.gettempdir()) / f"mutants-{hashlib.sha256(str(tests).encode()).hexdigest()[:12]}"
        self.copy = self.folder / "src"

    def run(self, mutant: Mutant, stages: list[str]) -> tuple[str | None, list[str]]:
        """Give the test that noticed, if one did, and the stages that ended without."""
        shutil.rmtree(self.copy, ignore_errors=True)
        shutil.copytree(self.original, self.copy, ignore=shutil.ignore_patterns("*.nb[ci]"))
        mutant.write(self.copy)
        module = "keepout." + mutant.file.removesuffix(".py").replace("/", ".")
        with tempfile.TemporaryDirectory() as fresh:
            environment = self._environment(mutant, Path(fresh))
            place = self._python(["-c", f"import {module} as m; print(m.__file__)"], environment).stdout.strip()
            if not place:
                sys.exit(f"mutant {mutant.name!r}: {module} cannot be imported; it is to be a fault, not a wreck")
            if not Path(place).is_relative_to(self.copy):
                sys.exit(f"mutant {mutant.name!r}: the tests would import {place}, not the copy in {self.copy}")
            survived: list[str] = []
            for stage in stages:
                found, ended = self._noticed(stage, survived, environment)
                if found is not None:
                    return found, survived
                survived += [stage] if ended else []
        return None, survived

    def _environment(self, mutant: Mutant, fresh: Path) -> dict[str, str]:
        file = self.copy / "keepout" / mutant.file
        compiled = fresh if "@kernel(" in file.read_text(encoding="utf-8") else self.folder
        built = fresh if str(Path(mutant.file).parent) in BUILT else self.folder
        places = {
            "NUMBA_CACHE_DIR": compiled / "numba",
            "KEEPOUT_CACHE": built / "fields",
        }
        for place in places.values():
            place.mkdir(parents=True, exist_ok=True)
        given = os.environ | {name: str(place) for name, place in places.items()}
        given.pop("PYTHONDONTWRITEBYTECODE", None)
        return given | {"PYTHONPATH": str(self.copy)}

    def _python(self, arguments: list[str], environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
        command = ["timeout", "--kill-after=10", f"{self.limit:g}", sys.executable, *arguments]
        return subprocess.run(command, cwd=self.tests.parent, env=environment, text=True, capture_output=True)

    def _noticed(self, stage: str, done: list[str], environment: dict[str, str]) -> tuple[str | None, bool]:
        """Give the test of a stage that failed, and whether the stage came to its end in time."""
        path, _, part = stage.partition(":")
        options = ["-m", "pytest", "-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", str(self.tests / path)]
        options += ["-k", part] if part else [f"--ignore={self.tests / name}" for name in done]
        ended = self._python(options, environment)
        failed = re.search(r"^(?:FAILED|ERROR) (\S+)", ended.stdout, re.MULTILINE)
        if failed is not None:
            return failed.group(1).rsplit("/tests/", 1)[-1].removeprefix("tests/"), True
        if ended.returncode not in (0, NOTHING_RAN, *OUT_OF_TIME):
            sys.exit(f"{stage}: pytest ended with {ended.returncode}:\n{ended.stdout[-3000:]}{ended.stderr}")
        return None, ended.returncode not in OUT_OF_TIME


def rows_of(path: Path) -> dict[str, dict]:
    """Give the last row of each mutant that is kept."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return {row["name"]: row for row in map(json.loads, lines)}


def main() -> None:
    """Try mutants, and say which survive."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these mutants")
    parser.add_argument("--tests", type=Path, default=ROOT / "tests", help="folder of tests, beside its src")
    parser.add_argument("--out", type=Path, default=KEPT, help="JSON lines, one a mutant tried")
    parser.add_argument("--first", action="store_true", help="only what is tried first, no folder")
    parser.add_argument("--then", nargs="+", default=[], metavar="FOLDER", help="further folders for survivors")
    parser.add_argument("--all", action="store_true", help="at last, all tests for survivors")
    parser.add_argument("--limit", type=float, default=360.0, help="seconds of a stage, else undecided")
    given = parser.parse_args()
    known, bench = {mutant.name: mutant for mutant in mutants()}, Bench(given.tests.resolve(), given.limit)
    wrong = [name for name in given.only or () if name not in known]
    if wrong:
        sys.exit(f"no mutant is called {wrong[0]!r}; there are: {', '.join(known)}")
    given.out.parent.mkdir(parents=True, exist_ok=True)
    for name in given.only or known:
        row = rows_of(given.out).get(name, {"killed_by": None, "survived": [], "seconds": 0.0})
        stages = known[name].stages(bench.tests, given.then, given.all)
        stages = [stage for stage in stages if ".py" in stage] if given.first else stages
        left = [stage for stage in stages if stage not in row["survived"]]
        if row["killed_by"] is not None or not left:
            continue
        began = time.perf_counter()
        killed, survived = bench.run(known[name], left)
        seconds = round(row["seconds"] + time.perf_counter() - began, 1)
        tried = [*row["survived"], *survived]
        row = {"name": name, "file": known[name].file, "killed_by": killed, "seconds": seconds, "survived": tried}
        with given.out.open("a", encoding="utf-8") as out:
            out.write(json.dumps(row) + "\n")
        sys.stderr.write(f"{name}: {killed or 'SURVIVES'} ({seconds:g} s)\n")
    rows = [rows_of(given.out)[name] for name in given.only or known]
    show(rows, ("name", "file", "killed_by", "seconds"))
    alive = [row["name"] for row in rows if row["killed_by"] is None]
    sys.stdout.write(f"\n{len(rows) - len(alive)} of {len(rows)} are noticed; {', '.join(alive) or 'none'} survive\n")


if __name__ == "__main__":
    main()
