"""SDK for components of Fractus applications: drone, camera, and requests between components."""

import typing

from fractus import sync as sync
from fractus.control import Control as Control
from fractus.control import Motion as Motion
from fractus.control_point import Circle as Circle
from fractus.control_point import ControlPoint as ControlPoint
from fractus.control_point import Polygon as Polygon
from fractus.drone import CanI as CanI
from fractus.drone import Mobility as Mobility
from fractus.drone import mobility as mobility
from fractus.environment import Endpoint as Endpoint
from fractus.environment import control_points as control_points
from fractus.environment import egress as egress
from fractus.environment import endpoint as endpoint
from fractus.errors import AutopilotRefused as AutopilotRefused
from fractus.errors import Busy as Busy
from fractus.errors import CameraFixed as CameraFixed
from fractus.errors import ControlHeld as ControlHeld
from fractus.errors import ControlLost as ControlLost
from fractus.errors import Corrected as Corrected
from fractus.errors import FractusError as FractusError
from fractus.errors import Interrupted as Interrupted
from fractus.errors import InvalidRequest as InvalidRequest
from fractus.errors import MissionComplete as MissionComplete
from fractus.errors import MissionEnded as MissionEnded
from fractus.errors import NoLegalWay as NoLegalWay
from fractus.errors import NotArmed as NotArmed
from fractus.errors import NotAtHome as NotAtHome
from fractus.errors import NotConfigured as NotConfigured
from fractus.errors import NotFlying as NotFlying
from fractus.errors import NotReady as NotReady
from fractus.errors import PolicyDenied as PolicyDenied
from fractus.errors import StateError as StateError
from fractus.errors import Unavailable as Unavailable
from fractus.exchange import Request as Request
from fractus.exchange import Requester as Requester
from fractus.exchange import Responder as Responder
from fractus.exchange import StoredResponses as StoredResponses
from fractus.exchange import requester as requester
from fractus.mission import Mission as Mission
from fractus.mission import MissionProgress as MissionProgress
from fractus.mission import Waypoint as Waypoint
from fractus.mission import orbit as orbit
from fractus.pictures import Camera as Camera
from fractus.pictures import camera as camera
from fractus.plan_file import read_plan as read_plan
from fractus.runner import fly as fly
from fractus.runner import run as run
from fractus.telemetry import Battery as Battery
from fractus.telemetry import Fix as Fix
from fractus.telemetry import Gps as Gps
from fractus.telemetry import Health as Health
from fractus.telemetry import Severity as Severity
from fractus.telemetry import StatusText as StatusText
from fractus.telemetry import Telemetry as Telemetry
from fractus.telemetry import Watch as Watch
from fractus.telemetry import Wind as Wind
from fractus.values import Action as Action
from fractus.values import AltitudeReference as AltitudeReference
from fractus.values import Attitude as Attitude
from fractus.values import Check as Check
from fractus.values import Decision as Decision
from fractus.values import ImageInfo as ImageInfo
from fractus.values import Picture as Picture
from fractus.values import Position as Position
from fractus.values import PositionResult as PositionResult
from fractus.values import Progress as Progress
from fractus.values import Result as Result
from fractus.values import SpeedResult as SpeedResult
from fractus.values import TourProgress as TourProgress
from fractus.values import Velocity as Velocity
from fractus.values import VelocityResult as VelocityResult

if typing.TYPE_CHECKING:
    from fractus.survey_lines import survey as survey


def __getattr__(name: str) -> typing.Any:
    # Most components need no geometry. The import of shapely and numpy would double their memory.
    if name != "survey":
        raise AttributeError(f"module fractus has no attribute {name!r}")
    try:
        from fractus.survey_lines import survey  # noqa: PLC0415
    except ImportError as error:
        raise ImportError(
            f"fractus.survey requires {error.name}; install it with: pip install 'fractus-drones[geometry]'"
        ) from error
    return survey
