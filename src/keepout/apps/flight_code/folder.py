"""The folder of flight code that `keepout export --to c` writes: sources, tables, a self-test and how to build them.

A mission's numbers are C text, its tables one binary image.
"""

import dataclasses
import math
import struct
import zlib
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from keepout.apps.flight_code.missions import Coded, coded, directions_of, numbers_of, require_entries, sizes_of
from keepout.apps.flight_code.spline_tables import SplineTables
from keepout.core.control.geodesic import GeodesicGuidance
from keepout.core.errors import ExchangeError
from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.field import values
from keepout.core.fields.neural import NeuralField
from keepout.core.mission.build import Mission, prepare
from keepout.core.mission.scenario import Scenario, ScenarioLike
from keepout.core.motion.chaser import Firing, ThrusterModel
from keepout.core.motion.relative import MotionState
from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import require_place, write_whole
from keepout.flights.on_board import OnBoard, Order
from keepout.flights.thrusters.on_off import OnOffThrusters

FORMAT = 1
"""Of the image; as KEEPOUT_FORMAT in sources/keepout.h."""
_LINE = 110


def image_of(made: Coded) -> bytes:
    """Give the image of a mission's tables, as `keepout_open` reads it (sources/keepout_tables.c)."""
    parts: list[bytes] = []
    guidance = made.law.velocity.guidance
    if isinstance(guidance, GeodesicGuidance):
        parts.append(directions_of(guidance).tobytes())
    for tables in (made.law_tables, made.guard_tables):
        parts += [] if tables is None else tables.parts
    body = struct.pack("<I", len(parts)) + b"".join(struct.pack("<I", len(part)) for part in parts) + b"".join(parts)
    return b"KEEPOUT\0" + struct.pack("<IIII", FORMAT, 0x01020304, len(body), zlib.crc32(body)) + body


def digest_of(image: bytes) -> int:
    """Give the CRC-32 that an image carries."""
    return struct.unpack_from("<I", image, 20)[0]


def sizes_text(made: Coded) -> str:
    """Give mission_sizes.h."""
    lines = [f"#define KEEPOUT_{name} {size}" for name, size in sizes_of(made).items()]
    return "\n".join(
        [
            f"/* Sizes of {made.mission.scenario.name}; written by `keepout export --to c`. */",
            "#ifndef MISSION_SIZES_H",
            "#define MISSION_SIZES_H",
            *lines,
            "#endif",
            "",
        ]
    )


def tables_text(made: Coded, digest: int) -> str:
    """Give mission_tables.c, for an image of this CRC-32."""
    numbers, field = numbers_of(made), made.law.velocity.field
    lines = [
        f"/* The numbers of {made.mission.scenario.name}; written by `keepout export --to c`. */",
        "#include <math.h>",
        "",
        '#include "mission_tables.h"',
        "",
    ]
    network = isinstance(field, NeuralField)
    if network:
        lines += _network(field)
    for name in ("motion", "law", "guard", "thrusters"):
        lines += [f"static const keepout_{name} {name} = {{", *_members(numbers[name]), "};", ""]
    lines += ["const keepout_tables keepout_mission_layout = {", "    .guidance = {"]
    lines += ["    " + line for line in _members(numbers["guidance"])] + ["    },"]
    for name, tables in (("law_spline", made.law_tables), ("guard_spline", made.guard_tables)):
        if tables is not None:
            lines += [f"    .{name} = {{", *("    " + line for line in _spline(tables)), "    },"]
    own = "law_spline" if made.law_tables is not None else "guard_spline"
    lines += [
        "};",
        "",
        f"const uint32_t keepout_mission_digest = 0x{digest:08X}u;",
        "",
        "void keepout_mission_with(const keepout_tables *tables, keepout_mission *mission)",
        "{",
        "    mission->motion = &motion;",
        "    mission->law = &law;",
        "    mission->guard = &guard;",
        "    mission->thrusters = &thrusters;",
        "    mission->guidance = &tables->guidance;",
        f"    mission->network = {'&network' if network else 'NULL'};",
        f"    mission->law_spline = &tables->{own};",
        "    mission->guard_spline = &tables->guard_spline;",
        "}",
        "",
    ]
    return "\n".join(lines)


