"""The target that a command is given by options, or that a field file names, as a scenario's entry."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from keepout.core.errors import FieldError, ScenarioError, UsageError

if TYPE_CHECKING:
    from keepout.core.fields.model import FieldModel
    from keepout.core.mission.entries import TargetEntry


def target_entry(source: Mapping[str, Any], *, options: str = "--") -> "TargetEntry":
    """Make an entry of options named like the entries of `[target]`; one that is None is left out.

    Args:
        source: the options.
        options: what each one's name begins with on the command line, for a refusal.

    Raises:
        UsageError: an option is not valid.

    """
    from keepout.core.mission.scenario import Scenario

    given = {key: value for key, value in source.items() if value is not None}
    try:
        return Scenario.parse({"target": given}).target
    except ScenarioError as error:  # the user gave options, not a scenario
        raise UsageError(str(error).replace("scenario: target.", options)) from None


def recorded_target(path: Path, model: "FieldModel", mesh: str | None) -> "TargetEntry":
    """Say where a field's mesh is: as given, or as `fit` recorded it, or the built-in of its name."""
    from keepout.core.geometry.builtin import BUILTINS

    recorded = model.training.get("target")
    if mesh is not None:
        return target_entry({**(recorded or {}), "source": mesh})
    if recorded is not None:
        return target_entry(recorded)
    if model.target_name in BUILTINS:
        return target_entry({"source": model.target_name})
    raise FieldError(f"{path}: does not say where its mesh is; name it with --mesh")
