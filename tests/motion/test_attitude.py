import jax
import jax.numpy as jnp
import numpy as np
import pytest

from keepout.errors import ScenarioError
from keepout.motion import NoDisturbance, Orbit, RelativeMotion, Tumbling


@pytest.mark.parametrize(
    ("inertia", "named"),
    [
        (np.diag([1.0, 1.0, 3.0]), "largest at most the sum"),
        (np.diag([1.0, -1.0, 1.0]), "positive"),
        (np.zeros((3, 3)), "positive"),
        (np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]), "symmetric"),
        (np.full((3, 3), np.nan), "finite"),
    ],
)
def test_tensors_of_no_rigid_body_are_refused(inertia, named):
    with pytest.raises(ScenarioError, match=named):
        Tumbling(jnp.zeros(3), inertia)


def test_an_axisymmetric_body_precesses_in_closed_form():
    """ω₁ + iω₂ turns at (J₃ − J₁)/J₁ ω₃ about the symmetry axis; ω₃ stays."""
    transverse, axial = 100.0, 60.0
    law = Tumbling([0.003, -0.002, 0.008], np.diag([transverse, transverse, axial]))
    motion = RelativeMotion(Orbit(7e6), law)
    state = motion.initial_state(jnp.zeros(3), jnp.zeros(3))

    def body(state, _):
        return motion.step(state, jnp.zeros(3), NoDisturbance(), 1.0, 1.0), None

    end = jax.jit(lambda s: jax.lax.scan(body, s, length=2000)[0])(state)
    phase = (axial - transverse) / transverse * 0.008 * 2000
    expected = (0.003 - 0.002j) * np.exp(1j * phase)
    np.testing.assert_allclose(end.angular_velocity, [expected.real, expected.imag, 0.008], atol=1e-13)


def test_substeps_must_be_at_least_one():
    with pytest.raises(ScenarioError, match="substeps"):
        RelativeMotion(Orbit(7e6), substeps=0)
