"""Fields for the reproduction: found, fitted once, and gone on with after a stop."""

import dataclasses

import jax
import numpy as np
import pytest

from keepout.apps.reproduction.fitted import Recipe, field_of
from keepout.apps.reproduction.work import Work
from keepout.core.geometry.target import Target
from keepout.core.learning.losses import PROFILES

pytestmark = pytest.mark.long

TINY = Recipe(
    "tiny",
    "-tiny",
    dataclasses.replace(PROFILES["paper"], width=8, depth=2, samples=2000, batch=200, steps=500),
    None,
)


@pytest.fixture(scope="module")
def target() -> Target:
    return Target.load("pocket")


@pytest.fixture(scope="module")
def fitted_once(target, tmp_path_factory):
    """Folder of a part that has fitted the field, and the field."""
    folder = tmp_path_factory.mktemp("reproduction") / "table1"
    return folder, field_of(Work(folder), TINY, target, fitting=True)


def weights(model):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(model.field.layers)]


@pytest.mark.slow  # other work that is gone on with is in test_work
def test_a_fit_that_was_stopped_goes_on_to_the_same_field(target, fitted_once, tmp_path):
    def stop(_fraction: float, message: str) -> None:
        if message.startswith("distance"):
            stopped.append(message)
        if len(stopped) == 1:
            raise KeyboardInterrupt

    stopped: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        field_of(Work(tmp_path / "part", progress=stop), TINY, target, fitting=True)
    folder = tmp_path / "part" / "fields"
    assert [path.name for path in folder.iterdir()] == ["pocket-tiny.checkpoint"]
    later: list[str] = []
    resumed = field_of(
        Work(tmp_path / "part", progress=lambda _, message: later.append(message)), TINY, target, fitting=True
    )
    assert sum(message.startswith("distance") for message in later) == 1  # one block of two was left
    assert [path.name for path in folder.iterdir()] == ["pocket-tiny.keepout"]
    for first, second in zip(weights(fitted_once[1]), weights(resumed), strict=True):
        np.testing.assert_array_equal(first, second)
    assert resumed.training["curve"]["steps"] == [250, 500]
