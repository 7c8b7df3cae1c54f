"""Keepout as flight software in Basilisk: two spacecraft, J2 and drag, an hour in closed loop, audited afterwards.

    make basilisk            # or: python examples/basilisk/fly.py [--seconds 3600] [-o out/basilisk]

Basilisk flies both spacecraft. Once a second a module reads their states, asks `keepout.OnBoard` for the force, and
sends it to the chaser. What Basilisk flew is then judged on the exact mesh: Keepout's own model of motion has no part.
"""

import argparse
import json
import statistics
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from Basilisk.architecture import messaging, sysModel
from basilisk_world import World, vvlh
from scipy.spatial.transform import Rotation

import keepout
from keepout.core.audit.audit import audit
from keepout.core.mission.surroundings import Surroundings


class FlightSoftware(sysModel.SysModel):
    """Reads both states once a control period, and orders the force that `OnBoard` gives."""

    def __init__(self, mission):
        super().__init__()
        self.ModelTag = "keepout"
        self.on_board = keepout.OnBoard(mission.setup, mission.initial)
        self.target, self.chaser = messaging.SCStatesMsgReader(), messaging.SCStatesMsgReader()
        self.force = messaging.CmdForceInertialMsg()
        self.rows, self.seconds = [], []

    def UpdateState(self, nanoseconds):
        """Take one step of law and guard."""
        target, chaser = self.target(), self.chaser()
        r, v = np.array(target.r_BN_N), np.array(target.v_BN_N)
        body = Rotation.from_mrp(np.array(target.sigma_BN)).inv()  # body <- inertial
        turning = np.array(target.omega_BN_B)
        position = body.apply(np.array(chaser.r_BN_N) - r)
        velocity = body.apply(np.array(chaser.v_BN_N) - v) - np.cross(turning, position)
        attitude = (body * Rotation.from_matrix(vvlh(r, v)).inv()).as_quat(scalar_first=True)
        began = time.perf_counter()
        orbit = np.concatenate([r, v])
        force = np.array(self.on_board.step(1e-9 * nanoseconds, position, velocity, attitude, turning, orbit))
        self.seconds.append(time.perf_counter() - began)
        self.rows.append((1e-9 * nanoseconds, position, velocity, force, self.on_board.order.guard_status))
        order = messaging.CmdForceInertialMsgPayload()
        order.forceRequestInertial = body.inv().apply(force)
        self.force.write(order, nanoseconds, self.moduleID)


def main():
    """Fly, audit, and print what came out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=int, default=3600)
    parser.add_argument("-o", "--out", type=Path, default=Path("out/basilisk"))
    arguments = parser.parse_args()
    mission = keepout.prepare(keepout.Scenario.load(Path(__file__).with_name("mission.toml")))
    scenario = mission.scenario
    software = FlightSoftware(mission)
    World(scenario, mission.initial, software).fly(arguments.seconds)

    names = ("time", "position", "velocity", "force", "guard_status")
    flown = SimpleNamespace(**{name: np.array(column) for name, column in zip(names, zip(*software.rows))})
    verdict = audit(
        flown,
        mission.target,
        chaser_radius=scenario.chaser.radius,
        bounds=Surroundings(scenario).flight_bounds,
        force_limit=scenario.chaser.force_limit,
        speed_limit=scenario.chaser.speed_limit,
        consistency=1e-5,
    )
    error = np.linalg.norm(flown.position - scenario.goal.position, axis=1)
    found = {
        "seconds": arguments.seconds,
        "contact_verdict": str(verdict.contact),
        "minimum_clearance_m": verdict.minimum_clearance,
        "measured_clearance_m": verdict.measured_clearance,
        "final_error_m": float(error[-1]),
        "largest_speed_mps": verdict.largest_speed,
        "guard_interventions": verdict.guard_interventions,
        "inconsistent_steps": len(verdict.inconsistent_steps),
        "delta_v_mps": float(np.linalg.norm(flown.force[:-1], axis=1).sum() / scenario.chaser.mass),
        "median_step_us": 1e6 * statistics.median(software.seconds),
        "remarks": list(verdict.remarks),
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    np.savez(arguments.out / "flight.npz", **vars(flown))
    (arguments.out / "summary.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(found, indent=2))
    raise SystemExit(0 if found["contact_verdict"] == "no" else 1)


if __name__ == "__main__":
    main()
