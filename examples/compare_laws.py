"""Three laws without a guard on the same random pairs of start and goal: the paper's, Keepout's, one of your own."""

from itertools import combinations

import jax.numpy as jnp
import numpy as np
from scipy.stats import binomtest

import keepout


def straight_on(away, velocity, time):
    """Fly straight to the goal (N, of position less the goal, m, and velocity, m/s); it knows of no target."""
    wanted = jnp.clip(-away / 15.0, -0.06, 0.06)
    return jnp.clip(6.0 * (wanted - velocity), -0.1, 0.1)


def main(runs: int = 20, duration: float = 500.0) -> dict[str, list[bool]]:
    target, model = keepout.Target.load("intelsat30"), keepout.load_shipped("intelsat30")
    laws = {"paper": {"profile": "paper"}, "default": {"profile": "default"}}
    draw = np.random.default_rng(0)
    good = {"paper": [], "default": [], "own": []}
    while len(good["own"]) < runs:
        start, goal = draw.uniform((-18.0, -9.0, -8.0), (18.0, 9.0, 8.0), size=(2, 3)).tolist()
        pair = keepout.Scenario().replace(
            duration=duration, guard={"enabled": False}, start={"position": start}, goal={"position": goal}
        )
        try:
            missions = [keepout.prepare(pair.replace(control=law), target=target, model=model) for law in laws.values()]
        except keepout.KeepoutError:  # in the target, or too near it for one of them: drawn anew for all
            continue
        missions.append(missions[0].with_law(keepout.PolicyLaw(goal, straight_on)))
        for name, mission in zip(good, missions):
            told = mission.fly().summary()
            good[name].append(told["reached"] and told["contact_verdict"] == "no")
    return good


if __name__ == "__main__":
    good = main()
    for name, found in good.items():
        low, high = binomtest(sum(found), len(found)).proportion_ci(method="exact")
        print(f"{name}: {sum(found)} of {len(found)} reached without contact, 95 % interval {low:.2f} to {high:.2f}")
    for one, other in combinations(good, 2):
        first, second = np.array(good[one]), np.array(good[other])
        only, too = int(np.sum(first & ~second)), int(np.sum(second & ~first))
        chance = binomtest(only, only + too).pvalue if only + too else 1.0
        print(f"{one} alone {only}, {other} alone {too}: by chance with p = {chance:.3f}")
