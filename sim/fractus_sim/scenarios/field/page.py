"""Summary page and results of the field experiment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fractus_sim.report.page import clock, rounded, table
from fractus_sim.scenarios.field.evidence import Call, Evidence
from fractus_sim.scenarios.field.expectations import Check
from fractus_sim.scenarios.field.place import NAVIGATOR, Field


def summary(field: Field, runs: Sequence[Evidence], checks: Sequence[Check], autopilot: str) -> str:
    """Return the page in Markdown."""
    failed = [check for check in checks if not check.holds]
    held = (
        f"All {len(checks)} expectations hold." if not failed else f"{len(failed)} of {len(checks)} expectations FAIL."
    )
    parts = [
        f"# The field experiment\n\n{held} Flown by {autopilot}, home at {field.home[0]:.6f}, {field.home[1]:.6f}.",
        "The scene has the structure of the thesis' Fig. 8.10 (two control points, a zigzag in a region, a no-fly zone, a"
        " no-photo stripe, 5 to 15 m), not its coordinates, which the thesis does not give. Without policies means: the"
        " same program with Grants that hold no policies and whose operation area covers the whole surroundings.",
        "![the ground](map.png)\n\n![altitudes](altitude.png)",
        "## The three runs\n\n" + _runs(runs),
        "## Requests beyond the limits\n\n" + _violations(field, runs),
        "## Expectations\n\n" + _checks(checks),
        "Each run's directory has its manifests, Grants, audit logs, the tlog of the autopilot's link, and pictures."
        " For programs: [report.json](report.json).",
    ]
    return "\n\n".join(parts) + "\n"


def figures(field: Field, runs: Sequence[Evidence], checks: Sequence[Check], autopilot: str) -> dict[str, Any]:
    """Return the results as JSON-compatible values."""
    return {
        "holds": all(check.holds for check in checks),
        "autopilot": autopilot,
        "home": {"lat": field.home[0], "lon": field.home[1]},
        "runs": [_figures(run) for run in runs],
        "checks": [{"run": c.run, "text": c.text, "holds": c.holds, "seen": c.seen} for c in checks],
    }


def _figures(run: Evidence) -> dict[str, Any]:
    takeover = run.takeover()
    return {
        "name": run.name,
        "title": run.title,
        "policies": run.policies,
        "flight_s": rounded(_flight_s(run)),
        "distance_m": rounded(run.track.distance_m),
        "max_altitude_m": rounded(run.track.max_altitude_m),
        "max_speed_mps": rounded(run.track.max_speed_mps),
        "landed_from_takeoff_m": rounded(run.track.miss_m),
        "pictures_taken": len(run.pictures(taken=True)),
        "pictures_refused": len(run.pictures(taken=False)),
        "corrected": sum(c.action == "correct" and _altered(c) for c in _mine(run)),
        "denied": sum(c.refused for c in _mine(run)),
        "takeover": None if takeover is None else takeover.reason,
        "texts": list(run.texts),
    }


def _runs(runs: Sequence[Evidence]) -> str:
    rows = []
    for run in runs:
        f = _figures(run)
        rows.append(
            (
                run.title, clock(f["flight_s"]), f"{f['distance_m']:.0f} m", f"{f['max_altitude_m']:.1f} m",
                str(f["pictures_taken"]), str(f["pictures_refused"]), str(f["corrected"]), str(f["denied"]),
                f["takeover"] or "-",
            )
        )  # fmt: skip
    head = (
        "Run",
        "In the air",
        "Way",
        "Highest",
        "Pictures",
        "Pictures refused",
        "Corrected",
        "Denied",
        "Taken over for",
    )
    return table(head, rows)


def _violations(field: Field, runs: Sequence[Evidence]) -> str:
    rows = []
    for run in runs:
        for call in _mine(run):
            if call.asked is None or not (call.refused or _altered(call)):
                continue
            flown = "refused" if call.refused or call.flown is None else f"{call.flown.alt_m:.1f} m"
            rows.append((run.title, _name(field, call), f"{call.asked.alt_m:.0f} m", flown, call.reason))
    return table(("Run", "Goto", "Asked", "Flown", "Why"), rows) if rows else "Nothing."


def _checks(checks: Sequence[Check]) -> str:
    rows = [(check.run, check.text, "yes" if check.holds else "**NO**", check.seen) for check in checks]
    return table(("Run", "Expected", "Holds", "Seen"), rows)


def _mine(run: Evidence) -> list[Call]:
    """Return the Gotos of the program while it had control, without those of the system."""
    return [c for c in run.gotos() if c.who == NAVIGATOR]


def _altered(call: Call) -> bool:
    return call.asked is not None and call.flown is not None and abs(call.asked.alt_m - call.flown.alt_m) > 0.05


def _name(field: Field, call: Call) -> str:
    if call.asked is None:
        return "-"
    east, north = field.frame.xy(call.asked.lat, call.asked.lon)
    near = {n: field.frame.xy(p[0], p[1]) for n, p in field.places.items()}
    name, at = min(near.items(), key=lambda item: (item[1][0] - east) ** 2 + (item[1][1] - north) ** 2)
    return name if abs(at[0] - east) + abs(at[1] - north) < 1.0 else f"{east:.0f} m east, {north:.0f} m north"


def _flight_s(run: Evidence) -> float | None:
    begin = run.track.takeoff_s
    end = run.track.landing_s
    return None if begin is None or end is None else end - begin
