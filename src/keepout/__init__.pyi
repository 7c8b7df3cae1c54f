from .control.guidance.guidance import Guidance as Guidance
from .control.guidance.plan import GuidancePlan as GuidancePlan
from .control.law import Command as Command
from .control.law import Law as Law
from .errors import KeepoutError as KeepoutError
from .fields.field import Field as Field
from .fields.model import FieldModel as FieldModel
from .fields.shipped import load_shipped as load_shipped
from .flight.on_board import OnBoard as OnBoard
from .flight.record import FlightRecord as FlightRecord
from .flight.setup import Faults as Faults
from .geometry.target import Target as Target
from .guard.safety_layer import SafetyLayer as SafetyLayer
from .learning.training import fit as fit
from .mission.build import Mission as Mission
from .mission.build import prepare as prepare
from .mission.campaign import Campaign as Campaign
from .mission.campaign import run_campaign as run_campaign
from .mission.flight import Flight as Flight
from .mission.flight import fly as fly
from .mission.flight import fly_mission as fly_mission
from .mission.scenario import Scenario as Scenario
from .motion.chaser import Chaser as Chaser
from .motion.disturbance import Disturbance as Disturbance
from .proof.certificate import certify as certify

__version__: str
