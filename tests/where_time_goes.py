"""Where the tests' processor time goes, by file: `python tests/where_time_goes.py [--keep FOLDER] [options of pytest]`.

It runs pytest with what is given (all that `make test` runs, on two cores, where nothing is) and prints a table: the
seconds of processor, commands that tests start with them; of these, by the clock, what JAX compiled and what Numba
did; the seconds of commands; the number of programs, the most memory of a worker and the clock. A worker that finds a
program that another has compiled reads it from the disk, which counts as compiling.

With `--keep`, a line for each test is kept in the folder as it ends; a run that was stopped goes on with the tests that
have not passed, and its table is that of both, while no file of the repository has changed. `make test-all` does so.
"""

import collections
import contextlib
import hashlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

FOLDER = "KEEPOUT_TIME_GOES"
"""The environment variable that names the folder of the measurements: the plugin measures where it is set."""
PASSED = "passed.json"
COLUMNS = ("all", "compiling", "numba", "commands")
COMPILED = "/jax/core/compile/backend_compile_duration"

_BY_FILE = ("-n", "2", "--dist", "loadfile", "--no-loadscope-reorder")
MAKE_TEST = (
    (("-m", "as_used and not slow", "--jaxtyping-packages=keepout.core,beartype.beartype"), {"XLA_FLAGS": ""}),
    (("-m", "not slow and not as_used", *_BY_FILE), {}),
)
"""What `make test` runs, there at once: options of pytest, and what is set in its environment."""


class Meter:
    """What this process has used so far, in seconds."""

    def __init__(self):
        import jax
        from numba.core import event

        self.spent: collections.Counter = collections.Counter()
        jax.monitoring.register_event_duration_secs_listener(self._jax_ended)
        self._kernels: list[float] = []  # when each kernel began: one may compile others
        listener = type("Listener", (event.Listener,), {"on_start": self._kernel_begun, "on_end": self._kernel_ended})
        event.register("numba:compile", listener())

    def _jax_ended(self, event: str, seconds: float, **_):
        if event == COMPILED:
            self.spent.update(compiling=seconds, programs=1)

    def _kernel_begun(self, *_):
        self._kernels.append(time.perf_counter())

    def _kernel_ended(self, *_):
        begun = self._kernels.pop()
        if not self._kernels:
            self.spent["numba"] += time.perf_counter() - begun

    def read(self) -> dict[str, float]:
        """Return all that was used so far (s)."""
        children = resource.getrusage(resource.RUSAGE_CHILDREN)
        forked = getattr(sys.modules.get("truths.command_line"), "FORKED", {"seconds": 0.0})
        commands = children.ru_utime + children.ru_stime + forked["seconds"]
        spent = {kind: self.spent[kind] for kind in ("compiling", "numba", "programs")}
        return {"all": time.process_time() + commands, "commands": commands, **spent}


class Plugin:
    """Leaves out the tests that have passed, and writes a line for each other: what its set-up, call and end used."""

    def __init__(self, folder: Path):
        self.meter = Meter()
        self.before = self.meter.read()
        self.clock = time.perf_counter()
        self.failed = False
        self.file = open(folder / f"{time.time_ns()}-{os.getpid()}.jsonl", "a")  # noqa: SIM115

    def pytest_runtest_logreport(self, report):
        self.failed |= report.failed

    def pytest_runtest_logfinish(self, nodeid: str):
        now, clock = self.meter.read(), time.perf_counter()
        used = {key: now[key] - self.before[key] for key in now}
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        line = {"test": nodeid, "passed": not self.failed, "clock": clock - self.clock, "memory": memory, **used}
        self.file.write(json.dumps(line) + "\n")
        self.file.flush()
        self.before, self.clock, self.failed = now, clock, False


def pytest_configure(config):
    """Measure in whichever process runs tests: the workers, or the only one."""
    if FOLDER in os.environ and (hasattr(config, "workerinput") or not config.getoption("numprocesses", None)):
        config.pluginmanager.register(Plugin(Path(os.environ[FOLDER])))


