"""From an application and an inventory to a plan that explains itself."""

from fractus_core.planning.area import OperationArea as OperationArea
from fractus_core.planning.area import operation_area as operation_area
from fractus_core.planning.flight import flight_of as flight_of
from fractus_core.planning.index import SpatialIndex as SpatialIndex
from fractus_core.planning.inventory import Flight as Flight
from fractus_core.planning.inventory import Host as Host
from fractus_core.planning.inventory import Inventory as Inventory
from fractus_core.planning.inventory import Settings as Settings
from fractus_core.planning.locations import NodeLocations as NodeLocations
from fractus_core.planning.plan import Infeasible as Infeasible
from fractus_core.planning.plan import instance_name as instance_name
from fractus_core.planning.plan import plan as plan
