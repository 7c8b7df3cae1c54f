"""The set-membership estimate: the truth is inside, always; never wider than what was told; caps; contradictions."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.adversaries import NOISES, PUSHES, Adversary, fly_many, motion_state

from keepout.errors import ScenarioError
from keepout.sensing.bounded import SetMembership
from keepout.sensing.caps import caps, design
from keepout.sensing.error_parts import BallNoise
from keepout.sensing.sensor import Sample
from keepout.sensing.sensors import RangeBearing, RelativePosition, RelativeVelocity
from keepout.sensing.suite import Suite

D = 9e-4
RANGE, SPEED = 2000.0, 30.0
INITIAL = (0.2, 0.01)
NUMBERS = {"disturbance": D, "mass": 20.0, "period": 1.0}
LIMITS = {"range_limit": RANGE, "speed_limit": SPEED, "initial_errors": INITIAL}


def noise(radius, kind):
    return (Adversary(jnp.asarray(radius), kind),)


def close(kind):
    return Suite((RelativePosition(noise(0.05, kind)), RelativeVelocity(noise(0.002, kind))))


def late(kind):
    """Late, seldom and lost, and in axes of VVLH."""
    position = dict(every=2, latency=3, dropout=0.4, most_missed=2)
    velocity = dict(every=3, latency=1, dropout=0.4, most_missed=1)
    return Suite(
        (
            RelativePosition(noise(0.05, kind), axes="vvlh", **position),
            RelativeVelocity(noise(0.002, kind), axes="vvlh", **velocity),
        )
    )


def positions_only(kind):
    return Suite((RelativePosition(noise(0.05, kind), every=1, latency=1),))


def sharp(kind):
    """Positions so good that what accelerations and commands add is all that there is."""
    return Suite((RelativePosition(noise(1e-4, kind), latency=2),))


def pushed(kind):
    """No noise, but positions three periods late: what the push has done since is all that there is."""
    return Suite((RelativePosition((BallNoise(0.0),), latency=3), RelativeVelocity((BallNoise(0.0),))))


def bearings(kind):
    arrival = dict(every=2, latency=1, dropout=0.3, most_missed=1)
    return Suite((RangeBearing(noise(0.03, kind), noise(0.002, kind), **arrival),))


def exact(kind):
    """No noise at all: what is left is rounding."""
    velocity = dict(every=1, latency=2)
    return Suite((RelativePosition((BallNoise(0.0),)), RelativeVelocity((BallNoise(0.0),), **velocity)))


MADE = {
    "close": close,
    "late": late,
    "positions only": positions_only,
    "sharp": sharp,
    "pushed": pushed,
    "bearings": bearings,
    "exact": exact,
}
QUIET = {"exact": 0.0}
"""Bound on the accelerations where it is not D."""


def limits_of(name):
    return LIMITS if name != "bearings" else {**LIMITS, "range_limit": 200.0}


@functools.cache
def designed(name):
    numbers = {**NUMBERS, "disturbance": QUIET.get(name, D)}
    return design(MADE[name](jnp.asarray(0)), **numbers, **limits_of(name))


@functools.cache
def flown(name, share=1.0):
    """Rows of 2000 flights of 100 steps: every kind of noise with every kind of push, from near and from far.

    `share` is the part of the truth's bound on accelerations that the estimate is told.
    """
    flights, disturbance = 2000, QUIET.get(name, D)
    estimate, _ = designed(name)
    kinds = np.stack(np.unravel_index(np.arange(flights) % (NOISES * PUSHES), (NOISES, PUSHES)), axis=1)
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(flights, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance = rng.choice([0.0, 3.0, 60.0], size=(flights, 1))
    starts = np.concatenate([distance * direction, 0.05 * rng.normal(size=(flights, 3))], axis=1)
    keys = jax.random.split(jax.random.key(0), flights)

    def make(kind):
        numbers = {**NUMBERS, "disturbance": share * disturbance}
        return SetMembership(MADE[name](kind), window=estimate.window, **numbers)

    rows = fly_many(
        make, jnp.asarray(disturbance), keys, jnp.asarray(kinds), jnp.asarray(starts), jnp.asarray(INITIAL), 100
    )
    return [np.asarray(row) for row in rows]


@pytest.mark.long
@pytest.mark.parametrize("name", MADE)
def test_the_truth_is_inside_in_all_of_two_hundred_thousand_samples(name):
    """Seven suites: in all 1 400 000 samples of as many. And no radius is above its cap, or above the propagated."""
    off, radii, before, contradicted, truth, _ = flown(name)
    assert off.shape == (2000, 100, 2)
    assert np.linalg.norm(truth[..., :3], axis=-1).max() < limits_of(name)["range_limit"]
    assert int(np.sum(off > radii)) == 0
    assert not contradicted.any()
    assert (radii <= before).all()
    assert (radii.max(axis=(0, 1)) <= np.asarray(designed(name)[1])).all()


@pytest.mark.long
def test_the_bounds_are_not_met_by_being_wide():
    """The adversary gets the truth to the edge: 99 % of the radius."""
    off, radii, *_ = flown("close")
    assert (off / radii).max(axis=(0, 1)).min() > 0.99


@pytest.mark.long
def test_with_less_than_the_disturbance_told_the_truth_gets_outside():
    """That the truth is inside is no property of the adversary: with nine tenths of D told it is not."""
    off, radii, _, contradicted, *_ = flown("close", share=0.9)
    assert np.sum(off > radii) > 0
    assert contradicted.any()


@pytest.mark.long
def test_never_wider_than_the_sample_told():
    _, radii, _, _, truth, came = flown("close")
    size = np.linalg.norm(truth[..., :3], axis=-1) + 1.0
    assert (radii[..., 0][came[..., 0]] <= 0.05 + 1e-13 * size[came[..., 0]]).all()
    assert (radii[..., 1][came[..., 1]] <= 0.002 + 1e-13).all()
    # A period late: what the velocity known by then adds, and no more.
    _, radii, before, _, _, came = flown("positions only")
    carried = 0.05 + before[..., 1] + D / 2 + 1e-9
    assert (radii[..., 0] <= carried)[came[..., 0]].all()


WORST = {
    "close": lambda: Suite((RelativePosition((BallNoise(0.05),)), RelativeVelocity((BallNoise(0.002),)))),
    "lost": lambda: Suite(
        (
            RelativePosition((BallNoise(0.05),), dropout=0.9, most_missed=3),
            RelativeVelocity((BallNoise(0.002),), dropout=0.9, most_missed=2, latency=1),
        )
    ),
    "seldom": lambda: Suite(
        (
            RelativePosition((BallNoise(0.05),), every=7, latency=2),
            RelativeVelocity((BallNoise(0.002),), every=3, latency=1),
        )
    ),
    "positions only": lambda: Suite((RelativePosition((BallNoise(0.05),), latency=1),)),
    "positions, lost": lambda: Suite((RelativePosition((BallNoise(0.05),), latency=1, dropout=0.9, most_missed=2),)),
}


@pytest.mark.long
@pytest.mark.parametrize("initial", [(0.05, 0.002), (0.5, 0.02)])
@pytest.mark.parametrize("name", WORST)
def test_caps_are_reached_and_never_passed(name, initial):
    """Noise and pushes that are nothing leave all balls concentric, so that no cut gains: the radii are largest.

    With the losses that hurt most, the largest radius flown is the cap, or 95 % of it at least. Where positions alone
    bound the velocity and some are lost, the cap lets both ends of the window be as badly known as either can be; no
    order of losses that was flown is as bad as that, and 90 % of it is what is reached.
    """
    suite = WORST[name]()
    estimate, found = design(suite, **NUMBERS, **{**LIMITS, "initial_errors": initial})
    assert caps(estimate, **{**LIMITS, "initial_errors": initial}) == found
    # The noise that is drawn is none; the balls are drawn for the noise that might have been.
    radii = _concentric(estimate, initial, 4 * estimate.window + 100)
    largest = radii.max(axis=(0, 1))
    assert (largest <= np.asarray(found)).all()
    assert (largest >= (0.9 if name == "positions, lost" else 0.95) * np.asarray(found)).all()


def _concentric(estimate, initial, steps):
    """Radii of flights in which every sample tells the truth and nothing pushes; what is lost differs."""
    return np.asarray(_undisturbed(estimate, jnp.asarray(initial), jax.random.split(jax.random.key(0), 200), steps))


@eqx.filter_jit
def _undisturbed(estimate, initial, keys, steps):
    truth = motion_state(jnp.array([1.0, 2.0, 3.0]), jnp.zeros(3))

    def step(carry, _):
        lines, known = carry
        lines, samples = estimate.suite.sample(lines, truth)
        samples = tuple(
            Sample(sensor.ideal(truth), sample.came) for sensor, sample in zip(estimate.suite.sensors, samples)
        )
        known, found = estimate.correct(known, samples, truth)
        return (lines, estimate.advance(known, jnp.zeros(3))), found.errors

    def one(key):
        lines = estimate.suite.initial_state(key, truth)
        return jax.lax.scan(step, (lines, estimate.initial_state(truth, initial)), length=steps)[1]

    return jax.vmap(one)(keys)


@pytest.mark.long
def test_without_noise_and_push_the_centres_are_the_truth():
    """The commands are accounted for over the latency, and over the window between two positions.

    What is left is the allowance under the root of a cut.
    """
    suite = Suite((RelativePosition((BallNoise(0.0),), latency=2),))
    estimate = SetMembership(suite, window=7, **{**NUMBERS, "disturbance": 0.0})
    truth, lines = motion_state(jnp.ones(3), jnp.array([0.3, 0.0, 0.0])), ()
    lines = suite.initial_state(jax.random.key(0), truth)
    # Its velocity is not known, its position is not either.
    known = estimate.initial_state(motion_state(1.1 * jnp.ones(3), jnp.zeros(3)), jnp.array([0.2, 0.4]))
    forces = 2.0 * np.random.default_rng(0).normal(size=(120, 3))
    correct, advance = eqx.filter_jit(estimate.correct), eqx.filter_jit(estimate.advance)
    for force in jnp.asarray(forces):
        lines, samples = suite.sample(lines, truth)
        known, found = correct(known, samples, truth)
        known = advance(known, force)
        off = truth.position - found.state.position, truth.velocity - found.state.velocity
        assert (np.linalg.norm(np.stack(off), axis=1) <= np.asarray(found.errors)).all()
        u = force / 20.0
        truth = motion_state(truth.position + truth.velocity + 0.5 * u, truth.velocity + u)
    assert np.abs(np.stack(off)).max() < 2e-6
    assert np.asarray(found.errors).max() < 2e-6


def test_a_sample_that_contradicts_is_left_out_and_believed_at_last():
    estimate = SetMembership(close(jnp.asarray(3)), patience=3, **NUMBERS)
    known = estimate.initial_state(motion_state(jnp.zeros(3), jnp.zeros(3)), jnp.array([0.05, 0.002]))
    still, away = motion_state(jnp.zeros(3), jnp.zeros(3)), jnp.array([5.0, 0.0, 0.0])
    yes = jnp.asarray(True)
    positions, told = [], []
    for value in (jnp.zeros(3), away, away, jnp.zeros(3), away, away, away):
        known, found = estimate.correct(known, (Sample(value, yes), Sample(jnp.zeros(3), yes)), still)
        positions.append(float(found.state.position[0]))
        told.append(bool(found.contradicted))
        known = estimate.advance(known, jnp.zeros(3))
    assert told == [False, True, True, False, True, True, True]
    assert positions == [0.0] * 6 + [5.0]


def test_a_contradiction_is_counted_on_between_samples_that_are_seldom():
    """A position that contradicts every second step is believed though a velocity agrees in each."""
    estimate = SetMembership(close(jnp.asarray(3)), patience=3, **NUMBERS)
    known = estimate.initial_state(motion_state(jnp.zeros(3), jnp.zeros(3)), jnp.array([0.05, 0.002]))
    still, away = motion_state(jnp.zeros(3), jnp.zeros(3)), jnp.array([5.0, 0.0, 0.0])
    for step in range(5):
        came = jnp.asarray(step % 2 == 0)
        samples = Sample(away, came), Sample(jnp.zeros(3), jnp.asarray(True))
        known, found = estimate.correct(known, samples, still)
        known = estimate.advance(known, jnp.zeros(3))
    assert float(found.state.position[0]) == 5.0


def test_a_sample_that_is_not_a_number_contradicts_and_is_never_believed():
    estimate = SetMembership(close(jnp.asarray(3)), patience=1, **NUMBERS)
    known = estimate.initial_state(motion_state(jnp.zeros(3), jnp.zeros(3)), jnp.array([0.05, 0.002]))
    samples = Sample(jnp.full(3, jnp.nan), jnp.asarray(True)), Sample(jnp.zeros(3), jnp.asarray(True))
    _, found = estimate.correct(known, samples, motion_state(jnp.zeros(3), jnp.zeros(3)))
    assert bool(found.contradicted)
    assert np.isfinite(np.asarray(found.errors)).all()
    assert np.isfinite(np.asarray(found.state.position)).all()


def test_after_a_replaced_position_the_window_begins_anew():
    """The velocity must not be taken from a position that is no longer believed and one that is."""
    suite = Suite((RelativePosition((BallNoise(0.05),)),))
    estimate = SetMembership(suite, window=10, patience=1, **NUMBERS)
    known = estimate.initial_state(motion_state(jnp.zeros(3), jnp.zeros(3)), jnp.array([0.05, 0.002]))
    still, away = motion_state(jnp.zeros(3), jnp.zeros(3)), jnp.array([500.0, 0.0, 0.0])
    for step in range(30):
        value = jnp.zeros(3) if step < 5 else away
        known, found = estimate.correct(known, (Sample(value, jnp.asarray(True)),), still)
        assert bool(found.contradicted) == (step == 5)
        known = estimate.advance(known, jnp.zeros(3))
    assert float(jnp.linalg.norm(found.state.velocity)) <= float(found.errors[1])


def test_refused():
    numbers = {**NUMBERS, **LIMITS}
    with pytest.raises(ScenarioError, match=r"^suite: 0 of its sensors bound the position.*add a RelativePosition"):
        design(Suite((RelativeVelocity((BallNoise(0.01),)),)), **numbers)
    with pytest.raises(ScenarioError, match=r"^suite: it has 0 sensors"):
        Suite(())
    seldom = Suite((RelativePosition((BallNoise(0.05),)),))
    with pytest.raises(ScenarioError, match=r"with a window of 0 steps the known set grows without end"):
        caps(SetMembership(seldom, **NUMBERS), **LIMITS)
    with pytest.raises(ScenarioError, match=r"window is -1 steps; it must be at least 0"):
        SetMembership(seldom, window=-1, **NUMBERS)
    with pytest.raises(ScenarioError, match=r"patience is 0 steps; it must be at least 1"):
        SetMembership(seldom, patience=0, **NUMBERS)
    for name, value in (("disturbance", np.nan), ("disturbance", -1e-3), ("mass", 0.0), ("period", -1.0)):
        with pytest.raises(ScenarioError, match=rf"^set membership: {name} is {value} .*it must be finite and "):
            SetMembership(seldom, **{**NUMBERS, name: value})
