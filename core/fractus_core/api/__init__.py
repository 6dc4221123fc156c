"""The kinds of the API group fractus.dev/v1alpha1, as pydantic models."""

from fractus_core.api.applications import Application
from fractus_core.api.components import Component
from fractus_core.api.model import API_VERSION, GROUP, VERSION, Condition, InvalidObject, Metadata, Resource
from fractus_core.api.names import component_identity, node_identity, node_server_name
from fractus_core.api.nodes import Depot, Drone, EdgeNode
from fractus_core.api.plans import DeploymentPlan, Grant
from fractus_core.api.policies import Policy, Zone

KINDS: tuple[type[Resource], ...] = (Drone, EdgeNode, Depot, Zone, Policy, Application, DeploymentPlan, Grant)

__all__ = [
    "API_VERSION",
    "GROUP",
    "KINDS",
    "VERSION",
    "Application",
    "Component",
    "Condition",
    "DeploymentPlan",
    "Depot",
    "Drone",
    "EdgeNode",
    "Grant",
    "InvalidObject",
    "Metadata",
    "Policy",
    "Resource",
    "Zone",
    "component_identity",
    "node_identity",
    "node_server_name",
]
