"""The exported step, compiled into a library and called from Python: many steps at once, memories as arrays.

Structures of C are NumPy's records with C's alignment, so that memories of Python's law and guard go in and come out.
"""

import ctypes
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from keepout.apps.flight_code.missions import Coded, sizes_of
from keepout.core.control.law import AheadOfDelay
from keepout.core.flight.navigation import OnBoardState
from keepout.flights.thrusters.on_off import ThrusterMemory

HARNESS = Path(__file__).parent / "flight_code_harness" / "harness.c"
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off")
ESTIMATE = np.dtype(
    [
        ("time", "f8"),
        ("position", "f8", 3),
        ("velocity", "f8", 3),
        ("attitude", "f8", 4),
        ("angular_velocity", "f8", 3),
    ],
    align=True,
)


DOUBT = np.dtype([("errors", "f8", 2), ("contradicted", "?")], align=True)
SAMPLE = np.dtype([("came", "?"), ("value", "f8", 4)], align=True)
KNOWLEDGE = np.dtype(
    [
        ("estimate", ESTIMATE),
        ("disturbance", "f8", 3),
        ("outliers", "i4"),
        ("known", ESTIMATE),
        ("errors", "f8", 2),
        ("contradicted", "?"),
    ],
    align=True,
)
BALL = np.dtype([("centre", "f8", 3), ("radius", "f8")], align=True)


def order_type(made: Coded) -> np.dtype:
    """Give the record that `keepout_order` is for a mission."""
    vectors = ("force", "commanded_force", "desired_velocity", "safe_velocity", "disturbance_estimate")
    return np.dtype(
        [
            *[(name, "f8", 3) for name in vectors],
            *[(name, "f8") for name in ("barrier", "backstepping_barrier", "lyapunov")],
            *[(name, "i4") for name in ("control_status", "guard_status")],
            ("mean_force", "f8", 3),
            *[(name, "f8", sizes_of(made)["THRUSTERS"]) for name in ("pulse", "on_time")],
        ],
        align=True,
    )


def memory_type(made: Coded) -> np.dtype:
    """Give the record that `keepout_memory` is for a mission."""
    sizes = sizes_of(made)
    delay, windows, model = sizes["DELAY"], sizes["WINDOWS"], sizes["MODEL"]
    law = np.dtype(
        [
            *[(name, "f8", 3) for name in ("velocity", "drift", "force")],
            ("model", "f8", (3, model)),
            ("pending", "f8", (delay, 3)),
            *([("push", "f8", 3)] if sizes["SENSORS"] else []),
            ("started", "?"),
        ],
        align=True,
    )
    guard = np.dtype(
        [
            *[(name, "f8", 3) for name in ("plan_position", "plan_velocity")],
            ("pending", "f8", (delay, 3)),
            *[(name, "f8", 3) for name in ("expected_position", "expected_velocity")],
            ("unexplained", "f8", (windows, 3)),
            *[(name, "f8", 3) for name in ("seen_position", "seen_velocity")],
            ("doubts", "f8", 2),
            ("begun_doubts", "f8", windows),
            ("counted", "i4"),
            *[(name, "?") for name in ("certified", "begun", "left_out", "steady")],
        ],
        align=True,
    )
    thrusters = np.dtype([(name, "f8", sizes["THRUSTERS"]) for name in ("owed", "tail")], align=True)
    navigation = [] if sizes["SENSORS"] == 0 else [("navigation", _navigation_type(sizes))]
    return np.dtype([("law", law), ("guard", guard), ("thrusters", thrusters), *navigation], align=True)


def _navigation_type(sizes: dict[str, int]) -> np.dtype:
    sensors, pushes, late, kept = (sizes[name] for name in ("SENSORS", "PUSHES", "LATENCY", "KEPT"))
    states = 6 + 3 * pushes
    belief = np.dtype(
        [
            ("motion", ESTIMATE),
            ("disturbance", "f8", 3 * pushes),
            ("covariance", "f8", (states, states)),
            ("left_out", "i4", sensors),
        ],
        align=True,
    )
    known = np.dtype(
        [
            *[(name, BALL) for name in ("position", "velocity")],
            ("accelerations", "f8", (kept, 3)),
            ("attitudes", "f8", (late + 1, 4)),
            ("centres", "f8", (kept, 3)),
            ("radii", "f8", kept),
            ("elapsed", "i4"),
            ("contradictions", "i4", 2),
        ],
        align=True,
    )
    return np.dtype(
        [
            ("settled", belief),
            ("forces", "f8", (late + 1, 3)),
            ("pending", "f8", (sizes["DELAY"], 3)),
            ("steps", "i4"),
            ("set", known),
        ],
        align=True,
    )


