"""Built-in targets, each made by parametric code from documented public dimensions."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from manifold3d import Manifold

from keepout.core.errors import MeshError
from keepout.core.geometry.builtin import simple
from keepout.core.geometry.builtin.intelsat30 import intelsat30
from keepout.core.geometry.builtin.iss import iss
from keepout.core.geometry.builtin.solids import mesh
from keepout.core.geometry.builtin.tiangong import tiangong


@dataclass(frozen=True)
class Parameter:
    """A shape parameter: lengths in metres, angles in radians."""

    default: float
    lower: float
    upper: float


@dataclass(frozen=True)
class Builtin:
    """A built-in target: what makes it, and the parameters it takes."""

    name: str
    make: Callable[..., Manifold]
    ranges: dict[str, tuple[float, float]]

    @property
    def summary(self) -> str:
        """The first line of the maker's docstring."""
        return (inspect.getdoc(self.make) or "").splitlines()[0]

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Every parameter with its default and range."""
        defaults = inspect.signature(self.make).parameters
        return {name: Parameter(defaults[name].default, *limits) for name, limits in self.ranges.items()}

    def build(
        self, parameters: dict[str, float] | None = None
    ) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
        """Vertices in metres and outward triangles.

        Raises:
            MeshError: an unknown parameter, or a value outside its range.

        """
        given = dict(parameters or {})
        for name, value in given.items():
            if name not in self.ranges:
                raise MeshError(
                    f"{self.name}: parameter {name!r} is unknown; it takes {', '.join(self.ranges) or 'none'}"
                )
            lower, upper = self.ranges[name]
            if not lower <= value <= upper:
                raise MeshError(f"{self.name}: {name} = {value}; it must be from {lower} to {upper}")
        return mesh(self.make(**given))


_ANGLE = (-float(np.pi), float(np.pi))
BUILTINS: dict[str, Builtin] = {
    b.name: b
    for b in (
        Builtin("intelsat30", intelsat30, {"wing_span": (12.0, 60.0), "wing_angle": _ANGLE}),
        Builtin("iss", iss, {"wing_span": (20.0, 100.0), "wing_angle": _ANGLE}),
        Builtin("tiangong", tiangong, {"wing_span": (10.0, 100.0), "wing_angle": _ANGLE}),
        Builtin("box", simple.box, {"length": (0.1, 400.0), "width": (0.1, 400.0), "height": (0.1, 400.0)}),
        Builtin("sphere", simple.sphere, {"radius": (0.1, 200.0)}),
        Builtin(
            "pocket",
            simple.pocket,
            {"length": (2.0, 100.0), "width": (2.0, 100.0), "depth": (1.0, 100.0), "wall": (0.05, 0.4)},
        ),
    )
}
