import datetime

from fractus_proto.v1 import types_pb2 as _types_pb2
from google.protobuf import timestamp_pb2 as _timestamp_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class GetControlRequest(_message.Message):
    __slots__ = ("response_timeout_s",)
    RESPONSE_TIMEOUT_S_FIELD_NUMBER: _ClassVar[int]
    response_timeout_s: float
    def __init__(self, response_timeout_s: _Optional[float] = ...) -> None: ...

class ControlEvent(_message.Message):
    __slots__ = ("state", "control_point", "reason", "waypoints_reached", "task", "decision", "ping")
    class State(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        STATE_UNSPECIFIED: _ClassVar[ControlEvent.State]
        STATE_WAITING: _ClassVar[ControlEvent.State]
        STATE_GRANTED: _ClassVar[ControlEvent.State]
        STATE_LOST: _ClassVar[ControlEvent.State]
        STATE_COMPLETE: _ClassVar[ControlEvent.State]
        STATE_PING: _ClassVar[ControlEvent.State]
        STATE_PASSENGER: _ClassVar[ControlEvent.State]
    STATE_UNSPECIFIED: ControlEvent.State
    STATE_WAITING: ControlEvent.State
    STATE_GRANTED: ControlEvent.State
    STATE_LOST: ControlEvent.State
    STATE_COMPLETE: ControlEvent.State
    STATE_PING: ControlEvent.State
    STATE_PASSENGER: ControlEvent.State
    STATE_FIELD_NUMBER: _ClassVar[int]
    CONTROL_POINT_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    WAYPOINTS_REACHED_FIELD_NUMBER: _ClassVar[int]
    TASK_FIELD_NUMBER: _ClassVar[int]
    DECISION_FIELD_NUMBER: _ClassVar[int]
    PING_FIELD_NUMBER: _ClassVar[int]
    state: ControlEvent.State
    control_point: int
    reason: str
    waypoints_reached: int
    task: _types_pb2.ControlPoint
    decision: _types_pb2.Decision
    ping: int
    def __init__(self, state: _Optional[_Union[ControlEvent.State, str]] = ..., control_point: _Optional[int] = ..., reason: _Optional[str] = ..., waypoints_reached: _Optional[int] = ..., task: _Optional[_Union[_types_pb2.ControlPoint, _Mapping]] = ..., decision: _Optional[_Union[_types_pb2.Decision, _Mapping]] = ..., ping: _Optional[int] = ...) -> None: ...

class ConfirmAliveRequest(_message.Message):
    __slots__ = ("ping",)
    PING_FIELD_NUMBER: _ClassVar[int]
    ping: int
    def __init__(self, ping: _Optional[int] = ...) -> None: ...

class ConfirmAliveResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ReportProgressRequest(_message.Message):
    __slots__ = ("waypoints",)
    WAYPOINTS_FIELD_NUMBER: _ClassVar[int]
    waypoints: int
    def __init__(self, waypoints: _Optional[int] = ...) -> None: ...

class ReportProgressResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ReportContactRequest(_message.Message):
    __slots__ = ("age_s",)
    AGE_S_FIELD_NUMBER: _ClassVar[int]
    age_s: float
    def __init__(self, age_s: _Optional[float] = ...) -> None: ...

class ReportContactResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ReturnControlRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ReturnControlResponse(_message.Message):
    __slots__ = ("mission_complete",)
    MISSION_COMPLETE_FIELD_NUMBER: _ClassVar[int]
    mission_complete: bool
    def __init__(self, mission_complete: bool = ...) -> None: ...

class ArmRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ArmResponse(_message.Message):
    __slots__ = ("decision",)
    DECISION_FIELD_NUMBER: _ClassVar[int]
    decision: _types_pb2.Decision
    def __init__(self, decision: _Optional[_Union[_types_pb2.Decision, _Mapping]] = ...) -> None: ...

class DisarmRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class DisarmResponse(_message.Message):
    __slots__ = ("decision",)
    DECISION_FIELD_NUMBER: _ClassVar[int]
    decision: _types_pb2.Decision
    def __init__(self, decision: _Optional[_Union[_types_pb2.Decision, _Mapping]] = ...) -> None: ...

class TakeoffRequest(_message.Message):
    __slots__ = ("altitude_m",)
    ALTITUDE_M_FIELD_NUMBER: _ClassVar[int]
    altitude_m: float
    def __init__(self, altitude_m: _Optional[float] = ...) -> None: ...

class LandRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class GotoRequest(_message.Message):
    __slots__ = ("target", "yaw_deg", "acceptance_radius_m", "speed_mps")
    TARGET_FIELD_NUMBER: _ClassVar[int]
    YAW_DEG_FIELD_NUMBER: _ClassVar[int]
    ACCEPTANCE_RADIUS_M_FIELD_NUMBER: _ClassVar[int]
    SPEED_MPS_FIELD_NUMBER: _ClassVar[int]
    target: _types_pb2.Position
    yaw_deg: float
    acceptance_radius_m: float
    speed_mps: float
    def __init__(self, target: _Optional[_Union[_types_pb2.Position, _Mapping]] = ..., yaw_deg: _Optional[float] = ..., acceptance_radius_m: _Optional[float] = ..., speed_mps: _Optional[float] = ...) -> None: ...

class ReturnToLaunchRequest(_message.Message):
    __slots__ = ("altitude_m",)
    ALTITUDE_M_FIELD_NUMBER: _ClassVar[int]
    altitude_m: float
    def __init__(self, altitude_m: _Optional[float] = ...) -> None: ...

class MotionProgress(_message.Message):
    __slots__ = ("decision", "target", "position", "distance_m", "complete")
    DECISION_FIELD_NUMBER: _ClassVar[int]
    TARGET_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_M_FIELD_NUMBER: _ClassVar[int]
    COMPLETE_FIELD_NUMBER: _ClassVar[int]
    decision: _types_pb2.Decision
    target: _types_pb2.Position
    position: _types_pb2.Position
    distance_m: float
    complete: bool
    def __init__(self, decision: _Optional[_Union[_types_pb2.Decision, _Mapping]] = ..., target: _Optional[_Union[_types_pb2.Position, _Mapping]] = ..., position: _Optional[_Union[_types_pb2.Position, _Mapping]] = ..., distance_m: _Optional[float] = ..., complete: bool = ...) -> None: ...

class HoverRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class HoverResponse(_message.Message):
    __slots__ = ("decision",)
    DECISION_FIELD_NUMBER: _ClassVar[int]
    decision: _types_pb2.Decision
    def __init__(self, decision: _Optional[_Union[_types_pb2.Decision, _Mapping]] = ...) -> None: ...

class SetSpeedRequest(_message.Message):
    __slots__ = ("speed_mps",)
    SPEED_MPS_FIELD_NUMBER: _ClassVar[int]
    speed_mps: float
    def __init__(self, speed_mps: _Optional[float] = ...) -> None: ...

class SetSpeedResponse(_message.Message):
    __slots__ = ("decision", "speed_mps")
    DECISION_FIELD_NUMBER: _ClassVar[int]
    SPEED_MPS_FIELD_NUMBER: _ClassVar[int]
    decision: _types_pb2.Decision
    speed_mps: float
    def __init__(self, decision: _Optional[_Union[_types_pb2.Decision, _Mapping]] = ..., speed_mps: _Optional[float] = ...) -> None: ...

class SetVelocityRequest(_message.Message):
    __slots__ = ("velocity", "yaw_deg", "hold_s")
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    YAW_DEG_FIELD_NUMBER: _ClassVar[int]
    HOLD_S_FIELD_NUMBER: _ClassVar[int]
    velocity: _types_pb2.Velocity
    yaw_deg: float
    hold_s: float
    def __init__(self, velocity: _Optional[_Union[_types_pb2.Velocity, _Mapping]] = ..., yaw_deg: _Optional[float] = ..., hold_s: _Optional[float] = ...) -> None: ...

class SetVelocityResponse(_message.Message):
    __slots__ = ("decision", "velocity")
    DECISION_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    decision: _types_pb2.Decision
    velocity: _types_pb2.Velocity
    def __init__(self, decision: _Optional[_Union[_types_pb2.Decision, _Mapping]] = ..., velocity: _Optional[_Union[_types_pb2.Velocity, _Mapping]] = ...) -> None: ...

class PointGimbalRequest(_message.Message):
    __slots__ = ("pitch_deg", "yaw_deg")
    PITCH_DEG_FIELD_NUMBER: _ClassVar[int]
    YAW_DEG_FIELD_NUMBER: _ClassVar[int]
    pitch_deg: float
    yaw_deg: float
    def __init__(self, pitch_deg: _Optional[float] = ..., yaw_deg: _Optional[float] = ...) -> None: ...

class PointGimbalResponse(_message.Message):
    __slots__ = ("decision",)
    DECISION_FIELD_NUMBER: _ClassVar[int]
    decision: _types_pb2.Decision
    def __init__(self, decision: _Optional[_Union[_types_pb2.Decision, _Mapping]] = ...) -> None: ...

class GetSpeedRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class GetSpeedResponse(_message.Message):
    __slots__ = ("decision", "speed_mps")
    DECISION_FIELD_NUMBER: _ClassVar[int]
    SPEED_MPS_FIELD_NUMBER: _ClassVar[int]
    decision: _types_pb2.Decision
    speed_mps: float
    def __init__(self, decision: _Optional[_Union[_types_pb2.Decision, _Mapping]] = ..., speed_mps: _Optional[float] = ...) -> None: ...

class GetPositionRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class GetPositionResponse(_message.Message):
    __slots__ = ("decision", "position", "velocity")
    DECISION_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    decision: _types_pb2.Decision
    position: _types_pb2.Position
    velocity: _types_pb2.Velocity
    def __init__(self, decision: _Optional[_Union[_types_pb2.Decision, _Mapping]] = ..., position: _Optional[_Union[_types_pb2.Position, _Mapping]] = ..., velocity: _Optional[_Union[_types_pb2.Velocity, _Mapping]] = ...) -> None: ...

class CheckCallRequest(_message.Message):
    __slots__ = ("arm", "disarm", "takeoff", "land", "goto", "return_to_launch", "hover", "set_speed", "set_velocity", "get_speed", "get_position", "get_control", "return_control", "point_gimbal")
    ARM_FIELD_NUMBER: _ClassVar[int]
    DISARM_FIELD_NUMBER: _ClassVar[int]
    TAKEOFF_FIELD_NUMBER: _ClassVar[int]
    LAND_FIELD_NUMBER: _ClassVar[int]
    GOTO_FIELD_NUMBER: _ClassVar[int]
    RETURN_TO_LAUNCH_FIELD_NUMBER: _ClassVar[int]
    HOVER_FIELD_NUMBER: _ClassVar[int]
    SET_SPEED_FIELD_NUMBER: _ClassVar[int]
    SET_VELOCITY_FIELD_NUMBER: _ClassVar[int]
    GET_SPEED_FIELD_NUMBER: _ClassVar[int]
    GET_POSITION_FIELD_NUMBER: _ClassVar[int]
    GET_CONTROL_FIELD_NUMBER: _ClassVar[int]
    RETURN_CONTROL_FIELD_NUMBER: _ClassVar[int]
    POINT_GIMBAL_FIELD_NUMBER: _ClassVar[int]
    arm: ArmRequest
    disarm: DisarmRequest
    takeoff: TakeoffRequest
    land: LandRequest
    goto: GotoRequest
    return_to_launch: ReturnToLaunchRequest
    hover: HoverRequest
    set_speed: SetSpeedRequest
    set_velocity: SetVelocityRequest
    get_speed: GetSpeedRequest
    get_position: GetPositionRequest
    get_control: GetControlRequest
    return_control: ReturnControlRequest
    point_gimbal: PointGimbalRequest
    def __init__(self, arm: _Optional[_Union[ArmRequest, _Mapping]] = ..., disarm: _Optional[_Union[DisarmRequest, _Mapping]] = ..., takeoff: _Optional[_Union[TakeoffRequest, _Mapping]] = ..., land: _Optional[_Union[LandRequest, _Mapping]] = ..., goto: _Optional[_Union[GotoRequest, _Mapping]] = ..., return_to_launch: _Optional[_Union[ReturnToLaunchRequest, _Mapping]] = ..., hover: _Optional[_Union[HoverRequest, _Mapping]] = ..., set_speed: _Optional[_Union[SetSpeedRequest, _Mapping]] = ..., set_velocity: _Optional[_Union[SetVelocityRequest, _Mapping]] = ..., get_speed: _Optional[_Union[GetSpeedRequest, _Mapping]] = ..., get_position: _Optional[_Union[GetPositionRequest, _Mapping]] = ..., get_control: _Optional[_Union[GetControlRequest, _Mapping]] = ..., return_control: _Optional[_Union[ReturnControlRequest, _Mapping]] = ..., point_gimbal: _Optional[_Union[PointGimbalRequest, _Mapping]] = ...) -> None: ...

class CheckCallResponse(_message.Message):
    __slots__ = ("decision", "takeoff", "goto", "set_speed", "set_velocity", "takeover", "brake_first")
    DECISION_FIELD_NUMBER: _ClassVar[int]
    TAKEOFF_FIELD_NUMBER: _ClassVar[int]
    GOTO_FIELD_NUMBER: _ClassVar[int]
    SET_SPEED_FIELD_NUMBER: _ClassVar[int]
    SET_VELOCITY_FIELD_NUMBER: _ClassVar[int]
    TAKEOVER_FIELD_NUMBER: _ClassVar[int]
    BRAKE_FIRST_FIELD_NUMBER: _ClassVar[int]
    decision: _types_pb2.Decision
    takeoff: TakeoffRequest
    goto: GotoRequest
    set_speed: SetSpeedRequest
    set_velocity: SetVelocityRequest
    takeover: str
    brake_first: bool
    def __init__(self, decision: _Optional[_Union[_types_pb2.Decision, _Mapping]] = ..., takeoff: _Optional[_Union[TakeoffRequest, _Mapping]] = ..., goto: _Optional[_Union[GotoRequest, _Mapping]] = ..., set_speed: _Optional[_Union[SetSpeedRequest, _Mapping]] = ..., set_velocity: _Optional[_Union[SetVelocityRequest, _Mapping]] = ..., takeover: _Optional[str] = ..., brake_first: bool = ...) -> None: ...

class SubscribeTelemetryRequest(_message.Message):
    __slots__ = ("interval_s",)
    INTERVAL_S_FIELD_NUMBER: _ClassVar[int]
    interval_s: float
    def __init__(self, interval_s: _Optional[float] = ...) -> None: ...

class MissionOutcome(_message.Message):
    __slots__ = ("kind", "reason", "waypoints_reached", "waypoints_skipped", "waypoints_corrected")
    class Kind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        KIND_UNSPECIFIED: _ClassVar[MissionOutcome.Kind]
        KIND_COMPLETE: _ClassVar[MissionOutcome.Kind]
        KIND_REVOKED: _ClassVar[MissionOutcome.Kind]
        KIND_FAILED: _ClassVar[MissionOutcome.Kind]
    KIND_UNSPECIFIED: MissionOutcome.Kind
    KIND_COMPLETE: MissionOutcome.Kind
    KIND_REVOKED: MissionOutcome.Kind
    KIND_FAILED: MissionOutcome.Kind
    KIND_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    WAYPOINTS_REACHED_FIELD_NUMBER: _ClassVar[int]
    WAYPOINTS_SKIPPED_FIELD_NUMBER: _ClassVar[int]
    WAYPOINTS_CORRECTED_FIELD_NUMBER: _ClassVar[int]
    kind: MissionOutcome.Kind
    reason: str
    waypoints_reached: int
    waypoints_skipped: int
    waypoints_corrected: int
    def __init__(self, kind: _Optional[_Union[MissionOutcome.Kind, str]] = ..., reason: _Optional[str] = ..., waypoints_reached: _Optional[int] = ..., waypoints_skipped: _Optional[int] = ..., waypoints_corrected: _Optional[int] = ...) -> None: ...

class Gps(_message.Message):
    __slots__ = ("fix_type", "satellites")
    FIX_TYPE_FIELD_NUMBER: _ClassVar[int]
    SATELLITES_FIELD_NUMBER: _ClassVar[int]
    fix_type: int
    satellites: int
    def __init__(self, fix_type: _Optional[int] = ..., satellites: _Optional[int] = ...) -> None: ...

class Wind(_message.Message):
    __slots__ = ("from_deg", "speed_mps")
    FROM_DEG_FIELD_NUMBER: _ClassVar[int]
    SPEED_MPS_FIELD_NUMBER: _ClassVar[int]
    from_deg: float
    speed_mps: float
    def __init__(self, from_deg: _Optional[float] = ..., speed_mps: _Optional[float] = ...) -> None: ...

class StatusText(_message.Message):
    __slots__ = ("number", "severity", "text", "time")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    SEVERITY_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    number: int
    severity: int
    text: str
    time: _timestamp_pb2.Timestamp
    def __init__(self, number: _Optional[int] = ..., severity: _Optional[int] = ..., text: _Optional[str] = ..., time: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ...) -> None: ...

class Telemetry(_message.Message):
    __slots__ = ("time", "position", "altitude_amsl_m", "velocity", "yaw_deg", "battery_remaining", "battery_voltage_v", "battery_current_a", "armed", "in_air", "mode", "ready", "home", "flight_state", "controller", "autopilot_connected", "missions", "position_error_m", "attitude", "position_age_s", "attitude_age_s", "gps", "wind", "not_ready_reason", "texts", "recording_problem", "gimbal", "gimbal_age_s", "controller_reason")
    class MissionsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: MissionOutcome
        def __init__(self, key: _Optional[str] = ..., value: _Optional[_Union[MissionOutcome, _Mapping]] = ...) -> None: ...
    TIME_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    ALTITUDE_AMSL_M_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    YAW_DEG_FIELD_NUMBER: _ClassVar[int]
    BATTERY_REMAINING_FIELD_NUMBER: _ClassVar[int]
    BATTERY_VOLTAGE_V_FIELD_NUMBER: _ClassVar[int]
    BATTERY_CURRENT_A_FIELD_NUMBER: _ClassVar[int]
    ARMED_FIELD_NUMBER: _ClassVar[int]
    IN_AIR_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    READY_FIELD_NUMBER: _ClassVar[int]
    HOME_FIELD_NUMBER: _ClassVar[int]
    FLIGHT_STATE_FIELD_NUMBER: _ClassVar[int]
    CONTROLLER_FIELD_NUMBER: _ClassVar[int]
    AUTOPILOT_CONNECTED_FIELD_NUMBER: _ClassVar[int]
    MISSIONS_FIELD_NUMBER: _ClassVar[int]
    POSITION_ERROR_M_FIELD_NUMBER: _ClassVar[int]
    ATTITUDE_FIELD_NUMBER: _ClassVar[int]
    POSITION_AGE_S_FIELD_NUMBER: _ClassVar[int]
    ATTITUDE_AGE_S_FIELD_NUMBER: _ClassVar[int]
    GPS_FIELD_NUMBER: _ClassVar[int]
    WIND_FIELD_NUMBER: _ClassVar[int]
    NOT_READY_REASON_FIELD_NUMBER: _ClassVar[int]
    TEXTS_FIELD_NUMBER: _ClassVar[int]
    RECORDING_PROBLEM_FIELD_NUMBER: _ClassVar[int]
    GIMBAL_FIELD_NUMBER: _ClassVar[int]
    GIMBAL_AGE_S_FIELD_NUMBER: _ClassVar[int]
    CONTROLLER_REASON_FIELD_NUMBER: _ClassVar[int]
    time: _timestamp_pb2.Timestamp
    position: _types_pb2.Position
    altitude_amsl_m: float
    velocity: _types_pb2.Velocity
    yaw_deg: float
    battery_remaining: float
    battery_voltage_v: float
    battery_current_a: float
    armed: bool
    in_air: bool
    mode: str
    ready: bool
    home: _types_pb2.Position
    flight_state: str
    controller: str
    autopilot_connected: bool
    missions: _containers.MessageMap[str, MissionOutcome]
    position_error_m: float
    attitude: _types_pb2.Attitude
    position_age_s: float
    attitude_age_s: float
    gps: Gps
    wind: Wind
    not_ready_reason: str
    texts: _containers.RepeatedCompositeFieldContainer[StatusText]
    recording_problem: str
    gimbal: _types_pb2.Attitude
    gimbal_age_s: float
    controller_reason: str
    def __init__(self, time: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., position: _Optional[_Union[_types_pb2.Position, _Mapping]] = ..., altitude_amsl_m: _Optional[float] = ..., velocity: _Optional[_Union[_types_pb2.Velocity, _Mapping]] = ..., yaw_deg: _Optional[float] = ..., battery_remaining: _Optional[float] = ..., battery_voltage_v: _Optional[float] = ..., battery_current_a: _Optional[float] = ..., armed: bool = ..., in_air: bool = ..., mode: _Optional[str] = ..., ready: bool = ..., home: _Optional[_Union[_types_pb2.Position, _Mapping]] = ..., flight_state: _Optional[str] = ..., controller: _Optional[str] = ..., autopilot_connected: bool = ..., missions: _Optional[_Mapping[str, MissionOutcome]] = ..., position_error_m: _Optional[float] = ..., attitude: _Optional[_Union[_types_pb2.Attitude, _Mapping]] = ..., position_age_s: _Optional[float] = ..., attitude_age_s: _Optional[float] = ..., gps: _Optional[_Union[Gps, _Mapping]] = ..., wind: _Optional[_Union[Wind, _Mapping]] = ..., not_ready_reason: _Optional[str] = ..., texts: _Optional[_Iterable[_Union[StatusText, _Mapping]]] = ..., recording_problem: _Optional[str] = ..., gimbal: _Optional[_Union[_types_pb2.Attitude, _Mapping]] = ..., gimbal_age_s: _Optional[float] = ..., controller_reason: _Optional[str] = ...) -> None: ...
