"""From an application and an inventory to a plan that explains itself."""

from fractus_core.planning.area import OperationArea, operation_area
from fractus_core.planning.flight import flight_of
from fractus_core.planning.index import SpatialIndex
from fractus_core.planning.inventory import CLASS_LABEL, Flight, Host, Inventory, Settings
from fractus_core.planning.locations import NodeLocations
from fractus_core.planning.plan import Infeasible, instance_name, plan

__all__ = [
    "CLASS_LABEL",
    "Flight",
    "Host",
    "Infeasible",
    "Inventory",
    "NodeLocations",
    "OperationArea",
    "Settings",
    "SpatialIndex",
    "flight_of",
    "instance_name",
    "operation_area",
    "plan",
]
