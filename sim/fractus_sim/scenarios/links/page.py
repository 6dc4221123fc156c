"""Summary page of the links scenario."""

from __future__ import annotations

from fractus_sim.report.page import table
from fractus_sim.scenarios.links.evidence import LATE_S, Evidence
from fractus_sim.scenarios.links.place import Site
from fractus_sim.scenarios.links.results import Expectation, Gain


def summary(site: Site, run: Evidence, gains: list[Gain], checks: list[Expectation]) -> str:
    """Return the page in Markdown."""
    failed = [check for check in checks if not check.holds]
    held = f"All {len(checks)} expectations hold." if not failed else f"{len(failed)} of {len(checks)} do NOT hold."
    parts = [
        f"# Direct links in flight\n\n{held} Radios reach {site.factor:g} of what they declare.",
        "The scene has the structure of the thesis' Fig. 8.12 and 8.13 (a drone at 3 m/s along three waypoints, six edge nodes"
        " of which one has no WiFi and one stands too far away, a picture each second), not its coordinates.",
        "![the ground](map.png)\n\n![bandwidth](bandwidth.png)",
        "## Expectations\n\n"
        + table(("Expected", "Holds", "Seen"), ((c.text, "yes" if c.holds else "**NO**", c.seen) for c in checks)),
        "## Switches\n\nSeconds since the first picture.\n\n" + _switches(run),
        "## Pictures\n\n" + _pictures(run),
        "## Gain over the cloud path alone\n\nMbit beyond what 4G carries, on the flight as it was flown: while traffic was led to"
        " a node in reach. In the modelled rows a link is up and measured after 0.9 s, also for the oracle, which knows the flight: real links may be sooner.\n\n"
        + table(
            ("", "Mbit", "Share of the oracle's", "Links"),
            ((g.who, f"{g.gain_mbit:.0f}", f"{g.share:.1%}", str(g.links) if g.links else "-") for g in gains),
        ),
        "For programs: [report.json](report.json). Raw lines of the pods: lines.jsonl.",
    ]
    return "\n\n".join(parts) + "\n"


def _switches(run: Evidence) -> str:
    begin = run.pictures[0].sent_s if run.pictures else 0.0

    def at(seconds: float | None) -> str:
        return "-" if seconds is None else f"{seconds - begin:.2f}"

    rows = (
        (
            s.peer, at(s.decided_s), at(s.up_s), at(s.measured_s), "-" if s.mbps is None else f"{s.mbps:.1f}",
            at(s.redirected_s), at(s.first_s), at(s.back_s), at(s.ended_s), s.reason, s.left,
        )
        for s in run.switches
    )  # fmt: skip
    head = (
        "Node",
        "Decided",
        "Link up",
        "Measured",
        "Mbit/s",
        "Redirected",
        "First picture",
        "Back",
        "Link ended",
        "Why",
        "Why left",
    )
    return table(head, rows) if run.switches else "None."


def _pictures(run: Evidence) -> str:
    counts = run.counts()
    rows = [
        ("sent", str(counts["sent"])),
        ("received", str(counts["received"])),
        ("lost", str(counts["lost"])),
        ("received twice by one instance", str(counts["doubled"])),
        ("received by a second instance after a repetition, known by its id", str(counts["repeated_elsewhere"])),
        (f"answered later than {LATE_S:g} s", str(counts["late"])),
        ("longest time between two receptions", f"{run.longest_gap_s:.2f} s"),
        *((f"received by {node}", str(count)) for node, count in run.by_node().items()),
    ]
    return table(("Pictures", ""), rows)
