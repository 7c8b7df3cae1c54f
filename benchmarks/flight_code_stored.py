"""Python's answers to steps and to states of the guard, in a file that `flight_code_harness/replay.c` reads."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
from compiled_step import DOUBT, ESTIMATE, KNOWLEDGE, SAMPLE, estimates_of, memories_of, memory_type
from flight_code_missions import Exported
from flight_code_states import GIVEN, Step

from keepout.apps.flight_code.missions import Coded, sizes_of
from keepout.core.flight import loop

STEP, OF_GUARD, BEGINNING, OF_THRUSTERS, OF_NAVIGATION = 0, 1, 2, 3, 4
NAME, FIELDS = "steps.bin", "fields.bin"
PLACES = 2000


def stored_type(made: Coded) -> np.dtype:
    """Give the record that `stored_step` is for a mission."""
    memory, sensors = memory_type(made), sizes_of(made)["SENSORS"]
    return np.dtype(
        [
            *[(name, "i4") for name in ("kind", "control_status", "guard_status", "spare")],
            *[(name, "f8", 3) for name in ("force", "mean_force")],
            *[(name, "f8", sizes_of(made)["THRUSTERS"]) for name in ("pulse", "on_time")],
            *[(name, "f8", 3) for name in ("commanded", "disturbance")],
            ("doubt", DOUBT),
            *([("samples", SAMPLE, sensors), ("known", KNOWLEDGE)] if sensors else []),
            ("under_way", "f8", (8, 3)),
            ("estimate", ESTIMATE),
            ("before", memory),
            ("after", memory),
        ],
        align=True,
    )


def of_step(made: Coded, row: Step) -> np.ndarray:
    """Give records of a step of flights."""
    records = np.zeros(len(row.status), stored_type(made))
    records["kind"] = STEP
    records["control_status"], records["guard_status"] = np.asarray(row.order.status), row.status
    for name, part in zip(GIVEN, row.given, strict=True):
        records[name] = part
    if row.known is None:
        records["estimate"] = row.told
    else:
        records["samples"], records["known"] = row.told, row.known
    records["before"], records["after"] = memories_of(made, *row.before), memories_of(made, *row.after)
    return records


def of_guard(made: Coded, law: Any, state: Any, answer: tuple[Any, np.ndarray, np.ndarray]) -> np.ndarray:
    """Give records of states of the guard (`flight_code_directed.State`) and its answers: memory, force, status."""
    records = np.zeros(len(state.force), stored_type(made))
    memory, force, status = answer
    records["kind"] = OF_GUARD
    records["guard_status"], records["force"], records["commanded"] = status, force, state.force
    records["disturbance"], records["estimate"] = state.disturbance, estimates_of(state.estimate)
    records["doubt"]["errors"], records["doubt"]["contradicted"] = state.errors, state.contradicted
    records["before"], records["after"] = memories_of(made, law, state.guard), memories_of(made, law, memory)
    return records


def of_thrusters(made: Coded, before: np.ndarray, given: tuple[np.ndarray, ...], after: np.ndarray) -> np.ndarray:
    """Give records of forces that the thrusters alone were given: memories, records themselves, and `GIVEN`."""
    records = np.zeros(len(before), stored_type(made))
    records["kind"], records["before"], records["after"] = OF_THRUSTERS, before, after
    for name, part in zip(GIVEN, given, strict=True):
        records[name] = part
    return records


def of_navigation(made: Coded, before: np.ndarray, asked: tuple[np.ndarray, np.ndarray], answer: Any) -> np.ndarray:
    """Give records of samples, and forces (N), that navigation alone was told, and what it knew and remembered."""
    records = np.zeros(len(before), stored_type(made))
    records["kind"], records["before"] = OF_NAVIGATION, before
    records["samples"], records["force"] = asked
    records["known"], records["after"] = answer
    return records


def of_beginnings(made: Coded, states: Any) -> np.ndarray:
    """Give records of beginnings at states, with forces under way."""
    setup, count = made.mission.setup, len(states.position)
    sent = np.random.default_rng(5).uniform(-0.05, 0.05, (count, 8, 3))
    records = np.zeros(count, stored_type(made))
    begin = jax.jit(jax.vmap(lambda estimate, forces: loop.memories(setup, estimate, under_way=forces)))
    records["kind"], records["under_way"], records["estimate"] = BEGINNING, sent, estimates_of(states)
    records["after"] = memories_of(made, *begin(states, sent))
    for name in ("owed", "tail"):
        records["before"]["thrusters"][name] = 1.0  # of another flight
    return records


def of_fields(made: Coded) -> np.ndarray:
    """Give places near and far, the values of both fields there (m), and the law's gradient: eight numbers each."""
    rng, guard = np.random.default_rng(7), made.mission.guard
    places = rng.normal(size=(PLACES, 3))
    places *= 40.0 * rng.random((PLACES, 1)) ** 2 / np.linalg.norm(places, axis=1)[:, None]
    places[:20] *= 10.0 ** rng.uniform(0, 200, (20, 1))
    field = made.law.velocity.field
    law, gradient = jax.jit(lambda told: field.value_and_gradient(told))(places)
    values = np.zeros(PLACES) if guard is None else jax.jit(lambda told: guard.field.value(told))(places)
    return np.column_stack([places, values, law, gradient])


def write(flown: Exported, records: list[np.ndarray]) -> int:
    """Write records beside the mission's sources, and values of the fields; how many records there are."""
    whole = np.concatenate(records)
    (flown.folder / FIELDS).write_bytes(of_fields(flown.made).tobytes())
    (flown.folder / NAME).write_bytes(whole.tobytes())
    return len(whole)


def stored_in(folder: Path) -> bool:
    """Whether a folder has them."""
    return (folder / NAME).is_file()
