"""Time of a control step in a campaign, by batch size and threads, with the default law and the shipped field.

    python benchmarks/campaign.py [--flights 256] [--steps 60]

Every figure is the best of three runs of one compiled program; `ratio` is against all flights in one batch, by the
clock. On a machine that does other work, compare the processor time, `cpu`.
"""

import argparse
import os
import time
from importlib import resources

import numpy as np

from keepout.control import profiles
from keepout.control.guidance.plan import Straight
from keepout.control.operation import Operation
from keepout.fields.model import FieldModel
from keepout.flight import FlightSetup
from keepout.flight.batches import fly_batches, initial_states
from keepout.motion import Chaser, Orbit, RelativeMotion, paper_disturbance


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flights", type=int, default=256)
    parser.add_argument("--steps", type=int, default=60)
    arguments = parser.parse_args()
    with resources.as_file(resources.files("keepout") / "data" / "fields" / "intelsat30.keepout") as path:
        field = FieldModel.load(path).field
    motion, goal = RelativeMotion(Orbit(7e6)), np.array([0.0, -10.0, -4.0])
    chaser = Chaser(mass=20.0, radius=0.3, force_limit=0.1, speed_limit=0.1)
    law = profiles.default(field, Operation(chaser, motion, 0.1, paper_disturbance().bound), goal, guidance=Straight())
    setup = FlightSetup(motion, paper_disturbance(), chaser.thrusters, law, goal, chaser.mass)

    def shell(generator, count):
        direction = generator.standard_normal((count, 3))
        return 25 * direction / np.linalg.norm(direction, axis=1, keepdims=True), np.zeros((count, 3))

    states = initial_states(motion, shell, arguments.flights, seed=0)

    def microseconds(batch, workers):
        best = np.full(2, np.inf)
        for _ in range(4):  # the first one compiles
            began = np.array([time.perf_counter(), time.process_time()])
            fly_batches(setup, states, arguments.steps, batch=batch, workers=workers)
            best = np.minimum(best, np.array([time.perf_counter(), time.process_time()]) - began)
        return 1e6 * best / arguments.flights / arguments.steps

    reference = microseconds(arguments.flights, 1)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    print(f"{cores} cores, {arguments.flights} flights of {arguments.steps} steps")
    print(f"{'batch':>6} {'threads':>8} {'us/step':>9} {'cpu us/step':>12} {'ratio':>6}")
    print(f"{arguments.flights:>6} {1:>8} {reference[0]:>9.1f} {reference[1]:>12.1f} {1.0:>6.2f}")
    for batch in (16, 64, 128):
        for workers in sorted({1, cores}):
            figure = microseconds(batch, workers)
            print(f"{batch:>6} {workers:>8} {figure[0]:>9.1f} {figure[1]:>12.1f} {reference[0] / figure[0]:>6.2f}")


if __name__ == "__main__":
    main()
