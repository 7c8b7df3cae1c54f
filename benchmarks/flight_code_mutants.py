"""Break the exported C in one place at a time, and see whether stored steps notice.

Each mutant is a text that occurs once in a source and what takes its place: a sign, a comparison, a constant, one step
too many. It is compiled into the missions' folders and run on their stored steps, which are Python's answers, until one
of them finds an answer that is another. What survives is named.
"""

import argparse
import shutil
import tempfile
from pathlib import Path
from typing import Any

import flight_code_checks as checks
import flight_code_stored as stored

MUTANTS: dict[str, list[tuple[str, str, str]]] = {
    "keepout_field.c": [
        ("continuation's bend", "(3.0 - (2.0 * t)))", "(3.0 - (1.0 * t)))"),
        ("ψ a power short", "(0.5 * ((t * t) * (t * t)))", "(0.5 * ((t * t) * t))"),
        ("allowance added", "result = result - ((c->allowance", "result = result + ((c->allowance"),
        ("rise without its angle", "- (c->target_radius * keepout_acos(c->target_radius / s))", "- c->target_radius"),
        ("gradient's radial part lost", "(gradient[i] - (radial * u))) + (along * u)", "(gradient[i] - (radial * u)))"),
        (
            "softplus' slope of the other side",
            "*slope = ((t > 0.0) ? 1.0 : e) / both",
            "*slope = ((t > 0.0) ? e : 1.0) / both",
        ),
        (
            "a row left out",
            "for (; (i + LANES) <= rows; i = i + LANES) {",
            "for (; (i + LANES) < rows; i = i + LANES + 1) {",
        ),
    ],
    "keepout_spline.c": [
        ("a byte without its sign", "(value < 0x80u) ? (double)value : ((double)value - 256.0)", "(double)value"),
        ("neighbour block too late", "((first + i) < EDGE) ? 0 : 1", "((first + i) <= EDGE) ? 0 : 1"),
        (
            "weights of a coarser node",
            "finer[1][n] = 0.5 * (p[1][n] + p[2][n]);",
            "finer[1][n] = 0.5 * (p[0][n] + p[2][n]);",
        ),
        (
            "octant's axes exchanged",
            "(4u * ((uint32_t)block[0] & 1u)) + (2u * ((uint32_t)block[1] & 1u))",
            "(2u * ((uint32_t)block[0] & 1u)) + (4u * ((uint32_t)block[1] & 1u))",
        ),
        ("brick from node 0 on", "brick[i] = block_of(start[i] + 1);", "brick[i] = block_of(start[i]);"),
        (
            "another cell taken for the same",
            "same = same && (cell->start[axis] == start);",
            "same = same && (cell->start[axis] >= start);",
        ),
        (
            "cubic weight",
            "((3.0 * ((s * s) * s)) - (6.0 * (s * s))) + 4.0",
            "((3.0 * ((s * s) * s)) - (5.0 * (s * s))) + 4.0",
        ),
        ("slope's sign", "slope[0] = -(s * s) / 2.0;", "slope[0] = (s * s) / 2.0;"),
        (
            "slope not over the size",
            "contracted(c, value[0], slope[1], value[2]) / size;",
            "contracted(c, value[0], slope[1], value[2]);",
        ),
    ],
    "keepout_guard.c": [
        ("sagitta an eighth", "(guard->period * guard->period)) / 8.0;", "(guard->period * guard->period)) / 8.1;"),
        ("packing counted once", "+ (2.0 * guard->evaluation_error))", "+ (1.0 * guard->evaluation_error))"),
        (
            "segment at half slope",
            "0.5 * ((value_a + value_b) - (guard->lipschitz",
            "0.5 * ((value_a + value_b) - (0.5 * guard->lipschitz",
        ),
        (
            "on the threshold is free",
            "(lowest(guard, before, value_before, corners[i], values[i]) > least)",
            "(lowest(guard, before, value_before, corners[i], values[i]) > (least - 1e-9))",
        ),
        ("speed without its radius", "((fastest + guard->velocity_radius) + faster)", "(fastest + faster)"),
        ("range without what is around", "((range + around) <= guard->range_limit)", "(range <= guard->range_limit)"),
        ("stop length", "+ ((0.5 * rest) * guard->period);", "+ ((0.4 * rest) * guard->period);"),
        (
            "one part too few",
            "for (i = 1; (i <= guard->parts) && (i <= KEEPOUT_MOST_PARTS); i++) {",
            "for (i = 1; (i < guard->parts) && (i <= KEEPOUT_MOST_PARTS); i++) {",
        ),
        (
            "left out for ever",
            "&& !off_plan(guard, memory, own_position, own_velocity) && !memory->left_out;",
            "&& !off_plan(guard, memory, own_position, own_velocity);",
        ),
        ("window a step wider", "(double)(place + 1)) + turned;", "(double)(place + 2)) + turned;"),
        ("count goes on", "seen->counted = memory->counted + 1;", "seen->counted = memory->counted;"),
        (
            "escape inwards",
            "(void)keepout_spline_value_and_gradient(mission->guard_spline, position, away);",
            "(void)keepout_spline_value_and_gradient(mission->guard_spline, position, away); away[0] = -away[0];",
        ),
        ("escape's range", "> (0.99 * guard->range_limit)", "> (0.9 * guard->range_limit)"),
        (
            "command beyond the box",
            "keepout_clip(finite ? force[i] : 0.0, -guard->force_limit, guard->force_limit)",
            "(finite ? force[i] : 0.0)",
        ),
        (
            "feedback of the position lost",
            "(guard->position_gain * course.drifted[i])",
            "(0.5 * guard->position_gain * course.drifted[i])",
        ),
        (
            "at rest a thousand times earlier",
            "(speed < 1e-9) ? KEEPOUT_GUARD_HOLDING",
            "(speed < 1.001e-9) ? KEEPOUT_GUARD_HOLDING",
        ),
        ("brake without end", "keepout_minimum(guard->deceleration, speed / guard->period)", "guard->deceleration"),
        (
            "follows when not certified",
            "follow = (course.planned || (memory->certified && !seen.told)) && !accepted;",
            "follow = course.planned && !accepted;",
        ),
        (
            "region by range alone",
            "(guard->speed_limit + guard->velocity_error)))",
            "(2.0 * guard->speed_limit + guard->velocity_error)))",
        ),
        (
            "field's flag at the other side",
            "flags += (here > least) ? 0 : KEEPOUT_FLAG_FIELD;",
            "flags += (here > (least + 1e-9)) ? 0 : KEEPOUT_FLAG_FIELD;",
        ),
        (
            "observer's share",
            "((1.0 - guard->observer_position) * guard->period)",
            "(guard->observer_position * guard->period)",
        ),
        ("spread forgotten", "seen->spread[0] + (faster * lever), faster);", "(faster * lever), faster);"),
        (
            "delay's own radius",
            "(guard->disturbance + guard->fault_push)) * (late * late)",
            "(guard->disturbance + guard->fault_push)) * late",
        ),
        (
            "doubt of the first step",
            "(memory->doubts[0] + known[0]) + (T * memory->doubts[1])",
            "(memory->doubts[0] + known[0])",
        ),
    ],
    "keepout_law.c": [
        (
            "guidance beyond its nodes",
            "along[axis] = ((outside[axis] == 0.0) ? blended[axis] : 0.0) - back[axis];",
            "along[axis] = blended[axis] - back[axis];",
        ),
        (
            "slowing by half",
            "const double slowed = keepout_tanh(distance / way->slowing_length);",
            "const double slowed = keepout_tanh(0.5 * distance / way->slowing_length);",
        ),
        ("class K's knee", "return (barrier >= 0.0) ? (root - knee)", "return (barrier >= 0.0) ? (root)"),
        (
            "reserve forgotten",
            "(keepout_maximum(barrier, 0.0) + law->speed_reserve)",
            "(keepout_maximum(barrier, 0.0))",
        ),
        ("projection by the wrong foot", "foot[i] = (-rate / square) * n[i];", "foot[i] = (rate / square) * n[i];"),
        (
            "safety's estimate term",
            "a = a - (b / ((2.0 * law->estimation_weight)",
            "a = a + (b / ((2.0 * law->estimation_weight)",
        ),
        ("drift not compensated", "(law->mass * (feedback[i] - drift[i]))", "(law->mass * feedback[i])"),
        (
            "observer without its mean",
            "residual = residual - (law->mean_output[j] * state[j]);",
            "residual = residual + (law->mean_output[j] * state[j]);",
        ),
        ("saturated from half on", "> law->force_limit[axis]);", "> (0.5 * law->force_limit[axis]));"),
        (
            "delay a step short",
            "for (i = 0; (i < mission->law->delay) && (i < KEEPOUT_DELAY); i++) {",
            "for (i = 1; (i < mission->law->delay) && (i < KEEPOUT_DELAY); i++) {",
        ),
        (
            "told force not kept",
            "keepout_copy(force, memory->pending[delay - 1]);",
            "keepout_copy(force, memory->pending[0]);",
        ),
    ],
    "keepout_motion.c": [
        ("Coriolis once", "((-2.0 * coriolis[i]) - euler[i])", "((-1.0 * coriolis[i]) - euler[i])"),
        ("Euler's sign", "- euler[i]) - centrifugal[i])", "+ euler[i]) - centrifugal[i])"),
        ("quaternion the other way", "slope->attitude[i + 1] = -0.5 *", "slope->attitude[i + 1] = 0.5 *"),
        ("Runge-Kutta's middle", "{0.0, 0.5, 0.5, 1.0}", "{0.0, 0.5, 0.4, 1.0}"),
        ("gravity's torque", "(3.0 * motion->gravitational_parameter)", "(2.0 * motion->gravitational_parameter)"),
        ("Kepler's correction", "(((d3 * d3) * cosine) / 6.0)", "(((d3 * d3) * cosine) / 2.0)"),
        ("Kepler's first guess", "(1.6 * KEEPOUT_PI)", "(1.7 * KEEPOUT_PI)"),
        ("rate without e", "((-2.0 * ratio) * e) * sine", "((-2.0 * ratio)) * sine"),
    ],
    "keepout_math.c": [
        (
            "NaN dropped",
            "double larger = (a > b) ? a : b;\n    if (keepout_is_nan(a)) {",
            "double larger = (a > b) ? a : b;\n    if (keepout_is_nan(b)) {",
        ),
        ("a term of exp short", "for (i = 13; i >= 1; i--) {", "for (i = 7; i >= 1; i--) {"),
        ("log from 1 on", "if (number > 1.4142135623730951) {", "if (number > 1.9) {"),
        (
            "cosine a quadrant off",
            "return of_quadrant((number + 1) % 4, left);",
            "return of_quadrant((number + 3) % 4, left);",
        ),
        ("arc tangent's third", "base = KEEPOUT_PI / 6.0;", "base = KEEPOUT_PI / 6.1;"),
        ("half a step ahead", "(half * acceleration[i]);", "(period * acceleration[i]);"),
        (
            "oldest command kept",
            "keepout_copy(pending[i], pending[i - 1]);",
            "keepout_copy(pending[i - 1], pending[i]);",
        ),
    ],
    "keepout_tables.c": [
        ("checksum's end", "return sum ^ 0xFFFFFFFFu;", "return sum;"),
        ("another mission's image", "(four_bytes(&image[20]) != digest)", "(four_bytes(&image[20]) == 0u)"),
        (
            "parts longer than told",
            "(length == (uint64_t)four_bytes(&from->image[from->lengths]))",
            "(length <= (uint64_t)four_bytes(&from->image[from->lengths]))",
        ),
        ("some parts left", "if (from.wrong || (from.parts != 0u) ||", "if (from.wrong ||"),
    ],
    "keepout_thrusters.c": [
        (
            "fee forgotten",
            "keepout_dot(thrusters->price[i], force) - thrusters->fee[i];",
            "keepout_dot(thrusters->price[i], force);",
        ),
        ("best point of the second half", "if (value > most) {", "if ((value > most) || (i == (points / 2))) {"),
        ("groups without their offset", "force) + thrusters->offset[best][i];", "force);"),
        (
            "a group beyond its force",
            "balanced[i] = keepout_minimum(wanted, thrusters->balanced[i]);",
            "balanced[i] = wanted;",
        ),
        ("alone as paired", "(thrusters->alone[number] * rest[group])", "(thrusters->paired[number] * rest[group])"),
        ("last of equal points", "if (value > most) {", "if (value >= most) {"),
        (
            "share beyond the period",
            "return keepout_minimum((thrusters->paired",
            "return keepout_maximum((thrusters->paired",
        ),
        ("what is owed not asked for", "(thrusters->period * share) + *owed;", "(thrusters->period * share);"),
        (
            "half of the least on-time",
            "(wanted <= (0.5 * thrusters->least_on_time))",
            "(wanted <= (0.6 * thrusters->least_on_time))",
        ),
        (
            "pulses as short as they are",
            "keepout_clip(wanted, thrusters->least_on_time, thrusters->period);",
            "keepout_clip(wanted, 0.0, thrusters->period);",
        ),
        ("owed with pulse-width too", "if (thrusters->delta_sigma) {", "if (true) {"),
        ("owed the other way", "*owed = wanted - given;", "*owed = given - wanted;"),
        ("pulse from the period's start", "(0.5 * (T - pulse)) + thrusters->rise_delay;", "thrusters->rise_delay;"),
        ("tail not kept", "memory->tail[i] = keepout_maximum(end - T, 0.0);", "memory->tail[i] = 0.0;"),
        ("mean force of what is fired now", "((tails[axis] + given[axis]) / T)", "(given[axis] / T)"),
        (
            "command beyond the limit",
            "force[axis] = keepout_clip(order->force[axis], -thrusters->force_limit, thrusters->force_limit);",
            "force[axis] = order->force[axis];",
        ),
    ],
    "keepout_navigation.c": [
        ("gate at half", "(square <= sensor->gate)", "(square <= (0.5 * sensor->gate))"),
        ("an outlier believed", "use = finite && (square <= sensor->gate);", "use = finite;"),
        ("patience a sample short", "#define PATIENCE 5", "#define PATIENCE 4"),
        ("widened by half", "(2.0 * square) / sensor->gate;", "square / sensor->gate;"),
        ("widened without end", "#define MOST_WIDENING 100.0", "#define MOST_WIDENING 1.0e4"),
        ("position widened beyond", "#define WIDEST_POSITION 1.0e4", "#define WIDEST_POSITION 1.0e6"),
        ("pushes widened beyond", "#define WIDEST_PUSH 100.0", "#define WIDEST_PUSH 1.0e4"),
        ("widened by rows alone", "(factors[i] * P[i][j]) * factors[j];", "factors[i] * P[i][j];"),
        ("count not begun anew", "*left_out = 0;", ""),
        ("count stands still", "*left_out = *left_out + 1;", "*left_out = *left_out;"),
        ("Joseph without R", "turned[m] = turned[m] - (K[i][k] * R[k][m]);", ""),
        ("M for P", "P[i][j] = P[i][j] - sum;\n        }\n        if (i < 3)", "}\n        if (i < 3)"),
        ("covariance of a vector turned", "((square * one) - outer)", "((square * one) + outer)"),
        ("range's error across", "(one - along));", "one);"),
        ("slope of the range forgotten", "((distance > 1e-12) ? (value[0] * along) : 0.0)", "0.0"),
        ("axes the other way", "sensor->in_vvlh ? body_from_vvlh[j][i]", "sensor->in_vvlh ? body_from_vvlh[i][j]"),
        ("attitude the longer way", "(along < 0.0) ? -(sampled", "(along > 0.0) ? -(sampled"),
        ("attitude whole", "(share * (wanted - attitude[i]))", "(wanted - attitude[i])"),
        ("middle of the period", "((0.5 * t) * acceleration[i])", "(t * acceleration[i])"),
        ("tide's sign", "- (tide * (one -", "+ (tide * (one -"),
        ("no Coriolis", "D[i][j] = -2.0 * turn[i][j];", "D[i][j] = -1.0 * turn[i][j];"),
        ("third order lost", "(one + (t2 * G[i][j])) + (t3 * DG[i][j]);", "(one + (t2 * G[i][j]));"),
        ("force's third order lost", "((t2 * one) + (t3 * D[i][j])) + (t4 * e);", "(t2 * one) + (t3 * D[i][j]);"),
        ("disturbance's phase", "(cosine * b) - (sine * a);", "(cosine * b) + (sine * a);"),
        ("mean without half", "for (i = 1; i < KEEPOUT_PUSHES; i++) {", "for (i = 1; i < KEEPOUT_PUSHES; i += 2) {"),
        ("noise of one alone", "(j < 6) && ((i % 3) == (j % 3))", "(j < 6) && (i == j)"),
        ("disturbance stands still", "noise = navigation->walk;", "noise = 0.0;"),
        ("acceleration for force", "top[i][j] = top[i][j] / navigation->mass;", ""),
        ("one side of F P F^T", "move_column(navigation, (const double(*)[9])top, P[i]);", ""),
        ("nothing but forces moves", "push[i] = force[i] + mean_of(", "push[i] = force[i] + 0.0 * mean_of("),
        ("first error whole", "(error * error) / 5.0;", "(error * error);"),
        (
            "moved before the start",
            "memory->steps > (KEEPOUT_LATENCY - i);",
            "memory->steps >= (KEEPOUT_LATENCY - i);",
        ),
        ("settled a period late", "        if (i == 0) {\n", "        if (i == KEEPOUT_LATENCY) {\n"),
        ("command acts at once", "(delay > 0) ? memory->pending[0] : force, acting", "force, acting"),
        ("steps stand still", "memory->steps = memory->steps + 1;", ""),
        ("nothing under way", "(under_way != NULL) && (i < delay)", "(under_way == NULL) && (i < -delay)"),
    ],
    "keepout_known_set.c": [
        ("rounding not allowed for", "(radius * (1.0 + ROUNDING)) + (ROUNDING * size);", "radius;"),
        ("lens about one ball", "first->centre[i] + (share * between[i]);", "first->centre[i];"),
        ("lens too small", "- ((share * (1.0 - share)) * square);", "- (share * square);"),
        ("larger ball", "meets && !(R1 <= R2)", "meets && (R1 <= R2)"),
        ("all meet", "(distance <= (((R1 + R2) * (1.0 + ROUNDING)) + (ROUNDING * size)))", "true"),
        ("meets a hair apart", "(((R1 + R2) * (1.0 + ROUNDING))", "(((R1 + R2) * (1.0 + 1e-6))"),
        ("patience a step long", "#define PATIENCE 3", "#define PATIENCE 4"),
        ("never believed", "if (believe && keepout_finite3", "if (false && keepout_finite3"),
        ("turned by less", "(radius + (sensor->turned * (length + radius)))", "(radius + (sensor->turned * length))"),
        ("bearing's radius", "((4.0 * length) * (length + radius))", "((4.0 * length) * length)"),
        ("attitude of now", "memory->attitudes[0], &told);", "memory->attitudes[KEEPOUT_LATENCY], &told);"),
        ("late velocity as it was", "centre[i] = told->centre[i] + change[i];", "centre[i] = told->centre[i];"),
        (
            "late position without its push",
            "(told->centre[i] + drift[i]) - change[i];",
            "(told->centre[i] + drift[i]);",
        ),
        ("position's push from the end", "((double)place + 0.5)", "((double)place + 1.5)"),
        ("late position as narrow", "(told->radius + (since * velocity->radius))", "told->radius"),
        (
            "one position's radius",
            "((position->radius + memory->radii[KEEPOUT_KEPT - KEEPOUT_WINDOW])",
            "(position->radius",
        ),
        ("window's weight", "- (double)memory->elapsed)) + 0.5;", "- (double)memory->elapsed)) - 0.5;"),
        ("past of another flight", "(i < KEEPOUT_KEPT) && position.replaced;", "(i < KEEPOUT_KEPT) && false;"),
        ("elapsed goes on", "if (position.replaced) { /*", "if (false) { /*"),
        ("contradictions kept", "(before + 1) : 0;", "(before + 1) : before;"),
        ("counts what is believed", "(before < (PATIENCE - 1))", "(before < PATIENCE)"),
        (
            "radius without D",
            "(T * memory->velocity.radius))\n                           + ((0.5 * (T * T)) * navigation->disturbance);",
            "(T * memory->velocity.radius));",
        ),
        (
            "velocity's radius stands",
            "memory->velocity.radius + (T * navigation->disturbance);",
            "memory->velocity.radius;",
        ),
        (
            "position without its push",
            "(memory->position.centre[i] + drift[i]) + push[i];",
            "memory->position.centre[i];",
        ),
        ("contradicted by position alone", "position.wrong || velocity.wrong;", "position.wrong;"),
    ],
    "keepout_step.c": [
        ("thrusters not begun", "keepout_thrusters_begin(&memory->thrusters);", ""),
        ("law not told", "keepout_law_told(mission->law, &memory->law, order->force);", ""),
    ],
}
EQUIVALENT = {
    "last of equal points": "where two points are equally good the forces are the same",
    "Kepler's correction": "the second of the two corrections makes up for what the first one lacks",
    "brick from node 0 on": "the window then begins at node 8 of the brick before, which is the same one",
    "Kepler's first guess": "two corrections of fourth order bring any guess nearby to the last digits",
}
"""Mutants that answer the same to rounding; not counted."""


