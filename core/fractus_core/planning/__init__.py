"""From an application and an inventory to a plan that explains itself."""

from fractus_core.planning.area import OperationArea, operation_area
from fractus_core.planning.inventory import CLASS_LABEL, Host, Inventory, Settings
from fractus_core.planning.plan import Infeasible, instance_name, plan

__all__ = [
    "CLASS_LABEL",
    "Host",
    "Infeasible",
    "Inventory",
    "OperationArea",
    "Settings",
    "instance_name",
    "operation_area",
    "plan",
]
