"""Attack the guard in real time: law, disturbance, estimates and clock are an adversary's, the truth is none of ours.

    python benchmarks/adversary.py [--flights 2000] [--seed 0] [--missions pocket …] [--attacks late …] [--duration 200]
        [--out benchmarks/results/adversary.json] [--json]

`keepout.OnBoard` is what is attacked, once a control period, as on board; `adversary_truth.py` flies. In every attack
the law looks ahead: of the corners of the force box and some more forces it asks for the one that leaves the least
clearance after braking, or the least that the guard still passes. The disturbance has the declared norm at every
instant, and the estimate's errors are at their vertices. On top of that each attack does to the clock, the memory or
the estimates what its name says. A row is one mission and attack, and the flights are spread evenly over the rows.

A flight is promised from the first step on in which the guard has a certified plan, until an assumption is broken.
`contacts` are those of promised flights, and must be 0; so must `false_flags`, flights in which an assumption is said
not to hold and all do. `least_above_threshold_m` is the least f̃ − θ at the true position of a promised flight: the
theorem says that it is above 0. Between two Runge–Kutta steps the path is not looked at.
"""

import copy
import functools
import operator
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from adversary_truth import SUBSTEPS, AxisThrusters, Surface, Truth
from kept_rows import Rows, command, tell, timed

import keepout
from keepout.core.control.law import Command, Law
from keepout.core.errors import ControlError
from keepout.core.flight.batches import states_at
from keepout.core.guard.field import RECIPE
from keepout.core.guard.safety_layer import GuardFlag, GuardStatus, flag_names
from keepout.core.guard.start import starts_certified
from keepout.core.kept import digest
from keepout.core.mission.build import build_guard
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.target import load_target
from keepout.flights.on_board import OnBoard
from keepout.flights.pages import terminal

VIOLATIONS = int(functools.reduce(operator.or_, (flag for flag in GuardFlag if flag is not GuardFlag.COMMAND)))
"""Flags that say that an assumption did not hold."""
LOW_ORBIT = {"semi_major_axis": 6_778_000.0}
MISSIONS = {
    "pocket": {
        "target": {"source": "pocket"},
        "chaser": {"radius": 0.3, "force_limit": 0.3, "speed_limit": 0.2},
        "guard": {"position_error": 0.05, "velocity_error": 0.002},
        "disturbance": {"kind": "none", "bound": 0.005},
        "start": {"position": (8.28, 0.0, 0.0)},
    },
    "no errors": {"target": {"source": "intelsat30"}},
    "tumbling": {
        "target": {"source": "box"},
        "attitude": {
            "kind": "tumbling",
            "angular_velocity": (0.002, 0.003, -0.0015),
            "inertia": ((2.0, 0.1, 0.0), (0.1, 1.5, 0.05), (0.0, 0.05, 1.0)),
        },
        "chaser": {"force_limit": 0.4},
        "guard": {"position_error": 0.02, "velocity_error": 0.001, "gain_error": 0.02, "mass_error": 0.02},
        "start": {"position": (0.0, 6.0, 4.0)},
        "goal": {"position": (0.0, -6.0, -3.0)},
    },
    "delay of two": {
        "target": {"source": "tiangong"},
        "orbit": LOW_ORBIT,
        "chaser": {"force_limit": 0.2},
        "guard": {"position_error": 0.02, "velocity_error": 0.001, "delay": 2},
        "start": {"position": (0.0, 35.0, 6.0)},
        "goal": {"position": (0.0, -35.0, -4.0)},
    },
    "thrusters": {
        "target": {"source": "intelsat30"},
        "orbit": LOW_ORBIT,
        "chaser": {"force_limit": 0.2},
        "guard": {"position_error": 0.02, "velocity_error": 0.001},
        "thrusters": {
            "layout": "12",
            "force": 0.2,
            "scale_error": 0.02,
            "survive_failure": True,
            "detection_time": 3.0,
        },
    },
}
ATTACKS = ("lookahead", "late", "restarts", "gaps", "wrong times", "stale", "jumps", "stuck")
"""`late`: built long before its first step; `gaps`: steps left out; `stuck`: a thruster, while the guard brakes."""
ROWS = [(mission, attack) for mission in MISSIONS for attack in ATTACKS if attack != "stuck" or mission == "thrusters"]
PLACE, SETTINGS = ("mission", "attack", "flights", "duration_s", "seed"), ("scenario", "guard_recipe", "version")
LONGEST_WAIT = 30
"""Periods before a late first step, at most."""
SAID = 5
"""Flights of a row that are described in it, of those that should not be."""


