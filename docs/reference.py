"""Write docs/scenario.md from the table of entries, and docs/commands.md from the command line.

python docs/reference.py           # write both
python docs/reference.py --check   # exit 1 where one of them is not of this version
"""

import json
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, get_args, get_origin

import typer
from pydantic.fields import FieldInfo
from typer.core import TyperArgument

from keepout import cli
from keepout.core.mission.entries import Entry, TargetEntry, ThrusterEntry
from keepout.core.mission.scenario import Scenario, entries_and_tables, is_table
from keepout.core.mission.task_entries import DispersionEntry, HoldPointEntry, ProtectedEntry

DOCS = Path(__file__).parent
SCENARIO = """\
# Scenario entries

This page lists the entries of a scenario file, what each means, and which values it takes.

A line begins with an entry and its default in TOML (angles rounded). `--set` and refusals put the table before it, as
`guard.delay`. An entry without a default is unset, and one that is *needed* must be given. An empty file is the source
paper's Case 1. Units are SI, angles radians. Places, corners, axes and directions are vectors of three numbers, in the
target's body frame unless said. Write words in quotes, the layouts 12 and 24 too. A number must be >0, or ≥0 where its
default is 0, unless the line ends otherwise; *any* may be negative. A table in double brackets may stand several times.
"""
SEE = {
    "target": "my-mesh",
    "field": "certificate",
    "chaser": "my-mission",
    "thrusters": "my-mission",
    "guard": "faults",
    "control": "control",
    "orbit": "my-mission",
    "attitude": "my-mission",
    "disturbance": "my-mission",
    "navigation": "faults",
    "faults": "faults",
    "[leg]": "approach",
    "approach": "approach",
    "campaign": "campaigns",
    "require": "my-mission.md#require-something",
    "rare": "campaigns.md#rare-events",
    "depth_sensor": "mapping",
    "map": "explore",
    "explore": "explore",
    "camera": "inspection",
    "light": "inspection",
    "inspect": "inspection",
}
"""The page on which a table is used."""
PLAIN = {"scenario", "target", "field", "chaser", "thrusters", "[thrusters.own]", "safety", "guard", "control", "orbit"}
PLAIN |= {"sun", "attitude", "disturbance", "navigation", "start", "goal", "approach", "campaign", "rare"}
PLAIN |= {"depth_sensor", "map", "explore", "camera", "light", "inspect"}
"""Tables whose names say what they are for."""
USUAL_AXES = ", body axes"
"""Said once for the page."""
INNER: Mapping[str, Sequence[tuple[str, type[Entry]]]] = {
    "thrusters": [("[thrusters.own]", ThrusterEntry)],
    "campaign": [('campaign.dispersions."ENTRY"', DispersionEntry)],
    "inspect": [("[inspect.no_thrust_towards]", ProtectedEntry), ("[inspect.hold_points]", HoldPointEntry)],
}
"""Tables within tables, after which they stand."""

COMMANDS = """\
# Command line

`keepout COMMAND --help` says the same as this page, with examples.

The exit code is 0 if the command did its work, whatever an audit's verdict is; 1 if it refused or failed, for which
standard error gives the reason; 2 if the command line is not valid; 3 if results do not meet the scenario's
`[require]`; 130 if it was interrupted. `fit`, `campaign`, `rare` and `reproduce` go on when started again.

## Common options

An option with `=` takes a value; a default stands behind it. `-o` is `--out`. A command's last line names those that it
has. All have the first three, but `scenario schema` has no `--json`.

- `-q`, `--quiet` Say only refusals, warnings and requirements not met
- `--log=` Add all that is said, with times, to this file
- `--json` Print one JSON object ([its keys](files.md)); all else goes to standard error
"""
LEFT_OUT = {"help", "quiet", "log", "as_json"}
"""Options that every command has."""
OF_TARGET = {key.replace("_", "-") for key in TargetEntry.model_fields}
SAID_ABOVE = ("Exit code", "A killed run")
"""Paragraphs of a command's help that begin so are in the table of exit codes."""


