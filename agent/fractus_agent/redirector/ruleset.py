"""Text of the agent's nftables tables, and the `nft` commands that create and remove them.

The chains hook at priority -150, before the chains of kube-proxy. On a node with clients they hook on prerouting (for pods)
and on output (for programs in the host network). On a node that serves, they hook on prerouting, for traffic from
paired nodes. A connection whose first packet matches an element of `targets` goes to the direct address. Without an
element it falls through to kube-proxy, and so to the cloud path. Elements time out, so that traffic returns to the
cloud path if the agent dies.

Every radio in range can send to a direct interface. Therefore a direct interface accepts only beacons, pairing, and
redirected connections from paired nodes to pods. Only redirected connections leave through it.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from fractus_agent.redirector.nft_maps import (
    CALLERS,
    GUARDED,
    MARK_BASE,
    MARK_MASK,
    MARKS,
    NO_GUARDS,
    PEERS,
    RECEIVED,
    SENT,
    TABLE,
    TARGETS,
    Callers,
    Endpoint,
    RedirectFailed,
)

NO_DEVICE = "/"
"""Name of the direct interface while no interface is usable. No device can have this name."""

COMMAND_TIMEOUT_S = 10.0

COUNTER_TIMEOUT_S = 60
"""The byte counter of a service is removed after this time without traffic."""

_KEY = "ip daddr . meta l4proto . th dport"
_REDIRECTED = f"ct mark and 0x{MARK_MASK:08x} == 0x{MARK_BASE:08x}"

_SETS = f"""	map {TARGETS} {{
		type ipv4_addr . inet_proto . inet_service : ipv4_addr . inet_service
		flags timeout
	}}
	map {MARKS} {{
		type ipv4_addr . inet_proto . inet_service : mark
	}}
	set {SENT} {{
		type mark
		flags dynamic, timeout
	}}
	set {RECEIVED} {{
		type mark
		flags dynamic, timeout
	}}
	set {PEERS} {{
		type ipv4_addr
		flags timeout
	}}
"""


@dataclass(frozen=True, slots=True)
class Ports:
    """Ports on which a node itself listens on its direct interfaces.

    Attributes:
        udp: UDP port of beacons.
        tcp: TCP port of pairing.
    """

    udp: int
    tcp: int


def ruleset_text(devices: str, ports: Ports, *, clients: bool, callers: Callers = NO_GUARDS) -> str:
    """Return the text of the tables for `nft -f`. They atomically replace older tables with all their elements.

    Args:
        devices: Pattern of the names of direct interfaces, such as `fxl*`.
        ports: Ports of the node itself that are open on direct interfaces.
        clients: True to redirect clients on this node. False to redirect only traffic of paired nodes that arrives over
            direct interfaces. Guarded pods of this node then accept nothing else.
        callers: Allowed clients by guarded endpoint. They are part of the text, so that the table never exists without them.
    """
    chains = (
        _redirect_chains(devices, clients=clients),
        _counter_chains(devices),
        _input_chain(devices, ports),
        _forward_chain(devices, clients=clients),
    )
    return f"""table ip {TABLE}
delete table ip {TABLE}
table ip {TABLE} {{
{_SETS}{_guard_sets(callers)}{"".join(chains)}}}
{_ip6_table(devices)}"""


def _guard_sets(callers: Callers) -> str:
    """Return the sets of guarded endpoints and their callers."""
    return f"""	set {GUARDED} {{
		type ipv4_addr . inet_proto . inet_service
		{_elements(_endpoint_text(each) for each in callers)}
	}}
	set {CALLERS} {{
		type ipv4_addr . ipv4_addr . inet_proto . inet_service
		{_elements(f"{client} . {_endpoint_text(to)}" for to, clients in callers.items() for client in clients)}
	}}
"""


def _redirect_chains(devices: str, *, clients: bool) -> str:
    """Return the chains that redirect connections and mark them with the service number."""
    only = "" if clients else f'iifname "{devices}" ip saddr @{PEERS} '
    # A client that is not an allowed caller is not redirected. The base instance decides whether to accept its call.
    guard = f"{_KEY} @{GUARDED} ip saddr . {_KEY} != @{CALLERS} return\n\t\t" if clients else ""
    rules = f"{guard}{only}ct mark set {_KEY} map @{MARKS}\n\t\t{only}dnat ip to {_KEY} map @{TARGETS}"
    output = f"""
	chain output {{
		type nat hook output priority -150; policy accept;
		{rules}
	}}"""
    return f"""	chain prerouting {{
		type nat hook prerouting priority -150; policy accept;
		{rules}
	}}{output if clients else ""}
	chain postrouting {{
		# Without masquerading the server would reply to the pod address, over the base path.
		type nat hook postrouting priority 50; policy accept;
		{_REDIRECTED} oifname "{devices}" masquerade
	}}
