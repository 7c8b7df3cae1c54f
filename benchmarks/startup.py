"""How long a command takes from its start: a first flight and a first campaign, with kept programs and without.

Each row is a process of its own, with a fresh folder for compiled programs (cold), the same folder again (warm), or
none (off); the median of several. Seconds depend on the machine and on what else it does, so that a reference stands in
every round: a Python that imports what any such program must. `cpu` is what the process and its threads used. Of the
programs that JAX was asked for it `compiled` some and had `taken` others from its folder; those kept `whole` were not
traced.
A campaign's `first flight s` goes to the first batch that lands, from where Python has started.

    python benchmarks/startup.py --repeats 3 --json startup.json
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SCENARIO = Path(__file__).parents[1] / "examples" / "case1.toml"
REFERENCE = "import jax, numpy, scipy"
PROGRAM = """
import sys, time
begin = time.perf_counter()
asked, taken, whole, first = [], [], [], []
def watch():
    from jax import monitoring
    monitoring.register_event_duration_secs_listener(
        lambda name, seconds, **_: asked.append(seconds) if name.endswith("backend_compile_duration") else None
    )
    counts = {"cache_hits": taken, "kept_program_loaded": whole}
    monitoring.register_event_listener(lambda name, **_: counts.get(name.rsplit("/")[-1], []).append(name))
from keepout import cli
if sys.argv[1] == "campaign":
    from keepout.flights.campaign import flying
    told = flying.fly_batches
    def landed_first(*arguments, **named):
        landed = named["landed"]
        def landing(*given):
            first.append(time.perf_counter() - begin)
            return landed(*given)
        return told(*arguments, **(named | {"landed": landing}))
    flying.fly_batches = landed_first
watch()
sys.argv = ["keepout", *sys.argv[1:]]
try:
    cli.main()
except SystemExit as stop:
    code = stop.code
print("PROGRAMS", len(asked) - len(taken), len(taken), len(whole), first[0] if first else "-", file=sys.stderr)
sys.exit(code)
"""


def measured(arguments: list[str], folder: Path | str) -> dict[str, float]:
    """Run one process; seconds by the clock and of processor, and how it came by its programs."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    before, begin = os.times(), time.perf_counter()
    done = subprocess.run(
        [sys.executable, *arguments], env=own | {"KEEPOUT_COMPILE_CACHE": str(folder)}, capture_output=True, text=True
    )
    seconds, after = time.perf_counter() - begin, os.times()
    if done.returncode:
        raise RuntimeError(done.stderr)
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    row = {"seconds": seconds, "cpu": cpu}
    for line in done.stderr.splitlines():
        if line.startswith("PROGRAMS"):
            _, compiled, taken, whole, first = line.split()
            row |= {"compiled": int(compiled), "taken": int(taken), "whole": int(whole)}
            row |= {} if first == "-" else {"first": float(first)}
    return row


def rounds(repeats: int, out: Path) -> dict[str, list[dict[str, float]]]:
    """Measure every row once a round."""
    rows: dict[str, list[dict[str, float]]] = {}
    run = ["-c", PROGRAM]
    fly = [*run, "fly", str(SCENARIO), "--json", "-o", str(out / "fly")]
    campaign = [*run, "campaign", str(SCENARIO), "--runs", "8", "--json", "-o"]
    for round_ in range(repeats):
        kept = out / f"compiled-{round_}"
        kept_campaign = out / f"compiled-campaign-{round_}"
        cases = {
            "reference: " + REFERENCE: (["-c", REFERENCE], "off"),
            "keepout --help": ([*("-m", "keepout.cli"), "--help"], "off"),
            "fly, cold": ([*fly, "--no-figures"], kept),
            "fly, warm": ([*fly, "--no-figures"], kept),
            # What only figures need is kept by the first flight that has them.
            "fly with figures for the first time": (fly, kept),
            "fly with figures, warm": (fly, kept),
            "fly, nothing kept": ([*fly, "--no-figures"], "off"),
            # A folder each: in one that is complete nothing would be flown again.
            "campaign of 8, cold": ([*campaign, str(out / f"campaign-{round_}-cold")], kept_campaign),
            "campaign of 8, warm": ([*campaign, str(out / f"campaign-{round_}-warm")], kept_campaign),
        }
        for name, (arguments, folder) in cases.items():
            rows.setdefault(name, []).append(measured(arguments, folder))
            sys.stderr.write(f"round {round_ + 1}: {name}: {rows[name][-1]}\n")
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=Path, help="also write the rows into this file")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = rounds(given.repeats, Path(folder))
    keys = ("seconds", "cpu", "compiled", "taken", "whole", "first")
    medians = {
        name: {key: statistics.median(one[key] for one in runs) for key in keys if key in runs[0]}
        for name, runs in rows.items()
    }
    reference = next(iter(medians.values()))["cpu"]
    heads = {"seconds": 9, "cpu s": 8, "÷ ref": 7, "compiled": 10, "taken": 7, "whole": 7, "first flight s": 16}
    print(" " * 38 + "".join(f"{head:>{width}s}" for head, width in heads.items()))
    for name, row in medians.items():
        widths = {"compiled": 10, "taken": 7, "whole": 7}
        counts = "".join(f"{row[key]:>{width}.0f}" if key in row else " " * width for key, width in widths.items())
        first = f"{row['first']:16.2f}" if "first" in row else ""
        print(f"{name:38s}{row['seconds']:9.2f}{row['cpu']:8.2f}{row['cpu'] / reference:7.2f}{counts}{first}")
    if given.json:
        given.json.write_text(json.dumps({"cores": len(os.sched_getaffinity(0)), "medians": medians, "rows": rows}))


if __name__ == "__main__":
    main()
