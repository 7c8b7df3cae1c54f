"""The verb `fit`: from a mesh to a field, with its certificate where it is asked for."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from keepout.core.errors import FieldError, UsageError
from keepout.core.fields import load_shipped, shipped_names
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.target import Target
from keepout.core.learning import training
from keepout.core.learning.losses import TrainingProfile
from keepout.core.mission.entries import TargetEntry
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import Progress, part_of, silent
from keepout.core.proof.certificate import certify as _certify
from keepout.core.whole_file import require_place
from keepout.verbs.meshes import MeshLike, mesh_of


def fit(
    target: MeshLike,
    *,
    profile: str | TrainingProfile = "default",
    chaser_radius: float | None = None,
    certify: bool = False,
    out: str | Path | None = None,
    first: FieldModel | str | Path | None = None,
    until_bound: float | None = None,
    at_most: float | None = None,
    seed: int = 0,
    progress: Progress = silent,
    **how: Any,
) -> FieldModel:
    """Learn a target's signed distance, tightest where the chaser touches; with `certify`, prove its error bound.

    With `out` a fit that was stopped goes on from its last checkpoint when it is called again.

    Args:
        target: a `Target`, a built-in target's name, a mesh or map file, or a scenario, whose target.
        profile: "default", "fine" (two to four times the work), "quick" (rough), "paper" or "paper_printed"; or a
            `TrainingProfile`.
        chaser_radius: of the ball that holds the chaser, m; a scenario's own, and else 0.5, if absent.
        certify: then prove by how much the field over-states the distance (e_h, m), for this radius.
        out: the field file (.keepout) to write, before and after the proof.
        first: the field of a mesh that differs little, to begin with, its file, or a built-in target's name: half the
            time or less.
        until_bound: end as soon as no over-statement above this is found, m.
        at_most: end after about this time, s; the proof's is not counted.
        seed: the same seed, target and profile on the same machine give the same field, but for `at_most`.
        progress: called as the work goes on.
        **how: `checkpoint` (a file kept up to date while training) and `solid` (the target's `OffsetSolid`).

    Returns:
        The field, with its certificate where it was asked for.

    Raises:
        KeepoutError: an unknown profile, a radius that is negative or too large, a mesh that cannot be used, a
            checkpoint of another fit, or a file that cannot be written.

    """
    path = None if out is None else Path(out)
    if path is not None:
        if path.suffix != ".keepout":
            raise UsageError(f"{path}: a field file ends in .keepout")
        require_place(path, refusal=FieldError)
    if isinstance(target, Mapping) or (isinstance(target, str | Path) and Path(target).suffix.lower() == ".toml"):
        target = Scenario.of(target)
    if chaser_radius is None:
        chaser_radius = target.chaser.radius if isinstance(target, Scenario) else 0.5
    loaded, entry = mesh_of(target)
    part = part_of(progress, 0.0, 0.9) if certify else progress
    first = field_named(first) if isinstance(first, str | Path) else first
    ends = {"first": first, "until_bound": until_bound, "at_most": at_most}
    settings = {"profile": profile, "chaser_radius": chaser_radius, "seed": seed, **ends, **how}
    model = learned(loaded, entry, path, settings, progress=part)
    if certify:
        part = part_of(progress, 0.9, 1.0)
        model = _certify(model, loaded, chaser_radius=chaser_radius, seed=seed, progress=part)
        if path is not None:
            model.save(path)
    return model


def field_named(name: Any) -> FieldModel:
    """Read a field: a file's, or the one that comes with the package for a built-in target of this name.

    Raises:
        KeepoutError: neither, or a file that cannot be read.

    """
    if str(name) in shipped_names():
        return load_shipped(str(name))
    if isinstance(name, str | Path) and Path(name).suffix == ".keepout":
        return FieldModel.load(name)
    valid = f"a .keepout file, or one of {', '.join(shipped_names())}"
    raise UsageError(f"{name}: no field; it must be {valid}. `keepout describe {name}` says what is wrong with a mesh")


def learned(
    target: Target, entry: TargetEntry | None, path: Path | None, settings: Mapping[str, Any], *, progress: Progress
) -> FieldModel:
    """Fit a field, note where its mesh is, and save it; a checkpoint beside the file lets a stopped fit go on.

    Args:
        target: what to learn.
        entry: where it was found; None where that is not known.
        path: the file, if it is to be written.
        settings: of `core/learning/training.fit`.
        progress: called as the work goes on.

    """
    kept: dict[str, Any] = {} if path is None else {"checkpoint": path.with_name(path.name + ".checkpoint")}
    model = training.fit(target, **(kept | dict(settings)), progress=progress)
    if entry is not None:
        located = entry.model_dump()
        if Path(entry.source).exists():
            located["source"] = str(Path(entry.source).resolve())
        model = model.with_training(target=located)
    if path is not None:
        model.save(path)  # before it is certified, so that a proof that is stopped loses nothing
    return model
