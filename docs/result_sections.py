"""The sections of docs/results.md: each gives its lines from the file of one benchmark's kept results."""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from field_sections import fits, fits_by_seed, guard_fields, motion, slopes, theorems
from flight_code_sections import flight_code
from inspection_sections import full_covers, inspecting, public_inspection
from paper_sections import errata, reproduction, training
from result_tables import kept_file, measured, note, table

SWEEPS = {
    "rival": "rival",
    "setting": "numbers",
    "chosen": "chosen",
    "flights": "flights",
    "reached_without_contact": "reached",
    "contacts": "contacts",
    "refused": "refused",
    "time_over_bound": "time / bound",
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
REACH = {
    "target": "target",
    "law": "law",
    "slowing_length_m": "k_p m",
    "gradient_error": "e_∇h",
    "tumbling_deg_s": "tumbling °/s",
    "speed_limit_mps": "speed limit m/s",
    "seed": "seed",
    "flights": "pairs",
    "reached": "reached",
    "refused": "refused",
    "contacts": "contacts",
    "minimum_clearance_m": "least clearance m",
    "saturated_fraction": "steps saturated",
    "delta_v_mps": "Δv m/s",
    "delta_v_over_floor": "Δv / floor",
    "time_over_bound": "time / bound",
}
GUIDANCE = {
    "geodesic": "geodesic",
    "none": "straight, no circulation",
    "printed": "straight, printed Ω",
    "skew": "straight, constant skew Ω",
    "switching": "straight, switching skew Ω",
}
SETTING_PAIRS = 128
"""Pairs of each row of the paper's law at its settings."""
NAVIGATION = {
    "target": "target",
    "suite": "suite",
    "estimate": "estimate",
    "flights": "flights",
    "refused": "refused",
    "reached": "reached",
    "contacts": "contacts",
    "undecided": "undecided",
    "minimum_clearance_m": "least clearance m",
    "saturated_fraction": "saturated",
    "delta_v_mps": "Δv m/s",
    "ratio": "Δv over noise-free",
    "guard_share": "guard share",
}
STUCK = {
    "target": "target",
    "layout": "layout",
    "stuck": "stuck",
    "detection_s": "known after s",
    "flights": "flights",
    "covered": "covered",
    "reached": "reached",
    "contacts": "contacts",
    "undecided": "undecided",
    "minimum_clearance_m": "least clearance m",
    "guard_share": "guard share",
    "saturated_fraction": "saturated",
    "delta_v_mps": "Δv m/s",
    "propellant_kg": "propellant kg",
}

APPROACH = {
    "target": "target",
    "part": "part",
    "flights": "flights, or steps",
    "refused": "refused",
    "contacts": "contacts",
    "undecided": "undecided",
    "zones_entered": "zones entered",
    "zones_undecided": "zones undecided",
    "zone_clearance_m": "least from a zone m",
    "corridor_clearance_m": "least from a wall m",
    "minimum_clearance_m": "least clearance m",
    "holds_kept": "holds kept",
    "reached": "reached",
    "delta_v_mps": "Δv m/s",
    "delta_v_over_straight": "Δv / straight legs",
    "delta_v_over_without_zones": "Δv / without zones",
    "time_over_without_zones": "time / without zones",
    "step_p50_us": "step p50 µs",
    "step_p50_without_us": "p50 without zones µs",
    "step_p99_us": "p99 µs",
    "step_p99_without_us": "p99 without zones µs",
}

ADVERSARY = {
    "mission": "mission",
    "attack": "attack",
    "flights": "flights",
    "steps": "steps",
    "contacts": "contacts",
    "below_threshold": "at or below θ",
    "false_flags": "flagged wrongly",
    "least_clearance_m": "least clearance m",
    "least_above_threshold_m": "least f̃ − θ m",
    "unpromised_contacts": "contacts before a plan",
    "broken": "broken",
    "broken_flagged": "of them flagged",
    "broken_contacts": "contacts of the broken",
    "broken_contacts_flagged": "of these flagged",
}


def origins() -> list[str]:
    """Give where each table comes from: command, machine, date, and the commit with which it was kept."""
    columns = {key: key for key in ("tables", "command", "machine", "date", "commit")}
    rows = [{"tables": name, **entry} for name, entry in kept_file("origins").items()]
    rows = [row | {"command": f"`{row['command']}`"} for row in rows]
    words = ["The shipped fields are of 2026-11-29: flights before that day are by those of their time."]
    return measured("Where the figures come from", words, rows, columns)


def reach() -> list[str]:
    """Give every law on the same pairs of start and goal, without a guard."""
    rows = [row | {"law": law_of(row)} for row in kept_file("reach") if row["flights"] != SETTING_PAIRS]
    words = [
        "`python benchmarks/reach.py`; discussed in [The control law](control.md). Pairs are random and keep 0.5 m "
        "between chaser and mesh. Refused: goals in the law's keep-out zone, or targets that turn too fast; they "
        "count as not reached. Reached: the flight ends within 0.1 m of the goal. A flight lasts twice the diagonal "
        "of the box of pairs over the speed limit, and 600 s more, and by the paper's law another 6 k_p/v_max. That "
        "law's thrusters hardly rest, so compare its Δv only between rows of one target and k_p. Δv, its ratio to the "
        "floor (disturbance rejection and the two changes of speed) and time over the bound (shortest way / speed "
        "limit) are medians.",
    ]
    return measured("Every law, without a guard", words, rows, REACH)


def settings() -> list[str]:
    """Give the paper's law at every k_p and e_∇h, which it does not print."""
    rows = [row for row in kept_file("reach") if row["flights"] == SETTING_PAIRS]
    columns = {name: REACH[name] for name in ("target", "slowing_length_m", "gradient_error", "flights", "reached")}
    columns |= {"clean": "reached without contact"}
    columns |= {name: REACH[name] for name in ("contacts", "minimum_clearance_m", "delta_v_mps", "time_over_bound")}
    length, error = best_setting()
    words = [
        "`python benchmarks/reach.py --flights 128 --laws paper --slowing 1.5 5 10 20 --gradient 0 0.2 0.42 0.9 "
        "largest`; discussed in [The control law](control.md#the-error-of-the-gradient). The "
        "last e_∇h of each target is the largest among 20,000 points. Over all targets most flights reach the goal "
        f"without contact at k_p = {length:g} m and e_∇h = {error:g}: that setting is its best in the README and "
        "among the rivals. Case 3 has a best of its own for each target.",
    ]
    return measured("The paper's law at its settings", words, rows, columns)


def best_setting() -> tuple[float, float]:
    """Give the k_p (m) and e_∇h at which most flights of the paper's law reach, untouched, over all targets."""
    clean: dict[tuple[float, float], int] = {}
    targets: dict[tuple[float, float], int] = {}
    for row in kept_file("reach"):
        if row["flights"] == SETTING_PAIRS:
            setting = row["slowing_length_m"], row["gradient_error"]
            clean[setting] = clean.get(setting, 0) + row["clean"]
            targets[setting] = targets.get(setting, 0) + 1
    everywhere = [setting for setting in clean if targets[setting] == max(targets.values())]
    return max(everywhere, key=lambda setting: clean[setting])


def law_of(row: Mapping[str, Any]) -> str:
    """Name the law of a row of benchmarks/reach.py."""
    return ("the paper's: " if row["profile"] == "paper" else "") + GUIDANCE[row["guidance"]]


def faults() -> list[str]:
    """Give every fault against every disturbance, within the guard's assumptions and beyond them."""
    rows = []
    for within in (True, False):
        chosen = [row for row in kept_file("faults") if row["within_assumptions"] is within]
        for fault in sorted({row["fault"] for row in chosen}):
            for twice in (False, True):
                some = [
                    row
                    for row in chosen
                    if row["fault"] == fault and (row["disturbance"] == "twice the bound") is twice
                ]
                if some:
                    rows.append(fault_row(fault, within, twice, some))
        if within:
            rows.append(fault_row("all of these", within, False, chosen))
    words = [
        "`python benchmarks/faults.py`; discussed in [Limits](safety.md). Hurt: not proved free of contact by the "
        "audit. Flagged: the guard said that an assumption did not hold. Inside margin: nearer than the operator's "
        "margin of 0.1 m, which the law keeps, and the guard only with `guard.keeps_margin`, which is off here.",
        *note("faults"),
    ]
    return measured("Faults, with the guard", words, rows, {key: key for key in rows[0]})


def fault_row(fault: str, within: bool, twice: bool, some: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Add up the rows of one fault over targets and disturbances."""
    counts = ("flights", "contacts", "undecided", "inside_margin", "flagged", "hurt", "hurt_and_flagged", "reached")
    return {
        "fault": fault,
        "disturbance": "twice its bound" if twice else "within its bound",
        "assumptions": "hold" if within else "broken",
        **{key.replace("_", " "): sum(row[key] for row in some) for key in counts},
        "least clearance m": min(row["minimum_clearance_m"] for row in some),
    }


def navigation() -> list[str]:
    """Give the standard missions flown on what sensors say, beside those flown on the true state."""
    kept = kept_file("navigation")
    rows = []
    for row in kept:
        same = ("target", "layout", "flights", "seed")
        suite = "close" if row["suite"] == "wide" else row["suite"]
        like = {key: row[key] for key in same} | {"suite": suite, "estimate": "none"}
        free = next((one for one in kept if like.items() <= one.items()), None)
        pairs = [] if free is None else zip(row["delta_v"], free["delta_v"], strict=True)
        ratios = [one / other for one, other in pairs if one and other]
        rows.append(dict.fromkeys(NAVIGATION) | row | {"ratio": statistics.median(ratios) if ratios else None})
    words = [
        "`python benchmarks/navigation.py`; discussed in [Motion and navigation](motion.md). Law and guard fly on "
        "on/off thrusters (six, Δ-Σ, 20 ms); the pairs are those of the table of every law. Suites: close is ± 0.05 m "
        "and ± 2 mm/s, once a period; wide is ± 0.2 m and ± 10 mm/s; late is close with commands that take effect two "
        "periods late. Estimate none: the true state. Δv over noise-free: the median of the ratios to the same pair "
        "on the true state. Guard share: of all steps, those in which the guard replaced the command.",
        *note("navigation"),
    ]
    return measured("Flown on sensors", words, sorted(rows, key=lambda row: (row["target"], row["suite"])), NAVIGATION)


def approaches() -> list[str]:
    """Give dispersed approaches from hold point to hold point, and abandoned ones."""
    rows = [dict.fromkeys(APPROACH) | row for row in kept_file("approach")]
    words = [
        "`python benchmarks/approach.py`; discussed in [Approaches](approach.md). With sensors and on/off thrusters; "
        "six zones and corridors; of an abandoned flight the holds are those before. A hold is kept where the true "
        "position stays within its tolerance for its dwell.",
        *note("approach"),
    ]
    return measured("Approaches", words, rows, APPROACH)


def stuck() -> list[str]:
    """Give flights with every thruster of a layout stuck."""
    rows = [dict.fromkeys(STUCK) | row for row in kept_file("stuck_thrusters")]
    words = [
        "`python benchmarks/stuck_thrusters.py`; discussed in [Motion and navigation](motion.md). The flights of a row "
        "are spread over all thrusters. Covered: the scenario declares the failure, and the guard is built for it.",
        *note("stuck_thrusters"),
    ]
    return measured("Stuck thrusters, with the guard", words, rows, STUCK)


def adversary() -> list[str]:
    """Give what an adversary's law, disturbance, estimates and clock do to the guard in real time."""
    rows = kept_file("adversary")
    sums = {name: sum(row[name] for row in rows) for name in ADVERSARY if isinstance(rows[0][name], int)}
    least = {name: min(row[name] for row in rows) for name in ("least_clearance_m", "least_above_threshold_m")}
    words = [
        "`python benchmarks/adversary.py`; discussed in [The guard](guard.md). Chaser and target fly as two bodies "
        "about the Earth, by a truth that shares no code with Keepout; distances are libigl's. The law looks ahead to "
        "the least clearance, the disturbance has its declared norm at every instant, and the estimates' errors are at "
        "their vertices. Contacts, least clearance and f̃ − θ are those of flights in which the guard has a certified "
        "plan and no assumption is broken: contacts must be 0 there, and f̃ − θ above 0. Contacts before a plan: those "
        "of chasers that nothing has been promised to since they began, or went without steps. Broken: "
        "estimates worse than declared, repeated or jumping.",
        *note("adversary"),
    ]
    whole = dict.fromkeys(ADVERSARY) | {"mission": "all", "attack": "all"} | sums | least
    return measured("An adversary, with the guard in real time", words, [*rows, whole], ADVERSARY)


def rivals() -> list[str]:
    """Give other methods on the same flights."""
    most: dict[tuple[str, str, bool], Mapping[str, Any]] = {}
    for row in sorted(kept_file("rivals"), key=lambda row: row["flights"]):
        most[row["target"], row["rival"], row["guard"]] = row  # a row of fewer flights was flown first
    words = [
        "`python benchmarks/rivals.py`; each rival is tuned and has Keepout's observer. Successive convexification and "
        "nonlinear MPC arrive sooner near satellites; without a barrier geodesic guidance does as well as the default, "
        "with exact states. Time / bound: as in the table of every law.",
        "![Paths of all rivals into the pocket and across a wing](figures/rivals-paths.png)",
        *note("rivals"),
    ]
    lines = measured("Rivals on the same loop", words, [most[key] for key in sorted(most)], RIVALS)
    swept = [row | {"setting": _setting(row["setting"])} for row in kept_file("rival_sweeps")]
    said = (
        "**Each choice of a rival's numbers: pairs of seed 1 round `intelsat30`, no guard; reached: without contact**"
    )
    return [*lines, said, "", *table(swept, SWEEPS)]


def _setting(numbers: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:g}" for name, value in numbers.items())


def rare_events() -> list[str]:
    """Give what subset simulation finds, against what is known, and beyond the guard's assumptions."""
    kept = kept_file("rare")
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
        "`python benchmarks/rare.py crossing`, `flights` and `table`; discussed in "
        "[Campaigns and rare events](campaigns.md#rare-events). A group "
        "is one answer: 8 runs of 1024 tapes a level, and the 95 % interval from their spread. Cover is the share of "
        "groups whose interval holds the truth.",
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


def campaigns() -> list[str]:
    """Give what a campaign costs, part by part, beside the usual way, and against the number of runs."""
    kept = kept_file("campaign")
    lines = [
        "## Campaigns",
        "",
        "`python benchmarks/campaign.py --scaling 100 1000 10000 100000`; discussed in [Campaigns](campaigns.md). "
        "Case 3's flights around `intelsat30` by the shipped field, the guard on, after start-up; "
        f"{kept['flights']} flights of {kept['steps']} s, medians of three.",
        "",
        *note("campaign"),
        "",
        "**Microseconds a flight-step, by the clock and of processor time, and seconds of the whole campaign**",
        "",
    ]
    columns = {"cores": "cores", "audit": "audit", "clock_us": "clock µs", "cpu_us": "processor µs", "seconds": "s"}
    lines += table([row | {"audit": "yes" if row["audit"] else "no"} for row in kept["times"]], columns)
    lines += ["**Microseconds of one core a flight-step, each part compiled alone**", ""]
    lines += table([{"part": name, "µs": figure} for name, figure in kept["shares_us"].items()])
    lines += ["**A step of the printed law: written with CVXPY, Clarabel and PyTorch, and in a campaign**", ""]
    lines += table([kept["usual way"]])
    lines += [f"**Time against the number of runs, audit included; flights of {kept['scaling_steps']} s**", ""]
    each = [row | {"each": 1e3 * row["seconds"] / row["runs"]} for row in kept["scaling"]]
    columns = {"runs": "runs", "seconds": "s", "each": "ms a flight", "cpu_us": "processor µs a flight-step"}
    return [*lines, *table(each, columns), *equipped()]


def equipped() -> list[str]:
    """Give what flights on sensors and thrusters cost beside those by the true state, and a campaign's first time."""
    kept = kept_file("campaign_equipped")
    columns = {
        "flown": "flown by",
        "clock_us": "clock µs",
        "cpu_us": "processor µs",
        "ratio": "to the first row",
        "first_s": "s of 96 runs, the first time",
        "other_number_s": "s of 128 runs after them",
    }
    rows = [row | {"ratio": row["cpu_us"] / kept["equipped"][0]["cpu_us"]} for row in kept["equipped"]]
    return [
        "**Flights on sensors and thrusters: microseconds a flight-step, audit included**",
        "",
        f"`python benchmarks/campaign.py --equipped`; {kept['flights']} flights of {kept['steps']} s on "
        f"{rows[0]['cores']} cores, medians of three. Campaigns of any number of runs share a few programs, "
        "so that the second campaign compiles nothing.",
        "",
        *note("campaign_equipped"),
        "",
        *table(rows, columns),
    ]


def startup() -> list[str]:
    """Give how long a command takes from its start, with kept programs and without."""
    kept = kept_file("startup")
    runs = min(len(runs) for runs in kept["rows"].values())
    columns = {
        "what": "what",
        "seconds": "s",
        "cpu": "processor s",
        "compiled": "programs compiled",
        "taken": "taken by JAX",
        "whole": "taken whole",
        "first": "s to the first flight",
    }
    rows = [dict.fromkeys(columns) | row | {"what": name} for name, row in kept["medians"].items()]
    words = [
        "`python benchmarks/startup.py`; discussed in "
        "[Install and first flight](tutorial.md#what-is-kept-on-your-disk). A process of its own a row, on "
        f"{kept['cores']} cores; {f'medians of {runs}' if runs > 1 else 'one run each'}. Cold: with an empty folder "
        "for compiled programs; warm: with the folder that the row before has filled.",
        *note("startup"),
    ]
    return measured("Start-up", words, rows, columns)


def learning() -> list[str]:
    """Give the steps a second of the environment for learning."""
    kept = kept_file("gym")
    rates = {"steps a second": "steps a second", "least": "least", "most": "most", "one in a loop": "one in a loop"}
    columns = {
        "guard": "guard",
        "actions": "actions",
        **rates,
        "ratio": "ratio",
        "cpu us a step": "processor µs a step",
    }
    words = [
        f"`python benchmarks/gym_steps.py --out benchmarks/results/gym.json`: {kept['envs']} environments of the "
        f"built-in mission on {kept['cores']} cores, nothing recorded, with random actions and with such as lead "
        f"straight to the goal. Medians of {kept['repeats']}, by the clock, and processor time; beside them one "
        "environment in a loop. [Learn a policy behind the guard](own-parts.md#learn-a-policy-behind-the-guard).",
        *note("gym"),
    ]
    rows = [row | {name: round(row[name]) for name in rates} for row in kept["rows"]]
    return measured("Environments for learning", words, rows, columns)


def exploring() -> list[str]:
    """Give what known-free maps said falsely, how near they come, and the flights by them."""
    kept = kept_file("explore")
    words = [
        "`python benchmarks/explore.py`; discussed in [Mapping](mapping.md). Approaches end 2 to 3 m from the surface; "
        "all to one target go into one map. Bad cubes are said to be free and meet a triangle; over-statements are "
        "points p of a map's field f with f(p) > √(d(p)² + h²), d the distance to the mesh and h the cubes' edge, half "
        "of them sought by ascent. Where no promise is broken both must be 0; where one is, they show what it is good "
        "for. The promised width is room to spare before walls: it makes up for a range error of twice its bound. "
        "Gap: from a point of the surface seen from within 5 m to the nearest free cube, 95 %. Distance less "
        "field: 1 m from such points along the normal.",
        *note("explore"),
    ]
    flown = ("flights", "ordinary")
    lines = measured("A target nobody has a model of", words, *_approaches([r for r in kept if r["part"] not in flown]))
    lines += ["**Flights to goals 1.5 m from a target whose panel is 1 m or more from where it was expected**", ""]
    lines += ["Ordinary: by a truncated-distance map, to which what it has not seen is free.", ""]
    rows = []
    for part in flown:
        for target in sorted({row["target"] for row in kept if row["part"] == part}):
            some = [row for row in kept if row["part"] == part and row["target"] == target]
            rows.append(
                {
                    "map": "known free" if part == "flights" else "ordinary",
                    "target": target,
                    "flights": len(some),
                    "complete": sum(row["complete"] for row in some),
                    "contacts": sum(row["contacts"] for row in some),
                    "least clearance m": min(row["minimum_clearance_m"] for row in some),
                    "views, median": statistics.median(row["views"] for row in some),
                    "s, median": statistics.median(row["duration_s"] for row in some),
                }
            )
    return [*lines, *table(rows)]


def _approaches(rows: Sequence[Mapping[str, Any]]) -> tuple[list[dict[str, Any]], dict[str, str]]:
    columns = {
        "target": "target",
        "mesh": "mesh",
        "errors": "errors",
        "broken": "broken",
        "width_m": "width m",
        "rays_across": "rays across",
        "times": "times the promise",
        "dropout": "lost",
        "grazing_angle": "lost from rad",
        "spacing_m": "h m",
        "outside_m": "begun m outside",
        "approaches": "approaches",
        "arrived": "to the end",
        "views": "views",
        "bad_cubes": "bad cubes",
        "points": "points",
        "over_statements": "over-statements",
        "gap_p95_m": "gap m",
        "under_median_m": "distance less field m, median",
        "under_p95_m": "95 %",
    }
    order = ("approaches", "sheets", "broken", "accuracy")
    shown = sorted(map(dict, rows), key=lambda row: (order.index(row["part"]), row["target"], str(row["broken"])))
    return [row | {"times": row["times"] if row["broken"] in ("range", "pose") else None} for row in shown], columns


SECTIONS = (
    origins,
    reach,
    settings,
    faults,
    navigation,
    stuck,
    approaches,
    adversary,
    reproduction,
    training,
    errata,
    rivals,
    rare_events,
    exploring,
    inspecting,
    full_covers,
    public_inspection,
    campaigns,
    startup,
    learning,
    fits,
    fits_by_seed,
    slopes,
    guard_fields,
    theorems,
    motion,
    flight_code,
)
"""As they stand on the page."""
