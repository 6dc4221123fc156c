"""Report of the links scenario: summary page, map with ranges and links (Fig. 8.13a), and bandwidth over time (Fig. 8.13b)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from fractus_sim.report.figure_style import GREY, INK, TRACK_COLOURS, VERMILION, add_legend, new_figure
from fractus_sim.report.report_files import (
    Expectation,
    expectations_headline,
    expectations_table,
    table,
    write_report,
)
from fractus_sim.scenarios.links.links_evidence import CLOUD, LATE_S, Evidence
from fractus_sim.scenarios.links.links_results import Gain, evaluate_run, gains, links_results
from fractus_sim.scenarios.links.links_site import Site


def write_links_report(site: Site, run: Evidence, out: Path) -> list[Expectation]:
    """Evaluate the run, write the report, and return the expectations."""
    gains_by_rule = gains(site, run)
    expectations = evaluate_run(run, gains_by_rule)
    write_report(
        out,
        links_page(site, run, gains_by_rule, expectations),
        links_results(site, run, gains_by_rule, expectations),
        {"map.png": lambda: draw_map(site, run), "bandwidth.png": lambda: draw_bandwidth(site, run)},
    )
    return expectations


def links_page(site: Site, run: Evidence, gains_by_rule: list[Gain], expectations: list[Expectation]) -> str:
    """Return the page in Markdown."""
    parts = [
        f"# Direct links in flight\n\n{expectations_headline(expectations)} The actual radio range is {site.factor:g} times"
        " the declared range.",
        "The scenario has the structure of the thesis' Fig. 8.12 and 8.13, but other coordinates: a drone flies at 3 m/s"
        " along three waypoints and takes one picture per second. Of six edge nodes, one has no WiFi and one is out of range.",
        "![map](map.png)\n\n![bandwidth](bandwidth.png)",
        "## Expectations\n\n" + expectations_table(expectations),
        "## Direct links\n\nTimes are seconds since the first picture.\n\n" + _link_uses_table(run),
        "## Pictures\n\n" + _pictures_table(run),
        "## Gain over the cloud path\n\nData in Mbit that direct links can carry in addition to the cloud path, on the recorded"
        " flight. Only times with traffic on a node in range count. The maximum assumes that the whole flight is known in"
        " advance. In the modelled rows and for the maximum, a link is up and measured after 0.9 s. Actual links may be"
        " faster.\n\n"
        + table(
            ("", "Mbit", "Share of the maximum", "Links"),
            ((g.name, f"{g.gain_mbit:.0f}", f"{g.share:.1%}", str(g.links) if g.links else "-") for g in gains_by_rule),
        ),
        "Data: [report.json](report.json), log lines of the pods in lines.jsonl.",
    ]
    return "\n\n".join(parts) + "\n"


def _link_uses_table(run: Evidence) -> str:
    begin_s = run.pictures[0].sent_s if run.pictures else 0.0

    def at(time_s: float | None) -> str:
        return "-" if time_s is None else f"{time_s - begin_s:.2f}"

    rows = (
        (
            s.peer, at(s.decided_s), at(s.up_s), at(s.measured_s), "-" if s.mbps is None else f"{s.mbps:.1f}",
            at(s.redirected_s), at(s.first_s), at(s.back_s), at(s.ended_s), s.reason, s.left,
        )
        for s in run.link_uses
    )  # fmt: skip
    head = (
        "Node",
        "Decided",
        "Link up",
        "Measured",
        "Mbit/s",
        "Redirected",
        "First picture",
        "Back to cloud",
        "Link ended",
        "Reason",
        "Reason for the end",
    )
    return table(head, rows) if run.link_uses else "No direct link was used."


def _pictures_table(run: Evidence) -> str:
    counts = run.counts()
    rows = [
        ("sent", str(counts["sent"])),
        ("received", str(counts["received"])),
        ("lost", str(counts["lost"])),
        ("received twice by one instance", str(counts["doubled"])),
        ("received by a second instance after a repetition", str(counts["repeated_elsewhere"])),
        (f"response after more than {LATE_S:g} s", str(counts["late"])),
        ("longest time between two receptions", f"{run.longest_gap_s:.2f} s"),
        *((f"received by {node}", str(count)) for node, count in run.by_node().items()),
    ]
    return table(("Pictures", ""), rows)


def node_colours(site: Site) -> dict[str, str]:
    """Assign a colour to each edge node. The cloud is grey."""
    return dict(zip(site.edges, TRACK_COLOURS, strict=False)) | {CLOUD: GREY}


def draw_map(site: Site, run: Evidence) -> Figure:
    """Draw the map: waypoints, ranges, and the flight in the colour of the node that received the pictures."""
    figure, axes = new_figure(8.0, 8.0)
    colour = node_colours(site)
    used = {use.peer for use in run.link_uses if use.redirected_s is not None}
    for peer in site.peers:
        x, y, _ = peer.position
        axes.add_patch(Circle((x, y), peer.range_m, facecolor=colour[peer.name], alpha=0.10, edgecolor="none"))
        axes.add_patch(Circle((x, y), peer.range_m * site.factor, fill=False, edgecolor=colour[peer.name], lw=1.0))
    for name, (x, y, _) in site.edges.items():
        style = {"marker": "*", "markersize": 16} if name in used else {"marker": "s", "markersize": 8}
        axes.plot(x, y, **style, color=colour[name], markeredgecolor=INK, linestyle="none")
        axes.annotate(name, (x, y), xytext=(8, 8), textcoords="offset points", fontsize=9, color=INK)
    if run.track:
        path = np.array([position[:2] for _, position in run.track])
        axes.plot(*path.T, color=VERMILION, linewidth=1.0, alpha=0.5, label="flight")
    _draw_receptions(site, run, axes)
    for number, (x, y, _) in enumerate(site.path, 1):
        axes.plot(x, y, marker="o", color=VERMILION, markeredgecolor=INK, markersize=9, linestyle="none", zorder=6)
        axes.annotate(f"WP{number}", (x, y), xytext=(-6, -16), textcoords="offset points", fontsize=9, color=INK)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_xlabel("metres east of WP1", fontsize=9)
    axes.set_ylabel("metres north of WP1", fontsize=9)
    axes.set_title(
        "Stars: nodes that received pictures by WiFi. Dots: pictures, in the colour of the receiving node", fontsize=10
    )
    add_legend(figure, axes, columns=4)
    return figure


def _draw_receptions(site: Site, run: Evidence, axes: Any) -> None:
    """Draw each picture in the colour of the node that responded."""
    times = [at for at, _ in run.track]
    if not times:
        return
    east = [position[0] for _, position in run.track]
    north = [position[1] for _, position in run.track]
    colour = node_colours(site)
    for node in sorted({p.responder for p in run.pictures if p.responder}):
        at = [p.sent_s for p in run.pictures if p.responder == node]
        x = np.interp(at, times, east)
        y = np.interp(at, times, north)
        name = node if node in site.edges else CLOUD
        axes.plot(x, y, ".", color=colour[name], markersize=8, label=name, zorder=5)


def draw_bandwidth(site: Site, run: Evidence) -> Figure:
    """Draw the measured bandwidth of the paths over time, and the path of the pictures."""
    figure, axes = new_figure(10.0, 4.2)
    colour = node_colours(site)
    begin = run.pictures[0].sent_s if run.pictures else 0.0
    for use in run.link_uses:
        for first, last in use.spans:
            end = max(p.sent_s for p in run.pictures) if last is None else last
            axes.axvspan(first - begin, end - begin, color=colour[use.peer], alpha=0.12)
            axes.axvline(first - begin, color=colour[use.peer], linewidth=1.0)
            axes.axvline(end - begin, color=GREY, linewidth=1.0, linestyle=":")
        if use.measured_s is not None and use.mbps is not None:
            axes.plot(
                use.measured_s - begin, use.mbps, marker="D", color=colour[use.peer], markeredgecolor=INK,
                linestyle="none", label="measurement of the agent", zorder=5,
            )  # fmt: skip
    for node in sorted({p.responder for p in run.pictures if p.responder}):
        pictures = [p for p in run.pictures if p.responder == node and p.took_s > 0]
        name = node if node in site.edges else CLOUD
        rates = [p.size * 8e-6 / p.took_s for p in pictures]
        axes.plot([p.sent_s - begin for p in pictures], rates, ".", color=colour[name], label=f"pictures to {name}")
    axes.axhline(site.cloud.ingress_mbps, color=GREY, linewidth=0.8)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("seconds since the first picture", fontsize=9)
    axes.set_ylabel("Mbit/s", fontsize=9)
    axes.set_title("Measured bandwidth, and the traffic path of the pictures", fontsize=10, loc="left")
    add_legend(figure, axes, columns=5)
    return figure
