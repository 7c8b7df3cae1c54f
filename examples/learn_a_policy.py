"""Learn a policy by the cross-entropy method, with and without the guard as a shield.

It needs the extra `gym`:

python examples/learn_a_policy.py [--generations 80] [--out out/learn_a_policy.png]
"""

import argparse
from pathlib import Path

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import keepout.gym  # noqa: F401

POLICIES, EPISODES, BEST = 128, 8, 16
"""In a generation: policies, episodes of each, and policies that the next one is drawn about."""
INPUTS, HIDDEN = 7, 16
SCALE = np.array([10.0, 10.0, 10.0, 0.3, 0.3, 0.3, 3.0])
"""Of an observation: m, m/s, m."""
SIZE = HIDDEN * (INPUTS + 1) + 3 * (HIDDEN + 1)


def act(weights, observation):
    """Give the actions (POLICIES, EPISODES, 3) of small networks, one a policy."""
    first, second = weights[:, : HIDDEN * (INPUTS + 1)], weights[:, HIDDEN * (INPUTS + 1) :]
    first, second = first.reshape(-1, INPUTS + 1, HIDDEN), second.reshape(-1, HIDDEN + 1, 3)
    hidden = np.tanh(observation / SCALE @ first[:, :-1] + first[:, -1:])
    return np.tanh(hidden @ second[:, :-1] + second[:, -1:])


def fly(envs, weights, seed):
    """Give each policy's mean return and its share of episodes with contact."""
    observation, _ = envs.reset(seed=seed)
    flying, returns, contacts = np.ones(len(observation), bool), 0.0, 0.0
    while flying.any():
        action = act(weights, observation.reshape(len(weights), -1, INPUTS)).reshape(-1, 3)
        observation, reward, terminated, truncated, info = envs.step(action)
        returns, contacts = returns + reward * flying, contacts + info["contact"] * flying
        flying &= ~(terminated | truncated)  # the rest of a step counts to the next episode, which is not looked at
    return returns.reshape(len(weights), -1).mean(axis=1), contacts.reshape(len(weights), -1).mean(axis=1)


def learn(guard, generations, policies=POLICIES, episodes=EPISODES):
    """Give the mean return and the share of contacts of each generation, and the last generation's mean weights."""
    envs = gymnasium.make_vec("keepout/Approach-v0", num_envs=policies * episodes, guard=guard)
    random, mean, spread, curve = np.random.default_rng(0), np.zeros(SIZE), np.ones(SIZE), []
    for generation in range(generations):
        weights = mean + spread * random.normal(size=(policies, SIZE))
        returns, contacts = fly(envs, weights, seed=policies * episodes * generation)
        best = weights[np.argsort(returns)[-BEST:]]
        mean, spread = best.mean(axis=0), best.std(axis=0) + 0.3 * 0.9**generation
        curve.append((returns.mean(), contacts.mean()))
        print(f"guard {guard!s:5} generation {generation:3}: return {curve[-1][0]:6.2f}, contacts {curve[-1][1]:.3f}")
    envs.close()
    return np.array(curve), mean


def main(generations, out, **sizes):
    """Learn with and without the guard, and draw both curves."""
    curves = {guard: learn(guard, generations, **sizes)[0] for guard in (True, False)}
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    for guard, curve in curves.items():
        for axis, column in zip(axes, curve.T):
            axis.plot(column, color="C0" if guard else "C3", label="with the guard" if guard else "without")
    axes[0].set(xlabel="generation", ylabel="mean return of an episode", ylim=(-30, 25))
    axes[1].set(xlabel="generation", ylabel="share of episodes with contact", ylim=(-0.02, None))
    axes[0].legend(frameon=False)
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=150)
    return curves


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--generations", type=int, default=80)
    parser.add_argument("--out", default="out/learn_a_policy.png")
    main(**vars(parser.parse_args()))
