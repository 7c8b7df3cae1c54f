"""When samples arrive: rate, latency and dropouts, against a plain loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from keepout.errors import ScenarioError
from keepout.sensing.arrival import Arrival


def run(arrival, steps, seed=0):
    """Values and whether they came, of a line into which the step's number is put."""
    normals = jax.random.normal(jax.random.key(seed), (steps, arrival.normals))

    def step(state, row):
        number, some = row
        state, sample = arrival.step(state, jnp.array([number, -number]), some)
        return state, (sample.value, sample.came)

    values, came = jax.lax.scan(step, arrival.initial_state(jnp.zeros(2)), (jnp.arange(1.0, steps + 1), normals))[1]
    return np.asarray(values), np.asarray(came), np.asarray(normals)


@settings(max_examples=40)
@given(
    st.integers(1, 5), st.integers(0, 4), st.sampled_from([0.0, 0.3, 0.9, 1.0]), st.integers(1, 3), st.integers(0, 99)
)
def test_rate_latency_and_losses_are_exactly_as_told(every, latency, dropout, most_missed, seed):
    arrival = Arrival(every, latency, dropout, most_missed)
    steps = 60
    values, came, normals = run(arrival, steps, seed)
    missed, expected = 0, np.zeros(steps + latency, bool)
    for step in range(0, steps, every):
        lost = dropout > 0 and stats.norm.cdf(normals[step, 0]) < dropout and missed < most_missed
        missed = missed + 1 if lost else 0
        expected[step + latency] = not lost
    assert came.tolist() == expected[:steps].tolist()
    arrived = np.flatnonzero(came)
    # What arrives is what was measured `latency` steps ago, and the first `latency` steps bring nothing.
    assert (values[arrived, 0] == arrived - latency + 1).all()
    assert not came[:latency].any()
    gaps = np.diff(arrived)
    assert gaps.max(initial=0) <= every * (most_missed + 1)
    if dropout == 1.0 and len(gaps):
        assert (gaps == every * (most_missed + 1)).all()
    ages = [step - arrived[arrived <= step][-1] + latency for step in range(arrived[0], steps)] if len(arrived) else [0]
    assert max(ages) <= arrival.oldest


def test_losses_are_as_many_as_told():
    _, came, _ = run(Arrival(dropout=0.1, most_missed=50), 20000)
    assert stats.binomtest(int((~came).sum()), 20000, 0.1).pvalue > 1e-3


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ({"every": 0}, "sensor: every is 0 control periods; it must be a whole number >= 1"),
        ({"latency": -1}, "sensor: latency is -1 control periods; it must be a whole number >= 0"),
        ({"most_missed": -1}, "sensor: most_missed is -1; it must be a whole number >= 0"),
        ({"dropout": 1.1, "most_missed": 1}, "sensor: dropout is 1.1; it must be a probability, 0 to 1"),
        ({"dropout": 0.1}, "sensor: dropout is 0.1 but most_missed is 0; it must be at least 1"),
    ],
)
def test_refused(numbers, said):
    with pytest.raises(ScenarioError) as caught:
        Arrival(**numbers)
    assert str(caught.value) == said
