from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class AltitudeReference(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ALTITUDE_REFERENCE_HOME: _ClassVar[AltitudeReference]
    ALTITUDE_REFERENCE_AMSL: _ClassVar[AltitudeReference]
    ALTITUDE_REFERENCE_TERRAIN: _ClassVar[AltitudeReference]
ALTITUDE_REFERENCE_HOME: AltitudeReference
ALTITUDE_REFERENCE_AMSL: AltitudeReference
ALTITUDE_REFERENCE_TERRAIN: AltitudeReference

class Position(_message.Message):
    __slots__ = ("latitude_deg", "longitude_deg", "altitude_m", "altitude_reference")
    LATITUDE_DEG_FIELD_NUMBER: _ClassVar[int]
    LONGITUDE_DEG_FIELD_NUMBER: _ClassVar[int]
    ALTITUDE_M_FIELD_NUMBER: _ClassVar[int]
    ALTITUDE_REFERENCE_FIELD_NUMBER: _ClassVar[int]
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    altitude_reference: AltitudeReference
    def __init__(self, latitude_deg: _Optional[float] = ..., longitude_deg: _Optional[float] = ..., altitude_m: _Optional[float] = ..., altitude_reference: _Optional[_Union[AltitudeReference, str]] = ...) -> None: ...

class Area(_message.Message):
    __slots__ = ("circle", "polygon")
    class Circle(_message.Message):
        __slots__ = ("center", "radius_m")
        CENTER_FIELD_NUMBER: _ClassVar[int]
        RADIUS_M_FIELD_NUMBER: _ClassVar[int]
        center: Position
        radius_m: float
        def __init__(self, center: _Optional[_Union[Position, _Mapping]] = ..., radius_m: _Optional[float] = ...) -> None: ...
    class Ring(_message.Message):
        __slots__ = ("corners",)
        CORNERS_FIELD_NUMBER: _ClassVar[int]
        corners: _containers.RepeatedCompositeFieldContainer[Position]
        def __init__(self, corners: _Optional[_Iterable[_Union[Position, _Mapping]]] = ...) -> None: ...
    class Polygon(_message.Message):
        __slots__ = ("exterior", "holes")
        EXTERIOR_FIELD_NUMBER: _ClassVar[int]
        HOLES_FIELD_NUMBER: _ClassVar[int]
        exterior: Area.Ring
        holes: _containers.RepeatedCompositeFieldContainer[Area.Ring]
        def __init__(self, exterior: _Optional[_Union[Area.Ring, _Mapping]] = ..., holes: _Optional[_Iterable[_Union[Area.Ring, _Mapping]]] = ...) -> None: ...
    CIRCLE_FIELD_NUMBER: _ClassVar[int]
    POLYGON_FIELD_NUMBER: _ClassVar[int]
    circle: Area.Circle
    polygon: Area.Polygon
    def __init__(self, circle: _Optional[_Union[Area.Circle, _Mapping]] = ..., polygon: _Optional[_Union[Area.Polygon, _Mapping]] = ...) -> None: ...

class ControlPoint(_message.Message):
    __slots__ = ("navigation", "path", "region")
    NAVIGATION_FIELD_NUMBER: _ClassVar[int]
    PATH_FIELD_NUMBER: _ClassVar[int]
    REGION_FIELD_NUMBER: _ClassVar[int]
    navigation: str
    path: _containers.RepeatedCompositeFieldContainer[Position]
    region: Area
    def __init__(self, navigation: _Optional[str] = ..., path: _Optional[_Iterable[_Union[Position, _Mapping]]] = ..., region: _Optional[_Union[Area, _Mapping]] = ...) -> None: ...

class Velocity(_message.Message):
    __slots__ = ("north_mps", "east_mps", "down_mps")
    NORTH_MPS_FIELD_NUMBER: _ClassVar[int]
    EAST_MPS_FIELD_NUMBER: _ClassVar[int]
    DOWN_MPS_FIELD_NUMBER: _ClassVar[int]
    north_mps: float
    east_mps: float
    down_mps: float
    def __init__(self, north_mps: _Optional[float] = ..., east_mps: _Optional[float] = ..., down_mps: _Optional[float] = ...) -> None: ...

class Attitude(_message.Message):
    __slots__ = ("roll_deg", "pitch_deg", "yaw_deg")
    ROLL_DEG_FIELD_NUMBER: _ClassVar[int]
    PITCH_DEG_FIELD_NUMBER: _ClassVar[int]
    YAW_DEG_FIELD_NUMBER: _ClassVar[int]
    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    def __init__(self, roll_deg: _Optional[float] = ..., pitch_deg: _Optional[float] = ..., yaw_deg: _Optional[float] = ...) -> None: ...

class Decision(_message.Message):
    __slots__ = ("action", "reason", "code", "policies")
    class Action(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        ACTION_UNSPECIFIED: _ClassVar[Decision.Action]
        ACTION_ALLOW: _ClassVar[Decision.Action]
        ACTION_CORRECT: _ClassVar[Decision.Action]
        ACTION_DENY: _ClassVar[Decision.Action]
        ACTION_TAKEOVER: _ClassVar[Decision.Action]
    ACTION_UNSPECIFIED: Decision.Action
    ACTION_ALLOW: Decision.Action
    ACTION_CORRECT: Decision.Action
    ACTION_DENY: Decision.Action
    ACTION_TAKEOVER: Decision.Action
    ACTION_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    CODE_FIELD_NUMBER: _ClassVar[int]
    POLICIES_FIELD_NUMBER: _ClassVar[int]
    action: Decision.Action
    reason: str
    code: str
    policies: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, action: _Optional[_Union[Decision.Action, str]] = ..., reason: _Optional[str] = ..., code: _Optional[str] = ..., policies: _Optional[_Iterable[str]] = ...) -> None: ...
