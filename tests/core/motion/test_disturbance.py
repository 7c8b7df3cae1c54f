import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from keepout.core.errors import ScenarioError
from keepout.core.motion.chaser import Thrusters
from keepout.core.motion.disturbance import (
    CombinedDisturbance,
    ConstantDisturbance,
    NoDisturbance,
    SinusoidalDisturbance,
    SquareWaveDisturbance,
    band_limited_noise,
    paper_disturbance,
    resonant,
    steady,
)

TIMES = np.linspace(0.0, 5000.0, 20_001)


def forces(disturbance, times):
    """Forces at times, as many at once as `TIMES`: those that are added are left out."""
    return np.asarray(_forces(disturbance, np.resize(times, TIMES.shape)))[: len(times)]


_forces = jax.jit(lambda disturbance, times: jax.vmap(disturbance.force)(times))


def largest(disturbance, times=TIMES):
    return float(np.linalg.norm(forces(disturbance, times), axis=1).max())


def test_the_papers_disturbance_and_its_exact_bound():
    t = np.array([0.0, 1.0, 77.7, 1234.0])
    expected = 0.01 * np.stack([np.sin(0.02 * t), np.cos(0.02 * t), np.sin(0.01 * t)], axis=1)
    np.testing.assert_allclose(forces(paper_disturbance(), t), expected, atol=1e-16)
    # sin² + cos² = 1, and the third axis adds at most 1: the largest norm is exactly 0.01 √2
    assert paper_disturbance().bound == pytest.approx(0.01 * np.sqrt(2), rel=1e-11)
    assert paper_disturbance().bound >= largest(paper_disturbance()) >= 0.01 * np.sqrt(2) * (1 - 1e-5)


@given(st.integers(0, 2**32 - 1))
def test_no_sum_of_sinusoids_exceeds_its_bound(seed):
    generator = np.random.default_rng(seed)
    shape = (4, 3)
    disturbance = SinusoidalDisturbance(
        generator.normal(size=shape),
        generator.choice([0.0, 0.01, 0.02, 0.05], size=shape),  # repeats: axes and terms share frequencies
        generator.uniform(0, 2 * np.pi, shape),
    )
    assert largest(disturbance) <= disturbance.bound
    per_axis = np.linalg.norm(np.abs(disturbance.amplitude).sum(axis=0))
    assert disturbance.bound <= per_axis * (1 + 1e-11)


def test_the_bound_is_tight_for_a_turning_force():
    """Equal amplitudes a quarter turn apart never peak together: the bound is the amplitude, not √2 of it."""
    turning = SinusoidalDisturbance([[0.3, 0.3, 0.0]], [[0.1, 0.1, 0.1]], [[0.0, np.pi / 2, 0.0]])
    assert turning.bound == pytest.approx(0.3, rel=1e-11)


def test_square_wave_switches_on_time():
    wave = SquareWaveDisturbance([0.02, 0.0, -0.01], period=10.0, delay=1.0)
    signs = np.sign(forces(wave, np.array([0.5, 1.5, 5.5, 6.5, 10.5, 11.5])))[:, 0]
    np.testing.assert_array_equal(signs, [-1, 1, 1, -1, -1, 1])
    with pytest.raises(ScenarioError, match="period"):
        SquareWaveDisturbance([0.1, 0.0, 0.0], period=0.0)
    assert largest(wave) <= wave.bound == pytest.approx(np.hypot(0.02, 0.01))


@pytest.mark.as_used
def test_phase_zero_leaves_every_bit():
    noise = band_limited_noise(jax.random.key(3), 0.01, 0.02, (0.05, 0.2))
    for one in (paper_disturbance(), resonant([0.0, 0.03, 0.0], control_period=2.0), noise):
        before, after = jax.tree.flatten(one), jax.tree.flatten(one.shifted(0.0))
        assert before[1] == after[1]
        for old, new in zip(before[0], after[0], strict=True):
            assert np.asarray(old).tobytes() == np.asarray(new).tobytes()
            assert old.dtype == new.dtype
            assert old.weak_type == new.weak_type
    assert largest(noise.shifted(1.0)) <= noise.shifted(1.0).bound == noise.bound
    assert not np.allclose(forces(noise.shifted(1.0), TIMES), forces(noise, TIMES))


