// Lists of drones, verdicts, areas and other objects. They contain everything that the map shows.

import { byId, element, setText } from "./elements";
import type { Application, Feature, Link, Note, Policy, Verdict } from "./events";
import { type Drone, MAX_GAP_MS, type Model } from "./model";
import { policiesAt } from "./places";
import { actionOf, callOf, classOf, clock, facts, isIntervention, kindName, quantity, sentence } from "./text";

const MAX_VERDICTS = 200;
const MAX_NOTES = 200;
const MAX_PICTURES = 6;
const NO_POLICIES =
  "No policy restricts flights or pictures. Each application is limited to its granted methods, its operation area and the limits of the drone.";
const UNLISTED_POLICIES = "Recordings do not list policies. The zones on the map are those of the policies that apply to the flight.";

export interface Actions {
  select(drone: string): void;
  seek(time: number): void;
}

function phaseBadge(phase: string): HTMLSpanElement {
  const badge = element("span", "badge", phase);
  badge.dataset["phase"] = phase;
  return badge;
}

function applicationItem(application: Application): HTMLLIElement {
  const item = element("li");
  const head = element("p", "head");
  head.append(element("span", "name", application.name), phaseBadge(application.phase), element("span", "facts", application.drone));
  item.append(head, element("p", "facts", [application.reason, application.text].filter(Boolean).join(": ")));
  return item;
}

function linkItem(link: Link): HTMLLIElement {
  const item = element("li");
  const head = element("p", "head");
  head.append(element("span", "name", `${link.drone} – ${link.node}`), phaseBadge(link.phase));
  const route = link.traffic === "direct" ? "traffic over the link" : "traffic through the cloud";
  item.append(head, element("p", "facts", [link.traffic ? route : "", link.text || link.reason].filter(Boolean).join(" · ")));
  return item;
}

function policyItem(policy: Policy): HTMLLIElement {
  const item = element("li");
  const scope = policy.zones.length > 0 ? `in ${policy.zones.join(", ")}` : "everywhere";
  item.append(element("span", "name", policy.name), element("span", "facts", ` ${policy.text}; ${scope}`));
  return item;
}

interface Row {
  item: HTMLLIElement;
  button: HTMLButtonElement;
  phase: HTMLElement;
  facts: HTMLElement;
}

export class Lists {
  private readonly drones = byId<HTMLUListElement>("drones");
  private readonly verdicts = byId<HTMLOListElement>("verdicts");
  private readonly zones = byId<HTMLUListElement>("zones");
  private readonly pictures = byId<HTMLUListElement>("pictures");
  private readonly log = byId<HTMLOListElement>("log");
  private readonly filter = byId<HTMLSelectElement>("verdict-filter");
  private readonly announcer = byId("announcer");
  /** Entries of the legend that are shown only if the map contains their class. */
  private readonly legend = document.querySelectorAll<HTMLElement>("#legend [data-class]");
  private readonly rows = new Map<string, Row>();
  private shown: Record<string, string> = { verdicts: "", zones: "", pictures: "", log: "" };
  private announced = -Infinity;

  constructor(
    private readonly model: Model,
    private readonly actions: Actions,
  ) {}

  clear(): void {
    for (const row of this.rows.values()) row.item.remove();
    this.rows.clear();
  }

  /** Shows the state at a time. `staleSince` is the time of the last contact if the state is stale, in Unix milliseconds. */
  show(time: number, selected: string, staleSince: number | undefined): void {
    this.showDrones(time, selected);
    this.showVerdicts(time);
    this.showZones(time);
    this.showLegend(time);
    const model = this.model;
    // Hide lists that a cluster does not report. An empty list would suggest that there were no pictures or log lines.
    const fromCluster = model.contact !== undefined;
    byId("pictures-section").hidden = fromCluster && model.pictureSource === undefined;
    const pictureProblem = model.pictureSource?.problem;
    setText(byId("pictures-problem"), pictureProblem ? `Pictures may be missing: ${pictureProblem}` : "");
    byId("log-section").hidden = fromCluster;
    // A cluster reports only calls that policies changed or refused.
    byId("verdict-filter-label").hidden = fromCluster;
    const problem = model.records?.verdicts_problem;
    setText(byId("verdicts-problem"), problem ? `Verdicts may be missing: ${problem}` : "");
    this.showSection("applications", model.applications.at(time)?.applications, applicationItem, "No applications.");
    this.showSection("links", model.linksAt(time), linkItem, "No direct links.");
    const unlisted = model.contact === undefined && model.drones.size > 0;
    this.showSection("policies", model.policies.at(time)?.policies ?? (unlisted ? [] : undefined), policyItem, unlisted ? UNLISTED_POLICIES : NO_POLICIES);
    setText(byId("policies-age"), staleSince === undefined ? "" : `as of ${clock(staleSince)} UTC, may have changed`);
    this.showPictures(time);
    this.showLog(time);
  }