def pytest_collection_modifyitems(config, items):
    """Leave out what has passed before the run began, so that all workers leave out the same."""
    passed = Path(os.environ.get(FOLDER, "")) / PASSED
    if FOLDER in os.environ and passed.exists():
        done = set(json.loads(passed.read_text()))
        config.hook.pytest_deselected(items=[item for item in items if item.nodeid in done])
        items[:] = [item for item in items if item.nodeid not in done]


def table(lines: list[dict], key, most: int | None = None) -> list[str]:
    """Return rows of a table: what each group of tests used, the largest first."""
    groups: dict[str, collections.Counter] = collections.defaultdict(collections.Counter)
    for line in lines:
        groups[key(line["test"])].update({**{c: line[c] for c in (*COLUMNS, "programs")}, "tests": 1})
    said = [f"| {'':60} | " + " | ".join(f"{c:>9}" for c in COLUMNS) + " | programs | tests |"]
    for name, used in sorted(groups.items(), key=lambda pair: -pair[1]["all"])[:most]:
        seconds = " | ".join(f"{used[c]:9.1f}" for c in COLUMNS)
        said.append(f"| {name:60} | {seconds} | {used['programs']:8.0f} | {used['tests']:5.0f} |")
    return said


def state_of_the_code() -> str:
    """Return a digest of every file of the repository that is tracked."""
    names = subprocess.run(["git", "ls-files", "-z"], capture_output=True, check=True).stdout.split(b"\0")
    digest = hashlib.sha256()
    for name in filter(None, names):
        path = Path(os.fsdecode(name))
        digest.update(name + (path.read_bytes() if path.exists() else b"absent"))
    return digest.hexdigest()[:16]


def measured(folder: Path) -> list[dict]:
    """Return the lines that are kept in a folder."""
    return [json.loads(line) for file in folder.glob("*.jsonl") for line in file.read_text().splitlines()]


def main(arguments: list[str]) -> int:
    """Run pytest and print where its time went."""
    keep = arguments[:1] == ["--keep"]
    with contextlib.ExitStack() as stack:
        if keep:
            folder, arguments = Path(arguments[1]) / state_of_the_code(), arguments[2:]
            folder.mkdir(parents=True, exist_ok=True)
        else:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        before = measured(folder)
        (folder / PASSED).write_text(json.dumps([line["test"] for line in before if line["passed"]]))
        compiled = stack.enter_context(tempfile.TemporaryDirectory())
        environment = os.environ | {
            FOLDER: str(folder),
            "JAX_COMPILATION_CACHE_DIR": os.environ.get("JAX_COMPILATION_CACHE_DIR", compiled),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
        }
        begun, code = time.perf_counter(), 0
        for given, flags in [(arguments, {})] if arguments else MAKE_TEST:
            code |= subprocess.run([sys.executable, "-m", "pytest", *given], env=environment | flags).returncode
        clock = time.perf_counter() - begun
        lines = measured(folder)
        distinct = len(list(Path(environment["JAX_COMPILATION_CACHE_DIR"]).glob("*-cache")))
    for title, rows in (
        ("by file", table(lines, lambda test: test.split("::")[0])),
        ("by test (the first sixty)", table(lines, lambda test: test, 60)),
        ("all", table(lines, lambda _: "all tests")),
    ):
        print(f"\nseconds of processor, {title}\n" + "\n".join(rows))
    memory = max((line["memory"] for line in lines), default=0.0)
    print(f"\n{distinct} distinct programs; most memory of a worker {memory:.2f} GiB; {clock:.0f} s by the clock")
    if before:
        print(f"{len(before)} tests of an earlier run of the same code are in the tables, and not in the last line")
    return 0 if code == 5 and before else code  # 5: nothing was left to run


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