def test_control_times_with_rounding_are_on_the_side_after_the_switch():
    times = np.cumsum([0.0, *[0.1] * 999])
    force = forces(resonant([0.03, 0.0, 0.0], control_period=0.1), times)[:, 0]
    np.testing.assert_array_equal(force, (-1.0) ** np.arange(1000) * 0.03)
    with pytest.raises(ScenarioError, match="control_period"):
        resonant([0.1, 0.0, 0.0], 0.0)


def test_noise_is_seeded_bounded_and_in_its_band():
    noise = band_limited_noise(jax.random.key(3), 0.01, 0.02, (0.05, 0.2))
    again = band_limited_noise(jax.random.key(3), 0.01, 0.02, (0.05, 0.2))
    other = band_limited_noise(jax.random.key(4), 0.01, 0.02, (0.05, 0.2))
    values = np.asarray(forces(noise, TIMES))
    np.testing.assert_array_equal(values, forces(again, TIMES))
    assert not np.allclose(values, forces(other, TIMES))
    assert np.linalg.norm(values, axis=1).max() <= noise.bound
    raw = np.asarray(forces(noise.sinusoids, TIMES))
    assert np.linalg.norm(raw, axis=1).max() > 0.02  # the cut does act here
    assert np.sqrt(np.mean(np.sum(raw**2, axis=1))) == pytest.approx(0.01, rel=0.05)
    window = np.hanning(len(raw))[:, None]
    power = np.sum(np.abs(np.fft.rfft(raw * window, axis=0)) ** 2, axis=1)
    frequency = 2 * np.pi * np.fft.rfftfreq(len(raw), d=0.25)
    inside = (frequency > 0.045) & (frequency < 0.205)
    assert power[~inside].sum() < 1e-3 * power.sum()
    with pytest.raises(ScenarioError, match="band"):
        band_limited_noise(jax.random.key(0), 0.01, 0.02, (0.2, 0.05))


def test_sums_add_up():
    both = CombinedDisturbance((ConstantDisturbance([0.01, 0, 0]), paper_disturbance(), NoDisturbance()))
    time = jnp.float64(40.0)
    np.testing.assert_allclose(both.force(time), jnp.array([0.01, 0, 0]) + paper_disturbance().force(time))
    assert largest(both) <= both.bound == pytest.approx(0.01 + 0.01 * np.sqrt(2))
    assert NoDisturbance().bound == 0.0


def test_thrusters_cut_each_axis_alone():
    thrusters = Thrusters([0.1, 0.2, 0.3])
    np.testing.assert_array_equal(thrusters.apply(jnp.array([1.0, -0.15, -5.0])), [0.1, -0.15, -0.3])
    assert bool(thrusters.saturated(jnp.array([0.0, 0.0, -0.3])))
    assert not bool(thrusters.saturated(jnp.array([0.09, -0.19, 0.29])))
    assert np.isnan(thrusters.apply(jnp.array([jnp.nan, 0.0, 0.0]))[0])  # never silently made a number
    np.testing.assert_array_equal(Thrusters(0.1).force_limit, [0.1, 0.1, 0.1])
    for limit in (0.0, [0.1, -0.1, 0.1], float("nan")):
        with pytest.raises(ScenarioError, match="force_limit"):
            Thrusters(limit)


@given(force=hnp.arrays(float, 3, elements=st.floats(-1e3, 1e3)), time=st.floats(0.0, 1e6))
def test_a_steady_force_is_that_force_and_flies_by_the_papers_program(force, time):
    own, papers = steady(force), paper_disturbance()
    # Numbers below 1e-307 count as zero to a processor that flushes them.
    np.testing.assert_allclose(forces(own, [time])[0], force, rtol=1e-15, atol=1e-300)
    assert own.bound == pytest.approx(np.linalg.norm(force), rel=1e-11)
    assert own.bound >= np.linalg.norm(force)
    assert jax.tree.structure(own) == jax.tree.structure(papers)
    assert [leaf.shape for leaf in jax.tree.leaves(own)] == [leaf.shape for leaf in jax.tree.leaves(papers)]
