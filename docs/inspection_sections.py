"""The sections of docs/results.md on inspections."""

import statistics

from result_tables import kept_file, measured, note, table

INSPECTIONS = {
    "target": "target",
    "tour": "tour",
    "light": "light",
    "outcome": "outcome",
    "coverage_seeable": "seen of it",
    "coverage_upper_bound": "at most",
    "coverage_lit": "lit",
    "views": "views",
    "way_m": "way m",
    "plans": "plans",
    "before": "computation s, plan",
    "seconds": "flight",
    "contact_verdict": "contact",
    "minimum_clearance_m": "clearance m",
    "delta_v_mps": "Δv m/s",
    "duration_s": "time s",
}
COVERS = {
    "target": "target",
    "by": "candidates see by",
    "places": "places",
    "candidates": "candidates",
    "coverage_of_seeable": "they see of what can be seen",
    "views": "views",
    "views_at_least": "at least",
    "proved": "proved fewest",
    "views_greedy": "by greed",
    "seconds": "s",
}
ACT3 = {
    "task": "reading",
    "seeds": "seeds",
    "success": "success",
    "crashes": "crash sphere entered",
    "crash_radius_m": "its radius m",
    "least_distance_m": "least distance m",
    "delta_v_mps": "Δv m/s",
    "delta_v_axes_mps": "Δv by axes m/s",
    "time_s": "time s",
    "guard_interventions": "guard stepped in",
    "seconds": "s for all",
}


def inspecting() -> list[str]:
    """Give whole inspections by the plan and by other tours, in light, and from dispersed starts."""
    kept = kept_file("inspection")
    words = [
        "`python benchmarks/inspection.py`; discussed in [Inspection](inspection.md). Stand-off 1.5 m, range 10 m "
        "(`iss` 20 m), patches of 0.25 m (`iss` 1 m); 99.5 % of the area that can be seen, and lit in time, was "
        "wanted on board. Seen of it: as flown, at the record's true positions. At most: the proved bound on the share "
        "of the whole area that any chaser could see. Lit: the share of it that can be seen and is lit at some time. "
        "Views and way are of the first plan, and its seconds come with those of what can be seen. Clearance is the "
        "ball's, between samples too.",
        *note("inspection"),
    ]
    rows = []
    for row in kept:
        if row["part"] != "dispersed":
            before = row["seeable_seconds"] + row["plan_seconds"] if "plan_seconds" in row else None
            flown = row | {"duration_s": round(row["duration_s"])} if "duration_s" in row else row
            rows.append(dict.fromkeys(INSPECTIONS) | flown | {"before": before})
    order = ("targets", "baselines", "light")
    rows.sort(key=lambda row: (row["target"], order.index(row["part"]), row["tour"], row["light"]))
    lines = measured("Inspections", words, rows, INSPECTIONS)
    lines += ["**From dispersed starts, with errors of the estimate up to the guard's bounds**", ""]
    dispersed = []
    for target in sorted({row["target"] for row in kept if row["part"] == "dispersed"}):
        some = [row for row in kept if row["part"] == "dispersed" and row["target"] == target]
        flown = [row for row in some if row["outcome"] != "refused"]
        calm = next(row for row in kept if row["part"] == "targets" and row["target"] == target)
        losses = [calm["coverage_seeable"] - row["coverage_seeable"] for row in flown]
        dispersed.append(
            {
                "target": target,
                "flights": len(some),
                "refused": len(some) - len(flown),
                "saw all asked": sum(row["outcome"].endswith(("all seen", "asked, seen")) for row in flown),
                "contacts": sum(row["contact"] for row in flown),
                "least clearance m": min(row["minimum_clearance_m"] for row in flown),
                "seen, median %": 100.0 * statistics.median(row["coverage_seeable"] for row in flown),
                "seen, least %": 100.0 * min(row["coverage_seeable"] for row in flown),
                "lost, median %": 100.0 * statistics.median(losses),
                "Δv m/s, median": statistics.median(row["delta_v_mps"] for row in flown),
                "s, median": statistics.median(row["duration_s"] for row in flown),
                "guard stepped in, steps": sum(row["guard_interventions"] for row in flown),
            }
        )
    return [*lines, *table(dispersed)]


def full_covers() -> list[str]:
    """Give the fewest views that see all that any candidate sees."""
    words = [
        "`python benchmarks/inspection_plans.py`; discussed in [Seeing](seeing.md). The fewest views "
        "that together see all that any candidate sees, and the bound: no choice of fewer of these candidates sees as "
        "much. Other candidates might do with fewer. Stand-off 1.5 m, range 10 m, cone and incidence 60°, patches of "
        "0.25 m. A plan's candidates show a patch with room for a flight's errors. The seconds are of the choice and "
        "its bound.",
        *note("inspection_plans"),
    ]
    by = ("the camera's limits", "a plan's tighter ones")
    rows = [row | {"by": by[row["allowance"]]} for row in kept_file("inspection_plans") if row["part"] == "full cover"]
    rows.sort(key=lambda row: (row["target"], row["allowance"], row["places"]))
    return measured("Full covers", words, rows, COVERS)


def public_inspection() -> list[str]:
    """Give the public inspection task of act3 by both readings."""
    words = [
        "`python benchmarks/act3_inspection.py`; its plan knows points and sun beforehand, as a learned "
        "controller does not. Δv "
        "and time are medians.",
        *note("act3_inspection"),
    ]
    return measured("The public inspection task of act3", words, kept_file("act3_inspection"), ACT3)
