"""Controller of CertificateSigningRequests of nodes. Only the agent on a node gets a certificate for this node."""

from __future__ import annotations

import base64
import logging
from collections.abc import Callable, Collection
from dataclasses import dataclass
from datetime import datetime

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from fractus_core.api import node_identity, node_server_name
from fractus_core.api.model import timestamp
from fractus_core.identity.authority import Authority

from fractus_operator.kinds import SIGNING_REQUEST, Body, Key
from fractus_operator.store import Conflict, NotFound, Store

log = logging.getLogger(__name__)

NODE_NAME_CLAIM = "authentication.kubernetes.io/node-name"
"""Key of the node name in the user info of a token that is bound to a pod. The API server adds it."""

_USAGES = frozenset({"server auth", "client auth"})
_TOLERATED_USAGES = frozenset({"digital signature"})


@dataclass(frozen=True, slots=True)
class Review:
    """The result of the review of a request.

    Attributes:
        reason: CamelCase.
        message: One sentence.
        node: The node of the certificate, if the request may be signed.
        request: The parsed request, if it may be signed.
    """

    reason: str
    message: str
    node: str | None = None
    request: x509.CertificateSigningRequest | None = None


class UnacceptableRequest(Exception):
    """A request that this signer does not sign."""

    def __init__(self, reason: str, message: str) -> None:
        self.reason = reason
        super().__init__(message)


def review(body: Body, agents: Collection[str]) -> Review:
    """Review a CertificateSigningRequest of the signer fractus.dev/node.

    Args:
        body: The request, with the user info of its requester that the API server adds.
        agents: User names of the service accounts of agents.
    """
    spec = body["spec"]
    if spec.get("username") not in agents:
        return Review("WrongRequester", f"{spec.get('username')} is not the agent ({', '.join(sorted(agents))})")
    nodes = (spec.get("extra") or {}).get(NODE_NAME_CLAIM) or []
    if len(nodes) != 1:
        return Review("NotNodeBound", "the requester's token is not bound to a pod on a node")
    node = nodes[0]
    usages = set(spec.get("usages") or ())
    if not usages >= _USAGES or usages - _USAGES - _TOLERATED_USAGES:
        return Review("WrongUsages", f"usages must be server auth and client auth, not {', '.join(sorted(usages))}")
    try:
        request, names = _parse(spec["request"])
    except UnacceptableRequest as unacceptable:
        return Review(unacceptable.reason, str(unacceptable))
    allowed = {(x509.UniformResourceIdentifier, node_identity(node)), (x509.DNSName, node_server_name(node))}
    if names != allowed:
        listed = ", ".join(sorted(str(value) for _, value in names))
        return Review("WrongNames", f"the agent of {node} may request only the names of {node}, not {listed}")
    return Review("NodeAgent", f"the agent on {node} requests its own certificate", node, request)


def _parse(encoded: str) -> tuple[x509.CertificateSigningRequest, frozenset[tuple[type[x509.GeneralName], object]]]:
    """Parse a request that proves possession of a P-256 key and contains subject alternative names.

    Returns:
        The request and the names.

    Raises:
        UnacceptableRequest: The request does not meet these conditions.
    """
    try:
        request = x509.load_pem_x509_csr(base64.b64decode(encoded, validate=True))
        key = request.public_key()
        extension = request.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        names = frozenset((type(name), name.value) for name in extension)
        self_signed = request.is_signature_valid
    except x509.ExtensionNotFound:
        raise UnacceptableRequest("WrongNames", "the request has no subject alternative names") from None
    except Exception as error:
        raise UnacceptableRequest(
            "Malformed", f"the request cannot be parsed: {error or type(error).__name__}"
        ) from error
    if not self_signed:
        raise UnacceptableRequest("Malformed", "the request is not signed with its own key")
    if not isinstance(key, ec.EllipticCurvePublicKey) or not isinstance(key.curve, ec.SECP256R1):
        raise UnacceptableRequest("WrongKey", "the key must be P-256")
    return request, names


class CsrController:
    """Approves, denies and signs requests of the signer fractus.dev/node."""

    def __init__(
        self,
        store: Store,
        read: Callable[[Key], Body | None],
        authority: Authority,
        agents: Collection[str],
        clock: Callable[[], datetime],
    ) -> None:
        self._store = store
        self._read = read
        self._authority = authority
        self._agents = agents
        self._clock = clock

    async def reconcile(self, key: Key) -> None:
        """Deny one request with the reason, or approve and sign it.

        A request that is approved already is reviewed as well, because other clients may approve requests.
        """
        body = self._read(key)
        if body is None:
            return
        status = body.get("status") or {}
        conditions = {c["type"] for c in status.get("conditions") or ()}
        if status.get("certificate") or conditions & {"Denied", "Failed"}:
            return
        reviewed = review(body, self._agents)
        try:
            if "Approved" not in conditions:
                verdict = "Approved" if reviewed.node is not None else "Denied"
                body = await self._conclude(body, verdict, reviewed, "approval")
            if reviewed.node is not None and reviewed.request is not None:
                certificate = self._authority.sign_node(reviewed.request, reviewed.node, self._clock())
                status = {**(body.get("status") or {}), "certificate": base64.b64encode(certificate).decode()}
                await self._store.replace(SIGNING_REQUEST, {**body, "status": status}, subresource="status")
                log.info("csr controller: certificate signed (node=%s request=%s)", reviewed.node, key[1])
            elif "Approved" in conditions:
                # Another client approved a request that this signer must not sign.
                await self._conclude(body, "Failed", reviewed, "status")
        except (Conflict, NotFound):
            # The request was changed or deleted meanwhile. The watch reports the new state.
            return

    async def _conclude(self, body: Body, verdict: str, reviewed: Review, subresource: str) -> Body:
        """Add a condition of the type `verdict`."""
        level = logging.WARNING if verdict == "Failed" else logging.INFO
        name = body["metadata"]["name"]
        log.log(level, "csr controller: request %s (request=%s message=%s)", verdict.lower(), name, reviewed.message)
        stamp = timestamp(self._clock())
        condition = {
            "type": verdict,
            "status": "True",
            "reason": reviewed.reason,
            "message": reviewed.message,
            "lastUpdateTime": stamp,
            "lastTransitionTime": stamp,
        }
        status = body.get("status") or {}
        status = {**status, "conditions": [*(status.get("conditions") or ()), condition]}
        return await self._store.replace(SIGNING_REQUEST, {**body, "status": status}, subresource=subresource)