class Told(Law):
    """A law that asks for the force handed over as the estimate's angular velocity, which the guard does not read."""

    @property
    def goal(self):
        """Nowhere in particular."""
        return jnp.zeros(3)

    def initial_state(self, state):
        """No memory."""
        return ()

    def step(self, state, estimate):
        """Ask for it."""
        return state, Command.of_force(estimate.angular_velocity)


class Case:
    """A mission: its guard on board, compiled, and its truth."""

    def __init__(self, name, steps):
        self.scenario = Scenario().replace(**MISSIONS[name])
        target = load_target(self.scenario.target)
        self.guard = build_guard(Surroundings(self.scenario, target))
        self.setup = Surroundings(self.scenario).setup(Told(), guard=self.guard)
        self.surface, self.truth = Surface(target.vertices, target.faces), Truth(self.scenario, steps + LONGEST_WAIT)
        self.radius, self.period = self.scenario.chaser.radius, self.scenario.control.period
        self.reach = float(np.linalg.norm(target.vertices, axis=1).max()) + 8.0
        self.on_board = functools.lru_cache(2)(self._on_board)
        self.field_value = eqx.filter_jit(self.guard.field.value)

    def _on_board(self, on_gap):
        return OnBoard(self.setup, self.state(np.full(3, self.reach), np.zeros(3), 0.0), on_gap)

    def board(self, on_gap):
        """Give an `OnBoard` as newly built: what is compiled is shared by all flights, memory and clock are not."""
        board = copy.copy(self.on_board(on_gap))
        board._clock = copy.deepcopy(board._clock)
        return board

    def state(self, position, velocity, time):
        """Give an estimate as `OnBoard` takes it."""
        return self.setup.motion.initial_state(position, velocity, time)

    def starts(self, generator, flights):
        """Give certified starts (m, m/s): most towards the surface, and moved on until they hardly are certified."""
        most = self.guard.assumptions.speed_limit - self.guard.braking.velocity_radius
        found = np.empty((0, 6))
        while len(found) < flights:
            points = generator.uniform(-1.0, 1.0, (4096, 3)) * self.reach
            away, nearest = self.surface.nearest(points)
            near = (away > self.guard.least_value) & (away < self.radius + 5.0)
            points, nearest = points[near][:256], nearest[near][:256]
            aside = generator.exponential(0.3, (len(points), 1)) * generator.normal(size=points.shape)
            heading = _unit(_unit(nearest - points) + aside)
            speed = most * generator.uniform(0.0, 1.0, (len(points), 1)) ** 0.3
            some = np.hstack([points, speed * heading])
            certified = self.certified(some)
            some, heading = some[certified], heading[certified]
            step = np.full((len(some), 1), 2.0)
            for _ in range(9):
                moved = some + np.hstack([step * heading, np.zeros_like(heading)])
                certified = self.certified(moved)[:, None]
                some, step = np.where(certified, moved, some), np.where(certified, step, 0.5 * step)
            found = np.vstack([found, some])
        return found[:flights, :3], found[:flights, 3:]

    def certified(self, states):
        """Say which states (m, m/s) are certified starts."""
        return starts_certified(self.guard, states_at(self.setup.motion, states[:, :3], states[:, 3:]))

    def stop(self, velocity):
        """Give the way (m) that braking takes from velocities, m/s."""
        speed = np.linalg.norm(velocity, axis=-1, keepdims=True)
        return velocity * (0.5 * speed / self.guard.braking.deceleration + 0.5 * self.period)

    def above_threshold(self, points):
        """Give f̃ − θ (m) at points (…, 3)."""
        flat, room = points.reshape(-1, 3), 4096
        padded = np.vstack([flat, np.zeros((-len(flat) % room, 3))]).reshape(-1, room, 3)
        values = np.concatenate([np.asarray(self.field_value(some)) for some in padded])[: len(flat)]
        return values.reshape(points.shape[:-1]) - self.guard.threshold


