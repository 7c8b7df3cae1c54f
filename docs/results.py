"""Write docs/results.md, all tables as measured, and the table of headline figures in README.md.

python docs/results.py           # write both
python docs/results.py --check   # exit 1 where one of them is not of these results

Every figure comes from a file under benchmarks/results, or the certificates that come with the package, and every file
from a command that the page names. Machine, date and commit of each stand in origins.json.
"""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from result_sections import SECTIONS, SETTING_PAIRS, best_setting
from result_tables import kept_file, table

from keepout.core.fields import load_shipped, shipped_names

PAGE = Path(__file__).with_name("results.md")
README = PAGE.parents[1] / "README.md"
BEGIN, END = "<!-- headline figures: written by docs/results.py -->\n", "<!-- headline figures: end -->\n"


def page() -> str:
    """Give the whole page."""
    lines = [
        "# Results",
        "",
        "`python docs/results.py` writes this page from the files under `benchmarks/results`. [Limits](safety.md) "
        "says which statements are proved and which are measured. Where laws are compared, a contact does not end a "
        "flight, so reached and contacts may add up to more than the flights. The exact distance has no sign: a least "
        "clearance of about −0.5 m, the chaser's radius, is the least that can be found, and says that the chaser's "
        "centre met the mesh. Meshes of `../shared/meshes` are public models that the checkout does not hold: "
        "`tests/truths/real_meshes.py` names the source of each.",
        "",
    ]
    return "\n".join(lines + [line for section in SECTIONS for line in section()]).rstrip() + "\n"


def headline() -> list[dict[str, str]]:
    """Give the figures that README.md shows, each with what prints it."""
    within = [row for row in kept_file("faults") if row["within_assumptions"]]
    laws = [row for row in kept_file("reach") if row["seed"] == 0 and row["tumbling_deg_s"] == 0.0]
    default = [row for row in laws if row["profile"] == "default" and row["guidance"] == "geodesic"]
    length, error = best_setting()
    laws = [row for row in laws if row["flights"] != SETTING_PAIRS and row["profile"] == "paper"]
    printed, best = (
        [row for row in laws if (row["slowing_length_m"], row["gradient_error"]) == setting]
        for setting in ((1.5, 0.0), (length, error))
    )
    sensed = [row for row in kept_file("navigation") if (row["suite"], row["estimate"]) == ("close", "filter")]
    sensed = [row for row in sensed if row["flights"] == max(one["flights"] for one in sensed)]
    explored = [row for row in kept_file("explore") if row["part"] == "flights"]
    inspected = [row for row in kept_file("inspection") if "contact" in row]
    planned = [row["coverage_seeable"] for row in inspected if row["part"] == "targets"]
    stuck = kept_file("stuck_thrusters")
    sections = {section["name"]: section for section in kept_file("paper")["sections"]}
    steps = {row["contender"]: row["median_ms"] for row in sections["runtime"]["tables"][0]["rows"]}
    step = "; ".join(
        ", ".join(f"{steps[f'{who}: printed constants, {field}']:.2f} ms" for who in ("Keepout", "usual way"))
        for field in ("shipped field", "10 x 512")
    )
    bounds = {name: load_shipped(name).certificate(0.0).error_bound for name in shipped_names()}
    proved = ", ".join(f"{1000 * bound:+.0f} mm `{name}`" for name, bound in bounds.items())
    return [
        {
            "what": "contacts in guarded flights within the guard's assumptions, hostile laws included",
            "figure": f"{total(within, 'contacts')} of {total(within, 'flights')}",
            "command": "python benchmarks/faults.py",
        },
        {
            "what": "goals reached near four targets at rest by the default law without a guard, and contacts",
            "figure": f"{total(default, 'reached')} of {total(default, 'flights')}, {total(default, 'contacts')}",
            "command": "python benchmarks/reach.py",
        },
        {
            "what": "the same by the source paper's law at that of 20 settings with most flights that reach without "
            f"contact (k_p {length:g} m, e_∇h {error:g})",
            "figure": f"{total(best, 'reached')} of {total(best, 'flights')}, {total(best, 'contacts')}",
            "command": f"python benchmarks/reach.py --laws paper --slowing {length:g} --gradient {error:g}",
        },
        {
            "what": "the same with its printed constants, and for what it does not print k_p 1.5 m and e_∇h 0",
            "figure": f"{total(printed, 'reached')} of {total(printed, 'flights')}, {total(printed, 'contacts')}",
            "command": "python benchmarks/reach.py --laws paper",
        },
        {
            "what": "the same by the default law on sensors (± 0.05 m, ± 2 mm/s, 1 Hz) and on/off thrusters, guarded",
            "figure": f"{total(sensed, 'reached')} of {total(sensed, 'flights')}, {total(sensed, 'contacts')}",
            "command": "python benchmarks/navigation.py",
        },
        {
            "what": "contacts in guarded flights with one of twelve thrusters stuck, off or on",
            "figure": f"{total(stuck, 'contacts')} of {total(stuck, 'flights')}",
            "command": "python benchmarks/stuck_thrusters.py",
        },
        {
            "what": "goals reached near targets that nothing on board had a model of, and contacts",
            "figure": f"{total(explored, 'complete')} of {len(explored)}, {total(explored, 'contacts')}",
            "command": "python benchmarks/explore.py flights",
        },
        {
            "what": "seen at least, of what can be seen, of five targets inspected; contacts, dispersed flights too",
            "figure": f"{100.0 * min(planned):.1f} %, {total(inspected, 'contact')} of {len(inspected)}",
            "command": "python benchmarks/inspection.py",
        },
        {
            "what": "proved bound on what the shipped fields over-state on the surface, R = 0",
            "figure": proved,
            "command": "keepout certify --check src/keepout/data/fields/TARGET.keepout",
        },
        {
            "what": "one step of the paper's law by Keepout, and by CVXPY with PyTorch: with the shipped field; with "
            "the paper's network",
            "figure": step,
            "command": "keepout reproduce runtime",
        },
    ]


def total(rows: Sequence[Mapping[str, Any]], key: str) -> str:
    """Add up a column, with spaces between thousands."""
    return f"{sum(row[key] for row in rows):,}".replace(",", " ")


def readme(text: str) -> str:
    """Give README.md with the headline figures of today's results."""
    head, rest = text.split(BEGIN)
    rows = [row | {"command": f"`{row['command']}`"} for row in headline()]
    lines = table(rows, {"what": "what was measured or proved", "figure": "figure", "command": "command"})
    return head + BEGIN + "\n" + "\n".join(lines) + "\n" + END + rest.split(END)[1]


def main() -> None:
    """Write the page and the README's table, or check them."""
    for path, new in ((PAGE, page()), (README, readme(README.read_text(encoding="utf-8")))):
        if "--check" not in sys.argv:
            path.write_text(new, encoding="utf-8")
        elif path.read_text(encoding="utf-8") != new:
            sys.exit(f"{path.name}: not of these results; run python docs/results.py")


if __name__ == "__main__":
    main()
