"""The guard's own field: a spline of exact distances with proved bounds, built once for each target and kept on disk.

It takes seconds to minutes to build and depends on nothing but the mesh and four numbers, so it is kept in the user's
cache folder under the digest of all of them. A file from there is used only if its checksum, the target's digest and
the certificate's digests agree (`FieldModel.load`); one that does not pass is built anew.
"""

import json
import os
from pathlib import Path

import numpy as np
import platformdirs

from keepout.core.fields.grid_build import build_grid
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.kept import Form, Store
from keepout.core.progress import Progress, silent
from keepout.core.proof.grid import certify_grid

RECIPE = 2
"""To be raised when offset solid, grid build or proof would make another field or certificate of the same numbers."""


def cache_folder() -> Path:
    """Where fields are kept: KEEPOUT_CACHE if that is set, else the platform's folder for caches."""
    chosen = os.environ.get("KEEPOUT_CACHE")
    return Path(chosen) if chosen else platformdirs.user_cache_path("keepout", appauthor=False, opinion=False)


def grid_numbers(target: Target, radius: float) -> tuple[float, float]:
    """Spacing and band, m, of the grid of a target for a chaser radius, m."""
    return max(0.1, float(np.ptp(target.vertices, axis=0).max()) / 400.0), radius + 0.3


def guard_field(
    target: Target, radius: float, *, offset: float = 0.03, closing_radius: float = 0.25, progress: Progress = silent
) -> FieldModel:
    """Give the guard's field for a chaser radius (m), certified for it, from the cache or newly built.

    The spacing is 0.1 m, coarser on targets above 40 m to keep the grid small. `offset` and `closing_radius` (m) are
    those of the offset solid. A folder that cannot be written to costs the time of building, nothing else.
    """
    spacing, band = grid_numbers(target, radius)
    numbers = {"offset": offset, "closing_radius": closing_radius, "spacing": spacing, "band": band, "radius": radius}
    key = json.dumps({"recipe": RECIPE, "target": target.sha256, **numbers}, sort_keys=True)

    def make() -> FieldModel:
        progress(0.0, "guard: offset solid")
        solid = OffsetSolid.build(target.distance, offset=offset, closing_radius=closing_radius)
        progress(0.4, "guard: grid field")
        grid = build_grid(target, spacing=spacing, band=band, solid=solid)
        progress(0.8, "guard: certificate")
        return certify_grid(grid, target, chaser_radius=radius)

    def read(path: Path) -> FieldModel:
        kept = FieldModel.load(path, target=target)
        kept.certificate(radius)
        return kept

    def write(path: Path, made: FieldModel) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        made.save(path)

    store = Store(
        cache_folder(),
        32,
        unread=lambda _, error: progress(0.0, f"guard: a kept field is not used: {error}"),
        unkept=lambda _, error: progress(0.95, f"guard: its field is not kept: {error}"),
    )
    return store.take("guard", key, make, Form(".keepout", read, write))
