"""The paper's Case 3 (section VI.C.3): a thousand flights around InterSat-30 and around the ISS from random starts."""

import dataclasses
import functools
from typing import Any

import numpy as np

from keepout.apps.reproduction.figures import draw_series, draw_settings
from keepout.apps.reproduction.fitted import (
    GRADIENT_BAND,
    OFFSET,
    largest_gradient_error,
    paper_network,
    solid_of,
    target_of,
)
from keepout.apps.reproduction.in_memory import SERIES, FlightSeries, plan_campaign
from keepout.apps.reproduction.work import Part, Table, Work, side_by_side
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.target import Target
from keepout.core.mission.build import load_model
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import Progress, part_of

PAPER = (
    "1000 flights each around InterSat-30 (x in [-15, 15] m, y in [-5, 5] m, z = -4 m, to [0, -10, 6] m, 3000 s) and "
    "the ISS (x in [-60, 60] m, y in [-40, 40] m, z = -30 m, to [0, -10, 6] m, 4000 s). h is strictly positive in all, "
    "V₁ and the position error converge to zero in all; the speed may pass its limit."
)

PRINTED = "printed constants"
DEFAULTS = "defaults with guard"
LAWS: dict[str, dict[str, Any]] = {
    PRINTED: {"control": {"profile": "paper"}, "guard": {"enabled": False}},
    DEFAULTS: {"control": {"profile": "default"}, "guard": {"enabled": True}},
}

DEFAULT_LAW = "default law alone"
ALONE: dict[str, Any] = {"control": {"profile": "default"}, "guard": {"enabled": False}}
PRINTED_MU_V = 1e-4
"""The paper's μ_v, 1/s²."""
LENGTHS = (1.5, 5.0, 10.0, 20.0)
"""k_p, m, and below e_∇h: what the paper does not print, so its law is flown at all of these."""
ERRORS = (0.0, 0.2, 0.42, 0.9)
"""Besides the largest that was sampled; 0.42 is above 95 % of those sampled around InterSat-30."""
SETTING_RUNS = 256
NETWORK_RUNS = 64

CHUNK = 128
"""Flights between two writings: what a kill loses at most of a campaign."""


def case3_scenarios(seed: int, *, quick: bool) -> dict[tuple[str, str], Scenario]:
    """Give one scenario for each target and law; a quick one flies fewer flights and shorter."""
    runs = 12 if quick else 1000
    around = {
        "intelsat30": {
            "duration": 600.0 if quick else 3000.0,
            "start": {"position": (15.0, 5.0, -4.0)},
            "goal": {"position": (0.0, -10.0, 6.0)},
            "campaign": {"runs": runs, "lower": (-15.0, -5.0, -4.0), "upper": (15.0, 5.0, -4.0)},
        },
        # The printed goal lies inside a module: z is read upwards, and the body frame's points to nadir.
        "iss": {
            "duration": 1400.0 if quick else 4000.0,
            "start": {"position": (60.0, 40.0, 30.0)},
            "goal": {"position": (0.0, -10.0, -6.0)},
            "campaign": {"runs": runs, "lower": (-60.0, -40.0, 30.0), "upper": (60.0, 40.0, 30.0)},
        },
    }
    return {
        (target, law): Scenario().replace(
            name=f"{target}-{law.replace(' ', '-')}", seed=seed, target={"source": target}, **entries, **changes
        )
        for target, entries in around.items()
        for law, changes in LAWS.items()
    }


def with_setting(scenario: Scenario, length: float, error: float, runs: int, name: str) -> Scenario:
    """Give a scenario of the paper's law at a k_p (m) and e_∇h, with time for the longer slowing."""
    later = 6.0 * (length - LENGTHS[0]) / scenario.chaser.speed_limit
    return scenario.replace(
        name=f"{scenario.target.source}-{name}",
        duration=scenario.duration + round(later),
        campaign={"runs": runs},
        control={"paper": {"slowing_length": length, "gradient_error": error}},
    )


