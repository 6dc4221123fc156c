"""Settings of the operator, read once from the environment."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from fractus_core.api import InvalidObject
from fractus_core.planning.inventory import PolicyConflicts
from fractus_core.planning.inventory import Settings as PlanningSettings
from fractus_core.planning.plugins import UnknownPlugin, load_plugin
from fractus_runtime.logs import FORMATS

_PLANNING = {
    "safety_radius_m": "FRACTUS_PLANNING_SAFETY_RADIUS",
    "depot_radius_m": "FRACTUS_PLANNING_DEPOT_RADIUS",
    "coverage_share": "FRACTUS_PLANNING_COVERAGE_SHARE",
    "cruise_speed_mps": "FRACTUS_PLANNING_CRUISE_SPEED",
    "climb_speed_mps": "FRACTUS_PLANNING_CLIMB_SPEED",
    "battery_reserve": "FRACTUS_PLANNING_BATTERY_RESERVE",
}
"""Environment variables of the numeric settings of planning."""


_TEXTS = {
    "namespace": "FRACTUS_SYSTEM_NAMESPACE",
    "agent_account": "FRACTUS_AGENT_ACCOUNT",
    "identity": "FRACTUS_IDENTITY",
    "health": "FRACTUS_HEALTH",
    "gateway_image": "FRACTUS_GATEWAY_IMAGE",
}
"""Environment variables of the settings that are strings."""


FORMER_AGENT_ACCOUNT = "fractus-agent"
"""Service account of the agents of earlier releases."""

DEFAULT_LEASE_S = 10.0
MIN_LEASE_S = 1.0


class BadSetting(ValueError):
    """An environment variable has no usable value."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of the operator.

    Attributes:
        namespace: Namespace of the Fractus services.
        agent_account: Name of the service account of agents in that namespace.
        health: URL of the liveness endpoint.
        metrics_port: Port of /metrics. 0 disables it.
        identity: Identity of this operator in the election, such as the name of its pod. Empty: a random identity.
        lease_s: Seconds after the last renewal of this operator's Lease until another operator may lead.
        log_level: Minimum level of log lines.
        log_format: Format of log lines, text or json.
        planning: Settings of planning.
        gateway_image: Image of the sidecar that connects a MAVLink program to the gateway of its drone. Empty if the drones
            have no gateway.
    """

    namespace: str = "fractus-system"
    agent_account: str = "fractus-node"
    health: str = "http://0.0.0.0:8080/healthz"
    metrics_port: int = 0
    identity: str = ""
    lease_s: float = DEFAULT_LEASE_S
    log_level: int = logging.INFO
    log_format: str = "text"
    planning: PlanningSettings = field(default_factory=PlanningSettings)
    gateway_image: str = ""

    @property
    def agent_users(self) -> frozenset[str]:
        """User names of the agents, including agents that an upgrade has not replaced yet."""
        accounts = (self.agent_account, FORMER_AGENT_ACCOUNT)
        return frozenset(f"system:serviceaccount:{self.namespace}:{account}" for account in accounts)

    @classmethod
    def from_environment(cls, environment: Mapping[str, str]) -> Settings:
        """Read FRACTUS_SYSTEM_NAMESPACE, FRACTUS_AGENT_ACCOUNT, FRACTUS_HEALTH, FRACTUS_IDENTITY, FRACTUS_LEASE, FRACTUS_GATEWAY_IMAGE, FRACTUS_METRICS_PORT, FRACTUS_LOG_LEVEL, FRACTUS_LOG_FORMAT and the FRACTUS_PLANNING_*.

        Raises:
            BadSetting: A variable is invalid. The message names it.
        """
        level = environment.get("FRACTUS_LOG_LEVEL", "INFO").upper()
        if level not in logging.getLevelNamesMapping():
            raise BadSetting(f"FRACTUS_LOG_LEVEL: {level} is not a log level; use DEBUG, INFO, WARNING or ERROR")
        log_format = environment.get("FRACTUS_LOG_FORMAT") or "text"
        if log_format not in FORMATS:
            raise BadSetting(f"FRACTUS_LOG_FORMAT: unknown log format {log_format!r}; use {' or '.join(FORMATS)}")
        planning = PlanningSettings(
            score_drone=_plugin(environment, "FRACTUS_PLANNING_RANKING"),
            cover=_plugin(environment, "FRACTUS_PLANNING_COVERING"),
            policy_conflicts=_policy_conflicts(environment, "FRACTUS_PLANNING_POLICY_CONFLICTS"),
            flat_terrain=environment.get("FRACTUS_PLANNING_FLAT_TERRAIN") == "true",
            gateway=bool(environment.get("FRACTUS_GATEWAY_IMAGE")),
        )
        for name, variable in _PLANNING.items():
            change: dict[str, Any] = {name: _number(environment, variable, getattr(planning, name))}
            try:
                planning = replace(planning, **change)
            except InvalidObject as error:
                raise BadSetting(f"{variable}: {error.problem}") from None
        lease_s = _number(environment, "FRACTUS_LEASE", DEFAULT_LEASE_S)
        if lease_s < MIN_LEASE_S:
            raise BadSetting(f"FRACTUS_LEASE: must be at least {MIN_LEASE_S:g} second, but is {lease_s:g}")
        texts = {name: environment[variable] for name, variable in _TEXTS.items() if variable in environment}
        log_level = logging.getLevelNamesMapping()[level]
        port = int(_number(environment, "FRACTUS_METRICS_PORT", 0))
        return cls(
            **texts, metrics_port=port, log_format=log_format, lease_s=lease_s, log_level=log_level, planning=planning
        )


def _plugin(environment: Mapping[str, str], name: str) -> Any:
    try:
        return load_plugin(environment.get(name))
    except UnknownPlugin as error:
        raise BadSetting(f"{name}: {error}") from None


def _policy_conflicts(environment: Mapping[str, str], name: str) -> PolicyConflicts:
    match environment.get(name) or "warn":
        case "warn" | "forbid" as chosen:
            return chosen
        case other:
            raise BadSetting(f"{name}: {other!r} is neither warn nor forbid")


def _number(environment: Mapping[str, str], name: str, default: float) -> float:
    text = environment.get(name)
    if text is None or text == "":
        return default
    try:
        value = float(text)
    except ValueError:
        raise BadSetting(f"{name}: {text!r} is not a number") from None
    if not 0 <= value < float("inf"):
        raise BadSetting(f"{name}: must not be negative, but is {text}")
    return value
