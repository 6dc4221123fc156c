"""Requests of fuzzers (arbitrary bytes, or messages with arbitrary values), and the gRPC context of their calls."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import atheris
import grpc
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from google.protobuf.descriptor import FieldDescriptor
from policy_world import HOME

CENTRE = {"latitude_deg": HOME.lat, "longitude_deg": HOME.lon}
MAX_METADATA_BYTES = 8 * 1024
"""Maximum size of a reply's metadata, in bytes. By default, gRPC clients report larger metadata as an error."""
DEADLINES_S = [5.0, None, 0.0, 0.4, 1e300, float("inf"), -1.0]

_KEY = ec.generate_private_key(ec.SECP256R1())
_BEGIN = datetime(2020, 1, 1, tzinfo=UTC)


def certificate(*uris: str, days: int = 36500) -> bytes:
    """Return a certificate with the given identities."""
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "fuzz")])
    builder = (
        x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(_KEY.public_key()).serial_number(1)
        .not_valid_before(_BEGIN).not_valid_after(_BEGIN + timedelta(days=days))
    )  # fmt: skip
    if uris:
        names = x509.SubjectAlternativeName([x509.UniformResourceIdentifier(uri) for uri in uris])
        builder = builder.add_extension(names, critical=False)
    return builder.sign(_KEY, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


STRANGE = (
    (),
    (b"",),
    (b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n",),
    (certificate(),),
    (certificate("spiffe://fractus.dev/none"),),
    (certificate("spiffe://fractus.dev/a", "spiffe://fractus.dev/b"),),
    (certificate("https://fractus.dev/a"),),
)
"""Certificate chains without a Grant."""


def number(data_provider: atheris.FuzzedDataProvider, bound: float) -> float:
    """Return a number of a realistic size, or any number, NaN and infinity included."""
    return (
        data_provider.ConsumeFloatInRange(-bound, bound)
        if data_provider.ConsumeBool()
        else data_provider.ConsumeFloat()
    )


def fill(data_provider: atheris.FuzzedDataProvider, message: Any) -> None:
    """Set some fields of a message to values of their type."""
    for field in message.DESCRIPTOR.fields:
        if field.is_repeated or not data_provider.ConsumeIntInRange(0, 3):
            continue
        if field.type == FieldDescriptor.TYPE_MESSAGE:
            getattr(message, field.name).SetInParent()
            fill(data_provider, getattr(message, field.name))
        elif field.type in {FieldDescriptor.TYPE_DOUBLE, FieldDescriptor.TYPE_FLOAT}:
            centre = CENTRE.get(field.name)
            value = number(data_provider, 120.0) if centre is None else centre + number(data_provider, 0.002)
            setattr(message, field.name, value)
        elif field.type == FieldDescriptor.TYPE_STRING:
            setattr(message, field.name, data_provider.ConsumeUnicodeNoSurrogates(40))
        elif field.type == FieldDescriptor.TYPE_BOOL:
            setattr(message, field.name, data_provider.ConsumeBool())
        elif field.type == FieldDescriptor.TYPE_ENUM:
            setattr(message, field.name, data_provider.ConsumeIntInRange(0, 7))
        else:
            setattr(
                message,
                field.name,
                data_provider.ConsumeIntInRange(0, 100 if data_provider.ConsumeBool() else 2**32 - 1),
            )


def request(data_provider: atheris.FuzzedDataProvider, kind: Any) -> bytes:
    """Return an encoded request of this message type."""
    if not data_provider.ConsumeIntInRange(0, 3):
        return data_provider.ConsumeBytes(data_provider.ConsumeIntInRange(0, 64))
    message = kind()
    fill(data_provider, message)
    return bytes(message.SerializeToString())


class Registry:
    """Fake gRPC server: it stores the handlers that generated code adds, by method name."""

    def __init__(self, admission: Any) -> None:
        self._admission = admission
        self.handlers: dict[str, grpc.RpcMethodHandler] = {}

    def add_generic_rpc_handlers(self, _handlers: object) -> None:
        """Ignore the handlers, because generated code also passes them to `add_registered_method_handlers`."""

    def add_registered_method_handlers(self, _service: str, handlers: dict[str, grpc.RpcMethodHandler]) -> None:
        """Store the handlers wrapped by the admission check, which runs before a request is decoded."""
        self.handlers |= {name: self._admission.wrap(name, handler) for name, handler in handlers.items()}


class Context:
    """Fake gRPC context of a call. It checks the replies of the service."""

    def __init__(self, chain: tuple[bytes, ...], remaining_s: float | None) -> None:
        self._chain = chain
        self._remaining_s = remaining_s
        self.code: grpc.StatusCode | None = None
        self.written: list[Any] = []
        self.body: Any = grpc.aio.EOF

    async def read(self) -> Any:
        return self.body

    def invocation_metadata(self) -> tuple[tuple[str, str], ...]:
        """Return no metadata."""
        return ()

    def auth_context(self) -> dict[str, Any]:
        return {"x509_pem_cert": list(self._chain)}

    def time_remaining(self) -> float | None:
        return self._remaining_s

    async def write(self, message: Any) -> None:
        message.SerializeToString()
        self.written.append(message)

    async def abort(self, code: grpc.StatusCode, text: str, metadata: Any) -> None:
        assert code not in {grpc.StatusCode.INTERNAL, grpc.StatusCode.UNKNOWN, grpc.StatusCode.OK}, text
        size = sum(len(name) + len(value) + 32 for name, value in metadata) + len(text.encode())
        assert size <= MAX_METADATA_BYTES, f"{size} bytes: {text[:200]}"
        self.code = code
        raise grpc.aio.AbortError


async def called(handler: grpc.RpcMethodHandler, body: bytes, context: Context) -> Any:
    """Return the reply of a handler, or None if the handler refuses the call or sends a stream."""
    handle = handler.stream_unary or handler.stream_stream
    context.body = body
    try:
        answer = await handle(None, context)
    except grpc.aio.AbortError:
        return None
    if answer is not None:
        handler.response_serializer(answer)
    return answer
