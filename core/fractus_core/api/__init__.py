"""The kinds of the API group fractus.dev/v1alpha1, as pydantic models."""

from fractus_core.api.applications import Application as Application
from fractus_core.api.components import Component as Component
from fractus_core.api.direct_links import DirectLink as DirectLink
from fractus_core.api.flight_plans import ApplicationTemplate as ApplicationTemplate
from fractus_core.api.flight_plans import FlightPlan as FlightPlan
from fractus_core.api.grants import Grant as Grant
from fractus_core.api.grants import NodeGrants as NodeGrants
from fractus_core.api.model import API_VERSION as API_VERSION
from fractus_core.api.model import GROUP as GROUP
from fractus_core.api.model import VERSION as VERSION
from fractus_core.api.model import Condition as Condition
from fractus_core.api.model import InvalidObject as InvalidObject
from fractus_core.api.model import Metadata as Metadata
from fractus_core.api.model import Resource as Resource
from fractus_core.api.names import component_identity as component_identity
from fractus_core.api.names import node_identity as node_identity
from fractus_core.api.names import node_server_name as node_server_name
from fractus_core.api.nodes import Depot as Depot
from fractus_core.api.nodes import Drone as Drone
from fractus_core.api.nodes import EdgeNode as EdgeNode
from fractus_core.api.plans import DeploymentPlan as DeploymentPlan
from fractus_core.api.policies import Policy as Policy
from fractus_core.api.policies import Zone as Zone

KINDS: tuple[type[Resource], ...] = (
    Drone,
    EdgeNode,
    Depot,
    Zone,
    Policy,
    Application,
    ApplicationTemplate,
    FlightPlan,
    DeploymentPlan,
    Grant,
    NodeGrants,
    DirectLink,
)
