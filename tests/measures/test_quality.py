"""Errors on and off the surface against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.integrate import dblquad

from keepout.fields.analytic import SphereField
from keepout.geometry.distance import ExactDistance
from keepout.geometry.offset_solid import OffsetSolid
from keepout.geometry.target import Target
from keepout.measures.quality import gradient_errors, summarised, surface_errors


def test_a_sphere_field_on_a_cube(tmp_path):
    """On the cube of side 2 the field √(1 + x² + y²) - r is known face by face; r = 1.2 gives it both signs."""
    path = tmp_path / "cube.stl"
    trimesh.creation.box((2.0, 2.0, 2.0)).export(path)
    found = surface_errors(SphereField(jnp.zeros(3), jnp.asarray(1.2)), Target.load(path, units="m"), count=200_000)

    def mean(function):
        return dblquad(lambda y, x: function(np.sqrt(1.0 + x * x + y * y) - 1.2), 0.0, 1.0, 0.0, 1.0, epsabs=1e-5)[0]

    assert found.count == 200_000
    assert found.epsilon == pytest.approx(mean(abs), rel=5e-3)
    over = mean(lambda f: max(f, 0.0)) / mean(lambda f: float(f > 0.0))
    assert found.epsilon_plus == pytest.approx(over, rel=5e-3)
    assert np.sqrt(3.0) - 1.2 - 0.02 < found.maximum <= np.sqrt(3.0) - 1.2


def test_only_what_is_over_stated_counts_in_epsilon_plus():
    found = summarised(np.array([-0.3, -0.1, 0.0, 0.2, 0.4]))
    assert (found.epsilon, found.epsilon_plus, found.maximum) == pytest.approx((0.2, 0.3, 0.4))
    assert summarised(np.array([-0.3, -0.1])).epsilon_plus == 0.0


def test_the_gradient_error_of_a_displaced_sphere():
    """∇d and ∇f̃ point away from centres 0.3 m apart: at most asin(0.3/|p|) between them, but for the facets."""
    facets = 0.02  # half the angle between neighbouring facets and more
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    solid = OffsetSolid.build(ExactDistance(np.asarray(mesh.vertices), np.asarray(mesh.faces)), leaf=0.1)
    displaced = SphereField(jnp.array([0.3, 0.0, 0.0]), jnp.asarray(1.0))
    near = gradient_errors(displaced, solid, nearest=0.05, farthest=0.1, count=20_000)
    largest = 2.0 * np.sin(0.5 * np.arcsin(0.3 / 1.05))
    assert near.mean < near.percentile_95 < near.maximum == pytest.approx(largest, abs=facets)
    far = gradient_errors(displaced, solid, nearest=2.0, farthest=3.0, count=20_000)
    assert far.maximum == pytest.approx(2.0 * np.sin(0.5 * np.arcsin(0.3 / 3.0)), abs=facets)
    exact = gradient_errors(SphereField(jnp.zeros(3), jnp.asarray(1.0)), solid, nearest=0.1, farthest=3.0, count=5_000)
    assert exact.maximum < facets
