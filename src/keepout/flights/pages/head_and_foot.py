"""What every page begins and ends with: its verdict and whether the theorem held, and what it was made of.

The head is read off a summary, so that page, terminal and printed report say the same. The foot names all that is
needed to make the page again; `SOURCE_DATE_EPOCH` (s since 1970) stands for the date where pages are to be equal.
"""

import datetime
import json
import math
import os
import platform
import re
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import keepout

if TYPE_CHECKING:
    from keepout.core.mission.scenario import Scenario
    from keepout.flights.pages.replayed import Replayed

_HARMLESS = "command"
"""The guard's flag that breaks no assumption: a command that was not finite was replaced."""
_BARE = re.compile(r"[A-Za-z0-9_-]+")
"""A key that TOML takes without quotes."""


@dataclass(frozen=True)
class Headline:
    """What a page says first.

    Attributes:
        said: the verdict, a sentence.
        good: whether it is what one wants; None where it is neither good nor bad, or open.
        theorem: whether the guard's theorem held, a sentence; empty where there is none to hold.

    """

    said: str
    good: bool | None = None
    theorem: str = ""


def verdict_of(summary: Mapping[str, Any]) -> Headline:
    """Say what became of one flight, by the summary that `Flight`, `Exploration` and `Inspection` give."""
    contact = str(summary["contact_verdict"])
    said = contact_said(contact, summary["minimum_clearance_m"])
    return Headline(f"{said} at every instant." if contact == "no" else f"{said}.", contact == "no", _theorem(summary))


def contact_said(contact: str, least: float, of: str = "the clearance") -> str:
    """Say what an audit says of contact and, where there was none, how large a clearance (m) is at least."""
    if contact == "no":
        return f"No contact, proved: {at_least(least, of)}"
    return {"yes": "Contact", "undecided": "Contact not excluded"}[contact]


def at_least(least: float, of: str = "the clearance") -> str:
    """Say that a clearance is at least so many metres: down to a millimetre, as it is a lower bound."""
    return f"{of} is at least {math.floor(1e3 * least) / 1e3:.3f} m"


def _theorem(summary: Mapping[str, Any]) -> str:
    certified, broken = summary.get("start_certified"), summary.get("assumptions_broken") or ()
    if certified is None or not summary.get("guard"):
        return "No guard flew, so no theorem promised anything beforehand."
    if broken:
        return f"The guard's theorem does not hold: it was flown beyond what is assumed: {'; '.join(broken)}."
    if not certified:
        return "The guard's theorem does not hold: the start is not one that it covers."
    flags = {name: steps for name, steps in (summary.get("guard_flags") or {}).items() if name != _HARMLESS}
    if flags:
        seen = ", ".join(f"{name.replace('_', ' ')} in {steps} steps" for name, steps in flags.items())
        return f"The guard's theorem covers the start; then the guard saw an assumption fail: {seen}."
    return "The guard's theorem held: it covers the start, and the guard saw no assumption fail."


@dataclass(frozen=True)
class Provenance:
    """What a page was made of.

    Attributes:
        scenarios: by words that tell them apart; a single one has none.
        digests: SHA-256 of what was flown around and by, by words.
        seed: of every draw.

    """

    scenarios: Mapping[str, "Scenario"] = field(default_factory=dict)
    digests: Mapping[str, str] = field(default_factory=dict)
    seed: int | None = None

    @classmethod
    def of(cls, flights: Iterable["Replayed"]) -> "Provenance":
        """Gather what some flights were made of."""
        flights = list(flights)
        digests = {f"mesh {flight.target.name}": flight.target.sha256 for flight in flights}
        digests |= {f"field of {flight.target.name}": flight.field_sha256 for flight in flights if flight.field_sha256}
        seeds = {flight.scenario.seed for flight in flights}
        seed = seeds.pop() if len(seeds) == 1 else None
        return cls({flight.name: flight.scenario for flight in flights}, digests, seed)

    def rows(self) -> dict[str, str]:
        """Give what stands at the foot, by words."""
        return {
            "version": f"keepout {keepout.__version__}, Python {platform.python_version()}",
            **({} if self.seed is None else {"seed": str(self.seed)}),
            **self.digests,
            "date": date(),
            "machine": machine(),
            "command": command(),
        }


def date() -> str:
    """Give the minute of now, or of `SOURCE_DATE_EPOCH`, in UTC."""
    told = os.environ.get("SOURCE_DATE_EPOCH")
    now = datetime.datetime.now(datetime.UTC)
    then = datetime.datetime.fromtimestamp(int(told), datetime.UTC) if told and told.isdecimal() else now
    return f"{then:%Y-%m-%d %H:%M} UTC"


def machine() -> str:
    """Name the processor, its number of cores, and the operating system."""
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text(encoding="utf-8").splitlines() if cpus.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    name = names[0] if names else platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores, {platform.system()}"


def command() -> str:
    """Give the command line of this process where it is Keepout's, else the program that called Keepout."""
    program = Path(sys.argv[0]) if sys.argv and sys.argv[0] else Path("python")
    if program.stem == "keepout" or program.parts[-3:-1] == ("keepout", "cli"):
        return shlex.join(["keepout", *sys.argv[1:]])
    return f"Python: {program.name}"


def as_toml(scenario: "Scenario") -> str:
    """Write a scenario with every entry that has a value, as a file that `keepout fly` takes."""
    tree = json.loads(scenario.model_dump_json())
    alone = [f"{key} = {_value(value)}" for key, value in tree.items() if not isinstance(value, dict | None)]
    tables = [
        "\n".join(["", f"[{key}]", *_lines(value)]) for key, value in tree.items() if isinstance(value, dict) and value
    ]
    return "\n".join([*alone, *tables]) + "\n"


def _lines(tree: Mapping[str, Any], above: str = "") -> Iterator[str]:
    for key, value in tree.items():
        name = f"{above}{key if _BARE.fullmatch(key) else json.dumps(key, ensure_ascii=False)}"
        if isinstance(value, dict) and value:
            yield from _lines(value, f"{name}.")
        elif value is not None:
            yield f"{name} = {_value(value)}"


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{{', '.join(_lines(value))}}}"
    if isinstance(value, list):
        return f"[{', '.join(_value(entry) for entry in value)}]"
    # As JSON does, which is TOML but for the one control character that JSON leaves as it is.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
