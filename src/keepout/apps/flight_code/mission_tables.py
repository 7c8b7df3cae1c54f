"""A mission's numbers as C text, and its tables as one binary image."""

import math
import struct
import zlib
from typing import Any

import numpy as np

from keepout.apps.flight_code.missions import Coded, directions_of, numbers_of, sizes_of
from keepout.apps.flight_code.spline_tables import SplineTables
from keepout.core.control.geodesic import GeodesicGuidance
from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.neural import NeuralField

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
    parts = ("motion", "law", "guard", "thrusters", *(["navigation"] if "navigation" in numbers else []))
    for name in parts:
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
        *[f"    mission->{name} = &{name};" for name in parts],
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
    return value_text({name: getattr(cont, name) for name in names})


def _members(numbers: dict[str, Any]) -> list[str]:
    return [f"    .{name} = {value_text(value)}," for name, value in numbers.items()]


def value_text(value: Any) -> str:
    """Give a number, an array, a list or members by name as a C initialiser; text is left as it is."""
    if isinstance(value, str):
        return value
    if isinstance(value, dict):
        return "{" + ", ".join(f".{name} = {value_text(part)}" for name, part in value.items()) + "}"
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if isinstance(value, int | np.integer):
        return str(int(value))
    if isinstance(value, list | tuple):
        return "{" + ", ".join(map(value_text, value)) + "}"
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