class Adversary:
    """What law, disturbance and estimates do to many flights of a mission, each in its own style."""

    def __init__(self, case, generator, flights):
        self.case, self.generator, self.flights = case, generator, flights
        self.law = generator.integers(0, 4, flights)
        self.wind = generator.integers(0, 8, flights)
        self.lie = generator.integers(0, 8, flights)
        self.along = generator.random(flights) < 0.3
        self.flip = generator.integers(1, 40, flights)
        self.spare = generator.exponential(0.03, flights)

    def look(self, position, velocity, pending):
        """Look from where the chasers are (m, m/s) and with which commands under way (N) they fly."""
        self.position, self.velocity, self.pending = position, velocity, pending
        self.away, nearest = self.case.surface.nearest(position)
        self.outward = _unit(position - nearest)
        self.heading = _unit(velocity)

    def errors(self, step, braking):
        """Give the estimates' errors (m, m/s), at their vertices: of norm ε_r and ε_v."""
        a, count = self.case.guard.assumptions, self.flights
        odd = (step // self.flip) % 2 * 2 - 1
        alternate = step % 2 * 2 - 1
        random = self.generator.integers(0, 2, (2, count)) * 2 - 1
        one, struck = np.ones(count), np.where(braking, 1, -1)
        signs = [(one, one), (odd, odd), (struck, struck), (-struck, -struck), (odd, -odd)]
        signs += [(alternate * one, -alternate * one), tuple(random)]
        pick = np.minimum(self.lie, len(signs) - 1)
        of_position, of_velocity = (np.choose(pick, [pair[k] for pair in signs]) for k in (0, 1))
        direction = np.where(self.along[:, None], -self.heading, self.outward)
        anywhere = _unit(self.generator.normal(size=(count, 3)))
        direction = np.where((self.lie == 7)[:, None], anywhere, direction)
        return (
            a.position_error * of_position[:, None] * direction,
            a.velocity_error * of_velocity[:, None] * direction,
        )

    def forces(self):
        """Give the forces to ask for (N), by what braking leaves of the way to the surface."""
        case, a = self.case, self.case.guard.assumptions
        inward = -self.outward / np.maximum(np.abs(self.outward).max(axis=1, keepdims=True), 1e-9)
        onward = self.heading / np.maximum(np.abs(self.heading).max(axis=1, keepdims=True), 1e-9)
        corners = np.array(np.meshgrid(*[[1.0, -1.0]] * 3)).reshape(3, -1).T
        choices = [np.broadcast_to(corner, inward.shape) for corner in corners]
        choices = a.force_limit * np.stack([*choices, inward, onward, -onward, np.zeros_like(inward)])
        position, velocity = self.position, self.velocity
        for force in self.pending:
            position, velocity = _moved(position, velocity, force / a.mass, case.period)
        position, velocity = _moved(position, velocity, choices / a.mass, case.period)
        path = position + np.array([0.0, 0.5, 1.0])[:, None, None, None] * case.stop(velocity)
        left = case.surface.nearest(path)[0].min(axis=0)
        edge = case.guard.threshold + case.guard.braking.position_radius + self.spare
        least = np.argmin(left, axis=0)
        passed = np.argmin(np.where(left > edge, left, np.inf), axis=0)
        random = self.generator.integers(0, len(choices), self.flights)
        mixed = np.where(self.generator.random(self.flights) < 0.2, random, passed)
        return choices[np.choose(self.law, [least, passed, mixed, passed]), np.arange(self.flights)]

    def pushes(self, step, braking):
        """Give the disturbance in each Runge–Kutta step of a period (N), of the largest norm."""
        odd = (step // self.flip) % 2 * 2 - 1
        one, struck = np.ones(self.flights), np.where(braking, 1, -1)
        strikes = np.where(braking & (odd > 0), -1, 1)
        signs = np.choose(self.wind, [one, one, odd, (step % 2 * 2 - 1) * one, one, struck, strikes, -one])
        inward = np.where((self.wind == 1)[:, None], self.heading, -self.outward)
        each = np.broadcast_to(signs, (SUBSTEPS, self.flights)).copy()
        each[: SUBSTEPS // 2, self.wind == 4] *= -1.0
        return self.case.guard.assumptions.disturbance_force * each[..., None] * inward

    def scales(self, forces):
        """Give the true acceleration over the nominal one, by axis: least where a force leads away, most towards."""
        a = self.case.guard.assumptions
        gain = self.case.scenario.guard.gain_error
        helps = np.sign(-forces * self.outward)
        lighter = np.where(np.sum(forces * self.outward, axis=1, keepdims=True) > 0.0, 1.0, -1.0)
        return (1.0 + gain * helps) / (1.0 + lighter * a.mass_error), 1.0 / (1.0 - a.mass_error)


def _unit(vectors):
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _moved(position, velocity, acceleration, period):
    return position + period * velocity + 0.5 * period**2 * acceleration, velocity + period * acceleration


class Flights:
    """Flights of one mission under one attack, all at once but for their steps on board."""

    def __init__(self, case, attack, count, steps, generator):
        self.case, self.attack, self.count, self.steps, self.generator = case, attack, count, steps, generator
        self.adversary = Adversary(case, generator, count)
        positions, velocities = case.starts(generator, count)
        late = attack == "late"
        self.first = generator.choice([1, 2, 4, 8, 15, LONGEST_WAIT], count) if late else np.zeros(count, int)
        self.place = self._before(positions, velocities)
        delay = case.guard.assumptions.delay
        self.pending = np.zeros((delay, count, 3))
        self.thrusters = None
        if case.scenario.thrusters.layout != "ideal":
            entry = case.scenario.thrusters
            scale = 1.0 + entry.scale_error * generator.choice([-1.0, 1.0], (count, 12))
            self.thrusters = AxisThrusters(count, entry.force, scale, case.period, entry.least_on_time)
        self.struck_at = np.full(count, -1)
        self.strikes_after = generator.integers(1, 40, count)
        self.braked = np.zeros(count, int)
        self.braking, self.promised, self.broken = (np.zeros(count, bool) for _ in range(3))
        self.false_flags, self.flagged = np.zeros(count, int), np.zeros(count, int)
        self.refused = self.let_in = self.promised_steps = 0
        self.missed = np.zeros(count, bool)
        self.often = generator.choice([0.1, 1.0], count)
        self.gap = np.zeros(count, int)
        self.jump = np.zeros((count, 6))
        self.told = None
        self.kept = []
        # A wrong time or a gap is refused in every other flight, and begun anew from in the others.
        self.anew = (np.arange(count) % 2 == 1) & (attack in ("gaps", "wrong times"))
        self.boards = [case.board("begin anew" if anew else "refuse") for anew in self.anew]
        seen = case.truth.seen(self.place, 0)
        self.adversary.look(*seen, self.pending)
        errors = self.adversary.errors(0, self.braking)
        for i, board in enumerate(self.boards):
            board.restart(case.state(seen[0][i] + errors[0][i], seen[1][i] + errors[1][i], 0.0))

    def _before(self, positions, velocities):
        """Give ECI states at time 0 of chasers that are at these states when their first step comes, uncontrolled."""
        truth, periods = self.case.truth, int(self.first.max())
        row = 2 * SUBSTEPS
        place = truth.placed(positions, velocities, row * periods)
        for k in range(periods, -1, -1):
            place = np.where((self.first >= k)[:, None], place, truth.placed(positions, velocities, row * k))
            begin = self.first == k
            place[begin] = truth.placed(positions[begin], velocities[begin], row * k)
            if k:
                for part in range(SUBSTEPS):
                    place = truth.flown(place, row * k - 2 * part, np.zeros(3), back=True)
        return place

    def fly(self):
        """Fly them all."""
        for step in range(self.steps):
            self._period(step)
        return self._row()

    def _period(self, step):
        position, velocity = self.case.truth.seen(self.place, row := 2 * SUBSTEPS * step)
        self.adversary.look(position, velocity, self.pending)
        asked = self.adversary.forces()
        told = self._told(step, position, velocity)
        begun, away = step >= self.first, self.gap > 0
        self.gap = np.maximum(self.gap - 1, 0)
        if self.attack == "gaps":
            begins = begun & ~away & ~self.missed & (step > self.first) & (self.generator.random(self.count) < 0.02)
            self.gap[begins] = self.generator.choice([0, 1, 4, 14], begins.sum())
            away |= begins
        self.promised[away] = False
        forces = np.zeros((self.count, 3))
        for i in np.flatnonzero(begun & ~away):
            forces[i] = self._on_board(i, step, told[i], asked[i])
        self.missed = away
        self._stick(step)
        self._move(row, forces)
        self.promised_steps += int((self.promised & ~self.broken).sum())

    def _told(self, step, position, velocity):
        """Give what each is told, (flights, 6), and note whose estimates are worse than declared."""
        a, truth = self.case.guard.assumptions, np.hstack([position, velocity])
        told = truth + np.hstack(self.adversary.errors(step, self.braking))
        if self.attack == "stale" and self.told is not None:
            old = (step % 16 >= 16 - self.adversary.flip % 12) & (step > self.first)
            told = np.where(old[:, None], self.told, told)
        if self.attack == "jumps":
            begins = (step > self.first) & (self.generator.random(self.count) < 0.03)
            size = np.array([1.5, 0.05]) * self.generator.uniform(0.0, 1.0, (self.count, 2)) ** 2
            new = np.hstack([size[:, :1] * self.adversary.outward, size[:, 1:] * self.adversary.outward])
            self.jump = np.where(begins[:, None], new, self.jump)
            self.jump[self.generator.random(self.count) < 0.2] = 0.0
            told = told + self.jump
        self.told = told
        wrong = told - truth
        far, fast = np.linalg.norm(wrong[:, :3], axis=1), np.linalg.norm(wrong[:, 3:], axis=1)
        beyond = (far > a.position_error + 1e-7) | (fast > a.velocity_error + 1e-9)
        self.broken |= beyond & (step >= self.first)
        return told

    def _on_board(self, i, step, told, asked):
        """Step one chaser's guard; give the force that it commands."""
        board, now = self.boards[i], step * self.case.period
        numbers = {"position": told[:3], "velocity": told[3:], "angular_velocity": asked}
        if self.attack == "restarts" and step > self.first[i] and self.generator.random() < 0.04:
            self.promised[i] = False
            board.restart(self.case.state(told[:3], told[3:], now))
        wrong = self.attack == "wrong times" and step > self.first[i] and self.generator.random() < self.often[i]
        if self.missed[i]:
            self.promised[i] = False
            if not self.anew[i]:
                self._refused(i, now, numbers)
                board.restart(self.case.state(told[:3], told[3:], now))
        elif wrong and not self.anew[i]:
            early_or_late = self.generator.choice([-1.0, -0.4, 0.3, 1.0]) * self.case.period
            self._refused(i, now + early_or_late, numbers)
        again = wrong and self.anew[i] and not self.case.guard.assumptions.delay
        if again:
            # Two commands for one period: the second takes the place of the first, which it asks to lead away.
            self.promised[i] = False
            board.step(now, **(numbers | {"angular_velocity": -asked}))
        force = board.step(now, **numbers)
        if wrong and not again:
            self._refused(i, now, numbers)
        self._note(i, step, board.order.guard_status)
        return force

    def _refused(self, i, time, numbers):
        """Step at a time that must be refused: one that is not due, or before it with commands under way."""
        try:
            self.boards[i].step(time, **numbers)
        except ControlError:
            self.refused += 1
        else:
            self.let_in += 1

    def _note(self, i, step, status):
        """Take down what the guard says of a step."""
        mode, flags = status & 3, status & VIOLATIONS
        self.braking[i] = mode in (GuardStatus.BRAKING, GuardStatus.HOLDING)
        self.braked[i] += self.braking[i]
        if self.broken[i]:
            self.flagged[i] |= flags
        elif self.struck_at[i] < 0:
            # Where nothing was promised the chaser may truly be below the threshold, or too fast.
            self.false_flags[i] |= flags if self.promised[i] else flags & ~int(GuardFlag.FIELD | GuardFlag.REGION)
        if mode != GuardStatus.ESCAPING:
            self.promised[i] = True

    def _stick(self, step):
        """Let a thruster stick while its chaser brakes, and be known some steps later."""
        if self.attack != "stuck":
            return
        begins = (self.struck_at < 0) & (self.braked >= self.strikes_after)
        self.struck_at[begins] = step
        count = int(begins.sum())
        on = self.generator.random(count) < 0.5
        towards = np.argmax(-self.adversary.outward[begins] @ AxisThrusters.DIRECTIONS.T, axis=1)
        # On: one that pushes towards the surface; off: its opposite, or any.
        worst = np.where(on, towards, (towards // 4) * 4 + (towards + 2) % 4)
        anywhere = self.generator.random(count) < 0.3
        self.thrusters.stuck[begins] = np.where(anywhere, self.generator.integers(0, 12, count), worst)
        self.thrusters.on[begins] = on
        periods = round(self.case.scenario.thrusters.detection_time / self.case.period)
        self.thrusters.known = (self.struck_at >= 0) & (step >= self.struck_at + periods)

    def _move(self, row, forces):
        """Fly a period under the forces that take effect now, and keep where the chasers were."""
        a, truth = self.case.guard.assumptions, self.case.truth
        queue = np.concatenate([self.pending, forces[None]])
        now, self.pending = queue[0], queue[1:]
        scale, lightest = self.adversary.scales(now)
        given = np.broadcast_to(now, (SUBSTEPS, *now.shape)) if self.thrusters is None else self.thrusters.give(now)
        push = given * scale + self.adversary.pushes(row // (2 * SUBSTEPS), self.braking) * lightest
        for part in range(SUBSTEPS):
            self.place = truth.flown(self.place, row + 2 * part, push[part] / a.mass)
            position = truth.seen(self.place, row + 2 * (part + 1))[0]
            self.kept.append((position, self.promised & ~self.broken, self.broken.copy()))

    def _row(self):
        """Sum up."""
        positions, promised, broken = (np.stack(part) for part in zip(*self.kept, strict=True))
        clearance = self.case.surface.nearest(positions)[0] - self.case.radius
        above = self.case.above_threshold(positions)
        touched = clearance <= 0.0
        nothing = np.full((), np.inf)
        contacts = np.any(touched & promised, axis=0)
        hurt = np.any(touched & broken, axis=0)
        below = np.any((above <= 0.0) & promised, axis=0)
        found = np.concatenate([np.flatnonzero(contacts | below), np.flatnonzero(self.false_flags != 0)])
        least = {
            "least_clearance_m": np.where(promised, clearance, nothing).min(),
            "least_above_threshold_m": np.where(promised, above, nothing).min(),
            "least_clearance_broken_m": np.where(broken, clearance, nothing).min(),
        }
        return {
            "steps": self.steps * self.count,
            "promised_steps": self.promised_steps,
            "contacts": int(contacts.sum()),
            "below_threshold": int(below.sum()),
            "false_flags": int((self.false_flags != 0).sum()),
            "unpromised_contacts": int((np.any(touched & ~promised & ~broken, axis=0) & ~contacts).sum()),
            "broken": int(self.broken.sum()),
            "broken_flagged": int((self.broken & (self.flagged != 0)).sum()),
            "broken_contacts": int(hurt.sum()),
            "broken_contacts_flagged": int((hurt & (self.flagged != 0)).sum()),
            "wrong_times_refused": self.refused,
            "wrong_times_let_in": self.let_in,
            **{name: round(float(value), 5) if np.isfinite(value) else None for name, value in least.items()},
            "found": [self._described(i, clearance, above, promised) for i in dict.fromkeys(found[:SAID].tolist())],
        }

    def _described(self, i, clearance, above, promised):
        """Say what one flight was like."""
        styles = {name: int(getattr(self.adversary, name)[i]) for name in ("law", "wind", "lie", "along", "flip")}
        place = int(np.argmin(np.where(promised[:, i], above[:, i], np.inf)))
        return styles | {
            "flight": int(i),
            "first_step": int(self.first[i]),
            "time_s": (place + 1) * self.case.truth.step,
            "clearance_m": float(clearance[place, i]),
            "above_threshold_m": float(above[place, i]),
            "false_flags": list(flag_names(int(self.false_flags[i]))),
        }


COLUMNS = (
    "mission",
    "attack",
    "flights",
    "steps",
    "contacts",
    "below_threshold",
    "false_flags",
    "unpromised_contacts",
    "broken",
    "broken_contacts",
    "broken_contacts_flagged",
    "wrong_times_let_in",
    "least_clearance_m",
    "least_above_threshold_m",
    "seconds",
)


def fly_all(arguments):
    """Fly every row that is not in `--out` yet; give those asked for."""
    rows = [(m, a) for m, a in ROWS if m in arguments.missions and a in arguments.attacks]
    flights = max(1, -(-arguments.flights // len(rows)))
    store, case_of = Rows(arguments.out, PLACE, SETTINGS), functools.lru_cache(1)(Case)
    shown = []
    with terminal.progress("adversary") as progress:
        for done, (mission, attack) in enumerate(rows):
            progress(done / len(rows), f"{mission}: {attack}")
            scenario = digest(Scenario().replace(**MISSIONS[mission]).model_dump_json())[:16]
            place = (mission, attack, flights, arguments.duration, arguments.seed)
            plan = dict(zip(PLACE + SETTINGS, (*place, scenario, RECIPE, keepout.__version__), strict=True))

            def made(mission=mission, attack=attack):
                case = case_of(mission, arguments.duration)
                generator = np.random.default_rng([arguments.seed, ROWS.index((mission, attack))])
                row, seconds = timed(Flights(case, attack, flights, arguments.duration, generator).fly)
                return row | {"seconds": round(seconds, 2)}

            shown.append(store.made(plan, made))
    return shown


def main():
    parser = command(__doc__)
    parser.add_argument("--flights", type=int, default=2000, help="in all, spread evenly over the rows")
    parser.add_argument("--duration", type=int, default=200, help="of each flight, control periods")
    parser.add_argument("--missions", nargs="+", choices=list(MISSIONS), default=list(MISSIONS))
    parser.add_argument("--attacks", nargs="+", choices=ATTACKS, default=list(ATTACKS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="file of rows, written after each and taken up again")
    arguments = parser.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    rows = fly_all(arguments)
    tell(rows, arguments, COLUMNS)
    for row in () if arguments.json else rows:
        for flight in row["found"]:
            sys.stdout.write(f"{row['mission']}, {row['attack']}: {flight}\n")


if __name__ == "__main__":
    main()
