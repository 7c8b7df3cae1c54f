"""What tools say of the exported C, by folders that `flight_code.py answers` has left: each part gives its rows.

A tool that is not there is named, and its part has a row that says so.
"""

import argparse
import collections
import gzip
import json
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import flight_code_stored as stored

from keepout.apps.flight_code.folder import sources

Rows = list[dict[str, Any]]
HARNESS = Path(__file__).parent / "flight_code_harness"
STRICT = ["-std=c99", "-ffp-contract=off", "-Wall", "-Wextra", "-Wconversion", "-pedantic"]
BUILDS = [
    *[(compiler, f"-O{level}", "") for compiler in ("gcc", "clang") for level in (0, 1, 2, 3, "s")],
    *[
        (f"{name}-linux-gnu-gcc", "-O2 -static", runner)
        for name, runner in (
            ("aarch64", "qemu-aarch64"),
            ("riscv64", "qemu-riscv64"),
            ("sparc64", "qemu-sparc64"),
            ("powerpc", "qemu-ppc"),
        )
    ],
]
DEVIATIONS = {
    "2.2": "with one number in the disturbance's model, or no latency, a product is by 1 or a sum with 0",
    "2.4": "an enumeration without a tag is a list of constants",
    "2.5": "sizes that only a mission with sensors uses",
    "8.7": "fly_mission.c, which is none of the step, measures by the same function",
    "9.3": "none: a structure is copied whole; the tool takes it for an array begun in part",
    "10.6": "none: 0 or 1 of a condition, of the type that it is assigned to",
    "10.8": "a sum or product of small whole numbers is widened: its parts are far below the smaller type's limit",
    "12.1": "none: each operand of the conditional is in parentheses",
    "14.1": "the loop ends by its counter, or at once by what does not change in it",
    "17.7": "none: these functions give nothing; the tool takes a cast of an argument for a call",
    "21.14": "the eight bytes by which an image begins are compared, all of them",
    "21.15": "the bits of a number are copied into one of another type: a cast would be an alias",
}
"""Reasons for the MISRA C:2012 rules from which the sources deviate; one that is missing is reported as such."""
UNREACHED = {
    "keepout_guard.c": "second bounds of loops beside the mission's own; windows of no length; an estimate that is no "
    "number and yet a jump; a mission whose numbers expire",
    "keepout_known_set.c": "balls of no radius, or about one centre; commands older than the latency",
    "keepout_navigation.c": "second bounds of loops; more samples left out than can be counted; a quaternion of 0",
    "keepout_law.c": "a field without a gradient, or numbers that are none at a finite place; second bounds of loops",
    "keepout_math.c": "second bounds of loops beside the mission's own delay",
    "keepout_motion.c": "second bounds of loops beside the mission's own substeps",
    "keepout_spline.c": "nodes outside the tables, of which the packing leaves none within the domain",
    "keepout_tables.c": "lengths beyond the image after a checksum that holds; a mission without a way to the goal",
}
"""Why branches of a file are left, file by file."""


def found(tool: str) -> bool:
    """Whether a tool is there."""
    return shutil.which(tool) is not None


def row(evidence: str, asked: str, reached: str, **more: Any) -> dict[str, Any]:
    """Give one line of the table."""
    return {"evidence": evidence, "asked": asked, "reached": reached, **more}


def refreshed(folder: Path) -> list[str]:
    """Put today's sources into a mission's folder: the step's own and its tables."""
    for name, content in sources().items():
        if name.endswith((".c", ".h")) and "/" not in name:
            (folder / name).write_bytes(content)
    return [path.name for path in sorted(folder.glob("keepout_*.c"))] + ["mission_tables.c"]


