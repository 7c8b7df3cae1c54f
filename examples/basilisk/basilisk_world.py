"""The world that Basilisk flies: two spacecraft in a low orbit, the Earth's oblateness, an exponential atmosphere."""

import math

import numpy as np
from Basilisk.simulation import dragDynamicEffector, exponentialAtmosphere, extForceTorque, gravityEffector, spacecraft
from Basilisk.utilities import SimulationBaseClass, macros, simIncludeGravBody
from scipy.spatial.transform import Rotation

from keepout.core.motion.orbit import EARTH_EQUATORIAL_RADIUS, EARTH_GRAVITATIONAL_PARAMETER, EARTH_J2

STEP = 0.25
"""Seconds of a Runge-Kutta step of Basilisk."""
DRAG_COEFFICIENT, TARGET_MASS = 2.2, 1500.0


class World:
    """Target and chaser as they start in a scenario, and flight software between them."""

    def __init__(self, scenario, initial, software):
        self.simulation = SimulationBaseClass.SimBaseClass()
        process = self.simulation.CreateNewProcess("world")
        # Where they meet, the states come first, then the software that reads them, then the thrusters that read it.
        for name, period, priority in (
            ("dynamics", STEP, 30),
            ("software", scenario.control.period, 20),
            ("thrusters", STEP, 10),
        ):
            process.addTask(self.simulation.CreateNewTask(name, macros.sec2nano(period)), priority)
        self.kept = []  # Basilisk holds no references of its own
        self.atmosphere = self._atmosphere(scenario.drag)
        r, v = np.split(np.array(initial.target_orbit), 2)
        body = Rotation.from_quat(np.array(initial.attitude), scalar_first=True) * Rotation.from_matrix(vvlh(r, v))
        turning, place = np.array(initial.angular_velocity), np.array(initial.position)
        away = body.inv().apply(place)
        drift = body.inv().apply(np.array(initial.velocity) + np.cross(turning, place))
        drag, inertia = scenario.drag, np.asarray(scenario.attitude.inertia)
        target = self._craft("target", TARGET_MASS, r, v, drag.target_area_to_mass, inertia)
        target.hub.sigma_BNInit = body.inv().as_mrp().reshape(3, 1).tolist()
        target.hub.omega_BN_BInit = turning.reshape(3, 1).tolist()
        mass = scenario.chaser.mass
        chaser = self._craft("chaser", mass, r + away, v + drift, drag.chaser_area_to_mass, np.eye(3))
        thrusters = extForceTorque.ExtForceTorque()
        chaser.addDynamicEffector(thrusters)
        self._add(thrusters, "thrusters")
        software.target.subscribeTo(target.scStateOutMsg)
        software.chaser.subscribeTo(chaser.scStateOutMsg)
        thrusters.cmdForceInertialInMsg.subscribeTo(software.force)
        self._add(software, "software")

    def fly(self, seconds):
        """Fly for so long."""
        self.simulation.InitializeSimulation()
        self.simulation.ConfigureStopTime(macros.sec2nano(seconds))
        self.simulation.ExecuteSimulation()

    def _add(self, model, task="dynamics"):
        self.simulation.AddModelToTask(task, model)
        self.kept.append(model)

    def _craft(self, name, mass, position, velocity, area_to_mass, inertia):
        craft = spacecraft.Spacecraft()
        craft.ModelTag = name
        craft.hub.mHub, craft.hub.IHubPntBc_B = mass, inertia.tolist()
        craft.hub.r_CN_NInit, craft.hub.v_CN_NInit = position.reshape(3, 1).tolist(), velocity.reshape(3, 1).tolist()
        bodies = simIncludeGravBody.gravBodyFactory()
        earth = bodies.createEarth()
        earth.isCentralBody, earth.mu = True, EARTH_GRAVITATIONAL_PARAMETER
        oblate = gravityEffector.SphericalHarmonicsGravityModel()
        oblate.muBody, oblate.radEquator, oblate.maxDeg = earth.mu, EARTH_EQUATORIAL_RADIUS, 2
        # Coefficients are normalised: C20 = -J2 / sqrt(5).
        oblate.cBar = [[1.0], [0.0, 0.0], [-EARTH_J2 / math.sqrt(5.0), 0.0, 0.0]]
        oblate.sBar = [[0.0], [0.0, 0.0], [0.0, 0.0, 0.0]]
        earth.gravityModel = oblate
        bodies.addBodiesTo(craft)
        self._add(craft)
        self.atmosphere.addSpacecraftToModel(craft.scStateOutMsg)
        drag = dragDynamicEffector.DragDynamicEffector()
        drag.coreParams.dragCoeff = DRAG_COEFFICIENT
        drag.coreParams.projectedArea = area_to_mass * mass / DRAG_COEFFICIENT
        drag.atmoDensInMsg.subscribeTo(self.atmosphere.envOutMsgs[-1])
        craft.addDynamicEffector(drag)
        self._add(drag)
        self.kept.append((bodies, oblate))
        return craft

    def _atmosphere(self, entry):
        air = exponentialAtmosphere.ExponentialAtmosphere()
        air.planetRadius, air.scaleHeight = EARTH_EQUATORIAL_RADIUS, entry.scale_height
        air.baseDensity = entry.density * math.exp(entry.altitude / entry.scale_height)
        self._add(air)
        return air


def vvlh(position, velocity):
    """Give the rotation VVLH <- inertial: z to nadir, y against the orbit's normal."""
    z = -position / np.linalg.norm(position)
    y = -np.cross(position, velocity)
    y /= np.linalg.norm(y)
    return np.array([np.cross(y, z), y, z])