def case3(work: Work) -> Part:
    """Fly Case 3 with the printed constants and with the defaults, and a full one with the paper's law at its best."""
    scenarios = case3_scenarios(work.seed, quick=work.quick)
    targets = {name: target_of(name) for name, _ in scenarios}
    settings = [] if work.quick else sweep(work.within(0.0, 0.5), scenarios, targets)
    models: dict[str, FieldModel] = {}
    if settings:
        scenarios |= _others(work, scenarios, settings, targets, models)

    jobs = {
        of.name: functools.partial(flown, work, of, targets[name], models.get(of.name))
        for (name, _), of in scenarios.items()
    }
    answers = side_by_side(jobs, part_of(work.progress, 0.5 if settings else 0.0, 0.95))
    kept = {key: answers[scenario.name] for key, scenario in scenarios.items()}
    rows = [row(*key, scenario, kept[key]) for key, scenario in scenarios.items()]
    drawings = {}
    for name in targets:
        scenario = scenarios[name, PRINTED]
        draw_series(
            work.folder / f"{name}.png",
            {f"{name}, {law}": series(kept[name, law]) for law in LAWS},
            tolerance=scenario.goal.tolerance,
            speed_limit=scenario.chaser.speed_limit,
        )
        drawings[name] = _caption(name, scenario)
    tables = [Table("flights", "Each campaign, by the audit on the exact mesh (metres, seconds, m/s, m²)", rows)]
    if settings:
        beside = [entry for entry in rows if entry["law"] in (DEFAULT_LAW, DEFAULTS)]
        draw_settings(work.folder / "settings.png", settings, beside)
        drawings["settings"] = (
            f"The paper's law at each k_p and e_∇h, {SETTING_RUNS} flights each: the share that stays within the "
            "tolerance of the goal against the share whose contact is not excluded. Beside it Keepout's default law "
            "alone, and with the guard"
        )
        tables.append(Table("settings", "The paper's law at each k_p and e_∇h, which it does not print", settings))
    return Part(
        name="case3",
        title="Case 3: Monte Carlo",
        paper=PAPER,
        ours=found(rows, scenarios, settings, quick=work.quick),
        rows=rows,
        tables=[
            *tables,
            *(
                Table(f"{scenarios[key].name}-flights", f"Around {key[0]}, {key[1]}: the ten flights of least h", worst)
                for key, worst in ((key, _worst(arrays)) for key, arrays in kept.items())
            ),
        ],
        drawings=drawings,
    )


def _largest(work: Work, target: Target, model: FieldModel) -> float:
    made_of = [model.sha256, GRADIENT_BAND, work.seed, OFFSET]
    name = f"largest-gradient-error-{target.name}"
    return work.numbers(
        name, made_of, lambda: largest_gradient_error(model, solid_of(target.name, quick=False), work.seed)
    )


def sweep(work: Work, scenarios: dict[tuple[str, str], Scenario], targets: dict[str, Target]) -> list[dict[str, Any]]:
    """Fly the paper's law around each target at every k_p and e_∇h; gives a row for each."""
    flights: dict[tuple[str, float, float], Scenario] = {}
    for name, target in targets.items():
        printed = scenarios[name, PRINTED]
        largest = _largest(work, target, load_model(printed, target))
        for length in LENGTHS:
            for error in (*ERRORS, largest):
                flights[name, length, error] = with_setting(
                    printed, length, error, SETTING_RUNS, f"kp-{length:g}-error-{error:g}"
                )
    jobs = {of.name: functools.partial(flown, work, of, targets[key[0]], None) for key, of in flights.items()}
    answers = side_by_side(jobs, work.progress)
    rows = []
    for (name, length, error), of in flights.items():
        arrays = answers[of.name]
        touched = arrays["contact"] != "no"
        rows.append(
            {
                "target": name,
                "k_p m": length,
                "e_∇h": error,
                "flights": len(touched),
                "reached": int(arrays["reached"].sum()),
                "clean": int(np.sum(arrays["reached"] & ~touched)),
                "contacts": int(touched.sum()),
                "below h 0": int((arrays["minimum_barrier"] < 0.0).sum()),
                "least h m": _rounded(arrays["minimum_barrier"].min()),
                "least gap m": _rounded(arrays["minimum_clearance"].min()),
                "Δv m/s": _rounded(np.median(arrays["delta_v"])),
                "seconds": of.duration,
            }
        )
    return rows


def best_of(settings: list[dict[str, Any]], target: str) -> dict[str, Any]:
    """Give the setting around a target at which most flights reach the goal without contact."""
    return max((row for row in settings if row["target"] == target), key=lambda row: (row["clean"], -row["contacts"]))


