"""Compare the exported C with Python, step by step and in closed loops, and one compiler's bits with another's.

python benchmarks/flight_code.py                  # the missions below, 10 000 steps each
python benchmarks/flight_code.py --steps 100000   # more of them

Each step starts from Python's memory, put into the C code's, so that differences do not add up; estimates are wrong,
jump, are no numbers or are far away. Closed loops are each on its own. A compiler that is not there is skipped, with
a word.
"""

import argparse
import dataclasses
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from compiled_step import CompiledStep, estimates_of, memories_of

from keepout.apps.flight_code.folder import write_flight_code
from keepout.apps.flight_code.missions import Coded, coded
from keepout.core.flight import loop
from keepout.core.mission.build import prepare
from keepout.core.mission.scenario import Scenario
from keepout.core.motion.disturbance import NoDisturbance

TURNING = {"kind": "tumbling", "angular_velocity": (0.001, 0.002, 0.0005)}
MISSIONS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "delay": {"guard": {"delay": 2}},
    "errors of the estimate": {"guard": {"position_error": 0.05, "velocity_error": 0.002}},
    "both, inertially fixed": {
        "guard": {"delay": 1, "position_error": 0.03, "velocity_error": 0.001},
        "attitude": {"kind": "inertial"},
    },
    "tumbling": {"attitude": {**TURNING, "inertia": ((2.0, 0, 0), (0, 3.0, 0), (0, 0, 4.0))}},
    "elliptic": {"orbit": {"eccentricity": 0.3, "semi_major_axis": 2.4e7, "true_anomaly": 0.4}},
    "law by the spline": {"field": {"source": "grid"}},
}
FLIGHTS = 64
LOOPS, SECONDS = 20, 3000
BUILDS = [
    *[(compiler, f"-O{level}", "") for compiler in ("gcc", "clang") for level in range(4)],
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


def apart(a: Any, b: Any, least: float = 1e-3) -> float:
    """Give the largest difference over the larger number plus `least`; none of equal ones, and of no numbers."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    with np.errstate(invalid="ignore", over="ignore"):
        far = np.abs(a - b) / (least + np.maximum(np.abs(a), np.abs(b)))
    return float(np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, far).max())


def told(state: Any, rng: np.random.Generator) -> Any:
    """Give wrong estimates of states."""
    count = len(state.position)
    position = state.position + rng.normal(0, 0.005, (count, 3)) * (rng.random((count, 1)) < 0.3)
    position += rng.normal(0, 0.5, (count, 3)) * (rng.random((count, 1)) < 0.03)
    position = jnp.where(rng.random((count, 1)) < 0.01, position * 10.0 ** rng.uniform(0, 300, (count, 1)), position)
    position = jnp.where(rng.random((count, 1)) < 0.01, jnp.nan, position)
    return dataclasses.replace(state, position=position, velocity=state.velocity + rng.normal(0, 3e-4, (count, 3)))


def scattered(made: Coded, rng: np.random.Generator) -> Any:
    """Give states on all sides of the target."""
    start = jax.tree.map(lambda a: jnp.broadcast_to(a, (FLIGHTS, *jnp.shape(a))), made.mission.initial)
    places = rng.normal(size=(FLIGHTS, 3))
    places *= rng.uniform(1.0, 14.0, (FLIGHTS, 1)) / np.linalg.norm(places, axis=1)[:, None]
    speeds = rng.normal(0, 0.03, (FLIGHTS, 3))
    return dataclasses.replace(start, position=jnp.asarray(places), velocity=jnp.asarray(speeds))


def compared(made: Coded, code: CompiledStep, steps: int) -> Iterator[tuple[int, float, float]]:
    """Step both codes: statuses that differ, and the largest differences of force and of memory, step by step."""
    setup, rng = made.mission.setup, np.random.default_rng(1)
    begin = jax.jit(jax.vmap(lambda estimate: loop.memories(setup, estimate)))

    @jax.jit
    @jax.vmap
    def step(memory: Any, estimate: Any, truth: Any) -> Any:
        law, guard, order, force, status = loop.command(setup, *memory, estimate)
        moved = setup.motion.step(truth, force, NoDisturbance(), setup.period, setup.mass)
        return (law, guard), (force, order.status, status), moved

    for number in range(-(-steps // FLIGHTS)):
        if number % 150 == 0:
            state = scattered(made, rng)
            memory = begin(state)
        estimate, held = told(state, rng), memories_of(made, *memory)
        order = code.step(held, estimates_of(estimate))
        memory, (force, law_status, status), state = step(memory, estimate, state)
        wrong = (order["guard_status"] != np.asarray(status)) | (order["control_status"] != np.asarray(law_status))
        after, parts = memories_of(made, *memory), ["law"] + (["guard"] if setup.guard is not None else [])
        unused = () if setup.guard.braking.observer is not None else ("seen_position", "seen_velocity")
        names = [(part, name) for part in parts for name in after[part].dtype.names if name not in unused]
        memory_apart = max(apart(held[part][name], after[part][name]) for part, name in names)
        yield int(wrong.sum()), apart(order["force"], force), memory_apart


def closed_loops(made: Coded, code: CompiledStep) -> float:
    """Fly whole flights by both codes, each on its own: how far apart they end, m."""
    setup, rng = made.mission.setup, np.random.default_rng(2)
    initial = jax.tree.map(lambda a: jnp.broadcast_to(a, (LOOPS, *jnp.shape(a))), made.mission.initial)
    moved = np.asarray(initial.position) + rng.uniform(-1.0, 1.0, (LOOPS, 3))
    initial = dataclasses.replace(initial, position=jnp.asarray(moved))
    pushes = rng.uniform(-0.002, 0.002, (LOOPS, 3))

    @jax.jit
    @jax.vmap
    def fly(state: Any, push: Any) -> Any:
        def advance(_: Any, carried: Any) -> Any:
            state, law, guard = carried
            law, guard, _, force, _ = loop.command(setup, law, guard, state)
            return setup.motion.step(state, force + push, NoDisturbance(), setup.period, setup.mass), law, guard

        return jax.lax.fori_loop(0, SECONDS, advance, (state, *loop.memories(setup, state)))[0]

    end = fly(initial, jnp.asarray(pushes))
    return float(np.abs(code.fly(estimates_of(initial), pushes, SECONDS)["position"] - np.asarray(end.position)).max())


def bits(folder: Path) -> dict[str, str]:
    """Build and run the self-test by each compiler that is there: its last words."""
    found = {}
    sources = [*sorted(folder.glob("keepout_*.c")), folder / "mission_tables.c", folder / "selftest.c"]
    for compiler, flags, runner in BUILDS:
        name = f"{compiler} {flags.split()[0]}"
        if shutil.which(compiler) is None or (runner and shutil.which(runner) is None):
            found[name] = "skipped: not installed"
            continue
        program = folder / "bits"
        command = [compiler, "-std=c99", "-ffp-contract=off", *flags.split(), "-w", "-o", str(program)]
        subprocess.run([*command, *map(str, sources), "-lm"], check=True)
        run = [*([runner] if runner else []), str(program), str(folder / "tables.bin")]
        found[name] = subprocess.run(run, capture_output=True, text=True, check=True).stdout.strip()
    return found


def main() -> None:
    """Print one table a question."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=int, default=10_000, help="of each mission")
    steps = parser.parse_args().steps
    if shutil.which("gcc") is None:
        raise SystemExit("skipped: gcc is not installed")
    with tempfile.TemporaryDirectory() as kept:
        print("| mission | steps | statuses that differ | force, over its size + 1e-3 | memory, likewise |")
        print("| --- | --- | --- | --- | --- |")
        for name, changes in MISSIONS.items():
            folder, mission = Path(kept) / name.replace(" ", "-"), prepare(Scenario().replace(**changes))
            write_flight_code(mission, folder)
            made = coded(mission)
            code = CompiledStep(made, folder)
            rows = list(compared(made, code, steps))
            wrong, force, memory = sum(row[0] for row in rows), max(r[1] for r in rows), max(r[2] for r in rows)
            print(f"| {name} | {len(rows) * FLIGHTS} | {wrong} | {force:.1e} | {memory:.1e} |", flush=True)
            if not changes:
                ends = closed_loops(made, code)
        print(f"\n{LOOPS} closed loops of {SECONDS} steps end at most {ends:.1e} m apart\n")
        for name, answer in bits(Path(kept) / "as-it-is").items():
            print(f"{name}: {answer}")


if __name__ == "__main__":
    main()