  private showDrones(time: number, selected: string): void {
    for (const [name, row] of this.rows) {
      if (this.model.drones.has(name)) continue;
      row.item.remove();
      this.rows.delete(name);
    }
    for (const drone of this.model.drones.values()) this.showDrone(drone, time, selected);
    if (this.rows.size === 0) this.empty(this.drones, "No drones yet.");
    else this.drones.querySelector(".empty")?.remove();
  }

  private showDrone(drone: Drone, time: number, selected: string): void {
    const row = this.rows.get(drone.name) ?? this.makeRow(drone.name);
    const state = drone.states.at(time);
    const battery = state?.battery;
    const isStale = drone.isStale(time);
    const position = drone.position(time);
    const policies = position === undefined ? undefined : policiesAt(this.model, time, position.lon, position.lat);
    const values = [
      `battery ${quantity(battery === null || battery === undefined ? null : battery * 100, 0, "%")}`,
      `altitude ${quantity(state?.altitude_m, 1, "m")}`,
      `speed ${quantity(state?.speed_mps, 1, "m/s")}`,
      `controller ${state?.controller || "–"}`,
      ...(state?.mode ? [`mode ${state.mode}`] : []),
      ...(policies === undefined ? [] : [policies]),
      ...(isStale ? [`last report at ${state?.seen_ms ? clock(state.seen_ms) : "–"}`] : []),
    ];
    setText(row.phase, state?.phase ?? "not reporting");
    row.phase.dataset["phase"] = state?.phase ?? "";
    setText(row.facts, values.join(" · "));
    row.item.classList.toggle("stale", isStale);
    const pressed = String(drone.name === selected);
    if (row.button.getAttribute("aria-pressed") !== pressed) row.button.setAttribute("aria-pressed", pressed);
  }

  private makeRow(name: string): Row {
    const row = {
      item: element("li"),
      button: element("button", "name", name),
      phase: element("span", "badge"),
      facts: element("p", "facts"),
    };
    row.button.type = "button";
    row.button.setAttribute("aria-label", `${name}: show on the map`);
    row.button.addEventListener("click", () => this.actions.select(name));
    row.item.append(row.button, row.phase, row.facts);
    this.rows.set(name, row);
    // Keep the rows sorted by name.
    const next = [...this.rows.keys()].filter((other) => other > name).sort()[0];
    this.drones.insertBefore(row.item, next === undefined ? null : this.rows.get(next)!.item);
    return row;
  }

  private showVerdicts(time: number): void {
    const all = this.filter.value === "all";
    const past = this.model.verdicts.values.slice(0, this.model.verdicts.count(time));
    const verdicts = (all ? past : past.filter(isIntervention)).slice(-MAX_VERDICTS);
    this.announce(verdicts.filter(isIntervention));
    const key = `${this.filter.value} ${verdicts.length} ${verdicts[0]?.time_ms} ${verdicts.at(-1)?.time_ms}`;
    if (key === this.shown.verdicts) return;
    this.shown.verdicts = key;
    this.verdicts.replaceChildren(...verdicts.reverse().map((verdict) => this.verdictItem(verdict)));
    if (verdicts.length === 0) this.empty(this.verdicts, all ? "No calls yet." : "No interventions by policies yet.");
  }

  private verdictItem(verdict: Verdict): HTMLLIElement {
    const item = element("li", `verdict ${verdict.action || verdict.kind}`);
    const at = element("button", "time", clock(verdict.time_ms));
    at.type = "button";
    at.setAttribute("aria-label", `${clock(verdict.time_ms)}: show this time`);
    at.addEventListener("click", () => this.actions.seek(verdict.time_ms));
    const head = element("p", "head");
    head.append(at, element("span", "badge", actionOf(verdict)), element("span", "", `${verdict.drone} ${callOf(verdict)}`));
    item.append(head);
    if (verdict.reason || verdict.code) item.append(element("p", "facts", verdict.reason || verdict.code));
    if (verdict.policies.length > 0) {
      item.append(element("p", "facts", `${verdict.policies.length > 1 ? "policies" : "policy"} ${verdict.policies.join(", ")}`));
    }
    return item;
  }

