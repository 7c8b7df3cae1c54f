"""What each section of docs/results.md is written with: files of kept results, and their rows as tables."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from keepout.flights.pages.page import shown

RESULTS = Path(__file__).parents[1] / "benchmarks" / "results"


def kept_file(name: str) -> Any:
    """Read a file of kept results."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def note(name: str) -> list[str]:
    """Give what is to be known of how a file of results was measured, as a paragraph, or nothing."""
    said = kept_file("origins")[name]["note"]
    return [f"How it was measured: {said}."] if said else []


def cell(value: Any) -> str:
    """Format a value for a cell: as in the terminal, on one line, and a dash for nothing."""
    return "–" if value is None else shown(value).replace("|", "\\|").replace("\n", " ")


def table(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str] | None = None) -> list[str]:
    """Give one line a row; the columns by their headings, or all of them."""
    if not rows:
        return ["No rows.", ""]
    columns = columns or {key: key for key in rows[0]}
    lines = ["| " + " | ".join(columns.values()) + " |", "|" + " --- |" * len(columns)]
    lines += ["| " + " | ".join(cell(row[key]) for key in columns) + " |" for row in rows]
    return [*lines, ""]


def measured(
    title: str, words: Sequence[str], rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str]
) -> list[str]:
    """Give the section of one benchmark: its title, a paragraph for each of the words, and its rows."""
    lines = [f"## {title}", ""]
    for paragraph in words:
        lines += [paragraph, ""]
    return [*lines, *table(rows, columns)]
