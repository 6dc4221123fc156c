"""What a component of a Fractus application imports."""

from fractus import sync
from fractus.control import Control
from fractus.drone import Mobility, Motion, mobility
from fractus.environment import Endpoint, control_points, egress, endpoint
from fractus.errors import (
    Busy,
    ControlLost,
    Corrected,
    FractusError,
    Interrupted,
    InvalidRequest,
    MissionComplete,
    NotConfigured,
    PolicyDenied,
    Unavailable,
)
from fractus.pictures import Camera, camera
from fractus.questions import CanI
from fractus.values import (
    Action,
    AltitudeReference,
    Attitude,
    Check,
    ControlPoint,
    Decision,
    ImageInfo,
    Position,
    PositionResult,
    Progress,
    Result,
    Ride,
    SpeedResult,
    Telemetry,
    Velocity,
    VelocityResult,
)

__all__ = [
    "Action",
    "AltitudeReference",
    "Attitude",
    "Busy",
    "Camera",
    "CanI",
    "Check",
    "Control",
    "ControlLost",
    "ControlPoint",
    "Corrected",
    "Decision",
    "Endpoint",
    "FractusError",
    "ImageInfo",
    "Interrupted",
    "InvalidRequest",
    "MissionComplete",
    "Mobility",
    "Motion",
    "NotConfigured",
    "PolicyDenied",
    "Position",
    "PositionResult",
    "Progress",
    "Result",
    "Ride",
    "SpeedResult",
    "Telemetry",
    "Unavailable",
    "Velocity",
    "VelocityResult",
    "camera",
    "control_points",
    "egress",
    "endpoint",
    "mobility",
    "sync",
]
