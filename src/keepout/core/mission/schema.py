"""The JSON Schema of scenario files, by which editors complete, explain and check them."""

from typing import Any

from keepout.core.mission.scenario import Scenario


def schema() -> dict[str, Any]:
    """Give the JSON Schema (draft 2020-12) of a scenario: every entry with its meaning, unit, default and bounds.

    What depends on several entries at once is not in it: `Scenario.load` says that.
    """
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": "keepout-scenario",
        **Scenario.model_json_schema(),
        "title": "Keepout scenario",
    }
