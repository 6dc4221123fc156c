"""Summary page of the links scenario."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from fractus_sim.report.figure_style import GREY, INK, TRACK_COLOURS, VERMILION, canvas, legend
from fractus_sim.report.report_files import table
from fractus_sim.scenarios.links.links_evidence import CLOUD, LATE_S, Evidence
from fractus_sim.scenarios.links.links_results import Expectation, Gain
from fractus_sim.scenarios.links.links_site import Site


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


def colours(site: Site) -> dict[str, str]:
    """Assign a colour to each edge node. The cloud is grey."""
    return dict(zip(site.edges, TRACK_COLOURS, strict=False)) | {CLOUD: GREY}


def draw_map(site: Site, run: Evidence) -> Figure:
    """Draw the map: waypoints, ranges, and the flight in the colour of the node that received the pictures."""
    figure, axes = canvas(8.0, 8.0)
    colour = colours(site)
    used = {switch.peer for switch in run.switches if switch.redirected_s is not None}
    for peer in site.peers:
        x, y, _ = peer.position
        axes.add_patch(Circle((x, y), peer.range_m, facecolor=colour[peer.name], alpha=0.10, edgecolor="none"))
        axes.add_patch(Circle((x, y), peer.range_m * site.factor, fill=False, edgecolor=colour[peer.name], lw=1.0))
    for name, (x, y, _) in site.edges.items():
        marker, size = ("*", 16) if name in used else ("s", 8)
        axes.plot(x, y, marker=marker, markersize=size, color=colour[name], markeredgecolor=INK, linestyle="none")
        axes.annotate(name, (x, y), xytext=(8, 8), textcoords="offset points", fontsize=9, color=INK)
    if run.track:
        way = np.array([position[:2] for _, position in run.track])
        axes.plot(*way.T, color=VERMILION, linewidth=1.0, alpha=0.5, label="the flight")
    _received(site, run, axes)
    for number, (x, y, _) in enumerate(site.path, 1):
        axes.plot(x, y, marker="o", color=VERMILION, markeredgecolor=INK, markersize=9, linestyle="none", zorder=6)
        axes.annotate(f"WP{number}", (x, y), xytext=(-6, -16), textcoords="offset points", fontsize=9, color=INK)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_xlabel("metres east of WP1", fontsize=9)
    axes.set_ylabel("metres north of WP1", fontsize=9)
    axes.set_title("Stars receive pictures by WiFi; dots are pictures, in the colour of who received them", fontsize=10)
    legend(figure, axes, columns=4)
    return figure


def _received(site: Site, run: Evidence, axes: object) -> None:
    times = [at for at, _ in run.track]
    if not times:
        return
    east = [position[0] for _, position in run.track]
    north = [position[1] for _, position in run.track]
    colour = colours(site)
    for node in sorted({p.by for p in run.pictures if p.by}):
        at = [p.sent_s for p in run.pictures if p.by == node]
        x = np.interp(at, times, east)
        y = np.interp(at, times, north)
        name = node if node in site.edges else CLOUD
        axes.plot(x, y, ".", color=colour[name], markersize=8, label=name, zorder=5)  # type: ignore[attr-defined]  # axes


def draw_bandwidth(site: Site, run: Evidence) -> Figure:
    """Draw the measured bandwidth of the paths over time, and the path of the pictures."""
    figure, axes = canvas(10.0, 4.2)
    colour = colours(site)
    begin = run.pictures[0].sent_s if run.pictures else 0.0
    for switch in run.switches:
        for first, last in switch.spans:
            end = max(p.sent_s for p in run.pictures) if last is None else last
            axes.axvspan(first - begin, end - begin, color=colour[switch.peer], alpha=0.12)
            axes.axvline(first - begin, color=colour[switch.peer], linewidth=1.0)
            axes.axvline(end - begin, color=GREY, linewidth=1.0, linestyle=":")
        if switch.measured_s is not None and switch.mbps is not None:
            axes.plot(
                switch.measured_s - begin, switch.mbps, marker="D", color=colour[switch.peer], markeredgecolor=INK,
                linestyle="none", label="probe of the agent", zorder=5,
            )  # fmt: skip
    for node in sorted({p.by for p in run.pictures if p.by}):
        own = [p for p in run.pictures if p.by == node and p.took_s > 0]
        name = node if node in site.edges else CLOUD
        rates = [p.size * 8e-6 / p.took_s for p in own]
        axes.plot([p.sent_s - begin for p in own], rates, ".", color=colour[name], label=f"pictures to {name}")
    axes.axhline(site.cloud.ingress_mbps, color=GREY, linewidth=0.8)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("seconds since the first picture", fontsize=9)
    axes.set_ylabel("Mbit/s", fontsize=9)
    axes.set_title("Bandwidth measured, and the paths that pictures took", fontsize=10, loc="left")
    legend(figure, axes, columns=5)
    return figure
