"""Plans as text tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from fractus_core.api import Application
from fractus_core.api.plans import DeploymentPlanSpec, DroneChoice, PlannedInstance, Rejection
from fractus_core.planning import Infeasible
from fractus_core.planning.link_planning import PlannedLink

_LISTED = 20


def plan_table(application: Application, plan: DeploymentPlanSpec, links: Sequence[PlannedLink] = ()) -> str:
    """Format the placements, possible direct links and rejected nodes of a plan."""
    lines = [f"{'/'.join(application.key)}: feasible"]
    if plan.drone is not None:
        lines += [_drone(plan.drone), *_legality(plan.drone)]
    lines += ["", *_columns(("COMPONENT", "INSTANCE", "NODE", "ROLE", "SERVES", "ADDS"), map(_row, plan.placements))]
    covered = sum(p.coverage or 0.0 for p in plan.placements if p.role == "hybrid-drone")
    if covered:
        lines.append(f"hybrid instances along the route add direct links over {covered:.1%} of the operation area")
    if links:
        lines += ["", *_columns(("DIRECT LINK TO", "BY", "NETWORK", "RANGE", "BANDWIDTH", "FOR"), map(_link, links))]
    return "\n".join([*lines, *_rejections(plan.rejected, plan.rejected_omitted or 0), ""])


def infeasible_table(application: Application, refusal: Infeasible) -> str:
    """Format the reason why an Application is infeasible."""
    lines = [f"{'/'.join(application.key)}: infeasible ({refusal.reason})", refusal.message]
    return "\n".join([*lines, *_rejections(refusal.rejected, refusal.omitted), ""])


def _drone(choice: DroneChoice) -> str:
    text = f"drone {choice.node}"
    if choice.shared_with is not None:
        text += f" is shared with {choice.shared_with}"
    if choice.mission is not None:
        mission = choice.mission
        text += f" flies {mission.distance:.0f} m in {mission.duration:.1f} of {mission.available:.1f} available min"
    if choice.transit:
        legs = len(choice.transit)
        text += f"; {legs} transit leg{'s' if legs > 1 else ''} flown by the system"
    if choice.alternatives:
        text += f"; next best: {', '.join(a.node for a in choice.alternatives[:3])}"
    return text


def _legality(choice: DroneChoice) -> list[str]:
    """Format the policy conflict and the legs that policies change."""
    lines = [f"policy conflict: {choice.policy_conflict}"] if choice.policy_conflict is not None else []
    if choice.legality:
        rows = [
            (f"{leg.end.lat:.6f}, {leg.end.lon:.6f}", leg.flown_by, leg.outcome, leg.reason, leg.message)
            for leg in choice.legality[:_LISTED]
        ]
        lines += ["", *_columns(("LEG TO", "FLOWN BY", "OUTCOME", "REASON", "MESSAGE"), rows)]
        hidden = len(choice.legality) - len(rows) + (choice.legality_omitted or 0)
        lines += [f"and {hidden} more; see -o yaml"] if hidden else []
    return lines


def _row(placed: PlannedInstance) -> tuple[str, ...]:
    node = placed.node or (f"any cloud node, {placed.replicas} replicas" if placed.replicas > 1 else "any cloud node")
    serves = f"{placed.serves.component} on {placed.serves.node}" if placed.serves is not None else ""
    adds = f"{placed.coverage:.1%}" if placed.coverage is not None else ""
    return (placed.component, placed.instance, node, placed.role, serves, adds)


def _link(link: PlannedLink) -> tuple[str, ...]:
    used = ", ".join(placed.component for placed in link.instances)
    bandwidth = f"{link.bandwidth_mbps:g} Mbit/s"
    return (link.node, link.technology, link.pairing.network_id, f"{link.range_m:g} m", bandwidth, used)


def _rejections(rejected: Sequence[Rejection], omitted: int) -> list[str]:
    if not rejected:
        return []
    rows = [(r.component, r.node, r.reason, r.message) for r in rejected[:_LISTED]]
    lines = ["", *_columns(("REJECTED FOR", "NODE", "REASON", "MESSAGE"), rows)]
    hidden = len(rejected) - len(rows) + omitted
    if hidden:
        counts = Counter(r.reason for r in rejected[_LISTED:])
        by_reason = ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items()))
        listed = f" ({by_reason})" if by_reason else ""
        lines.append(f"and {hidden} more{listed}; see -o yaml")
    return lines


def _columns(titles: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> list[str]:
    table = [titles, *rows]
    widths = [max(len(row[i]) for row in table) for i in range(len(titles))]
    return ["   ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in table]
