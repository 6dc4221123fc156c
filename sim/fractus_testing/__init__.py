"""Tests of applications and of the platform with virtual drones, from Python.

The pytest plugin provides the fixture `fractus`, which is a `Scene`. See docs/testing.md.
"""

from fractus_sim.errors import ExperimentError as ExperimentError

from fractus_testing import malice as malice
from fractus_testing.applications import App as App
from fractus_testing.flight_plan import MIN_RESOURCES as MIN_RESOURCES
from fractus_testing.flight_plan import FlightPlan as FlightPlan
from fractus_testing.flight_plan import Resources as Resources
from fractus_testing.flight_plan import Restriction as Restriction
from fractus_testing.flight_plan import circle as circle
from fractus_testing.flight_plan import max_altitude as max_altitude
from fractus_testing.flight_plan import max_speed as max_speed
from fractus_testing.flight_plan import no_fly as no_fly
from fractus_testing.flight_plan import no_photo as no_photo
from fractus_testing.flight_plan import polygon as polygon
from fractus_testing.flight_plan import stay_inside as stay_inside
from fractus_testing.network import LTE as LTE
from fractus_testing.network import WIFI as WIFI
from fractus_testing.network import Network as Network
from fractus_testing.results import ABORTED as ABORTED
from fractus_testing.results import FAILED as FAILED
from fractus_testing.results import RUNNING as RUNNING
from fractus_testing.results import SUCCESS as SUCCESS
from fractus_testing.results import Results as Results
from fractus_testing.results import Violation as Violation
from fractus_testing.scene import SITL as SITL
from fractus_testing.scene import Ardupilot as Ardupilot
from fractus_testing.scene import Builtin as Builtin
from fractus_testing.scene import NetSim as NetSim
from fractus_testing.scene import Scene as Scene
from fractus_testing.scene import VirtualController as VirtualController
from fractus_testing.scene import VirtualDrone as VirtualDrone
from fractus_testing.scene import VirtualNode as VirtualNode
from fractus_testing.scene import app as app
from fractus_testing.scene import autopilot as autopilot
from fractus_testing.scene import runtime as runtime
from fractus_testing.triggers import Trigger as Trigger
from fractus_testing.triggers import until as until
from fractus_testing.world import World as World
