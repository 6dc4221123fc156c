"""Airspace: volumes that flights reserve, conflicts between flights, and the states of a flight plan (ASTM F3548)."""

from fractus_core.airspace.conflicts import Airspace as Airspace
from fractus_core.airspace.conflicts import OperationalIntent as OperationalIntent
from fractus_core.airspace.decide import Decision as Decision
from fractus_core.airspace.decide import Finding as Finding
from fractus_core.airspace.decide import decide as decide
from fractus_core.airspace.decide import standing_overlaps as standing_overlaps
from fractus_core.airspace.flight_volumes import flight_volumes as flight_volumes
from fractus_core.airspace.lifecycle import transition_problem as transition_problem
from fractus_core.airspace.volumes import Overlap as Overlap
from fractus_core.airspace.volumes import Volume4D as Volume4D
from fractus_core.api.flight_plans import PlanState as PlanState