def range_of(spec: Mapping[str, Any]) -> str:
    """Say in words which values the JSON Schema of an entry allows; nothing where any of its kind are."""
    if "anyOf" in spec:
        return " or ".join(dict.fromkeys(filter(None, (range_of(one) for one in spec["anyOf"]))))
    if "enum" in spec or "const" in spec:
        return f"`{', '.join(json.dumps(word) for word in spec.get('enum', [spec.get('const')]))}`"
    kind = spec.get("type")
    if kind in ("integer", "number"):
        return ", ".join(filter(None, ("whole" * (kind == "integer"), interval(spec)))) or "any"
    if kind == "array" and "prefixItems" in spec:
        inner = spec["prefixItems"][0]
        if inner.get("type") == "array" or "anyOf" in inner:
            return "3 vectors" if inner.get("type") == "array" else "2 numbers or 2 vectors"
        length = len(spec["prefixItems"])
        return f"{'vector' if length == 3 else f'{length} numbers'} {interval(inner)}".rstrip()
    return ""


def interval(spec: Mapping[str, Any]) -> str:
    """Give the bounds of a number, as `0 to <1` or `>0`; the words are for both bounds."""
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    given = {key: number(spec[key]) for key in signs if key in spec}
    if len(given) == 2:
        return " to ".join(signs[key] * key.startswith("exclusive") + bound for key, bound in given.items())
    return "".join(f"{signs[key]}{bound}" for key, bound in given.items())


def number(value: float) -> str:
    """Write a number: exactly where it is a whole number, else with four digits."""
    if value == int(value):
        return str(int(value)) if value % 1e6 or not value else f"{value:.4g}".replace("e+0", "e").replace("e+", "e")
    return f"{value:.4g}"