def memories_of(made: Coded, law: Any, guard: Any, thrusters: Any = (), navigation: Any = ()) -> np.ndarray:
    """Give memories of Python's law, guard, thrusters and navigation, with a leading axis, as records."""
    delay = made.mission.scenario.guard.delay
    pending = None
    if isinstance(made.mission.setup.controller, AheadOfDelay):
        law, pending = law
    count = len(law.velocity)
    memory = np.zeros(count, memory_type(made))
    for name in ("velocity", "drift", "force", "started"):
        memory["law"][name] = getattr(law, name)
    if made.mission.setup.navigation is None:
        model = np.asarray(law.observer).reshape(count, 3, -1)
        memory["law"]["model"][:, :, : model.shape[2]] = model
    if isinstance(navigation, OnBoardState):
        _put_navigation(made, memory["navigation"], navigation)
    if isinstance(thrusters, ThrusterMemory):
        memory["thrusters"]["owed"], memory["thrusters"]["tail"] = thrusters.owed, thrusters.tail
    if pending is not None:
        memory["law"]["pending"][:, :delay] = pending
    if made.mission.guard is None:
        return memory
    into = memory["guard"]
    names = ("plan_position", "plan_velocity", "expected_position", "expected_velocity", "unexplained", "counted")
    for name in (*names, "certified", "begun", "left_out"):
        into[name] = getattr(guard, name)
    if delay:
        into["pending"][:, :delay] = guard.pending
    into["steady"] = True
    a = made.mission.guard.assumptions
    into["doubts"] = [float(a.position_error), float(a.velocity_error)]
    into["begun_doubts"] = float(a.velocity_error)
    if guard.observed is None:
        into["seen_position"], into["seen_velocity"] = guard.expected_position, guard.expected_velocity
    else:
        into["seen_position"] = guard.observed.expected_position
        into["seen_velocity"] = guard.observed.expected_velocity
        into["steady"] = guard.observed.steady
        into["doubts"], into["begun_doubts"] = guard.observed.doubts.last, guard.observed.doubts.begun
    return memory


def _put_navigation(made: Coded, into: np.ndarray, state: OnBoardState) -> None:
    """Put memories of the filter and the set into records."""
    kalman, known = state.estimator, state.bounded
    settled, count = into["settled"], len(into)
    settled["motion"] = estimates_of(kalman.settled.motion)
    settled["disturbance"] = np.asarray(kalman.settled.disturbance).reshape(count, -1)
    settled["covariance"], settled["left_out"] = kalman.settled.covariance, kalman.settled.left_out
    into["forces"], into["steps"] = kalman.forces, kalman.steps
    if delay := made.mission.scenario.guard.delay:
        into["pending"][:, :delay] = state.pending
    held = into["set"]
    for name in ("position", "velocity"):
        held[name]["centre"], held[name]["radius"] = getattr(known, name).centre, getattr(known, name).radius
    for name in ("attitudes", "elapsed", "contradictions"):
        held[name] = getattr(known, name)
    for name in ("accelerations", "centres", "radii"):
        rows = np.asarray(getattr(known, name))
        if rows.shape[1]:
            held[name][:, -rows.shape[1] :] = rows


def samples_of(samples: Any) -> np.ndarray:
    """Give what sensors say, `Sample`s with a leading axis, as records (n, sensors)."""
    told = np.zeros((len(samples[0].came), len(samples)), SAMPLE)
    for number, sample in enumerate(samples):
        told["came"][:, number] = sample.came
        value = np.asarray(sample.value)
        told["value"][:, number, : value.shape[1]] = value
    return told


def estimates_of(state: Any) -> np.ndarray:
    """Give states of motion, with a leading axis, as records."""
    estimate = np.zeros(len(state.position), ESTIMATE)
    for name in ESTIMATE.names or ():
        estimate[name] = getattr(state, name)
    return estimate


