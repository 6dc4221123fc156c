"""The Kubernetes client on the wire: what arrives, what is refused, what is torn, what never answers, who asks."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import json
import socket
import ssl
import sys
from collections.abc import AsyncIterator
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
from kube_server import CHUNKED, HEAD, Request, Server, answer, chunk, client_of, kubeconfig_for, listening

ZONE = Kind("fractus.dev/v1alpha1", "Zone", "zones", namespaced=False)
SECRET = Kind("v1", "Secret", "secrets", namespaced=True)
OBJECT = {"metadata": {"name": "a", "resourceVersion": "7"}}
EVENT = json.dumps({"type": "ADDED", "object": OBJECT}).encode() + b"\n"


async def events(client: Client, silence_s: float = 20.0) -> AsyncIterator[tuple[str, Any]]:
    async for event in client.watch(ZONE, resource_version="7", timeout_s=300, silence_s=silence_s):
        yield event


# -- what arrives --


async def test_a_request_arrives_as_it_is_and_connections_are_kept() -> None:
    server = Server(answer({"a": [1]}))
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


async def test_a_connection_whose_other_side_is_gone_is_found_dead(monkeypatch: pytest.MonkeyPatch) -> None:
    """A watch sends nothing: only keepalives of TCP notice that a cable was pulled."""
    made = list[socket.socket]()
    real = connection._socket
    monkeypatch.setattr(connection, "_socket", lambda address: made.append(real(address)) or made[-1])
    async with client_of(Server(answer({}))) as client:
        await client.request("GET", "/apis/one")
        (used,) = made
        assert used.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
        times = [getattr(socket, f"TCP_KEEP{name}") for name in ("IDLE", "INTVL", "CNT")]
        idle_s, interval_s, count = (used.getsockopt(socket.IPPROTO_TCP, option) for option in times)
        assert idle_s + interval_s * count <= 30


async def test_writes_say_who_they_are_from_and_how_they_are_meant() -> None:
    server = Server(answer(OBJECT))
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


async def test_what_is_compressed_is_read() -> None:
    data = gzip.compress(b'{"metadata": {}, "items": []}')
    head = HEAD + b"Content-Encoding: gzip\r\nContent-Length: %d\r\n\r\n" % len(data)
    async with client_of(Server(head + data)) as client:
        assert await client.list(ZONE) == []


async def test_a_list_is_read_page_by_page() -> None:
    def pages(request: Request) -> bytes:
        if "continue=next" in request.line:
            return answer({"metadata": {"resourceVersion": "9"}, "items": [{"n": 2}]})
        return answer({"metadata": {"resourceVersion": "9", "continue": "next"}, "items": [{"n": 1}]})

    server = Server(pages)
    async with client_of(server) as client:
        whole = await client.list_whole(ZONE, selectors={"fieldSelector": "spec.node=a"})
    assert (whole.items, whole.resource_version) == ([{"n": 1}, {"n": 2}], "9")
    assert all("limit=250" in r.line and "fieldSelector=spec.node%3Da" in r.line for r in server.requests)


async def test_a_watch_gives_events_as_they_are_sent_and_ends_with_its_reader() -> None:
    server = Server(CHUNKED + chunk(EVENT + EVENT[:9]) + chunk(EVENT[9:]))
    async with client_of(server) as client:
        watched = events(client)
        assert [await anext(watched) for _ in range(2)] == [("ADDED", OBJECT)] * 2
        await watched.aclose()
        await server.gone.wait()
    assert "allowWatchBookmarks=true&resourceVersion=7&timeoutSeconds=300" in server.requests[0].line


# -- what is refused --


@pytest.mark.parametrize(
    ("status", "error"),
    [(400, Invalid), (403, KubeError), (404, NotFound), (409, Conflict), (410, Expired), (422, Invalid), (429, KubeError),
     (500, KubeError), (503, KubeError)],
)  # fmt: skip
async def test_a_refusal_is_told_by_what_to_do_about_it(status: int, error: type[KubeError]) -> None:
    refusal = {"kind": "Status", "code": status, "reason": "Because", "message": "it says why"}
    async with client_of(Server(answer(refusal, status))) as client:
        with pytest.raises(KubeError, match=r"^it says why$") as raised:
            await client.get(ZONE, "a")
        with pytest.raises(error):
            await anext(events(client))
    assert type(raised.value) is error
    assert (raised.value.status, raised.value.reason) == (status, "Because")


async def test_nothing_is_sent_where_a_redirect_points() -> None:
    head = b"HTTP/1.1 307 Temporary Redirect\r\nLocation: http://127.0.0.1:1/stolen\r\nContent-Length: 0\r\n\r\n"
    async with client_of(Server(head)) as client:
        with pytest.raises(KubeError, match="refused a redirect to http"):
            await client.request("POST", "/api/v1/secrets", {"data": {"tls.key": "c2VjcmV0"}})


async def test_a_refusal_of_a_proxy_on_the_way_is_one_too() -> None:
    async with client_of(Server(answer(b"<html>Bad Gateway</html>", 502))) as client:
        with pytest.raises(KubeError, match="Bad Gateway") as raised:
            await client.get(ZONE, "a")
    assert raised.value.status == 502


async def test_an_error_in_a_watch_is_told_like_a_refusal() -> None:
    event = {"type": "ERROR", "object": {"code": 410, "reason": "Expired", "message": "too old"}}
    async with client_of(Server(CHUNKED + chunk(json.dumps(event).encode() + b"\n"))) as client:
        with pytest.raises(Expired, match="too old"):
            await anext(events(client))


# -- what is torn, and what never answers --


async def test_a_watch_that_is_cut_is_an_error() -> None:
    async with client_of(Server(CHUNKED + chunk(EVENT)[:-4], closes=True)) as client:
        with pytest.raises(KubeError) as raised:
            [event async for event in events(client)]
    assert (raised.value.status, raised.value.reason) == (0, "Unreachable")


async def test_a_connection_that_is_closed_without_an_answer_is_an_error() -> None:
    async with client_of(Server(b"", closes=True)) as client:
        with pytest.raises(KubeError, match="POST /x: ServerDisconnected"):
            await client.request("POST", "/x", {})


@pytest.mark.parametrize("used", [False, True])
async def test_requests_after_the_end_are_errors_like_others(used: bool) -> None:
    async with client_of(Server(answer({"a": 1}))) as client:
        if used:
            await client.request("GET", "/x")
        await client.aclose()
        with pytest.raises(KubeError, match="the connection was closed"):
            await client.request("GET", "/x")
        with pytest.raises(KubeError, match="the connection was closed"):
            await anext(events(client))
        assert not await client.ready()


async def test_an_answer_that_is_no_json_is_an_error() -> None:
    async with client_of(Server(answer(b"<html>"))) as client:
        with pytest.raises(KubeError, match="JSONDecodeError"):
            await client.get(ZONE, "a")


@pytest.mark.parametrize(
    "silent",
    [b"", CHUNKED + chunk(EVENT), CHUNKED + chunk(EVENT) + b"HTTP/1.1 502 Bad Gateway\r\n\r\n"],
    ids=["no answer", "silent stream", "no chunk"],
)
async def test_silence_is_a_time_out(silent: bytes) -> None:
    async with client_of(Server(silent)) as client:
        with pytest.raises(KubeError) as raised:
            [event async for event in events(client, silence_s=0.2)]
        assert raised.value.status == 0
        with pytest.raises(KubeError):
            await client.request("GET", "/", timeout_s=0.2)


async def test_a_connection_that_is_refused_is_one_sentence() -> None:
    async with contextlib.aclosing(Client(with_certificate("http://127.0.0.1:1"), "tests")) as client:
        with pytest.raises(KubeError, match=r"^GET /x: ClientConnectorError: [^\n]*127.0.0.1:1[^\n]*$"):
            await client.request("GET", "/x")
        assert not await client.ready()


async def test_a_request_that_is_given_up_leaves_no_connection() -> None:
    server = Server(b"")
    async with client_of(server) as client:
        request = asyncio.create_task(client.get(ZONE, "a"))
        await server.heard.wait()
        request.cancel()
        with pytest.raises(asyncio.CancelledError):
            await request
        await server.gone.wait()


async def test_a_list_that_makes_progress_has_more_time_than_an_object() -> None:
    page = json.dumps({"metadata": {"resourceVersion": "7"}, "items": []}).encode()
    slow = Server(CHUNKED + b"".join(chunk(page[i : i + 1]) for i in range(len(page))) + chunk(b""), delay_s=0.15)
    async with client_of(slow) as client:
        assert (await client.list_page(ZONE, timeout_s=10.0)).resource_version == "7"
        with pytest.raises(KubeError, match=r"no response in 0\.1 s"):
            await client.request("GET", "/x", timeout_s=0.1)


async def test_a_list_that_makes_no_progress_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fractus_runtime.kubernetes.connection.REQUEST_TIMEOUT_S", 0.2)
    async with client_of(Server(CHUNKED + chunk(b'{"items"'))) as client, asyncio.timeout(5.0):
        with pytest.raises(KubeError, match="no response"):
            await client.list(ZONE)


async def test_a_write_to_an_api_server_that_stalls_ends_before_another_may_act() -> None:
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


# -- who asks --


class Guarded(Server):
    """Answers who has the token, and 401 all others."""

    def __init__(self, token: str) -> None:
        self.token = token
        super().__init__(self._judge)

    def _judge(self, request: Request) -> bytes:
        if request.header("authorization").lower() == f"bearer {self.token}":
            return answer(OBJECT)
        return answer({"code": 401, "reason": "Unauthorized", "message": "Unauthorized"}, 401)


@contextlib.asynccontextmanager
async def guarded(tmp_path: Path, user: dict[str, Any], token: str) -> AsyncIterator[tuple[Guarded, Client]]:
    server = Guarded(token)
    async with listening(server):
        access = await kubeconfig(kubeconfig_for(tmp_path, server.url, user))
        async with contextlib.aclosing(Client(access, "tests")) as client:
            yield server, client


async def test_a_token_that_is_refused_is_read_again_once(tmp_path: Path) -> None:
    (tmp_path / "token").write_text("one\n")
    async with guarded(tmp_path, {"tokenFile": str(tmp_path / "token")}, "one") as (server, client):
        assert await client.get(ZONE, "a") == OBJECT
        server.token = "two"
        with pytest.raises(KubeError, match="Unauthorized") as raised:
            await client.get(ZONE, "a")
        assert (raised.value.status, len(server.requests)) == (401, 3)
        (tmp_path / "token").write_text("two\n")
        assert await client.get(ZONE, "a") == OBJECT


async def test_a_service_account_is_used_and_its_token_rotates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


async def test_a_credential_plugin_is_asked_again_when_its_token_is_refused(tmp_path: Path) -> None:
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
    server = Server(answer(OBJECT))
    async with listening(server, context):
        access = with_certificate(server.url.replace("127.0.0.1", "localhost"), tmp_path / "ca.crt")
        async with contextlib.aclosing(Client(access, "tests")) as client:
            assert await client.get(ZONE, "a") == OBJECT


async def test_a_certificate_of_an_unknown_authority_is_one_sentence(tmp_path: Path) -> None:
    for name in ("theirs", "ours"):
        (tmp_path / name).mkdir()
    credential = Authority(tmp_path / "theirs").issue("server", common_name="s", alternative_names=("localhost",))
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(credential.certificate, credential.key)
    ours = Authority(tmp_path / "ours").credential.certificate
    server = Server(answer({}))
    async with listening(server, context) as access:
        access.configuration.ssl_ca_cert = str(ours)
        client = Client(access, "tests")
        async with contextlib.aclosing(client):
            with pytest.raises(KubeError, match=r"^GET /x: [^\n]*certificate verify failed[^\n]*$"):
                await client.request("GET", "/x")


@pytest.mark.parametrize("text", ["", "][", "[1]", "clusters: []\ncontexts: []\nusers: []\n", "current-context: c\n"])
async def test_a_kubeconfig_that_is_of_no_use_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    (tmp_path / "config").write_text(text)
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "config"))
    with pytest.raises(Unconfigured, match=r"^no cluster: set KUBECONFIG, or run in a pod"):
        await from_environment()
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "none"))
    with pytest.raises(Unconfigured, match=r"^no cluster: set KUBECONFIG, or run in a pod"):
        await from_environment()


async def test_certificates_that_cannot_be_read_are_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "ca.crt").write_text("no certificate")
    for ca in ("ca.crt", "none"):
        with pytest.raises(Unconfigured, match=r"^the certificates of the cluster cannot be used"):
            Client(with_certificate("https://127.0.0.1:1", tmp_path / ca), "tests")


@pytest.mark.parametrize("trust_env", [True, False])
async def test_a_proxy_of_the_environment_is_used_where_it_is_trusted(
    monkeypatch: pytest.MonkeyPatch, trust_env: bool
) -> None:
    for name in ("http_proxy", "https_proxy", "all_proxy", "no_proxy"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    proxy = Server(answer({"from": "proxy"}))
    server = Server(answer({"from": "server"}))
    async with listening(proxy), client_of(server, trust_env=trust_env) as client:
        monkeypatch.setenv("http_proxy", proxy.url)
        assert await client.request("GET", "/x") == {"from": "proxy" if trust_env else "server"}


# -- without an event loop --


async def test_the_blocking_client_serves_many_threads() -> None:
    server = Server(
        lambda request: answer({} if "/a" in request.line else {"code": 404}, 200 if "/a" in request.line else 404)
    )
    async with listening(server) as access:

        def use() -> None:
            with BlockingClient(access, "tests") as client:
                assert client.ready() is False
                assert client.get("/a") == {}
                assert client.get("/b") is None
                client.delete("/b")
                client.apply("/a", {"b": 1}, manager="kubectl")

        await asyncio.gather(*(asyncio.to_thread(use) for _ in range(3)))
    assert sum("fieldManager=kubectl&force=true" in r.line for r in server.requests) == 3
