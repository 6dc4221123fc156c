// What the map shows, and more, as lists.

import type { Application, Feature, Link, Note, Policy, Verdict } from "./events";
import type { Drone, Model } from "./model";
import { actionOf, clock, decided, facts, kindName, quantity, sentence } from "./words";

const MAX_VERDICTS = 200;
const MAX_NOTES = 200;
const MAX_PICTURES = 6;

export interface Actions {
  select(drone: string): void;
  seek(time: number): void;
}

function element<K extends keyof HTMLElementTagNameMap>(tag: K, kind = "", text = ""): HTMLElementTagNameMap[K] {
  const made = document.createElement(tag);
  if (kind) made.className = kind;
  if (text) made.textContent = text;
  return made;
}

export function byId<T extends HTMLElement>(id: string): T {
  return document.getElementById(id) as T;
}

function setText(target: HTMLElement, text: string): void {
  if (target.textContent !== text) target.textContent = text;
}

function applicationItem(one: Application): HTMLLIElement {
  const item = element("li");
  const head = element("p", "head");
  const phase = element("span", "badge", one.phase);
  phase.dataset["phase"] = one.phase;
  head.append(element("span", "name", one.name), phase, element("span", "facts", one.drone));
  item.append(head, element("p", "facts", [one.reason, one.text].filter(Boolean).join(": ")));
  return item;
}

function linkItem(one: Link): HTMLLIElement {
  const item = element("li");
  const head = element("p", "head");
  const phase = element("span", "badge", one.phase);
  phase.dataset["phase"] = one.phase;
  head.append(element("span", "name", `${one.drone} – ${one.node}`), phase);
  const traffic = one.traffic ? `traffic ${one.traffic === "direct" ? "over the link" : "by the cloud"}` : "";
  item.append(head, element("p", "facts", [traffic, one.text || one.reason].filter(Boolean).join(" · ")));
  return item;
}