def table(options: argparse.Namespace, folders: list[Path]) -> list[dict[str, Any]]:
    """Compile and run every mutant until a mission's stored steps find it."""
    asked = "≥ 40 not equivalent, ≥ 90 % killed, survivors named"
    killed: dict[str, str] = {}
    survived: list[str] = []
    with tempfile.TemporaryDirectory() as room:
        works = []
        for folder in folders:
            files = checks.refreshed(folder)
            work = Path(room) / folder.name
            work.mkdir()
            for path in [*folder.glob("*.[ch]"), folder / "tables.bin", folder / stored.NAME, folder / stored.FIELDS]:
                if path.is_file():
                    shutil.copy(path, work)
            shutil.copy(checks.HARNESS / "replay.c", work)
            for name in [*files, "replay.c"]:
                _compile(work, name)
            works.append((work, files))
            if _notices(work, files):
                raise SystemExit(f"{folder.name}: the code as it is answers otherwise than stored")
        for file, some in MUTANTS.items():
            for name, text, instead in some:
                if name in EQUIVALENT:
                    continue
                for work, files in works:
                    source = (work / file).read_text(encoding="utf-8")
                    if source.count(text) != 1:
                        raise SystemExit(f"{name}: {source.count(text)} times in {file}")
                    (work / file).write_text(source.replace(text, instead), encoding="utf-8")
                    _compile(work, file)
                    found = _notices(work, files)
                    (work / file).write_text(source, encoding="utf-8")
                    _compile(work, file)
                    if found:
                        killed[name] = work.name
                        break
                else:
                    survived.append(f"{file}: {name}")
    count = len(killed) + len(survived)
    reached = f"{len(killed)} of {count} ({100.0 * len(killed) / count:.0f} %) by {len(folders)} missions"
    reached += f"; survivors: {', '.join(survived)}" if survived else ""
    return [checks.row("mutants of the C", asked, reached, equivalent=EQUIVALENT, killed=killed)]


def _compile(work: Path, name: str) -> None:
    done = checks.run(
        ["gcc", "-std=c99", "-ffp-contract=off", "-O1", "-w", "-I.", "-c", "-o", name[:-2] + ".o", name], work
    )
    if done.returncode:
        raise SystemExit(f"{name}: {done.stderr[:500]}")


def _notices(work: Path, files: list[str]) -> bool:
    objects = [name[:-2] + ".o" for name in [*files, "replay.c"]]
    checks.run(["gcc", "-o", "replay", *objects, "-lm"], work)
    return checks.run(["./replay", "tables.bin", stored.NAME, stored.FIELDS], work, limit=120.0).returncode != 0
