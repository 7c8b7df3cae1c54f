"""Write docs/results.md: the tables of the paper's reproduction, of its errata, and of the rivals, as measured.

python docs/results.py           # write it
python docs/results.py --check   # exit 1 where the page is not of these results

Every figure comes from a file under benchmarks/results, and every file from a command that the page names.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from keepout.report.terminal import shown

PAGE = Path(__file__).with_name("results.md")
RESULTS = PAGE.parents[1] / "benchmarks" / "results"


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


def reproduction() -> list[str]:
    """Give the paper's Section VI, part by part."""
    path = RESULTS / "paper.json"
    kept = json.loads(path.read_text(encoding="utf-8"))
    lines = [
        "## The paper's Section VI, repeated",
        "",
        "`keepout reproduce all -o out/paper`, of which this is `tables.json`.",
    ]
    lines += [f"Machine: {kept['machine']}. Date: {kept['date']}. Version: {kept['version']}.", ""]
    for section in kept["sections"]:
        lines += [f"### {section['title']}", "", f"The paper: {section['paper']}", ""]
        for paragraph in section["ours"]:
            lines += [paragraph, ""]
        for entry in section["tables"]:
            lines += [f"**{entry['caption']}**", "", *table(entry["rows"])]
    return lines


ERRATA = {
    "erratum": "erratum",
    "quantity": "quantity",
    "printed": "as printed",
    "mended": "mended",
    "unit": "unit",
}
RIVALS = {
    "target": "target",
    "rival": "rival",
    "guard": "guard",
    "flights": "flights",
    "reached": "reached",
    "refused": "refused",
    "contacts": "contacts",
    "minimum_clearance_m": "least clearance m",
    "delta_v_mps": "Δv m/s",
    "time_over_bound": "time / bound",
    "plan_s": "plan s",
    "step_ms": "step ms",
    "machine": "machine",
    "note": "note",
}
BUSY = (
    "Times of steps and plans were taken on a machine that flew other rows at the same time: they compare rivals by "
    "orders of magnitude, not by tenths."
)


def measured(
    title: str, words: Sequence[str], rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str]
) -> list[str]:
    """Give the section of one benchmark: its title, a paragraph for each of the words, and its rows."""
    lines = [f"## {title}", ""]
    for paragraph in words:
        lines += [paragraph, ""]
    return [*lines, *table(rows, columns)]


def errata() -> list[str]:
    """Give what each slip of the paper does."""
    words = ["`python benchmarks/errata.py`; discussed in from-paper-to-code.md."]
    return measured("The paper's errata, measured", words, kept_rows("errata"), ERRATA)


def rivals() -> list[str]:
    """Give other methods on the same flights."""
    most: dict[tuple[str, str, bool], Mapping[str, Any]] = {}
    for row in sorted(kept_rows("rivals"), key=lambda row: row["flights"]):
        most[row["target"], row["rival"], row["guard"]] = row  # a row of fewer flights was flown first
    words = ["`python benchmarks/rivals.py`; discussed in rivals.md.", BUSY]
    return measured("Rivals on the same loop", words, [most[key] for key in sorted(most)], RIVALS)


def kept_rows(name: str) -> list[dict[str, Any]]:
    """Read the rows that a benchmark has left."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def rare_events() -> list[str]:
    """Give what subset simulation finds, against what is known, and beyond the guard's assumptions."""
    kept = json.loads((RESULTS / "rare.json").read_text(encoding="utf-8"))
    columns = {
        "case": "case",
        "truth": "truth",
        "groups": "groups",
        "cover": "cover",
        "too_low": "below the truth",
        "too_high": "above it",
        "bias": "bias",
        "bias_error": "± bias",
        "cover_t_of_mean": "cover, t of the mean",
        "cover_t_of_logarithms": "cover, t of the logarithms",
        "relative_spread_of_a_group": "spread of a group",
    }
    lines = [
        "## Rare events",
        "",
        "`python benchmarks/rare.py crossing`, `flights` and `table`; discussed in rare.md. A group is one "
        "answer: 8 runs of 1024 tapes a level, and the 95 % interval from their spread. Cover is the share of groups "
        "whose interval holds the truth.",
        "",
        "**The maximum of an Ornstein–Uhlenbeck process (correlation time, s, of so many samples a second apart), "
        "truth by quadrature; 58 368 tapes a group**",
        "",
        *table([{"case": name, **row} for name, row in kept["crossing"].items()], columns),
    ]
    flown = [
        {"case": f"{name}, below {clearance:.3f} m", **row}
        for name, case in kept["flights"].items()
        for clearance, row in zip(case["clearances_m"], case["figures"])
    ]
    with_error = columns | {"truth_error": "± truth"}
    lines += ["**Flights of 120 s along a wing of `intelsat30`, truth by brute force**", "", *table(flown, with_error)]
    rows = []
    for row in kept["table"]:
        low, high = row["interval"] or (0.0, row["probability_below"])
        rows.append(row | {"said": row["probability"], "low": low, "high": high})
    columns = {
        "fault": "fault",
        "guard": "guard",
        "said": "P(contact)",
        "low": "from",
        "high": "to, 95 %",
        "levels": "levels",
        "flights_a_level": "flights a level",
        "flights": "flights",
        "least_clearance_m": "least clearance m",
    }
    lines += ["**The same flights with faults beyond the guard's assumptions: measured**", ""]
    return [*lines, *table(rows, columns)]


def page() -> str:
    """Give the whole page."""
    lines = ["# Results", "", "Written by `python docs/results.py` from the files under `benchmarks/results`.", ""]
    return "\n".join([*lines, *reproduction(), *errata(), *rivals(), *rare_events()]).rstrip() + "\n"


if __name__ == "__main__":
    if "--check" in sys.argv:
        sys.exit(
            0 if PAGE.read_text(encoding="utf-8") == page() else "docs/results.md is old: run python docs/results.py"
        )
    PAGE.write_text(page(), encoding="utf-8")
