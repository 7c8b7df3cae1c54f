"""Steps a second of `keepout/Approach-v0`: many environments on the batched step, against one in a loop.

    python benchmarks/gym_steps.py [--envs 1024] [--steps 200] [--repeats 7] [--cores 2] [--out OUT.json]

The built-in mission, nothing recorded, with and without the guard. Actions are random, or lead to the goal as the crow
flies, where the guard has most to do: half the ways are into the pocket. Environments that are over begin anew. Each
figure is the median of repeats, after start-up; one environment is timed in between them. A process of its own is kept
to so many cores.
"""

import argparse
import datetime
import json
import os
import statistics
import time

from campaign import apart
from kept_rows import show

COLUMNS = ("guard", "actions", "steps a second", "least", "most", "cpu us a step", "one in a loop", "ratio", "episodes")


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--envs", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=200, help="of every environment in a repeat")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--out", metavar="JSON", help="write all figures here too")
    given = parser.parse_args()
    from keepout.flights.pages.page import machine

    load = os.getloadavg()[0]
    rows = [apart(given.cores, measure, guard, given.envs, given.steps, given.repeats) for guard in (False, True)]
    rows = [row for pair in rows for row in pair]
    show(rows, COLUMNS)
    if given.out:
        found = {"machine": machine(), "date": datetime.date.today().isoformat(), "load at the start": load}
        found |= {
            "envs": given.envs,
            "steps": given.steps,
            "repeats": given.repeats,
            "cores": given.cores,
            "rows": rows,
        }
        with open(given.out, "w", encoding="utf-8") as file:
            json.dump(found, file, indent=1)


def measure(guard, count, steps, repeats):
    """Time environments with random actions and with those that lead to the goal."""
    import gymnasium
    import numpy as np

    import keepout.gym  # noqa: F401

    envs = gymnasium.make_vec("keepout/Approach-v0", num_envs=count, guard=guard)
    one = gymnasium.make("keepout/Approach-v0", guard=guard).unwrapped
    drawn = np.random.default_rng(0).uniform(-1.0, 1.0, (16, count, 3)).astype(np.float32)
    chosen = {
        "random": lambda step, seen: drawn[step % 16, : len(seen)],
        "to the goal": lambda step, seen: np.clip(-0.5 * seen[:, :3] - 6.0 * seen[:, 3:6], -1.0, 1.0),
    }
    return [row(name, act, guard, envs, one, count, steps, repeats) for name, act in chosen.items()]


def row(name, act, guard, envs, one, count, steps, repeats):
    """Time one kind of action."""
    many, single, processor, ended = [], [], [], 0
    fly(envs, act, 20), alone(one, act, 20)  # compiles
    for _ in range(repeats):
        begun, begun_cpu = time.perf_counter(), time.process_time()
        ended += fly(envs, act, steps)
        many.append(count * steps / (time.perf_counter() - begun))
        processor.append(1e6 * (time.process_time() - begun_cpu) / count / steps)
        begun = time.perf_counter()
        alone(one, act, steps)
        single.append(steps / (time.perf_counter() - begun))
    return {
        "guard": "on" if guard else "off",
        "actions": name,
        "steps a second": statistics.median(many),
        "least": min(many),
        "most": max(many),
        "cpu us a step": statistics.median(processor),
        "one in a loop": statistics.median(single),
        "ratio": statistics.median(many) / statistics.median(single),
        "episodes": ended,
    }


def fly(envs, act, steps):
    """Step environments; give how many episodes ended."""
    seen, ended = envs.reset(seed=0)[0], 0
    for step in range(steps):
        seen, _, terminated, truncated, _ = envs.step(act(step, seen))
        ended += int((terminated | truncated).sum())
    return ended


def alone(one, act, steps):
    """Step one environment."""
    seen = one.reset(seed=0)[0]
    for step in range(steps):
        seen, _, terminated, truncated, _ = one.step(act(step, seen[None])[0])
        if terminated or truncated:
            seen = one.reset()[0]


if __name__ == "__main__":
    main()
