"""HTTP behaviour of the Kubernetes client: requests, errors, broken connections, timeouts and authentication."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import json
import math
import socket
import ssl
import sys
import time
from collections.abc import AsyncGenerator, AsyncIterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from fractus_cluster.pki import Authority
from fractus_runtime.kubernetes import (
    BlockingClient,
    Client,
    Conflict,
    ContentType,
    Expired,
    Invalid,
    Kind,
    KubeError,
    NotFound,
    Unconfigured,
    connection,
    from_environment,
    in_cluster,
    kubeconfig,
    with_certificate,
)
from kube_server import CHUNKED, HEAD, Request, Server, chunk, client_of, kubeconfig_for, listening, response

ZONE = Kind("fractus.dev/v1alpha1", "Zone", "zones", namespaced=False)
SECRET = Kind("v1", "Secret", "secrets", namespaced=True)
OBJECT = {"metadata": {"name": "a", "resourceVersion": "7"}}
EVENT = json.dumps({"type": "ADDED", "object": OBJECT}).encode() + b"\n"


async def events(client: Client, silence_s: float = 20.0) -> AsyncGenerator[tuple[str, Any], None]:
    async for event in client.watch(ZONE, resource_version="7", timeout_s=300, silence_s=silence_s):
        yield event


# -- requests and responses --


DEEP = b'{"a":' * 5000 + b'["\\"]}{",1]' + b"}" * 5000


async def test_object_with_very_deep_values_does_not_hide_the_other_objects_of_a_list() -> None:
    body = b'{"metadata":{},"items":[' + DEEP + b',{"text":"[{\\"","list":[[]]}]}'
    async with client_of(Server(response(body))) as client:
        deep, other = (await client.list_page(ZONE)).items
    assert other == {"text": '[{"', "list": [[]]}
    depth = 0
    while deep is not None:
        deep = deep["a"]
        depth += 1
    assert 100 < depth < 300


async def test_request_is_sent_unchanged_and_connection_is_reused() -> None:
    server = Server(response({"a": [1]}))
    async with client_of(server) as client:
        for _ in range(3):
            params = {"labelSelector": "a=b/c,d", "fieldManager": "x"}
            assert await client.request("POST", "/apis/one", {"b": 2}, params=params) == {"a": [1]}
    assert server.connections == 1
    request = server.requests[0]
    target = urlsplit(request.line.split(" ")[1])
    assert (request.method, target.path) == ("POST", "/apis/one")
    assert parse_qs(target.query) == {"labelSelector": ["a=b/c,d"], "fieldManager": ["x"]}
    assert request.header("content-length") == "8"
    assert json.loads(request.body) == {"b": 2}


async def test_dead_connection_is_detected_by_keepalives(monkeypatch: pytest.MonkeyPatch) -> None:
    """The client of a watch sends no data, so only TCP keepalives can detect a broken connection."""
    created = list[socket.socket]()
    create_socket = connection._socket
    monkeypatch.setattr(connection, "_socket", lambda address: created.append(create_socket(address)) or created[-1])
    async with client_of(Server(response({}))) as client:
        await client.request("GET", "/apis/one")
        (connected,) = created
        assert connected.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
        times = [getattr(socket, f"TCP_KEEP{name}") for name in ("IDLE", "INTVL", "CNT")]
        idle_s, interval_s, count = (connected.getsockopt(socket.IPPROTO_TCP, option) for option in times)
        assert idle_s + interval_s * count <= 30


async def test_writes_have_field_manager_and_content_type() -> None:
    server = Server(response(OBJECT))
    body = ZONE.header("a")
    async with client_of(server) as client:
        await client.apply(ZONE, body, subresource="status")
        await client.create(ZONE, body)
        await client.patch(SECRET, ("ns", "s"), [{"op": "test"}], ContentType.JSON_PATCH)
        await client.patch(SECRET, ("ns", "s"), {"data": {}}, ContentType.MERGE)
        await client.replace(ZONE, body)
        await client.delete(ZONE, ("", "a"), uid="u1")
    zones = "/apis/fractus.dev/v1alpha1/zones"
    assert [(r.line, r.header("content-type")) for r in server.requests] == [
        (f"PATCH {zones}/a/status?fieldManager=tests&force=true", "application/apply-patch+yaml"),
        (f"POST {zones}?fieldManager=tests&fieldValidation=Strict", "application/json"),
        ("PATCH /api/v1/namespaces/ns/secrets/s?fieldManager=tests", "application/json-patch+json"),
        ("PATCH /api/v1/namespaces/ns/secrets/s?fieldManager=tests", "application/merge-patch+json"),
        (f"PUT {zones}/a?fieldManager=tests", "application/json"),
        (f"DELETE {zones}/a", "application/json"),
    ]
    assert json.loads(server.requests[2].body) == [{"op": "test"}]
    assert json.loads(server.requests[5].body) == {
        "propagationPolicy": "Background",
        "preconditions": {"uid": "u1"},
    }


async def test_compressed_response_is_read() -> None:
    data = gzip.compress(b'{"metadata": {}, "items": []}')
    head = HEAD + b"Content-Encoding: gzip\r\nContent-Length: %d\r\n\r\n" % len(data)
    async with client_of(Server(head + data)) as client:
        assert await client.list(ZONE) == []


async def test_list_is_read_page_by_page() -> None:
    def pages(request: Request) -> bytes:
        if "continue=next" in request.line:
            return response({"metadata": {"resourceVersion": "9"}, "items": [{"n": 2}]})
        return response({"metadata": {"resourceVersion": "9", "continue": "next"}, "items": [{"n": 1}]})

    server = Server(pages)
    async with client_of(server) as client:
        result = await client.list_whole(ZONE, selectors={"fieldSelector": "spec.node=a"})
    assert (result.items, result.resource_version) == ([{"n": 1}, {"n": 2}], "9")
    assert all("limit=250" in r.line and "fieldSelector=spec.node%3Da" in r.line for r in server.requests)


async def test_watch_yields_events_at_once_and_closes_its_connection() -> None:
    server = Server(CHUNKED + chunk(EVENT + EVENT[:9]) + chunk(EVENT[9:]))
    async with client_of(server) as client:
        watched = events(client)
        assert [await anext(watched) for _ in range(2)] == [("ADDED", OBJECT)] * 2
        await watched.aclose()
        await server.connection_ended.wait()
    assert "allowWatchBookmarks=true&resourceVersion=7&timeoutSeconds=300" in server.requests[0].line


# -- errors --


@pytest.mark.parametrize(
    ("status", "error"),
    [(400, Invalid), (403, KubeError), (404, NotFound), (409, Conflict), (410, Expired), (422, Invalid), (429, KubeError),
     (500, KubeError), (503, KubeError)],
)  # fmt: skip
async def test_error_type_follows_the_response_status(status: int, error: type[KubeError]) -> None:
    refusal = {"kind": "Status", "code": status, "reason": "Because", "message": "it says why"}
    async with client_of(Server(response(refusal, status))) as client:
        with pytest.raises(KubeError, match=r"^it says why$") as raised:
            await client.get(ZONE, "a")
        with pytest.raises(error):
            await anext(events(client))
    assert type(raised.value) is error
    assert (raised.value.status, raised.value.reason) == (status, "Because")


async def test_redirect_is_not_followed() -> None:
    head = b"HTTP/1.1 307 Temporary Redirect\r\nLocation: http://127.0.0.1:1/stolen\r\nContent-Length: 0\r\n\r\n"
    async with client_of(Server(head)) as client:
        with pytest.raises(KubeError, match="refused a redirect to http"):
            await client.request("POST", "/api/v1/secrets", {"data": {"tls.key": "c2VjcmV0"}})


async def test_error_of_a_proxy_is_raised() -> None:
    async with client_of(Server(response(b"<html>Bad Gateway</html>", 502))) as client:
        with pytest.raises(KubeError, match="Bad Gateway") as raised:
            await client.get(ZONE, "a")
    assert raised.value.status == 502


async def test_error_event_of_a_watch_is_raised() -> None:
    event = {"type": "ERROR", "object": {"code": 410, "reason": "Expired", "message": "too old"}}
    async with client_of(Server(CHUNKED + chunk(json.dumps(event).encode() + b"\n"))) as client:
        with pytest.raises(Expired, match="too old"):
            await anext(events(client))


# -- broken connections and timeouts --


async def test_interrupted_watch_raises() -> None:
    async with client_of(Server(CHUNKED + chunk(EVENT)[:-4], closes=True)) as client:
        with pytest.raises(KubeError) as raised:
            [event async for event in events(client)]
    assert (raised.value.status, raised.value.reason) == (0, "Unreachable")


async def test_connection_closed_without_response_raises() -> None:
    async with client_of(Server(b"", closes=True)) as client:
        with pytest.raises(KubeError, match="POST /x: ServerDisconnected"):
            await client.request("POST", "/x", {})


@pytest.mark.parametrize("used", [False, True])
async def test_request_after_close_raises(used: bool) -> None:
    async with client_of(Server(response({"a": 1}))) as client:
        if used:
            await client.request("GET", "/x")
        await client.aclose()
        with pytest.raises(KubeError, match="the connection was closed"):
            await client.request("GET", "/x")
        with pytest.raises(KubeError, match="the connection was closed"):
            await anext(events(client))
        assert not await client.ready()


@pytest.mark.parametrize(
    "line", [b"[" * 50_000, b"[]", b"1", b'{"type": "ADDED"}'], ids=["deep", "list", "number", "no-object"]
)
async def test_watch_with_a_line_that_is_no_event_raises(line: bytes) -> None:
    async with client_of(Server(CHUNKED + chunk(line + b"\n"))) as client:
        with pytest.raises(KubeError) as raised:
            await anext(events(client))
    assert (raised.value.status, raised.value.reason) == (0, "Unreachable")


@pytest.mark.parametrize("status", [200, 500])
async def test_response_that_is_nested_too_deeply_raises(status: int) -> None:
    async with client_of(Server(response(b"[" * 50_000, status))) as client:
        with pytest.raises(KubeError):
            await client.get(ZONE, "a")


async def test_response_without_json_raises() -> None:
    async with client_of(Server(response(b"<html>"))) as client:
        with pytest.raises(KubeError, match="JSONDecodeError"):
            await client.get(ZONE, "a")


@pytest.mark.parametrize(
    "data",
    [b"", CHUNKED + chunk(EVENT), CHUNKED + chunk(EVENT) + b"HTTP/1.1 502 Bad Gateway\r\n\r\n"],
    ids=["no response", "silent stream", "no chunk"],
)
async def test_silent_server_times_out(data: bytes) -> None:
    async with client_of(Server(data)) as client:
        with pytest.raises(KubeError) as raised:
            [event async for event in events(client, silence_s=0.2)]
        assert raised.value.status == 0
        with pytest.raises(KubeError):
            await client.request("GET", "/", timeout_s=0.2)


async def test_refused_connection_raises_one_sentence() -> None:
    async with contextlib.aclosing(Client(with_certificate("http://127.0.0.1:1"), "tests")) as client:
        with pytest.raises(KubeError, match=r"^GET /x: ClientConnectorError: [^\n]*127.0.0.1:1[^\n]*$"):
            await client.request("GET", "/x")
        assert not await client.ready()


async def test_cancelled_request_closes_its_connection() -> None:
    server = Server(b"")
    async with client_of(server) as client:
        request = asyncio.create_task(client.get(ZONE, "a"))
        await server.request_received.wait()
        request.cancel()
        with pytest.raises(asyncio.CancelledError):
            await request
        await server.connection_ended.wait()


async def test_slow_list_with_progress_does_not_time_out() -> None:
    page = json.dumps({"metadata": {"resourceVersion": "7"}, "items": []}).encode()
    slow = Server(CHUNKED + b"".join(chunk(page[i : i + 1]) for i in range(len(page))) + chunk(b""), delay_s=0.15)
    async with client_of(slow) as client:
        assert (await client.list_page(ZONE, timeout_s=10.0)).resource_version == "7"
        with pytest.raises(KubeError, match=r"no response in 0\.1 s"):
            await client.request("GET", "/x", timeout_s=0.1)


async def test_list_without_progress_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fractus_runtime.kubernetes.connection.REQUEST_TIMEOUT_S", 0.2)
    async with client_of(Server(CHUNKED + chunk(b'{"items"'))) as client, asyncio.timeout(5.0):
        with pytest.raises(KubeError, match="no response"):
            await client.list(ZONE)


async def test_write_times_out_before_the_lease_ends() -> None:
    left_s = 0.02
    server = Server(b"")
    async with client_of(server, may_write_s=lambda: left_s) as client:
        with pytest.raises(KubeError, match=r"no response in 0\.0 s"):
            await client.create(ZONE, ZONE.header("a"))
        left_s = 0.0
        before = len(server.requests)
        with pytest.raises(KubeError, match="another operator may act"):
            await client.create(ZONE, ZONE.header("a"))
    assert len(server.requests) == before


# -- authentication --


class Guarded(Server):
    """Server that responds with 401 to requests without the token."""

    def __init__(self, token: str) -> None:
        self.token = token
        super().__init__(self._judge)

    def _judge(self, request: Request) -> bytes:
        if request.header("authorization").lower() == f"bearer {self.token}":
            return response(OBJECT)
        return response({"code": 401, "reason": "Unauthorized", "message": "Unauthorized"}, 401)


@contextlib.asynccontextmanager
async def guarded(tmp_path: Path, user: dict[str, Any], token: str) -> AsyncIterator[tuple[Guarded, Client]]:
    server = Guarded(token)
    async with listening(server):
        access = await kubeconfig(kubeconfig_for(tmp_path, server.url, user))
        async with contextlib.aclosing(Client(access, "tests")) as client:
            yield server, client


async def test_token_file_is_read_again_once_after_401(tmp_path: Path) -> None:
    (tmp_path / "token").write_text("one\n")
    async with guarded(tmp_path, {"tokenFile": str(tmp_path / "token")}, "one") as (server, client):
        assert await client.get(ZONE, "a") == OBJECT
        server.token = "two"
        with pytest.raises(KubeError, match="Unauthorized") as raised:
            await client.get(ZONE, "a")
        assert (raised.value.status, len(server.requests)) == (401, 3)
        (tmp_path / "token").write_text("two\n")
        assert await client.get(ZONE, "a") == OBJECT


async def test_service_account_token_is_rotated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    credential = Authority(tmp_path).issue("server", common_name="s", alternative_names=("localhost",))
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(credential.certificate, credential.key)
    (tmp_path / "ca.crt").write_bytes((Authority(tmp_path).credential.certificate).read_bytes())
    (tmp_path / "token").write_text("one")
    server = Guarded("one")
    async with listening(server, context):
        monkeypatch.setenv("KUBERNETES_SERVICE_HOST", "localhost")
        monkeypatch.setenv("KUBERNETES_SERVICE_PORT", server.url.rsplit(":", 1)[1])
        async with contextlib.aclosing(Client(await in_cluster(tmp_path), "tests")) as client:
            assert await client.get(ZONE, "a") == OBJECT
            server.token = "two"
            (tmp_path / "token").write_text("two")
            assert await client.get(ZONE, "a") == OBJECT
        with pytest.raises(Unconfigured, match="service account cannot be used: Service token file does not exist"):
            await in_cluster(tmp_path / "none")


async def test_credential_plugin_runs_again_after_401(tmp_path: Path) -> None:
    plugin = tmp_path / "plugin.py"
    plugin.write_text(
        "import json, pathlib\n"
        f"token = pathlib.Path({str(tmp_path / 'token')!r}).read_text()\n"
        "print(json.dumps({'apiVersion': 'client.authentication.k8s.io/v1', 'kind': 'ExecCredential',"
        " 'status': {'token': token}}))\n"
    )
    (tmp_path / "token").write_text("one")
    command = {"apiVersion": "client.authentication.k8s.io/v1", "command": sys.executable, "args": [str(plugin)]}
    async with guarded(tmp_path, {"exec": command}, "one") as (server, client):
        assert await client.get(ZONE, "a") == OBJECT
        server.token = "two"
        (tmp_path / "token").write_text("two")
        assert await client.get(ZONE, "a") == OBJECT


async def test_server_certificate_without_authority_key_identifier_is_accepted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    credential = Authority(tmp_path).issue("server", common_name="s", alternative_names=("localhost",))
    key = serialization.load_pem_private_key(credential.key.read_bytes(), None)
    ca_key = serialization.load_pem_private_key((tmp_path / "ca.key").read_bytes(), None)
    original = x509.load_pem_x509_certificate(credential.certificate.read_bytes())
    builder = x509.CertificateBuilder(
        original.issuer, original.subject, key.public_key(), x509.random_serial_number(),
        original.not_valid_before_utc, original.not_valid_after_utc,
    )  # fmt: skip
    for extension in original.extensions:
        if not isinstance(extension.value, x509.AuthorityKeyIdentifier):
            builder = builder.add_extension(extension.value, extension.critical)
    credential.certificate.write_bytes(
        builder.sign(ca_key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)  # type: ignore[arg-type]
    )
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(credential.certificate, credential.key)
    default_context = ssl.create_default_context

    def strict_context(*args: Any, **kwargs: Any) -> ssl.SSLContext:
        """Create a context with the defaults of Python 3.13."""
        strict = default_context(*args, **kwargs)
        strict.verify_flags |= ssl.VERIFY_X509_STRICT
        return strict

    monkeypatch.setattr(ssl, "create_default_context", strict_context)
    server = Server(response(OBJECT))
    async with listening(server, context):
        access = with_certificate(server.url.replace("127.0.0.1", "localhost"), tmp_path / "ca.crt")
        async with contextlib.aclosing(Client(access, "tests")) as client:
            assert await client.get(ZONE, "a") == OBJECT


async def test_certificate_of_unknown_authority_raises_one_sentence(tmp_path: Path) -> None:
    for name in ("server_ca", "client_ca"):
        (tmp_path / name).mkdir()
    credential = Authority(tmp_path / "server_ca").issue("server", common_name="s", alternative_names=("localhost",))
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(credential.certificate, credential.key)
    trusted = Authority(tmp_path / "client_ca").credential.certificate
    server = Server(response({}))
    async with listening(server, context) as access:
        access.configuration.ssl_ca_cert = str(trusted)
        client = Client(access, "tests")
        async with contextlib.aclosing(client):
            with pytest.raises(KubeError, match=r"^GET /x: [^\n]*certificate verify failed[^\n]*$"):
                await client.request("GET", "/x")


@pytest.mark.parametrize("text", ["", "][", "[1]", "clusters: []\ncontexts: []\nusers: []\n", "current-context: c\n"])
async def test_invalid_kubeconfig_raises_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    (tmp_path / "config").write_text(text)
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "config"))
    with pytest.raises(
        Unconfigured, match=r"^no cluster: set KUBECONFIG to the kubeconfig of a cluster, or run in a pod"
    ):
        await from_environment()
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "none"))
    with pytest.raises(
        Unconfigured, match=r"^no cluster: set KUBECONFIG to the kubeconfig of a cluster, or run in a pod"
    ):
        await from_environment()


async def test_unreadable_certificates_raise_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "ca.crt").write_text("no certificate")
    for ca in ("ca.crt", "none"):
        with pytest.raises(Unconfigured, match=r"^the certificates of the cluster cannot be used"):
            Client(with_certificate("https://127.0.0.1:1", tmp_path / ca), "tests")


@pytest.mark.parametrize("trust_env", [True, False])
async def test_proxy_of_the_environment_is_used_only_with_trust_env(
    monkeypatch: pytest.MonkeyPatch, trust_env: bool
) -> None:
    for name in ("http_proxy", "https_proxy", "all_proxy", "no_proxy"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    proxy = Server(response({"from": "proxy"}))
    server = Server(response({"from": "server"}))
    async with listening(proxy), client_of(server, trust_env=trust_env) as client:
        monkeypatch.setenv("http_proxy", proxy.url)
        assert await client.request("GET", "/x") == {"from": "proxy" if trust_env else "server"}


# -- blocking client --


async def test_blocking_client_works_in_several_threads() -> None:
    server = Server(
        lambda request: response({} if "/a" in request.line else {"code": 404}, 200 if "/a" in request.line else 404)
    )
    async with listening(server) as access:

        def send_requests() -> None:
            with BlockingClient(access, "tests") as client:
                assert client.ready() is False
                assert client.get("/a") == {}
                assert client.get("/b") is None
                client.delete("/b")
                client.apply("/a", {"b": 1}, manager="kubectl")

        await asyncio.gather(*(asyncio.to_thread(send_requests) for _ in range(3)))
    assert sum("fieldManager=kubectl&force=true" in r.line for r in server.requests) == 3


async def test_client_records_time_of_successful_responses_only() -> None:
    status = 403
    server = Server(lambda _request: response({"kind": "Status", "message": "no"} if status != 200 else {}, status))
    async with client_of(server) as client:
        assert client.succeeded_at == -math.inf
        assert await client.responds(5.0), "a refusal is a response"
        assert client.succeeded_at == -math.inf
        status = 200
        assert await client.responds(5.0)
        assert 0 <= time.monotonic() - client.succeeded_at < 5
