"""Signed distance fields: learned, on a grid, of your own; and those that come with the package.

`benchmarks/shipped.py` makes those of the built-in targets anew. Their names alone load no JAX.
"""

from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from keepout.core.errors import FieldError

if TYPE_CHECKING:
    from keepout.core.fields.model import FieldModel
    from keepout.core.geometry.target import Target


def shipped_folder() -> Path:
    """Where the package keeps its fields."""
    return Path(str(resources.files("keepout"))) / "data" / "fields"


def shipped_names() -> tuple[str, ...]:
    """Names of the built-in targets whose fields come with the package."""
    return tuple(sorted(path.stem for path in shipped_folder().glob("*.keepout")))


def shipped_path(name: str) -> Path:
    """Return the file of a built-in target's shipped field.

    Raises:
        FieldError: no field of that name comes with the package.

    """
    if name not in shipped_names():
        raise FieldError(f"shipped field {name!r}: there is none; choose from {', '.join(shipped_names())}, or fit one")
    return shipped_folder() / f"{name}.keepout"


def load_shipped(name: str, *, target: "Target | None" = None) -> "FieldModel":
    """Read the shipped field of a built-in target, and check it against the target if that is given.

    Args:
        name: of the target (`keepout targets` lists them).
        target: the mesh that it should have been made for.

    Raises:
        FieldError: no field of that name comes with the package, or it was made for other geometry than `target`'s.

    """
    from keepout.core.fields.model import FieldModel  # which imports JAX; the names alone do without

    return FieldModel.load(shipped_path(name), target=target)