def _others(
    work: Work,
    scenarios: dict[tuple[str, str], Scenario],
    settings: list[dict[str, Any]],
    targets: dict[str, Target],
    models: dict[str, FieldModel],
) -> dict[tuple[str, str], Scenario]:
    """Give what a full run flies besides: the paper's law at its best, guarded, by its own network; no guard.

    `models` is given the fields of those that fly by the paper's network.
    """
    made: dict[tuple[str, str], Scenario] = {}
    for name, target in targets.items():
        best, printed = best_of(settings, name), scenarios[name, PRINTED]
        length, error, runs = best["k_p m"], best["e_∇h"], printed.campaign.runs
        law = f"best setting, k_p {length:g} m, e_∇h {error:g}"
        made[name, law] = with_setting(printed, length, error, runs, "best-setting")
        guarded = printed.replace(guard={"enabled": True})
        made[name, f"{law}, with guard"] = with_setting(guarded, length, error, runs, "best-setting-with-guard")
        made[name, DEFAULT_LAW] = printed.replace(name=f"{name}-default-law-alone", **ALONE)
        network = paper_network(work, target)
        if network is not None:
            for what, setting, ending in (
                (PRINTED, (LENGTHS[0], ERRORS[0]), "printed-network"),
                (law, (length, error), "best-setting-network"),
            ):
                by_network = with_setting(printed, *setting, NETWORK_RUNS, ending)
                made[name, f"{what}, the paper's network"] = by_network
                models[by_network.name] = network
    return made


def flown(
    work: Work, scenario: Scenario, target: Target, model: FieldModel | None, progress: Progress
) -> dict[str, np.ndarray]:
    """Fly a campaign chunk by chunk, each kept as it lands; what an earlier run kept is not flown again.

    Returns the columns of `FlownInMemory.columns`, the series of `SERIES` with their `time`, and `starts_drawn_again`.
    """
    model = load_model(scenario, target) if model is None else model
    planned = functools.cache(lambda: plan_campaign(scenario, target=target, model=model))
    made_of = {
        "scenario": scenario.model_dump(mode="json"),
        "target": target.sha256,
        "field": model.sha256,
        "series": list(SERIES),
    }
    runs = scenario.campaign.runs

    def fly(first: int, last: int) -> dict[str, np.ndarray]:
        # One size for all, so that the last chunk is not compiled anew.
        done = planned().fly(first, last, batch=min(CHUNK, runs))
        shared = {"time": done.series.time[None], "starts_drawn_again": np.array([done.starts_drawn_again])}
        return {**done.columns(), **done.series.values, **shared}

    joined = dataclasses.replace(work, progress=progress).batches(scenario.name, runs, CHUNK, made_of, fly)
    return joined | {name: joined[name][0] for name in ("time", "starts_drawn_again")}


def series(arrays: dict[str, np.ndarray]) -> FlightSeries:
    """Give the time series of a campaign's arrays; every control step was kept."""
    return FlightSeries(arrays["time"], {name: arrays[name] for name in SERIES})


