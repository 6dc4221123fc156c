"""Planner: computes a plan for an application from an inventory, with a reason for each decision."""

from fractus_core.planning.inventory import Flight as Flight
from fractus_core.planning.inventory import Host as Host
from fractus_core.planning.inventory import Inventory as Inventory
from fractus_core.planning.inventory import Settings as Settings
from fractus_core.planning.mission import flight_of as flight_of
from fractus_core.planning.operation_area import OperationArea as OperationArea
from fractus_core.planning.operation_area import operation_area as operation_area
from fractus_core.planning.planner import Infeasible as Infeasible
from fractus_core.planning.planner import instance_name as instance_name
from fractus_core.planning.planner import plan as plan
from fractus_core.planning.spatial_index import NodeLocations as NodeLocations
from fractus_core.planning.spatial_index import SpatialIndex as SpatialIndex