function policyItem(one: Policy): HTMLLIElement {
  const item = element("li");
  const where = one.zones.length > 0 ? `in ${one.zones.join(", ")}` : "everywhere";
  item.append(element("span", "name", one.name), element("span", "facts", ` ${one.text}; ${where}`));
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

  show(time: number, selected: string): void {
    this.showDrones(time, selected);
    this.showVerdicts(time);
    this.showZones(time);
    const model = this.model;
    // A cluster tells of no calls, pictures or logs: an empty list would say that there were none.
    const silent = model.contact !== undefined && model.verdicts.values.length === 0;
    for (const id of ["verdicts", "pictures", "log"]) byId(`${id}-section`).hidden = silent;
    this.showSection("applications", model.applications.at(time)?.applications, applicationItem, "No application.");
    this.showSection("links", model.linksAt(time), linkItem, "No direct link.");
    this.showSection("policies", model.policies.at(time)?.policies, policyItem, "No policy: without one nothing is allowed.");
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
    if (this.rows.size === 0) this.empty(this.drones, "No drone was heard of yet.");
    else this.drones.querySelector(".empty")?.remove();
  }

  private showDrone(drone: Drone, time: number, selected: string): void {
    const row = this.rows.get(drone.name) ?? this.makeRow(drone.name);
    const state = drone.states.at(time);
    const battery = state?.battery;
    const said = [
      `battery ${quantity(battery === null || battery === undefined ? null : battery * 100, 0, "%")}`,
      `altitude ${quantity(state?.altitude_m, 1, "m")}`,
      `speed ${quantity(state?.speed_mps, 1, "m/s")}`,
      `controller ${state?.controller || "–"}`,
      ...(state?.mode ? [`mode ${state.mode}`] : []),
      ...(drone.stale(time) ? [`last heard of at ${state?.seen_ms ? clock(state.seen_ms) : "–"}`] : []),
    ];
    setText(row.phase, state?.phase ?? "not heard of");
    row.phase.dataset["phase"] = state?.phase ?? "";
    setText(row.facts, said.join(" · "));
    row.item.classList.toggle("stale", drone.stale(time));
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
    // By name, however they come.
    const later = [...this.rows.keys()].filter((other) => other > name).sort()[0];
    this.drones.insertBefore(row.item, later === undefined ? null : this.rows.get(later)!.item);
    return row;
  }

  private showVerdicts(time: number): void {
    const all = this.filter.value === "all";
    const until = this.model.verdicts.values.slice(0, this.model.verdicts.count(time));
    const found = (all ? until : until.filter(decided)).slice(-MAX_VERDICTS);
    this.announce(found.filter(decided));
    const key = `${this.filter.value} ${found.length} ${found[0]?.time_ms} ${found.at(-1)?.time_ms}`;
    if (key === this.shown.verdicts) return;
    this.shown.verdicts = key;
    this.verdicts.replaceChildren(...found.reverse().map((verdict) => this.verdictItem(verdict)));
    if (found.length === 0) this.empty(this.verdicts, all ? "No call yet." : "Policies changed nothing yet.");
  }

  private verdictItem(verdict: Verdict): HTMLLIElement {
    const item = element("li", `verdict ${verdict.action || verdict.kind}`);
    const at = element("button", "time", clock(verdict.time_ms));
    at.type = "button";
    at.setAttribute("aria-label", `${clock(verdict.time_ms)}: show this moment`);
    at.addEventListener("click", () => this.actions.seek(verdict.time_ms));
    const asked = [verdict.component, verdict.method].filter(Boolean).join(" ");
    const head = element("p", "head");
    head.append(at, element("span", "badge", actionOf(verdict)), element("span", "", `${verdict.drone} ${asked}`));
    item.append(head);
    if (verdict.reason || verdict.code) item.append(element("p", "facts", verdict.reason || verdict.code));
    if (verdict.policies.length > 0) {
      item.append(element("p", "facts", `${verdict.policies.length > 1 ? "policies" : "policy"} ${verdict.policies.join(", ")}`));
    }
    return item;
  }

  /** Say what is new to who does not see it; going back in time says nothing. */
  private announce(found: Verdict[]): void {
    const latest = found.at(-1);
    const before = this.announced;
    this.announced = latest?.time_ms ?? -Infinity;
    if (latest === undefined || latest.time_ms <= before) return;
    const count = found.filter((one) => one.time_ms > before).length;
    setText(this.announcer, count === 1 ? sentence(latest) : `${count} new verdicts, the latest: ${sentence(latest)}`);
  }

  private showZones(time: number): void {
    const lines = new Map<string, Feature>();
    for (const one of this.model.features(time)) {
      const owner = one.properties.component ? ` of ${one.properties.component}` : "";
      const name = one.properties.name === one.properties.kind ? kindName(one) : one.properties.name;
      lines.set(`${name}${owner}`, one);
    }
    const key = [...lines].map(([name, one]) => `${name} ${facts(one)}`).join("\n");
    if (key === this.shown.zones) return;
    this.shown.zones = key;
    const items = [...lines].map(([name, one]) => {
      const item = element("li");
      const swatch = element("span", `swatch ${one.properties.kind}`);
      item.append(swatch, element("span", "name", name), element("span", "facts", ` ${facts(one)}`));
      return item;
    });
    this.zones.replaceChildren(...items);
    if (items.length === 0) this.empty(this.zones, "No zone or area is known.");
  }

  /** A list that is only there where something tells of such things. */
  private showSection<T>(id: string, found: T[] | undefined, item: (one: T) => HTMLLIElement, empty: string): void {
    const key = found === undefined ? "" : JSON.stringify(found);
    if (key === this.shown[id] || found === undefined) return;
    this.shown[id] = key;
    byId(`${id}-section`).hidden = false;
    if (found.length > 0) byId(id).replaceChildren(...found.map(item));
    else this.empty(byId(id), empty);
  }

  private showPictures(time: number): void {
    const found = this.model.pictures(time, MAX_PICTURES);
    const key = found.map((picture) => picture.id).join(" ");
    if (key === this.shown.pictures && key) return;
    this.shown.pictures = key;
    if (found.length === 0) return this.empty(this.pictures, "No picture was taken yet.");
    const items = found.map((picture) => {
      const item = element("li");
      const link = element("a");
      link.href = `/pictures/${picture.id}`;
      link.target = "_blank";
      const image = element("img");
      image.src = link.href;
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
    const found = this.model.notes.values.slice(0, this.model.notes.count(time)).slice(-MAX_NOTES);
    const key = `${found.length} ${found[0]?.time_ms} ${found.at(-1)?.time_ms}`;
    if (key === this.shown.log) return;
    this.shown.log = key;
    this.log.replaceChildren(...found.reverse().map((note: Note) => element("li", "", `${clock(note.time_ms)} ${note.drone}: ${note.text}`)));
  }

  private empty(list: HTMLElement, text: string): void {
    if (list.querySelector(".empty") === null || list.textContent !== text) list.replaceChildren(element("li", "empty", text));
  }
}
