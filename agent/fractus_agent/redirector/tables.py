"""The text of our nftables tables, and what makes and removes them.

Our chains hook at priority -150, before those of kube-proxy: on a node with clients on prerouting for pods and on output for
programs in the host's network, on one that serves them on prerouting for what comes from paired nodes. A connection whose first packet matches an element of `targets` goes to the direct address; without an element it
falls through to kube-proxy, and so to the cloud path. Elements time out, so that an agent that dies leaves the cloud path.

Every radio in reach can send to a direct interface. So nothing comes in there but beacons and pairing, and what our redirects
lead from nodes that have paired on to pods; and nothing goes out by it that we did not redirect.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from fractus_agent.redirector.nft import (
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
"""A name that no device can have: of the direct interface while there is none to be used."""

COMMAND_TIMEOUT_S = 10.0

COUNTED_S = 60
"""Bytes of a service are counted until nothing has moved for so long."""

_KEY = "ip daddr . meta l4proto . th dport"
_OURS = f"ct mark and 0x{MARK_MASK:08x} == 0x{MARK_BASE:08x}"

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
    """What a node itself listens to on its direct interfaces.

    Attributes:
        udp: of beacons.
        tcp: of pairing.
    """

    udp: int
    tcp: int


def table(devices: str, ports: Ports, *, clients: bool, callers: Callers = NO_GUARDS) -> str:
    """The text of our tables, for `nft -f`; they replace older ones at once, with all their elements.

    Args:
        devices: pattern of the names of direct interfaces, such as fxl*.
        ports: of the node itself that are open there.
        clients: whether clients on this node are led; otherwise only what paired nodes send over these interfaces is, and
            guarded pods of this node take nothing else.
        callers: by guarded endpoint, which clients are led; with the table, so that it is never there without.
    """
    chains = (
        _leading(devices, clients=clients),
        _counting(devices),
        _arriving(devices, ports),
        _passing(devices, clients=clients),
    )
    return f"""table ip {TABLE}
delete table ip {TABLE}
table ip {TABLE} {{
{_SETS}{_guards(callers)}{"".join(chains)}}}
{_ip6(devices)}"""


def _guards(callers: Callers) -> str:
    """Who may call what; in the text, so that no table is ever there without."""
    return f"""	set {GUARDED} {{
		type ipv4_addr . inet_proto . inet_service
		{_elements(_text(each) for each in callers)}
	}}
	set {CALLERS} {{
		type ipv4_addr . ipv4_addr . inet_proto . inet_service
		{_elements(f"{client} . {_text(to)}" for to, clients in callers.items() for client in clients)}
	}}
"""


def _leading(devices: str, *, clients: bool) -> str:
    """What leads connections elsewhere, and numbers them."""
    only = "" if clients else f'iifname "{devices}" ip saddr @{PEERS} '
    # Who may not call a service is not led there; whether the base instance takes the call is not for this node to say.
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
		# Without it the server would answer over the base path: it knows the client by its pod address.
		type nat hook postrouting priority 50; policy accept;
		{_OURS} oifname "{devices}" masquerade
	}}
"""


def _counting(devices: str) -> str:
    """What counts bytes, by number."""
    return f"""	chain sending {{
		type filter hook postrouting priority 150; policy accept;
		{_OURS} oifname "{devices}" update @{SENT} {{ ct mark timeout {COUNTED_S}s counter }}
	}}
	chain receiving {{
		type filter hook prerouting priority 0; policy accept;
		{_OURS} iifname "{devices}" update @{RECEIVED} {{ ct mark timeout {COUNTED_S}s counter }}
	}}
"""


def _arriving(devices: str, ports: Ports) -> str:
    """What the node itself takes from direct interfaces."""
    return f"""	chain arriving {{
		type filter hook input priority -5; policy accept;
		iifname != "{devices}" accept
		ct state established,related accept
		udp dport {ports.udp} accept
		tcp dport {ports.tcp} accept
		# Of connections whose redirect ended: their clients must not wait for a time-out.
		meta l4proto tcp reject with tcp reset
		drop
	}}
"""


def _passing(devices: str, *, clients: bool) -> str:
    """What the node forwards to and from direct interfaces, and to guarded pods."""
    closed = f"{_KEY} @{GUARDED} ct state new ct mark and 0x{MARK_MASK:08x} != 0x{MARK_BASE:08x} drop\n\t\t"
    return f"""	chain passing {{
		type filter hook forward priority -5; policy accept;
		{"" if clients else closed}iifname != "{devices}" oifname != "{devices}" accept
		ct state established,related accept
		{_OURS} oifname "{devices}" accept
		{_OURS} iifname "{devices}" ip saddr @{PEERS} accept
		drop
	}}
"""


def _ip6(devices: str) -> str:
    """Links have no IPv6: nothing of it comes in or goes out."""
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
    listed = ", ".join(texts)
    return f"elements = {{ {listed} }}" if listed else ""


def _text(endpoint: Endpoint) -> str:
    return f"{endpoint.address} . {endpoint.protocol} . {endpoint.port}"


def create(
    devices: str, ports: Ports, namespace: Sequence[str] = (), *, clients: bool, callers: Callers = NO_GUARDS
) -> None:
    """Make our tables, or make them again, in one transaction.

    Args:
        devices: pattern of the names of direct interfaces.
        ports: of the node itself that are open there.
        namespace: command words that run `nft` in another network namespace; for tests.
        clients: whether clients on this node are led.
        callers: by guarded endpoint, which clients are led.

    Raises:
        RedirectFailed: nft is missing, or refuses.
    """
    _nft(table(devices, ports, clients=clients, callers=callers), namespace)


def remove(namespace: Sequence[str] = ()) -> None:
    """Remove our tables and all that they do; that there are none is no error."""
    _nft("".join(f"table {family} {TABLE}\ndelete table {family} {TABLE}\n" for family in ("ip", "ip6")), namespace)


def _nft(text: str, namespace: Sequence[str]) -> None:
    try:
        done = subprocess.run(
            [*namespace, "nft", "-f", "-"],
            input=text,
            capture_output=True,
            text=True,
            timeout=COMMAND_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise RedirectFailed(f"nftables: cannot run nft: {error}") from error
    if done.returncode:
        raise RedirectFailed(f"nftables: nft refused our table: {done.stderr.strip()}")