def _network(field: NeuralField) -> list[str]:
    weights, biases = field.layers.weights, field.layers.biases
    lines: list[str] = []
    for number, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        arrays = [("weights", weight), ("biases", bias)]
        for name, array in arrays[: 2 if number < len(weights) - 1 else 1]:
            values = np.asarray(array).ravel()
            if not np.array_equal(values, values.astype(np.float32)):  # they come from float32
                raise AssertionError("a weight is no float32 number")
            lines += [f"static const float {name}_{number}[{len(values)}] = {{"]
            lines += [*_wrapped([f"{_number(value)}f" for value in values]), "};"]
    hidden = len(weights) - 1
    members = {
        "layers": hidden,
        "width": np.array([len(bias) for bias in biases[:-1]]),
        "weights": "{" + ", ".join(f"weights_{i}" for i in range(hidden)) + "}",
        "biases": "{" + ", ".join(f"biases_{i}" for i in range(hidden)) + "}",
        "last_weights": f"weights_{hidden}",
        "last_bias": f"{_number(float(biases[-1][0]))}f",
        "beta": field.beta,
        "scale": field.scale,
        "continuation": _continuation(field.continuation),
    }
    return [*lines, "", "static const keepout_network network = {", *_members(members), "};", ""]


def _spline(tables: SplineTables) -> list[str]:
    blocks = [len(level.scale) for level in tables.levels] + [int(np.prod(tables.shape))]
    members = {
        "levels": len(blocks),
        "shape": np.array(tables.shape),
        "bricks": np.array(tables.brick.shape),
        "brick_count": f"{len(tables.base)}u",
        "blocks": "{" + ", ".join(f"{count}u" for count in blocks) + "}",
        "origin": tables.origin,
        "spacing": tables.spacing,
        "continuation": _continuation(tables.continuation),
    }
    return _members(members)


def _continuation(cont: RadialContinuation) -> str:
    names = ("centre", "target_radius", "domain_radius", "outer_radius", "allowance")
    return "{" + ", ".join(f".{name} = {value_text(getattr(cont, name))}" for name in names) + "}"


def _members(numbers: dict[str, Any]) -> list[str]:
    return [f"    .{name} = {value_text(value)}," for name, value in numbers.items()]


def value_text(value: Any) -> str:
    """Give a number or an array as a C initialiser; text is left as it is."""
    if isinstance(value, str):
        return value
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if isinstance(value, int | np.integer):
        return str(int(value))
    array = np.asarray(value)
    if array.ndim == 0:
        return _number(float(array))
    return (
        "{"
        + ", ".join(value_text(int(row) if array.dtype.kind in "iu" and array.ndim == 1 else row) for row in array)
        + "}"
    )


def _number(value: float) -> str:
    """Give a number's shortest decimal text: every compiler that rounds correctly reads the same double again."""
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0.0 else "-INFINITY"
    text = repr(float(value))
    return text if "." in text or "e" in text else f"{text}.0"


def _wrapped(words: list[str]) -> list[str]:
    lines, line = [], "   "
    for word in words:
        if len(line) + len(word) + 2 > _LINE:
            lines.append(line)
            line = "   "
        line += f" {word},"
    return [*lines, line]


STEPS = 64
"""Stored in the self-test."""
_BLIND, _JUMP = (20, 21), 40
"""Of these the steps at which the estimate is not a number, and the one at which it jumps half a metre."""


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
        "selftest_steps.h": _selftest(made),
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


class Answer(NamedTuple):
    """What a step answers in Python: of `keepout_order` all in its order.

    Attributes:
        order: law's and guard's.
        mean_force: of what is fired, N, body axes.
        pulse: of each thruster, s; one of 0 s without a layout.
        on_time: likewise.

    """

    order: Order
    mean_force: np.ndarray
    pulse: np.ndarray
    on_time: np.ndarray


def fired(thrusters: ThrusterModel, memory: Any, force: Any) -> tuple[Any, Firing, tuple[Array, Array, Array]]:
    """Fire a force (3,), N, for a control period.

    Returns:
        The memory afterwards, the firing, and of an `Answer` the mean force (N), pulses and on-times (s). A pulse is
        how long a thruster is commanded to be on: what the firing tells of it is late.

    """
    memory, firing = thrusters.fire(memory, force)
    if not isinstance(thrusters, OnOffThrusters):
        return memory, firing, (firing.force, jnp.zeros(1), jnp.zeros(1))
    assert firing.pulses is not None
    assert firing.on_time is not None
    pulse = thrusters.period - 2.0 * (firing.pulses.begin[len(thrusters.push) :] - thrusters.rise_delay)
    return memory, firing, (firing.force, pulse, firing.on_time)