def toml(value: Any) -> str:
    """Write a default as TOML, in as few digits as its reader needs; a whole number is a number there."""
    if isinstance(value, tuple | list):
        return f"[{', '.join(toml(part) for part in value)}]"
    return number(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def entry_head(name: str, field: FieldInfo) -> str:
    """Give an entry as TOML with its default, or its name alone."""
    default = None if field.is_required() else field.get_default(call_default_factory=True)
    return f"`{name}`" if default is None else f"`{name} = {toml(default)}`"


def values_of(field: FieldInfo, spec: Mapping[str, Any]) -> str:
    """Give which values an entry takes, as the end of its line, where nothing else on the page says so."""
    values, said = range_of(spec), field.description or ""
    unset = field.is_required() or field.get_default(call_default_factory=True) is None
    words = [word.strip('`"') for word in values.split(", ")]
    if unset and values == ">0":
        values = ""
    told = values.startswith("`") and all(word in said for word in words)
    if told or values in ("vector", "2 numbers or 2 vectors") or (values in ("2 numbers", "3 vectors") and not unset):
        values = ""
    if not unset and spec.get("type") in ("integer", "number"):
        usual = ">0" if field.get_default() else "≥0"
        values = "" if values == usual else values
    values = ", ".join(filter(None, ("needed" if field.is_required() else "", values)))
    return f"; {values}" if values else ""


def holds_tables(annotation: Any) -> bool:
    """Whether an entry is a table or an array of tables, which have sections of their own."""
    return is_table(annotation) or (get_origin(annotation) is tuple and is_table(get_args(annotation)[0]))


def table_lines(title: str, table: type[Entry]) -> Iterator[str]:
    """Give the section of one table; of its entries those that hold no tables, alike ones in one line."""
    page = SEE.get(title)
    said = (table.__doc__ or "").splitlines()[0]
    place = page if page is None or ".md" in page else f"{page}.md"
    header = f"[{title}]" if title.startswith("[") else title
    yield from (f"## [{title}]({place})" if place and title in PLAIN else f"## {header}", "")
    if title not in PLAIN:
        said = said.replace(USUAL_AXES, "")
        yield from (f"[{said}]({place})" if place else said, "")
    properties = table.model_json_schema()["properties"]
    entries = [(key, field) for key, field in table.model_fields.items() if not holds_tables(field.annotation)]
    for (meaning, values), alike in groupby(
        entries, key=lambda entry: (entry[1].description, values_of(entry[1], properties[entry[0]]))
    ):
        yield f"- {', '.join(entry_head(*entry) for entry in alike)} {(meaning or '').replace(USUAL_AXES, '')}{values}"
    yield ""


def scenario_page() -> str:
    """Give the page of all scenario entries."""
    lines = [SCENARIO]
    lines += [line.replace("## scenario", "## No table") for line in table_lines("scenario", Scenario)]
    for key, field in Scenario.model_fields.items():
        if holds_tables(field.annotation) and not is_table(field.annotation):
            lines += table_lines(f"[{key}]", get_args(field.annotation)[0])
    for name, told in entries_and_tables():
        if not isinstance(told, FieldInfo):
            lines += table_lines(name, told)
            for inner in INNER.get(name, ()):
                lines += table_lines(*inner)
    return "\n".join(lines).rstrip() + "\n"


def commands_of(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Give every command with its full name, in the order of the help."""
    if not hasattr(command, "list_commands"):
        yield name, command
        return
    context = typer.Context(command)
    for key in command.list_commands(context):
        yield from commands_of(command.get_command(context, key), f"{name} {key}")


def option_line(option: Any, context: typer.Context) -> str:
    """Give the line of one argument or option: how it is written, with its default after `=`, and what it does."""
    written, said = option.get_help_record(context)
    said, _, ending = said.partition("  [")
    said = said.removesuffix(".")
    if isinstance(option, TyperArgument):
        return f"- `{option.name.upper()}{'…' if option.nargs == -1 else ''}` {said}"
    default = ending.removesuffix("]").partition("default: ")[2]
    notes = "; required" * ("required" in ending)
    if option.is_flag:
        notes += f"; default `--{default}`" * bool(default)
    elif option.metavar is None:
        written = option.opts[-1] + (" X Y Z" if option.nargs == 3 else f"={default}")
    written = written.replace("-o, --out", "-o")
    return f"- `{written}` {said}{notes}"


def commands_page() -> str:
    """Give the page of all commands; lines that several of them have stand at its beginning."""
    described: list[tuple[str, str, dict[str, str]]] = []
    for name, command in commands_of(typer.main.get_command(cli.app), "keepout"):
        context = typer.Context(command)
        said = [part for part in (command.help or "").split("\n\n") if not part.startswith(SAID_ABOVE)]
        options = {
            option.name.upper() if isinstance(option, TyperArgument) else option.opts[-1]: option_line(option, context)
            for option in command.params
            if option.name not in LEFT_OUT
        }
        placed = [key for key in options if key.removeprefix("--target-") in OF_TARGET]
        written = [f"`{options.pop(key).split('`')[1]}`" for key in placed]
        if placed:
            options["placed"] = f"- {', '.join(written)} As in [[target]](scenario.md#target)"
        described.append((name, " ".join(" ".join(said).split()), options))
    count = Counter(line for *_, options in described for line in options.values())
    shared = [line for line in count if count[line] > (2 if line.startswith("- `-o") else 1)]
    lines = [COMMANDS.rstrip(), *shared, ""]
    for name, said, options in described:
        common = [f"`{line.split()[1].strip('`').removesuffix('=')}`" for line in options.values() if line in shared]
        lines += [f"## {name.removeprefix('keepout ')}", "", said, ""]
        own = [line.removeprefix("- `").partition("` ") for line in options.values() if line not in shared]
        for told, alike in groupby(own, key=lambda parts: parts[2]):
            lines.append(f"- {', '.join(f'`{written}`' for written, *_ in alike)} {told}")
        twin = next((other for other, _, same in described if same == options and len(same) > 2), name)
        last = f"As `{twin.removeprefix('keepout ')}`" if twin != name else ", ".join(common)
        lines += [f"- {last}"] * bool(last) + [""]
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    """Write the pages, or check them."""
    for page, text in (("scenario", scenario_page()), ("commands", commands_page())):
        path = DOCS / f"{page}.md"
        if "--check" not in sys.argv:
            path.write_text(text, encoding="utf-8")
        elif not path.exists() or path.read_text(encoding="utf-8") != text:
            sys.exit(f"{path.name}: not of this version; run python docs/reference.py")


if __name__ == "__main__":
    main()
