from fractus_proto.v1 import mobility_pb2 as _mobility_pb2
from fractus_proto.v1 import types_pb2 as _types_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class GatewayRequest(_message.Message):
    __slots__ = ("id", "certificate", "call", "cancel")
    ID_FIELD_NUMBER: _ClassVar[int]
    CERTIFICATE_FIELD_NUMBER: _ClassVar[int]
    CALL_FIELD_NUMBER: _ClassVar[int]
    CANCEL_FIELD_NUMBER: _ClassVar[int]
    id: int
    certificate: bytes
    call: GatewayCall
    cancel: bool
    def __init__(self, id: _Optional[int] = ..., certificate: _Optional[bytes] = ..., call: _Optional[_Union[GatewayCall, _Mapping]] = ..., cancel: bool = ...) -> None: ...

class GatewayCall(_message.Message):
    __slots__ = ("method", "request", "timeout_s")
    METHOD_FIELD_NUMBER: _ClassVar[int]
    REQUEST_FIELD_NUMBER: _ClassVar[int]
    TIMEOUT_S_FIELD_NUMBER: _ClassVar[int]
    method: str
    request: bytes
    timeout_s: float
    def __init__(self, method: _Optional[str] = ..., request: _Optional[bytes] = ..., timeout_s: _Optional[float] = ...) -> None: ...

class GatewayResponse(_message.Message):
    __slots__ = ("id", "message", "status")
    ID_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    id: int
    message: bytes
    status: bytes
    def __init__(self, id: _Optional[int] = ..., message: _Optional[bytes] = ..., status: _Optional[bytes] = ...) -> None: ...

class VehicleFrames(_message.Message):
    __slots__ = ("frames",)
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    frames: bytes
    def __init__(self, frames: _Optional[bytes] = ...) -> None: ...

class ParameterList(_message.Message):
    __slots__ = ("values",)
    class ValuesEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    VALUES_FIELD_NUMBER: _ClassVar[int]
    values: _containers.ScalarMap[str, float]
    def __init__(self, values: _Optional[_Mapping[str, float]] = ...) -> None: ...

class Route(_message.Message):
    __slots__ = ("calls",)
    CALLS_FIELD_NUMBER: _ClassVar[int]
    calls: _containers.RepeatedCompositeFieldContainer[_mobility_pb2.CheckCallRequest]
    def __init__(self, calls: _Optional[_Iterable[_Union[_mobility_pb2.CheckCallRequest, _Mapping]]] = ...) -> None: ...

class RouteVerdict(_message.Message):
    __slots__ = ("calls",)
    CALLS_FIELD_NUMBER: _ClassVar[int]
    calls: _containers.RepeatedCompositeFieldContainer[RouteCall]
    def __init__(self, calls: _Optional[_Iterable[_Union[RouteCall, _Mapping]]] = ...) -> None: ...

class RouteCall(_message.Message):
    __slots__ = ("index", "decision", "permitted")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    DECISION_FIELD_NUMBER: _ClassVar[int]
    PERMITTED_FIELD_NUMBER: _ClassVar[int]
    index: int
    decision: _types_pb2.Decision
    permitted: bool
    def __init__(self, index: _Optional[int] = ..., decision: _Optional[_Union[_types_pb2.Decision, _Mapping]] = ..., permitted: bool = ...) -> None: ...