def run(command: list[str], folder: Path, limit: float | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder; its words are kept."""
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=limit, check=False)


def built(folder: Path, program: str, sources_: list[str], flags: list[str], compiler: str = "gcc") -> None:
    """Build a program in a mission's folder."""
    command = [compiler, "-std=c99", "-ffp-contract=off", *flags, "-I.", "-o", program, *sources_, "-lm"]
    done = run(command, folder)
    if done.returncode:
        raise SystemExit(f"{folder.name}: {' '.join(command[:6])}: {done.stderr[:800]}")


def senses(folder: Path) -> bool:
    """Whether a mission has sensors: else nothing of navigation is compiled."""
    return "KEEPOUT_SENSORS 0\n" not in (folder / "mission_sizes.h").read_text(encoding="utf-8")


def bits(options: argparse.Namespace, folders: list[Path]) -> Rows:
    """Build and run the self-test by each compiler that is there: one hash."""
    hashes: collections.Counter = collections.Counter()
    builds: list[str] = []
    missing: list[str] = []
    sensing = [folder for folder in folders if senses(folder)][-1:]
    for folder in dict.fromkeys([*folders[:1], *folders[-1:], *sensing]):
        files = [*refreshed(folder), "selftest.c"]
        said = set()
        for compiler, flags, runner in BUILDS:
            name = f"{compiler} {flags.split()[0]}"
            if not found(compiler) or (runner and not found(runner)):
                missing.append(name)
                continue
            built(folder, "bits", files, ["-w", *flags.split()], compiler)
            done = run([*([runner] if runner else []), "./bits", "tables.bin"], folder)
            said.add(done.stdout.strip() if done.returncode == 0 else f"{name}: {done.stderr.strip()}")
            builds.append(name)
        hashes[len(said)] += 1
    same = "identical" if set(hashes) == {1} else "not identical"
    reached = (
        f"{same} over {len(set(builds))} builds of {sum(hashes.values())} missions: {', '.join(dict.fromkeys(builds))}"
    )
    reached += f"; not installed: {', '.join(dict.fromkeys(missing))}" if missing else ""
    return [row("bits of the self-test's answers", "one hash over gcc and clang, -O0 to -O3, five processors", reached)]


def eva(options: argparse.Namespace, folders: list[Path]) -> Rows:
    """Let Frama-C Eva look for run-time errors."""
    asked = "0 alarms, all inputs, memories and tables unknown"
    if not found("frama-c"):
        return [row("Frama-C Eva", asked, "skipped: frama-c is not installed")]
    reached, alarms = [], 0
    # Missions that between them have most of the code come first.
    parts = ("strong", "gravity", "24-thrusters", "laser", "pose", "GNSS")
    first = [folder for part in parts for folder in folders if part in folder.name]
    for folder in [*first, *[folder for folder in folders if folder not in first]][: options.eva]:
        # By whole paths: it takes others from where its caller is.
        files = [str((folder / name).resolve()) for name in refreshed(folder)]
        include = f"-cpp-extra-args=-I{folder.resolve()}"
        command = ["frama-c", "-eva", "-machdep", "gcc_x86_64", include, "-c11", "-eva-precision", "2"]
        command += ["-eva-auto-loop-unroll", "128", "-eva-split-return", "auto", "-warn-special-float", "none"]
        said = run([*command, str(HARNESS / "eva.c"), *files], folder).stdout
        (folder / "eva.txt").write_text(said, encoding="utf-8")
        if "ANALYSIS SUMMARY" not in said:
            reached.append(f"{folder.name}: not finished")
            continue
        count = said.count("[eva:alarm]")
        alarms += count
        statements = re.search(r"(\d+) statements reached \(out of (\d+)\)", said)
        of = f", {statements[1]} of {statements[2]} statements" if statements else ""
        reached.append(f"{folder.name}: {count} alarms{of}")
    return [row("Frama-C Eva", asked, "; ".join(reached), alarms=alarms)]


def style(options: argparse.Namespace, folders: list[Path]) -> Rows:
    """Ask compilers for warnings, and cppcheck for MISRA's rules."""
    some = [*folders[:1], *[folder for folder in folders if senses(folder)]]
    words = []
    for compiler in ("gcc", "clang"):
        if found(compiler):
            said = ""
            for folder in some:
                files = [*refreshed(folder), "selftest.c", "fly_mission.c"]
                said += run([compiler, *STRICT, "-O2", "-fsyntax-only", *files], folder).stderr
            words.append(f"{compiler}: {said.count('warning:') or 'silent'}")
    rows = [row("warnings, -Wall -Wextra -Wconversion -pedantic", "silent", ", ".join(words))]
    asked = "every remaining deviation listed with its reason"
    if not found("cppcheck"):
        return [*rows, row("MISRA C:2012 by cppcheck", asked, "skipped: cppcheck is not installed")]
    command = ["cppcheck", "--addon=misra", "--enable=style", "--std=c99", "--quiet", "--template={id} {file} {line}"]
    lines: set[str] = set()
    for folder in some:
        files = [name for name in refreshed(folder) if name != "mission_tables.c"]
        said = run([*command, "--inline-suppr", *files], folder)
        lines |= {line for line in said.stderr.splitlines() if line.startswith("misra-c2012-")}
    counted = collections.Counter(line.split()[0].removeprefix("misra-c2012-") for line in lines)
    listed = [
        {"rule": rule, "count": count, "reason": DEVIATIONS.get(rule, "no reason yet")}
        for rule, count in sorted(counted.items(), key=lambda one: [int(part) for part in one[0].split(".")])
    ]
    without = [one["rule"] for one in listed if one["reason"] == "no reason yet"]
    (folders[0] / "misra.txt").write_text("\n".join(sorted(lines)), encoding="utf-8")
    reached = f"{sum(counted.values())} of {len(counted)} rules" + (f"; no reason for {without}" if without else "")
    return [*rows, row("MISRA C:2012 by cppcheck", asked, reached, deviations=listed)]


def coverage(options: argparse.Namespace, folders: list[Path]) -> Rows:
    """Count lines and branches that stored steps, self-tests and a little fuzzing reach, over all missions."""
    asked = "100 % of lines, ≥ 95 % of branches, reasons for the rest"
    if not found("gcov"):
        return [row("coverage", asked, "skipped: gcov is not installed")]
    lines: collections.Counter = collections.Counter()
    branches: collections.Counter = collections.Counter()
    for folder in folders:
        files = refreshed(folder)
        with tempfile.TemporaryDirectory() as room:
            objects = []
            for name in files:
                objects.append(f"{room}/{name[:-2]}.o")
                command = [
                    "gcc",
                    "-std=c99",
                    "-ffp-contract=off",
                    "-O0",
                    "--coverage",
                    "-I.",
                    "-c",
                    "-o",
                    objects[-1],
                    name,
                ]
                if run(command, folder).returncode:
                    raise SystemExit(f"{folder.name}: {name} is not compiled")
            for program in ("replay", "fuzz"):
                built(folder, program, [str(HARNESS / f"{program}.c"), *objects], ["--coverage", "-w"])
            built(folder, "selftest", ["selftest.c", *objects], ["--coverage", "-w"])
            for words in (
                ["./replay", "tables.bin", stored.NAME, stored.FIELDS],
                ["./fuzz", "tables.bin", "20000", "7"],
            ):
                if (done := run(words, folder)).returncode:
                    raise SystemExit(f"{folder.name}: {done.stdout[-200:]}{done.stderr[-200:]}")
            run(["./selftest", "tables.bin"], folder)
            names = [name[:-2] for name in files if name != "mission_tables.c"]
            run(["gcov", "--json-format", "-b", *[f"{room}/{name}.gcda" for name in names]], folder)
            for path in folder.glob("*.gcov.json.gz"):
                for one in json.loads(gzip.decompress(path.read_bytes()))["files"]:
                    if one["file"].startswith("keepout_") and one["file"].endswith(".c"):
                        for line in one["lines"]:
                            place = one["file"], line["line_number"]
                            lines[place] += line["count"]
                            for number, branch in enumerate(line["branches"]):
                                branches[(*place, number)] += branch["count"]
                path.unlink()
    left = collections.Counter(place[0] for place, count in branches.items() if not count)
    text = {name: content.decode().splitlines() for name, content in sources().items() if name.endswith(".c")}
    unreached = [
        {"file": place[0], "line": text[place[0]][place[1] - 1].strip()}
        for place in sorted({place[:2] for place, count in branches.items() if not count})
    ]
    dark = [place for place, count in lines.items() if not count]
    reached = (
        f"{100.0 * (1.0 - len(dark) / len(lines)):.1f} % of {len(lines)} lines, "
        f"{100.0 * (1.0 - sum(left.values()) / len(branches)):.1f} % of {len(branches)} branches, "
        f"{len(folders)} missions"
    )
    why = [
        {"file": name, "branches left": count, "why": UNREACHED.get(name, "see the lines")}
        for name, count in sorted(left.items())
    ]
    listed = [f"{name}:{text[name][number - 1].strip()}" for name, number in sorted(dark)]
    return [row("coverage", asked, reached, left=why, lines=listed, branches=unreached)]


def fuzz(options: argparse.Namespace, folders: list[Path]) -> Rows:
    """Step on numbers of any kind under sanitizers; most of them by a mission whose law needs no network."""
    quick = [folder for folder in folders if "spline" in folder.name] or folders[:1]
    sensing = [folder for folder in folders if senses(folder)]
    shares = {folder: options.fuzz // 100 for folder in [*folders[: options.fuzzed], *sensing]}
    shares[quick[0]] = options.fuzz - sum(count for folder, count in shares.items() if folder != quick[0])
    flags = ["-O1", "-g", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all", "-w"]
    words = []
    for number, (folder, count) in enumerate(shares.items()):
        built(folder, "fuzz", [str(HARNESS / "fuzz.c"), *refreshed(folder)], flags)
        done = run(["./fuzz", "tables.bin", str(count), str(number + 1)], folder)
        if done.returncode:
            words.append(f"{folder.name}: {done.stderr[:300]}")
    total = sum(shares.values())
    reached = f"{total:,} over {len(shares)} missions, {shares[quick[0]]:,} of them by {quick[0].name}: "
    reached += "; ".join(words) or "clean"
    return [row("fuzzed steps under ASan, UBSan, float-cast", "10⁷, clean", reached)]


def budget(options: argparse.Namespace, folders: list[Path]) -> Rows:
    """Count instructions of each step, bytes of code, stack and memory; with sensors once more."""
    sensing = [folder for folder in folders if senses(folder)][-1:]
    rows = _budget(folders[0], "≤ 40 kB, ≤ 8 kB, ≤ 1 kB")
    for folder in sensing:
        told = _budget(folder, "≤ 8 kB of stack, ≤ 16 kB of memory")
        rows += [one | {"evidence": f"{one['evidence']}, with sensors"} for one in told]
    return rows


def _budget(folder: Path, asked_of_bytes: str) -> Rows:
    rows: Rows = []
    files = refreshed(folder)
    asked = "≤ 450 k in the mean, worst over mean ≤ 1.1"
    if not found("valgrind"):
        rows.append(row("instructions a step", asked, "skipped: valgrind is not installed"))
    else:
        built(folder, "fly_mission", ["fly_mission.c", *files], ["-O2", "-g"])
        built(folder, "replay", [str(HARNESS / "replay.c"), *files], ["-O2", "-g"])
        flown = _counted(folder, ["./fly_mission", "tables.bin", "600"])
        hard = _counted(folder, ["./replay", "tables.bin", stored.NAME, stored.FIELDS])
        mean = sum(flown) / len(flown)
        reached = f"a flight of {len(flown)} steps: mean {mean / 1e3:.0f} k, worst {max(flown) / 1e3:.0f} k, "
        reached += f"{max(flown) / mean:.2f} times; {len(hard)} random steps: worst {max(hard) / 1e3:.0f} k, "
        reached += f"{max(hard) / mean:.2f} times"
        rows.append(row("instructions a step", asked, reached))
    sizes = {level: _code_bytes(folder, level) for level in ("-Os", "-O2")}
    stack = _deepest(folder)
    (folder / "b-sizes.c").write_text(
        '#include <stdio.h>\n#include "keepout.h"\n'
        'int main(void) { printf("%zu", sizeof(keepout_memory)); return 0; }\n'
    )
    built(folder, "b-sizes", ["b-sizes.c"], [])
    memory = int(run(["./b-sizes"], folder).stdout)
    reached = f"{sizes['-O2'] / 1e3:.1f} kB ({sizes['-Os'] / 1e3:.1f} with -Os), {stack / 1e3:.1f} kB, {memory} B"
    reached += "; x86-64, gcc -O2, without tables for exceptions, which C has none of"
    for path in folder.glob("b-*"):
        path.unlink()
    return [*rows, row("code, stack, memory", asked_of_bytes, reached)]


def _code_bytes(folder: Path, level: str) -> int:
    """Compile all but the mission's numbers, with call graphs, and give the bytes of code and constants."""
    files = [name for name in refreshed(folder) if name != "mission_tables.c"]
    flags = ["-std=c99", "-ffp-contract=off", level, "-fno-asynchronous-unwind-tables", "-fcallgraph-info=su"]
    for name in files:
        run(["gcc", *flags, "-c", "-o", f"b-{name[:-2]}.o", name], folder)
    text = run(["size", *[f"b-{name[:-2]}.o" for name in files]], folder).stdout
    return sum(int(line.split()[0]) for line in text.splitlines()[1:])


def _counted(folder: Path, words: list[str]) -> list[int]:
    """Count the instructions of each call of keepout_step."""
    with tempfile.TemporaryDirectory() as room:
        tool = ["valgrind", "--tool=callgrind", "--toggle-collect=keepout_step", "--dump-after=keepout_step"]
        run([*tool, "--combine-dumps=yes", f"--callgrind-out-file={room}/out", *words], folder)
        said = "".join(path.read_text() for path in sorted(Path(room).iterdir()))
    return [count for count in (int(number) for number in re.findall(r"^totals: (\d+)", said, re.M)) if count > 1000]


def _deepest(folder: Path) -> int:
    """Give the bytes of stack of the deepest chain of calls below keepout_step, by gcc's call graph."""
    own: dict[str, int] = {}
    calls: dict[str, set[str]] = collections.defaultdict(set)
    for path in folder.glob("b-*.ci"):
        said = path.read_text()
        for name, words in re.findall(r'node: \{ title: "([^"]+)" label: "([^"]*)"', said):
            if used := re.search(r"(\d+) bytes", words):
                own[name.split(":")[-1]] = int(used[1])
        for caller, callee in re.findall(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', said):
            calls[caller.split(":")[-1]].add(callee.split(":")[-1])

    def below(name: str) -> int:
        return own.get(name, 0) + 8 + max((below(callee) for callee in calls[name]), default=0)

    return below("keepout_step")