def stored_steps(made: Coded) -> tuple[list[MotionState], list[Answer]]:
    """Fly steps in Python as the code flies them: what each is told, and what it answers.

    They begin half a minute before the flight is nearest to the target. Estimates are wrong within what the guard is
    declared; two are no numbers, one jumps.
    """
    mission, setup, states = made.mission, made.mission.setup, [made.mission.initial]
    board = OnBoard(setup, mission.initial)

    @jax.jit
    def moved(state: MotionState, memory: Any, force: Any) -> tuple[MotionState, Any, tuple[Array, ...]]:
        memory, firing, given = fired(setup.thrusters, memory, force)
        period, mass = setup.period, setup.mass
        return setup.motion.step(state, firing.force, setup.disturbance, period, mass, firing.pulses), memory, given

    def stepped(estimate: MotionState) -> Any:
        parts = (estimate.position, estimate.velocity, estimate.attitude, estimate.angular_velocity)
        return board.step(float(estimate.time), *(np.asarray(part) for part in parts))

    begun = memory = setup.thrusters.initial_state(jax.random.key(0))
    for _ in range(mission.steps):
        state, memory, _ = moved(states[-1], memory, stepped(states[-1]))
        states.append(state)
    away = values(made.law.velocity.field, np.array([state.position for state in states]))
    state = states[max(int(np.argmin(away)) - STEPS // 2, 0)]
    board.restart(state, under_way=[])
    memory = begun
    rng, told, answered = np.random.default_rng(0), [], []
    entry = mission.scenario.guard
    for number in range(STEPS):
        noise = rng.uniform(-0.5, 0.5, (2, 3)) * [[entry.position_error], [entry.velocity_error]] * (number > 0)
        noise[0] += 0.5 if number == _JUMP else 0.0
        estimate = state.moved(*jnp.asarray(noise))
        if number in _BLIND:
            estimate = dataclasses.replace(estimate, position=jnp.full(3, jnp.nan))
        force = stepped(estimate)
        told.append(jax.tree.map(np.asarray, estimate))
        state, memory, given = moved(state, memory, force)
        answered.append(Answer(board.order, *map(np.asarray, given)))
    return told, answered


def _header(said: str, *lines: str) -> bytes:
    """Give a header that only one program includes."""
    head = [f"/* {said}; written by `keepout export --to c`. */", "#include <math.h>", "", '#include "keepout.h"', ""]
    return "\n".join([*head, *lines, ""]).encode()


def _selftest(made: Coded) -> bytes:
    told, answered = stored_steps(made)
    return _header(
        "Stored steps: what each is told, and what Python answers",
        f"#define SELFTEST_STEPS {STEPS}",
        "",
        f"static const keepout_estimate selftest_estimates[{STEPS}] = {{",
        *[f"    {_estimate(state)}," for state in told],
        "};",
        f"static const keepout_order selftest_orders[{STEPS}] = {{",
        *[f"    {{{', '.join(value_text(part) for part in (*order, *given))}}}," for order, *given in answered],
        "};",
    )


def _begin(made: Coded, image: int) -> bytes:
    return _header(
        "Where the mission's flight begins, and how many bytes its tables have",
        f"#define FLIGHT_IMAGE {image}u",
        "",
        f"static const keepout_estimate flight_begin = {_estimate(made.mission.initial)};",
    )


def _estimate(state: MotionState) -> str:
    parts = (state.time, state.position, state.velocity, state.attitude, state.angular_velocity)
    return "{" + ", ".join(value_text(part) for part in parts) + "}"


def _readme(made: Coded, image: int, text: str) -> str:
    """Fill what differs by mission into the sources' README."""
    guard, scenario, thrusters = made.mission.guard, made.mission.scenario, made.mission.setup.thrusters
    layout = thrusters if isinstance(thrusters, OnOffThrusters) else None
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
        "THRUSTERS": f"{len(layout.push)} thrusters and their allocation" if layout else "ideal thrusters",
        "DONE_WITH_IT": "fire `order.pulse`, each in the middle of the time" if layout else "hold `order.force`",
    }
    for name, value in told.items():
        text = text.replace(f"@{name}@", value)
    return text
