"""Commands on scenario files as functions: what `scenario new`, `check` and `schema` do."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from keepout.core.errors import ScenarioError, UsageError
from keepout.core.progress import Progress, silent


def new_scenario_file(
    source: Mapping[str, Any],
    out: Path | None,
    *,
    profile: str = "default",
    force: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Draft a scenario, for a target where `source` names one, and write it to `out` where that is given."""
    from keepout.core.mission.draft import draft
    from keepout.core.whole_file import require_place, write_whole

    if out is not None and out.suffix != ".toml":
        raise UsageError(f"{out}: a scenario file ends in .toml")
    if out is not None and out.exists() and not force:
        raise ScenarioError(f"{out}: is there already; --force replaces it")
    if out is not None and not out.absolute().parent.is_dir():
        raise ScenarioError(f"{out}: the folder {out.parent} does not exist")
    if out is not None:
        require_place(out, refusal=ScenarioError)
    if profile not in ("default", "paper"):
        raise UsageError(f"--profile: {profile!r}; it must be 'default' or 'paper'")
    given = {key: value for key, value in source.items() if value}
    if "source" not in given and given:
        raise UsageError(f"--{next(iter(given)).replace('_', '-')}: only with --for, which names the mesh")
    name = "mission" if out is None else "".join(c if c.isalnum() and c.isascii() else "-" for c in out.stem).strip("-")
    made = draft(
        **given,
        name=name or "mission",
        folder=Path() if out is None else out.parent,
        profile=profile,
        progress=progress,
    )
    if out is not None:
        write_whole(out, made.text, refusal=ScenarioError)
    chaser = made.scenario.chaser
    return {
        "scenario": None if out is None else str(out),
        "text": made.text,
        "extents_m": made.extents,
        "start_m": list(made.scenario.start.position),
        "goal_m": list(made.scenario.goal.position),
        "speed_limit_mps": chaser.speed_limit,
        "honoured_speed_mps": made.honoured_speed,
        "margin_m": made.scenario.safety.margin,
        "duration_s": made.scenario.duration,
        "next": [*made.remarks, *([] if out is None else [f"keepout scenario check {out}", f"keepout fly {out}"])],
    }


def check_scenario_file(path: Path, *, progress: Progress = silent) -> dict[str, Any]:
    """Say what a scenario file would fly, without flying it."""
    from keepout.core.mission.scenario import Scenario

    scenario = Scenario.load(path)  # before what checks it is imported, which takes seconds
    from keepout.core.mission.check import check

    return check(scenario, progress=progress).summary()


def schema_file(out: Path | None) -> str:
    """Give the JSON Schema of scenarios as text, written to `out` where that is given."""
    from keepout.core.mission.scenario import schema
    from keepout.core.whole_file import require_place, write_whole

    if out is not None:
        require_place(out, refusal=ScenarioError)
    text = json.dumps(schema(), indent=2, ensure_ascii=False) + "\n"
    if out is not None:
        write_whole(out, text, refusal=ScenarioError)
    return text
