"""Time one step on board with sensors: samples in, filter, guaranteed set, law, guard and allocation, force out.

Run as `taskset -c 0 python benchmarks/on_board_navigation.py [--suite close] [--layout 12] [--steps 5000] [--json]`.
Each step is called from Python as on board: the compiled program on the calling thread, and no garbage collection
inside the loop. The samples are those of a flight around `intelsat30`.
"""

import gc
import json
import time

import equinox as eqx
import jax
import numpy as np
from kept_rows import command

from keepout.core.flight import loop
from keepout.core.mission.build import prepare
from keepout.core.mission.scenario import Scenario
from keepout.flights.on_board import OnBoard
from keepout.flights.pages.page import machine


def recorded(mission, steps):
    """Give the first estimate, and what each sensor said in each step of a flight (None where nothing came)."""
    setup, key = mission.setup, jax.random.key(mission.scenario.seed)
    navigation = setup.navigation

    @eqx.filter_jit
    def fly(initial):
        def advance(state, _):
            samples = navigation.suite.sample(state.sensors, state.motion)[1]
            return loop.step(setup, state)[0], samples

        return jax.lax.scan(advance, loop.start(setup, initial, key), length=steps)[1]

    samples = jax.device_get(fly(mission.initial))
    period, late = mission.scenario.control.period, [sensor.latency for sensor in navigation.suite.sensors]
    return [
        [((k - ago) * period, one.value[k]) if one.came[k] else None for one, ago in zip(samples, late, strict=True)]
        for k in range(steps)
    ]


def timed(on_board, told, period):
    """Give the seconds of each step after the first."""
    on_board.step(0.0, samples=told[0])
    seconds = []
    gc.collect()
    gc.disable()
    for number, samples in enumerate(told[1:], start=1):
        begin = time.perf_counter()
        on_board.step(number * period, samples=samples)
        seconds.append(time.perf_counter() - begin)
    gc.enable()
    return np.asarray(seconds)


def main():
    options = command(__doc__)
    options.add_argument("--suite", default="close", choices=["close", "near", "far"])
    options.add_argument("--layout", default="12", choices=["ideal", "six", "12", "24"])
    options.add_argument("--force-limit", type=float, default=0.1, help="of the chaser, N")
    options.add_argument("--steps", type=int, default=5000)
    chosen = options.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)

    scenario = Scenario().replace(
        navigation={"suite": chosen.suite},
        thrusters={"layout": chosen.layout},
        chaser={"force_limit": chosen.force_limit},
    )
    mission = prepare(scenario)
    told = recorded(mission, chosen.steps)
    on_board = OnBoard(mission.setup, mission.initial, by_samples=True)
    micro = 1e6 * timed(on_board, told, scenario.control.period)
    row = {
        "suite": chosen.suite,
        "layout": chosen.layout,
        "one_kernel": on_board.one_kernel,
        "median_us": float(np.median(micro)),
        "p99_us": float(np.quantile(micro, 0.99)),
        "steps": len(micro),
    }
    if chosen.json:
        print(json.dumps({"machine": machine(), "rows": [row]}))
        return
    print(f"suite {row['suite']}, layout {row['layout']}, {'one kernel' if row['one_kernel'] else 'several kernels'}")
    print(f"a step: p50 {row['median_us']:.1f} us, p99 {row['p99_us']:.1f} us, over {row['steps']} steps")


if __name__ == "__main__":
    main()