  /** Announces new verdicts to screen readers. Going back in time announces nothing. */
  private announce(verdicts: Verdict[]): void {
    const latest = verdicts.at(-1);
    const before = this.announced;
    this.announced = latest?.time_ms ?? -Infinity;
    if (latest === undefined || latest.time_ms <= before) return;
    const count = verdicts.filter((verdict) => verdict.time_ms > before).length;
    setText(this.announcer, count === 1 ? sentence(latest) : `${count} new verdicts, the latest: ${sentence(latest)}`);
  }

  private showZones(time: number): void {
    const features = new Map<string, Feature>();
    for (const feature of this.model.features(time)) {
      const properties = feature.properties;
      const owner = properties.component ? ` of ${properties.component}` : "";
      const name = properties.name === properties.kind ? kindName(feature) : properties.name;
      const number = properties.number === undefined ? "" : ` ${properties.number}`;
      features.set(`${name}${owner}${number}`, feature);
    }
    const key = [...features].map(([name, feature]) => `${name} ${facts(feature)}`).join("\n");
    if (key === this.shown.zones) return;
    this.shown.zones = key;
    const items = [...features].map(([name, feature]) => {
      const item = element("li");
      const swatch = element("span", `swatch ${classOf(feature)}`);
      item.append(swatch, element("span", "name", name), element("span", "facts", ` ${facts(feature)}`));
      return item;
    });
    this.zones.replaceChildren(...items);
    if (items.length === 0) this.empty(this.zones, "No zones or areas.");
  }

  /** Shows the entries of the legend whose class the map contains. */
  private showLegend(time: number): void {
    const classes = new Set(this.model.features(time).map(classOf));
    if (this.model.linksAt(time).length > 0) classes.add("link");
    const drones = [...this.model.drones.values()];
    if (drones.some((drone) => (drone.fixes.values[0]?.time_ms ?? Infinity) < drone.flightStart(time) - MAX_GAP_MS)) classes.add("earlier");
    for (const entry of this.legend) entry.hidden = !classes.has(entry.dataset["class"]!);
  }

  /** Shows the section of a list. The section stays hidden until the source has sent such a list. */
  private showSection<T>(id: string, values: T[] | undefined, createItem: (value: T) => HTMLLIElement, empty: string): void {
    const key = values === undefined ? "" : JSON.stringify(values);
    if (key === this.shown[id] || values === undefined) return;
    this.shown[id] = key;
    byId(`${id}-section`).hidden = false;
    if (values.length > 0) byId(id).replaceChildren(...values.map(createItem));
    else this.empty(byId(id), empty);
  }

  private showPictures(time: number): void {
    const pictures = this.model.pictures(time, MAX_PICTURES);
    const key = pictures.map((picture) => picture.id).join(" ");
    if (key === this.shown.pictures && key) return;
    this.shown.pictures = key;
    if (pictures.length === 0) return this.empty(this.pictures, "No pictures yet.");
    const items = pictures.map((picture) => {
      const item = element("li");
      const link = element("a");
      link.href = `/pictures/${picture.id}`;
      link.target = "_blank";
      const image = element("img");
      image.src = `/thumbnails/${picture.id}`;
      image.alt = `Picture that ${picture.drone} took at ${clock(picture.time_ms)}`;
      image.width = 160;
      image.height = 90;
      link.append(image);
      item.append(link, element("span", "facts", `${picture.drone} ${clock(picture.time_ms)}`));
      return item;
    });
    this.pictures.replaceChildren(...items);
  }

  private showLog(time: number): void {
    if (!this.log.closest("details")?.open) return;
    const notes = this.model.notes.values.slice(0, this.model.notes.count(time)).slice(-MAX_NOTES);
    const key = `${notes.length} ${notes[0]?.time_ms} ${notes.at(-1)?.time_ms}`;
    if (key === this.shown.log) return;
    this.shown.log = key;
    this.log.replaceChildren(...notes.reverse().map((note: Note) => element("li", "", `${clock(note.time_ms)} ${note.drone}: ${note.text}`)));
  }

  private empty(list: HTMLElement, text: string): void {
    if (list.querySelector(".empty") === null || list.textContent !== text) list.replaceChildren(element("li", "empty", text));
  }
}
