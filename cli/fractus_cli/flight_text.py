"""A FlightPlan and the decision on it as text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from fractus_cli.cluster_reader import Body, conditions_of


def state_of(plan: Body) -> str:
    """Return the state of a plan."""
    return str((plan.get("status") or {}).get("state") or "Draft")


def headline(plan: Body) -> str:
    """Return name, state and message of a plan."""
    metadata = plan["metadata"]
    message = (plan.get("status") or {}).get("message") or "not decided by the operator yet"
    return f"{metadata['namespace']}/{metadata['name']}: {state_of(plan)}: {message}"


def flight_lines(plan: Body) -> Iterator[str]:
    """Yield the lines of `fractus flights show`."""
    spec: Body = plan["spec"]
    status: Body = plan.get("status") or {}
    dry_run = " (a check that reserves nothing)" if spec.get("dryRun") else ""
    yield headline(plan) + dry_run
    yield f"Template: {spec['template']}"
    yield f"Window: {spec['window']['start']}, {spec['window']['duration']:g} minutes"
    if status.get("drone"):
        yield f"Drone: {status['drone']}"
    if status.get("application"):
        yield f"Application: {status['application']}"
    if status.get("candidates"):
        fitting = ", ".join(f"{each['node']} ({each['score']:.3g})" for each in status["candidates"])
        yield f"Suitable drones, best first: {fitting}"
    yield from _findings("Refused", status.get("refusals") or ())
    if status.get("rejected"):
        yield "Rejected drones:"
        for each in status["rejected"]:
            yield f"  {each['node']}: {each['reason']}: {each['message']}"
    yield from _policies(plan)
    yield from _volumes("Volumes", status.get("volumes") or ())
    yield from _volumes("Off-nominal volumes", status.get("offNominalVolumes") or ())
    yield from _findings("Advisories", status.get("advisories") or ())
    conditions = conditions_of(plan).values()
    if conditions:
        yield "Conditions:"
    for each in conditions:
        yield f"  {each['type']}={each['status']} {each['reason']}: {each.get('message', '')}".rstrip(": ")
    yield from _next_step(plan)


def _findings(title: str, findings: Sequence[Body]) -> Iterator[str]:
    if findings:
        yield f"{title}:"
    for each in findings:
        yield f"  {each['reason']}: {each['message']}"


def _policies(plan: Body) -> Iterator[str]:
    restrictions = (plan.get("status") or {}).get("restrictions") or ()
    if restrictions:
        yield "Policies:"
    for each in restrictions:
        choices = ", ".join(each.get("choices") or ())
        if not each.get("chosen"):
            yield f"  {each['policy']}: not selected; choose one of: {choices}"
        elif choices:
            yield f"  {each['policy']}: {each['chosen']}, selected among: {choices}"
        else:
            yield f"  {each['policy']}: {each['chosen']}"


def _volumes(title: str, volumes: Sequence[Body]) -> Iterator[str]:
    if volumes:
        yield f"{title}:"
    for volume in volumes:
        lower = f"{volume['lower']:.0f} m" if volume.get("lower") is not None else "the ground"
        upper = f"{volume['upper']:.0f} m above mean sea level" if volume.get("upper") is not None else "no upper bound"
        places = "; ".join(map(_area, volume["areas"]))
        yield f"  {volume['begin']} to {volume['end']}, from {lower} to {upper}: {places}"


def _area(area: Body) -> str:
    circle = area.get("circle")
    if circle:
        return f"circle of {circle['radius']:.0f} m around {_point(circle['center'])}"
    corners: Sequence[Body] = area["polygon"]["exterior"]
    north = max(corners, key=lambda corner: float(corner["lat"]))
    return f"polygon with {len(corners)} corners, the northernmost at {_point(north)}"


def _point(point: Body) -> str:
    return f"{point['lat']:.6f}, {point['lon']:.6f}"


def _next_step(plan: Body) -> Iterator[str]:
    """Yield what the user must do next, if anything."""
    spec = plan["spec"]
    metadata = plan["metadata"]
    target = f"{metadata['name']} -n {metadata['namespace']}"
    waits = spec.get("use", "Planned") == "Planned" and not spec.get("autoActivate")
    if spec.get("dryRun"):
        return
    if conditions_of(plan).get("ActionNeeded", {}).get("status") == "True":
        yield f"Next: fractus flights choose {target} POLICY=ACTION"
    elif state_of(plan) == "Accepted" and waits:
        yield f"Next: fractus flights start {target}"
