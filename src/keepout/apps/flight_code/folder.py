"""The folder of flight code that `keepout export --to c` writes: sources, tables, a self-test and how to build them.

A mission's numbers are C text, its tables one binary image.
"""

from importlib import resources
from pathlib import Path
from typing import Any

import jax
import numpy as np

from keepout.apps.flight_code.mission_tables import digest_of, image_of, sizes_text, tables_text
from keepout.apps.flight_code.missions import Coded, coded, require_entries
from keepout.apps.flight_code.self_test import estimate_text, header, selftest_text
from keepout.core.errors import ExchangeError
from keepout.core.mission.build import Mission, prepare
from keepout.core.mission.scenario import Scenario, ScenarioLike
from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import require_place, write_whole
from keepout.flights.thrusters.on_off import OnOffThrusters


def write_flight_code(
    source: ScenarioLike | Mission, out: str | Path, *, progress: Progress = silent
) -> dict[str, Any]:
    """Write a mission's flight code into a folder; everything is made before the first file is written.

    Args:
        source: what to fly: a `Scenario`, the path of its TOML file, its tables, or a prepared `Mission`.
        out: the folder; files of these names in it are replaced.
        progress: called as the work goes on.

    Returns:
        The folder, its files, the bytes of the tables, by how much a packed field can be wrong (m), what rounding
        can do to the guard's tests (as a field value, m), to its force (N) and to the law's field (m), and whether
        the start is under the guard's theorem with packing and rounding counted.

    Raises:
        ExchangeError: something of the mission that the code cannot fly; the message names the entry.

    """
    folder = Path(out)
    require_place(folder / "tables.bin", refusal=ExchangeError)
    progress(0.0, "preparing")
    if isinstance(source, Mission):
        mission = source
    else:
        scenario = Scenario.of(source)
        require_entries(scenario)
        mission = prepare(scenario, progress=part_of(progress, 0.0, 0.5))
    progress(0.5, "packing tables")
    made = coded(mission)
    image = image_of(made)
    progress(0.6, "self-test: its steps are flown in Python")
    files: dict[str, bytes] = {
        "tables.bin": image,
        "mission_sizes.h": sizes_text(made).encode(),
        "mission_tables.c": tables_text(made, digest_of(image)).encode(),
        "selftest_steps.h": selftest_text(made).encode(),
        "flight_begin.h": _begin(made, len(image)),
    }
    files |= sources()
    files["README.md"] = _readme(made, len(image), files["README.md"].decode()).encode()
    progress(0.95, "writing")
    for name, content in files.items():
        write_whole(folder / name, content, refusal=ExchangeError)
    progress(1.0, "")
    return {
        "folder": str(folder),
        "files": sorted(files),
        "tables_bytes": len(image) + _network_bytes(made),
        "packing_error_m": made.packing_error,
        "rounding_m": made.rounding.guard_field,
        "rounding_n": made.rounding.force,
        "law_rounding_m": made.rounding.law_field,
        "start_certified": made.mission.start_certified,
    }


def sources() -> dict[str, bytes]:
    """Give the files that are the same for every mission, by their names in the folder."""
    root = resources.files("keepout.apps.flight_code") / "sources"
    found = {item.name: item.read_bytes() for item in root.iterdir() if item.is_file()}
    return found | {f"examples/{item.name}": item.read_bytes() for item in (root / "examples").iterdir()}


def _network_bytes(made: Coded) -> int:
    layers = getattr(made.law.velocity.field, "layers", None)
    return 0 if layers is None else sum(4 * np.size(array) for array in jax.tree.leaves(layers))


def _begin(made: Coded, image: int) -> bytes:
    return header(
        "Where the mission's flight begins, and how many bytes its tables have",
        f"#define FLIGHT_IMAGE {image}u",
        "",
        f"static const keepout_estimate flight_begin = {estimate_text(made.mission.initial)};",
    ).encode()


def _readme(made: Coded, image: int, text: str) -> str:
    """Fill what differs by mission into the sources' README."""
    guard, scenario, thrusters = made.mission.guard, made.mission.scenario, made.mission.setup.thrusters
    layout = thrusters if isinstance(thrusters, OnOffThrusters) else None
    suite = scenario.navigation.suite != "none"
    told = {
        "MISSION": scenario.name,
        "IMAGE_BYTES": f"{image:,}",
        "NETWORK_BYTES": f"{_network_bytes(made):,}",
        "PACKING_ERROR": f"{1e3 * made.packing_error:.3f} mm",
        "ROUNDING": f"{made.rounding.guard_field:.1e} m",
        "LAW_ROUNDING": f"{made.rounding.law_field:.1e} m",
        "FORCE_ROUNDING": f"{made.rounding.force:.1e} N",
        "EVALUATION_ERROR": "none" if guard is None else f"{1e3 * guard.evaluation_error:.3f} mm",
        "CERTIFIED": {True: "is", False: "is not", None: "has no guard, and so is not"}[made.mission.start_certified],
        "PERIOD": f"{scenario.control.period:g} s",
        "TOLD": f"what the sensors of the suite `{scenario.navigation.suite}` say" if suite else "the estimated state",
        "BEGUN_WITH": "the first estimate and the first samples" if suite else "the first estimate",
        "TOLD_EACH_TIME": (
            "the samples that arrived, each of them taken `KEEPOUT_LATENCY` periods ago"
            if suite
            else "the estimate of that time"
        ),
        "ASSUMED": (
            "samples keep within the sensors' bounds" if suite else "the estimate keeps within the errors declared"
        ),
        "THRUSTERS": f"{len(layout.push)} thrusters and their allocation" if layout else "ideal thrusters",
        "DONE_WITH_IT": "fire `order.pulse`, each in the middle of the time" if layout else "hold `order.force`",
    }
    for name, value in told.items():
        text = text.replace(f"@{name}@", value)
    return text