def row(target: str, law: str, scenario: Scenario, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Give a campaign's figures."""
    barrier, contact = arrays["minimum_barrier"], arrays["contact"]
    reached = arrays["reached"]
    error, lyapunov = arrays["position_error"][:, -1], arrays["lyapunov"][:, -1]
    fastest = arrays["axis_speed"].max(axis=1)
    over = fastest > scenario.chaser.speed_limit * (1.0 + 1e-6)  # the series are float32
    return {
        "target": target,
        "law": law,
        "flights": len(reached),
        "seconds_flown": scenario.duration,
        "starts_drawn_again": int(arrays["starts_drawn_again"]),
        "reached": int(reached.sum()),
        "contacts": int((contact != "no").sum()),
        "undecided": int((contact == "undecided").sum()),
        "minimum_clearance_m": _plain(arrays["minimum_clearance"].min()),
        "starts_below_h_0": int((arrays["barrier"][:, 0] < 0.0).sum()),
        "below_h_0": int((barrier < 0.0).sum()),
        "minimum_h_m": _plain(barrier.min()),
        "median_time_to_reach_s": _plain(np.median(arrays["time_to_reach"][reached])) if reached.any() else None,
        "largest_final_error_m": _plain(error.max()),
        "median_final_v1_m2": _plain(np.median(lyapunov)),
        "largest_final_v1_m2": _plain(lyapunov.max()),
        "over_axis_limit": int(over.sum()),
        "largest_axis_speed_mps": _plain(fastest.max()),
        "largest_speed_mps": _plain(arrays["largest_speed"].max()),
        "median_delta_v_mps": _plain(np.median(arrays["delta_v"])),
        "guard_interventions": int(arrays["guard_interventions"].sum()),
    }


def found(
    rows: list[dict[str, Any]],
    scenarios: dict[tuple[str, str], Scenario],
    settings: list[dict[str, Any]],
    *,
    quick: bool,
) -> list[str]:
    """Say in plain sentences what the rows show."""
    said = [
        "The paper prints neither k_p nor e_∇h; the flights with printed constants use "
        f"{scenarios['intelsat30', PRINTED].control.paper.slowing_length:g} m and 0, at 1 Hz and 0.1 N. Around the "
        "built-in ISS the printed goal lies inside a module. With z read upwards it is free: the flights start at "
        "z = +30 m and go to (0, -10, -6) m in body axes. Reached: ends within the goal's tolerance. The campaigns fly "
        "by the shipped fields, except those that say the paper's network.",
    ]
    for target in dict.fromkeys(entry["target"] for entry in settings):
        best, first = best_of(settings, target), next(entry for entry in settings if entry["target"] == target)
        said.append(
            f"{target}: of {len(LENGTHS)} k_p and {len(ERRORS) + 1} e_∇h the paper's law does best at k_p = "
            f"{best['k_p m']:g} m and e_∇h = {best['e_∇h']:g}: {best['clean']} of {best['flights']} flights reach the "
            f"goal without contact, {best['contacts']} touch; at {first['k_p m']:g} m and {first['e_∇h']:g} "
            f"{first['clean']} do, and {first['contacts']} touch."
        )
    if quick:
        shorter = ", ".join(
            f"{target} {scenario.duration:g} s" for (target, law), scenario in scenarios.items() if law == PRINTED
        )
        said.append(f"Quick: {rows[0]['flights']} flights a campaign instead of 1000, and shorter ones ({shorter}).")
    for entry in rows:
        limit = scenarios[entry["target"], entry["law"]].chaser.speed_limit
        over = max(0.0, (entry["largest_axis_speed_mps"] or 0.0) - limit)
        said.append(
            f"{entry['target']}, {entry['law']}: {entry['reached']} of {entry['flights']} reached the goal; contact is "
            f"not excluded in {entry['contacts']}, the least clearance is {_shown(entry['minimum_clearance_m'])} m; h "
            f"falls below 0 in {entry['below_h_0']} flights ({entry['starts_below_h_0']} of them start there), least "
            f"{_shown(entry['minimum_h_m'])} m; V₁ ends at a median of {_shown(entry['median_final_v1_m2'])} m²; "
            f"{entry['over_axis_limit']} flights pass {limit:g} m/s in an axis, by at most {_shown(over)} m/s; "
            f"{entry['starts_drawn_again']} starts were drawn again because they lay in the target or too near it."
        )
    printed = [entry for entry in rows if entry["law"] == PRINTED]
    floor = max(entry["median_final_v1_m2"] or 0.0 for entry in printed)
    said.append(
        f"With the printed constants V₁ stays at about {floor:.2f} m²: it holds ‖v − v_s‖²/(2 μ_v), and at μ_v = "
        f"{PRINTED_MU_V:g} /s² that is a difference of {1e3 * np.sqrt(2.0 * PRINTED_MU_V * floor):.1f} mm/s, which "
        "saturated thrusters leave at 1 Hz. That floor says nothing of the distance to the goal."
    )
    if any(entry["below_h_0"] for entry in printed):
        said.append(
            "At 1 Hz and 0.1 N the printed constants do not keep h strictly positive, as the paper states it: "
            + ", ".join(f"{e['below_h_0']} of {e['flights']} flights around {e['target']}" for e in printed)
            + " fall below 0."
        )
    if any(entry["reached"] < entry["flights"] for entry in printed):
        said.append(
            "With them not all errors converge to zero in the time flown: "
            + ", ".join(
                f"{e['flights'] - e['reached']} of {e['flights']} flights around {e['target']}" for e in printed
            )
            + " do not reach the goal."
        )
    return said


def _caption(target: str, scenario: Scenario) -> str:
    return (
        f"Case 3 around {target}: h, V₁, distance to the goal and largest speed of an axis, of all flights over "
        f"{scenario.duration:g} s; printed constants on the left, defaults with guard on the right; dotted: h = 0, the "
        "goal's tolerance, the speed limit of an axis. Worst: lowest h, highest final V₁ and distance, highest speed."
    )


_WORST = {
    "x m": "start_x",
    "y m": "start_y",
    "z m": "start_z",
    "contact": "contact",
    "gap m": "minimum_clearance",
    "least h": "minimum_barrier",
    "error m": "final_error",
    "v m/s": "largest_speed",
}
"""Headings that fit a terminal, and the columns of a campaign below them."""


def _worst(arrays: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    order = np.argsort(arrays["minimum_barrier"], kind="stable")[:10]
    return [{heading: _rounded(arrays[name][flight]) for heading, name in _WORST.items()} for flight in order]


def _rounded(value: Any) -> Any:
    plain = _plain(value)
    return round(plain, 3) if isinstance(plain, float) else plain


def _plain(value: Any) -> Any:
    """Give a JSON value: None for a number that is not finite."""
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _shown(value: float | None) -> str:
    return "not finite" if value is None else f"{value:.3g}"
