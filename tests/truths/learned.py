"""Fields that were learned and proved in this run of the tests, for tests of what comes after, whichever worker asks.

What is given back is what `fit` and `certify` gave for the same target and numbers: both are functions of them, which
tests/test_journey.py and tests/proof/test_fit_and_certify.py hold them to.
"""

import hashlib
import inspect
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from keepout.fields.model import FieldModel

FOLDER = Path(os.environ["KEEPOUT_TESTS_LEARNED"])
"""New for every run (conftest.py)."""
_SAY_NOTHING = {"target", "model", "checkpoint", "solid", "progress"}
"""Arguments that the digests tell, or that change nothing."""


def _path(function: Callable[..., FieldModel], *given: Any, **named: Any) -> Path:
    bound = inspect.signature(function).bind(*given, **named)
    bound.apply_defaults()
    told = {name: value for name, value in bound.arguments.items() if name not in _SAY_NOTHING}
    about = [bound.arguments[name].sha256 for name in ("model", "target") if name in bound.arguments]
    told_apart = repr((function.__name__, about, sorted(told.items())))
    return FOLDER / f"{function.__name__}-{hashlib.sha256(told_apart.encode()).hexdigest()}.keepout"


def _keep(model: FieldModel, path: Path) -> None:
    part = path.with_name(f"{os.getpid()}-{path.name}")
    model.save(part)
    part.replace(path)


def kept(function: Callable[..., FieldModel]) -> Callable[..., FieldModel]:
    """Give `fit` or `certify` as it is, which leaves what comes of it for `taken`."""

    def called(*given: Any, **named: Any) -> FieldModel:
        model = function(*given, **named)
        _keep(model, _path(function, *given, **named))
        return model

    return called


def taken(function: Callable[..., FieldModel]) -> Callable[..., FieldModel]:
    """Give `fit` or `certify` for tests of something else: what was kept of the same call, else of a call now."""

    def called(*given: Any, **named: Any) -> FieldModel:
        path = _path(function, *given, **named)
        if not path.exists():
            _keep(function(*given, **named), path)
        made = FieldModel.load(path)
        if "model" not in inspect.signature(function).parameters:
            return made
        # Certified is the field; how it was learned and its other radii are the asker's own.
        asked = inspect.signature(function).bind(*given, **named).arguments
        certificate = made.certificate(asked.get("chaser_radius", 0.0))
        return asked["model"].with_certificate(certificate)

    return called