"""


def _counter_chains(devices: str) -> str:
    """Return the chains that count bytes by service number."""
    return f"""	chain sending {{
		type filter hook postrouting priority 150; policy accept;
		{_REDIRECTED} oifname "{devices}" update @{SENT} {{ ct mark timeout {COUNTER_TIMEOUT_S}s counter }}
	}}
	chain receiving {{
		type filter hook prerouting priority 0; policy accept;
		{_REDIRECTED} iifname "{devices}" update @{RECEIVED} {{ ct mark timeout {COUNTER_TIMEOUT_S}s counter }}
	}}
"""


def _input_chain(devices: str, ports: Ports) -> str:
    """Return the chain that filters traffic to the node itself."""
    return f"""	chain arriving {{
		type filter hook input priority -5; policy accept;
		iifname != "{devices}" accept
		ct state established,related accept
		udp dport {ports.udp} accept
		tcp dport {ports.tcp} accept
		# Reset connections whose redirect ended, so that their clients do not wait for a timeout.
		meta l4proto tcp reject with tcp reset
		drop
	}}
"""


def _forward_chain(devices: str, *, clients: bool) -> str:
    """Return the chain that filters forwarded traffic of direct interfaces and guarded pods."""
    closed = f"{_KEY} @{GUARDED} ct state new ct mark and 0x{MARK_MASK:08x} != 0x{MARK_BASE:08x} drop\n\t\t"
    return f"""	chain passing {{
		type filter hook forward priority -5; policy accept;
		{"" if clients else closed}iifname != "{devices}" oifname != "{devices}" accept
		ct state established,related accept
		{_REDIRECTED} oifname "{devices}" accept
		{_REDIRECTED} iifname "{devices}" ip saddr @{PEERS} accept
		drop
	}}
"""


def _ip6_table(devices: str) -> str:
    """Return the IPv6 table, which drops all IPv6 traffic of direct interfaces."""
    return f"""table ip6 {TABLE}
delete table ip6 {TABLE}
table ip6 {TABLE} {{
	chain arriving {{
		type filter hook input priority -5; policy accept;
		iifname "{devices}" drop
	}}
	chain passing {{
		type filter hook forward priority -5; policy accept;
		iifname "{devices}" drop
		oifname "{devices}" drop
	}}
}}
"""


def _elements(texts: Iterable[str]) -> str:
    elements = ", ".join(texts)
    return f"elements = {{ {elements} }}" if elements else ""


def _endpoint_text(endpoint: Endpoint) -> str:
    return f"{endpoint.address} . {endpoint.protocol} . {endpoint.port}"


def create(
    devices: str, ports: Ports, namespace: Sequence[str] = (), *, clients: bool, callers: Callers = NO_GUARDS
) -> None:
    """Create the tables, or replace existing ones, in one transaction.

    Args:
        devices: Pattern of the names of direct interfaces.
        ports: Ports of the node itself that are open on direct interfaces.
        namespace: Command prefix that runs `nft` in another network namespace, for tests.
        clients: True to redirect clients on this node.
        callers: Allowed clients by guarded endpoint.

    Raises:
        RedirectFailed: nft is missing, or refused the tables.
    """
    _run_nft(ruleset_text(devices, ports, clients=clients, callers=callers), namespace)


def remove(namespace: Sequence[str] = ()) -> None:
    """Remove the tables with all redirects. Missing tables are not an error."""
    _run_nft("".join(f"table {family} {TABLE}\ndelete table {family} {TABLE}\n" for family in ("ip", "ip6")), namespace)


def _run_nft(text: str, namespace: Sequence[str]) -> None:
    try:
        result = subprocess.run(
            [*namespace, "nft", "-f", "-"],
            input=text,
            capture_output=True,
            text=True,
            timeout=COMMAND_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise RedirectFailed(f"nftables: cannot run nft: {error}") from error
    if result.returncode:
        raise RedirectFailed(f"nftables: nft refused the table: {result.stderr.strip()}")
