"""OEM and AEM files by another writer: text templates that share no code with the package's reader and writer."""

import datetime

import numpy as np
import trimesh

from keepout.core.geometry.target import Target
from keepout.flights.exchange.audited import Given, audit_files

START = datetime.datetime(2026, 5, 28, 12, 0, 0)
TARGET, CHASER = ("SATELLITE", "2026-001A"), ("VISITOR", "2026-002A")


def instant(second):
    return (START + datetime.timedelta(seconds=float(second))).isoformat(timespec="milliseconds")


def printed(number, digits, *, cut):
    """A number with so many decimals: rounded, or cut off."""
    return f"{number:.{digits + 4}f}"[:-4] if cut else f"{number:.{digits}f}"


def segment(kind, who, time, rows, *, digits=12, cut=False, more="", frames=("EME2000", "SC_BODY_1")):
    """One segment of metadata and rows, numbers with so many decimals (in km where they are of an orbit)."""
    lines = [f"{instant(t)} {' '.join(printed(x, digits, cut=cut) for x in row)}" for t, row in zip(time, rows)]
    where = [f"REF_FRAME_A = {frames[0]}", f"REF_FRAME_B = {frames[1]}", "ATTITUDE_TYPE = QUATERNION"]
    if kind == "OEM":
        where = ["CENTER_NAME = EARTH", f"REF_FRAME = {frames[0]}"]
    else:
        lines = ["DATA_START", *lines, "DATA_STOP"]
    about = ["META_START", f"OBJECT_NAME = {who[0]}", f"OBJECT_ID = {who[1]}", *where, "TIME_SYSTEM = UTC"]
    times = [f"START_TIME = {instant(time[0])}", f"STOP_TIME = {instant(time[-1])}{more}", "META_STOP"]
    return "\n".join([*about, *times, *lines])


def message(path, kind, *segments, comment=""):
    head = f"CCSDS_{kind}_VERS = 2.0\n{comment}CREATION_DATE = 2026-01-01T00:00:00\nORIGINATOR = TEST\n"
    path.write_text(head + "\n".join(segments) + "\n")
    return path


def xml_of(kind, who, time, rows):
    """An `<oem>` or `<aem>` of one segment."""
    keys, around, inside = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT"), ("stateVector",), ()
    where = "<CENTER_NAME>EARTH</CENTER_NAME><REF_FRAME>EME2000</REF_FRAME>"
    if kind == "AEM":
        keys, around, inside = ("Q1", "Q2", "Q3", "QC"), ("attitudeState", "quaternionEphemeris"), ("quaternion",)
        where = "<REF_FRAME_A>EME2000</REF_FRAME_A><REF_FRAME_B>SC_BODY_1</REF_FRAME_B>"
        where += "<ATTITUDE_TYPE>QUATERNION</ATTITUDE_TYPE>"

    def within(tags, text):
        for tag in reversed(tags):
            text = f"<{tag}>{text}</{tag}>"
        return text

    def state(t, row):
        numbers = "".join(f"<{key}>{number:.12f}</{key}>" for key, number in zip(keys, row))
        return within(around, f"<EPOCH>{instant(t)}</EPOCH>{within(inside, numbers)}")

    return (
        f'<{kind.lower()} id="CCSDS_{kind}_VERS" version="2.0"><body><segment><metadata>'
        f"<OBJECT_NAME>{who[0]}</OBJECT_NAME><OBJECT_ID>{who[1]}</OBJECT_ID>{where}<TIME_SYSTEM>UTC</TIME_SYSTEM>"
        f"<START_TIME>{instant(time[0])}</START_TIME><STOP_TIME>{instant(time[-1])}</STOP_TIME></metadata><data>"
        f"{''.join(map(state, time, rows))}</data></segment></body></{kind.lower()}>"
    )


def ndm(path, *messages):
    path.write_text(f'<?xml version="1.0"?>\n<ndm>{"".join(messages)}</ndm>')
    return path


def base(time, *, beside=(0.0, 0.0, 0.0)):
    """Where the target is, along a straight line, or what rests beside it; m and m/s."""
    time = np.asarray(time, float)
    states = np.tile([7e6, 0.0, 0.0, 0.0, 7500.0, 0.0], (len(time), 1))
    states[:, 1] += 7500.0 * time
    states[:, :3] += beside
    return states


def orbits(folder, time, relative, velocity, *, comment="", **options):
    rows = base(time)
    chaser = rows + np.concatenate([relative, velocity], axis=1)
    target = segment("OEM", TARGET, time, rows / 1e3, **options)
    return {
        "target_orbit": message(folder / "t.oem", "OEM", target, comment=comment),
        "chaser": message(folder / "c.oem", "OEM", segment("OEM", CHASER, time, chaser / 1e3, **options)),
    }


def resting(folder, place=(9.0, 0.0, 0.0), **options):
    return orbits(folder, np.arange(5.0), np.tile(place, (5, 1)), np.zeros((5, 3)), **options)


def turning(folder, *, who=TARGET, quaternion=(0.0, 0.0, 0.0, 1.0), time=(0.0, 1.0, 2.0, 3.0, 4.0), **more):
    """A chaser at rest and a target's attitude."""
    rows = segment("AEM", who, time, np.tile(quaternion, (len(time), 1)), **more)
    return resting(folder) | {"target_attitude": message(folder / "a.aem", "AEM", rows)}


def meshed(folder, sides):
    trimesh.creation.box(sides).export(folder / "box.stl")
    return Target.load(folder / "box.stl", units="m")


def judged(box, files, *, radius=0.5, bound=0.01, **options):
    if "target_attitude" not in options and "target_attitude" not in files:
        options.setdefault("target_fixed_in", "inertial")
    return audit_files(box, Given(**files, chaser_radius=radius, acceleration_bound=bound, **options))
