"""The volumes part against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from keepout.apps.reproduction import fitted, shapes
from keepout.apps.reproduction.work import Work
from keepout.core.fields.model import Certificate, FieldModel
from keepout.core.fields.own import SphereField
from keepout.core.geometry.target import Target


class Ball(FieldModel):
    """A model of an exact ball, which has no file form."""

    @property
    def sha256(self) -> str:
        """Stand in for the digest of a file."""
        return "ball"

    def __post_init__(self) -> None:
        """Take any field."""


def test_a_ball_learned_of_a_cube(tmp_path, monkeypatch):
    """Cube of side 1: hull 1 m³, smallest ellipsoid the ball through its corners; the field is a ball of radius 1."""
    trimesh.creation.box((1.0, 1.0, 1.0)).export(tmp_path / "cube.stl")
    cube = Target.load(tmp_path / "cube.stl", units="m")
    monkeypatch.setattr(fitted, "target_of", lambda _: cube)
    certificate = Certificate("sampled", 0.5, 0.1, 0.0, 0.1, 1.0, "sampled", 0.0, 0.0, cube.sha256, "ball")
    model = Ball(SphereField(jnp.zeros(3), jnp.asarray(1.0)), cube.name, cube.sha256, 0.001, {}, (certificate,))
    point, ball = shapes._measured(Work(tmp_path / "volumes", quick=True), cube, model)
    assert point["field_m3"] == pytest.approx(4.0 / 3.0 * np.pi, abs=4.0 * point["standard_error_m3"])
    assert point["exact_m3"] == pytest.approx(1.0, rel=1e-9)
    assert point["hull_m3"] == pytest.approx(1.0, rel=1e-9)
    round_it = 4.0 / 3.0 * np.pi * 0.75**1.5
    assert point["ellipsoid_m3"] == pytest.approx(round_it, rel=1e-4)
    assert point["ellipsoid_over_field"] == pytest.approx(round_it / point["field_m3"], rel=1e-4)
    assert (ball["chaser_radius_m"], ball["level_m"]) == pytest.approx((0.5, 0.6))
    assert ball["field_m3"] == pytest.approx(4.0 / 3.0 * np.pi * 1.6**3, abs=4.0 * ball["standard_error_m3"])
    grown = 1.0 + 6.0 * 0.5 + 3.0 * np.pi * 0.25 + 4.0 / 3.0 * np.pi * 0.125
    assert ball["exact_m3"] == pytest.approx(grown, abs=4.0 * ball["standard_error_m3"])
    assert ball["hull_m3"] == pytest.approx(grown, rel=1e-6)