class CompiledStep:
    """The step of an exported mission, compiled.

    Attributes:
        made: the mission.

    """

    def __init__(self, made: Coded, folder: Path, *, compiler: str = "gcc", flags: tuple[str, ...] = FLAGS) -> None:
        """Compile the folder's sources into a library.

        Args:
            made: the mission.
            folder: that `keepout export --to c` wrote.
            compiler: its command.
            flags: for it.

        """
        self.made = made
        library = folder / "harness.so"
        sources = [*sorted(folder.glob("keepout_*.c")), folder / "mission_tables.c", HARNESS]
        command = [compiler, *flags, "-fPIC", "-shared", f"-I{folder}", "-o", str(library), *map(str, sources), "-lm"]
        subprocess.run(command, check=True)
        self._library = ctypes.CDLL(str(library))
        self._image = (folder / "tables.bin").read_bytes()
        if answer := self.opened(self._image):
            raise RuntimeError(f"the image of {folder} is refused: {answer}")

    def opened(self, image: bytes) -> int:
        """Open an image: a KEEPOUT_IMAGE_*, 0 if it is good."""
        return self._library.harness_open(image, ctypes.c_size_t(len(image)))

    def begin(
        self, estimate: np.ndarray, under_way: np.ndarray | None = None, samples: np.ndarray | None = None
    ) -> np.ndarray:
        """Begin at each estimate, with forces (8, 3) N under way or none, told samples where sensors do."""
        memory = np.zeros(len(estimate), memory_type(self.made))
        sent = None if under_way is None else np.ascontiguousarray(under_way, np.float64)
        told = [] if samples is None else [self._at(np.ascontiguousarray(samples))]
        self._library.harness_begin(
            len(estimate), self._at(np.ascontiguousarray(estimate)), self._at(sent), *told, self._at(memory)
        )
        return memory

    def step(self, memory: np.ndarray, estimate: np.ndarray) -> np.ndarray:
        """Run a step of each; the memories are changed in place."""
        order = np.zeros(len(estimate), order_type(self.made))
        self._library.harness_step(
            len(estimate), self._at(memory), self._at(np.ascontiguousarray(estimate)), self._at(order)
        )
        return order

    def step_by_samples(self, memory: np.ndarray, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Run a step of each, told samples: what is known, and the answers; the memories are changed in place."""
        order, knowledge = np.zeros(len(samples), order_type(self.made)), np.zeros(len(samples), KNOWLEDGE)
        told = self._at(np.ascontiguousarray(samples))
        self._library.harness_step(len(samples), self._at(memory), told, self._at(knowledge), self._at(order))
        return knowledge, order

    def navigate(self, memory: np.ndarray, samples: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Run navigation alone on samples and then the forces (n, 3) commanded, N: what is known."""
        knowledge = np.zeros(len(samples), KNOWLEDGE)
        given = [self._at(np.ascontiguousarray(array)) for array in (samples, np.asarray(force, np.float64))]
        self._library.harness_navigate(len(samples), self._at(memory), *given, self._at(knowledge))
        return knowledge

    def guard(
        self, memory: np.ndarray, estimate: np.ndarray, doubt: np.ndarray, force: np.ndarray, disturbance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Run the guard alone on commanded forces (n, 3), N: what it gives, and its statuses."""
        filtered, status = np.zeros((len(estimate), 3)), np.zeros(len(estimate), np.int32)
        given = [np.ascontiguousarray(array) for array in (estimate, doubt, force, disturbance)]
        self._library.harness_guard(
            len(estimate), self._at(memory), *map(self._at, given), self._at(filtered), self._at(status)
        )
        return filtered, status

    def fire(self, memory: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Give forces (n, 3), N, to the thrusters alone; the memories are changed in place."""
        order = np.zeros(len(force), order_type(self.made))
        given = np.ascontiguousarray(force, np.float64)
        self._library.harness_fire(len(force), self._at(memory), self._at(given), self._at(order))
        return order

    def fields(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Give the values of the guard's field and of the law's at points (n, 3), m."""
        guard, law = np.zeros(len(points)), np.zeros(len(points))
        place = self._at(np.ascontiguousarray(points, np.float64))
        self._library.harness_fields(len(points), place, self._at(guard), self._at(law))
        return guard, law

    def function(self, name: str, x: np.ndarray) -> np.ndarray:
        """Give a function of keepout_math.c, "exp" for instance, of each number."""
        function = getattr(self._library, f"keepout_{name}")
        function.restype, function.argtypes = ctypes.c_double, [ctypes.c_double]
        return np.array([function(number) for number in x])

    def fly(self, estimate: np.ndarray, push: np.ndarray, steps: int) -> np.ndarray:
        """Fly closed loops under a constant force (N) from each state; the states at the end."""
        end = np.ascontiguousarray(estimate)
        self._library.harness_fly(len(end), self._at(end), self._at(np.ascontiguousarray(push, np.float64)), steps)
        return end

    def move(self, estimate: np.ndarray, force: np.ndarray) -> None:
        """Move states a control period on, in place, under forces (n, 3) that are held, N."""
        self._library.harness_move(len(estimate), self._at(estimate), self._at(np.ascontiguousarray(force, np.float64)))

    @staticmethod
    def _at(array: np.ndarray | None) -> Any:
        return None if array is None else array.ctypes.data_as(ctypes.c_void_p)
