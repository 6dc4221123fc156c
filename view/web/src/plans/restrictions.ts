// Restrictions: list, and for an authority the form with impact, publication, change and deletion.

import { byId, element, setText } from "../elements";
import { type Api, Problem, type Reply } from "./api";
import { differences, mergePatch } from "./differences";
import type { MapClicks } from "./map_clicks";
import type { PlanMap } from "./plan_map";
import { RestrictionForm } from "./restriction_form";
import { RestrictionList } from "./restriction_list";
import { type RestrictionClass, classOf, isValidBetween } from "./restriction_text";
import { areaFeatures, pointFeature, routeFeatures } from "./shapes";
import { timeOf } from "./times";
import type { Impact, NewRestriction, Restriction } from "./types";

const READER_ROLES = "fractus-policy-viewer and fractus-zone-viewer";
const EDITOR_ROLES = "fractus-policy-editor and fractus-zone-editor";
const IMPACT_ROLES = "fractus-flightplan-viewer, fractus-drone-viewer and fractus-grant-viewer";
const CLASSES: RestrictionClass[] = ["methods", "limit", "pictures", "exclusion"];

/** The parts of the page that restrictions use. */
export interface Surroundings {
  api(): Api | undefined;
  map(): PlanMap | undefined;
  clicks: MapClicks;
  /** Returns a sentence about an error, or undefined if the page has signed out because of it. */
  explain(error: unknown): string | undefined;
}

export class Restrictions {
  private items: Restriction[] = [];
  private readable = true;
  private mayPublish = false;
  /** Time in which restrictions are shown, in Unix milliseconds. Undefined: at any time. */
  private window: [number, number] | undefined;
  /** Restriction that the form changes, with the version that the user has seen. Undefined: the form publishes a new one. */
  private changed: { seen: Restriction; etag: string } | undefined;
  /** Entered restriction whose impact is shown, as JSON. */
  private compared = "";
  private busy = false;
  private readonly form: RestrictionForm;
  private readonly list: RestrictionList;
  private readonly publish = byId<HTMLButtonElement>("publish");

  constructor(private readonly page: Surroundings) {
    this.form = new RestrictionForm(page.clicks, () => this.edited(), () => page.map()?.fit(this.entered()));
    this.list = new RestrictionList({
      show: (restriction) => this.select(restriction),
      change: (restriction) => void this.beginChange(restriction),
      end: (restriction) => {
        if (confirm(`End ${restriction.name} now? Flights do not obey it any more.`)) void this.end(restriction);
      },
      remove: (restriction) => {
        if (confirm(`Delete ${restriction.name}? Flights do not obey it any more.`)) void this.remove(restriction);
      },
    });
    byId("restriction").addEventListener("submit", (event) => {
      event.preventDefault();
      void this.submit();
    });
    byId("impact").addEventListener("click", () => void this.showImpact());
    byId("keep-restriction").addEventListener("click", () => this.release());
    this.edited();
  }

  /** Shows if the user may publish restrictions. */
  permit(mayPublish: boolean): void {
    this.mayPublish = mayPublish;
    byId("restriction").hidden = !mayPublish;
    setText(byId("publish-permission"), mayPublish ? "" : `You may not publish restrictions. An administrator can give you the roles ${EDITOR_ROLES}.`);
    this.show();
  }

  /** Reads the restrictions, unless the user may not read them. */
  async load(client: Api): Promise<void> {
    if (!this.readable) return;
    try {
      const items = await client.list<Restriction>("/restrictions");
      if (client !== this.page.api()) return;
      this.items = items;
      this.readable = true;
    } catch (error) {
      if (!(error instanceof Problem) || error.status !== 403) throw error;
      this.items = [];
      this.readable = false;
    }
    this.show();
  }

  /** Shows the restrictions that are valid in a time, in Unix milliseconds. Undefined: all, with buttons to change them. */
  setWindow(window: [number, number] | undefined): void {
    this.window = window;
    this.show();
  }

  /** Forgets all data of the user. */
  clear(): void {
    this.items = [];
    this.readable = true;
    this.release();
    this.show();
  }

  /** Adds a clicked point to the entered area. */
  addPoint(point: { lat: number; lon: number }): void {
    if (this.mayPublish) this.form.addPoint(point);
  }

  /** Returns true if the area of a policy can be shown. */
  has(policy: string): boolean {
    return this.items.some(({ name, zone }) => name === policy && zone);
  }

  /** Shows the area of a policy on the map. */
  showArea(policy: string): void {
    const restriction = this.items.find(({ name }) => name === policy);
    if (restriction !== undefined) this.select(restriction);
  }

  /** Draws the restrictions and the entered area. */
  draw(): void {
    const map = this.page.map();
    if (map === undefined) return;
    const shown = this.shown();
    for (const name of CLASSES) {
      const zones = shown.flatMap(({ policy, zone }) => (zone && classOf(policy) === name ? [zone] : []));
      map.set(name, zones.flatMap(({ area }) => areaFeatures(area)));
    }
    map.set("area", this.window === undefined ? this.entered() : []);
  }

  private shown(): Restriction[] {
    const { window } = this;
    return window === undefined ? this.items : this.items.filter((restriction) => isValidBetween(restriction, ...window));
  }

  private show(): void {
    const none = this.window === undefined ? "No restrictions are published." : "No published restriction is in force during the flight.";
    const empty = this.readable ? none : `You may not read restrictions. An administrator can give you the roles ${READER_ROLES}.`;
    setText(byId("restrictions-title"), this.window === undefined ? "Restrictions" : "Restrictions during the flight");
    this.list.show(this.shown(), this.mayPublish && this.window === undefined, empty);
    this.draw();
  }

  private entered(): GeoJSON.Feature[] {
    const { area, points } = this.form.enteredArea;
    return [...(area ? areaFeatures(area) : routeFeatures(points, true)), ...this.form.landingPlaces.map(pointFeature)];
  }

  private select({ zone }: Restriction): void {
    const features = zone ? areaFeatures(zone.area) : [];
    this.page.map()?.set("selected", features);
    this.page.map()?.fit(features);
  }

  // -- form --

  private edited(): void {
    // The constructor of the form also reports its first values.
    if (this.form === undefined) return;
    this.showObstacle();
    this.draw();
  }

  private showObstacle(): void {
    const { problem } = this.form;
    const seen = problem === "" && JSON.stringify(this.form.content) === this.compared;
    if (!seen) byId("impact-findings").replaceChildren();
    if (!seen) setText(byId("impact-result"), problem || "See the impact before you publish the restriction.");
    byId<HTMLButtonElement>("impact").disabled = problem !== "" || this.busy;
    this.publish.disabled = !seen || this.busy;
    this.publish.textContent = this.changed === undefined ? "Publish the restriction" : "Change the restriction";
    byId("keep-restriction").hidden = this.changed === undefined;
    setText(byId("publish-title"), this.changed === undefined ? "Publish a restriction" : `Change ${this.changed.seen.name}`);
  }

  private async showImpact(): Promise<void> {
    const { content } = this.form;
    await this.act("restriction-problem", async (client) => {
      let text: string;
      let items: HTMLLIElement[] = [];
      try {
        const impact = (await client.send<Impact>("POST", "/restrictions:impact", content)).body;
        text = `${count(impact.plans.length, "plan")} and ${count(impact.flights.length, "flight")} in the air are affected.`;
        items = impactItems(impact);
      } catch (error) {
        if (!(error instanceof Problem) || error.status !== 403) throw error;
        text = `You may not see the impact. An administrator can give you the roles ${IMPACT_ROLES}. You can publish the restriction without it.`;
      }
      if (JSON.stringify(this.form.content) !== JSON.stringify(content)) return;
      this.compared = JSON.stringify(content);
      byId("impact-findings").replaceChildren(...items);
      setText(byId("impact-result"), text);
    });
  }

  private async submit(): Promise<void> {
    if (this.publish.disabled) return;
    const { content } = this.form;
    const target = this.changed;
    await this.act("restriction-problem", async (client) => {
      const reply = target === undefined ? await client.send<Restriction>("POST", "/restrictions", content) : await this.change(client, target, content);
      if (reply === undefined) return;
      this.put(reply.body);
      // The user has left the form, or has edited it meanwhile, so that it still changes the restriction.
      if (this.changed !== target) return;
      if (target !== undefined && JSON.stringify(this.form.content) !== JSON.stringify(content)) {
        this.changed = { seen: reply.body, etag: reply.etag };
        return;
      }
      this.release();
      byId("restrictions-title").focus();
    });
  }

  /** Changes a restriction. Returns undefined if another user has changed it, and shows the differences. */
  private async change(client: Api, target: { seen: Restriction; etag: string }, content: NewRestriction): Promise<Reply<Restriction> | undefined> {
    const { name, zone, policy } = target.seen;
    const patch = mergePatch({ zone: zone ?? {}, policy }, { zone: content.zone, policy: content.policy });
    try {
      return await client.send<Restriction>("PATCH", `/restrictions/${name}`, patch, { "If-Match": target.etag });
    } catch (error) {
      if (!(error instanceof Problem) || error.status !== 412) throw error;
    }
    const present = await this.read(client, name);
    if (this.changed !== target) return undefined;
    this.changed = { seen: present.body, etag: present.etag };
    const { name: _name, ...mine } = content;
    const text = differences(contentOf(present.body), mine) || "both versions are equal";
    setText(byId("restriction-problem"), `Another user changed the restriction meanwhile: ${text}. To replace that version by yours, press “Change the restriction” again.`);
    return undefined;
  }

  private async beginChange(restriction: Restriction): Promise<void> {
    await this.act("restrictions-problem", async (client) => {
      const { body, etag } = await this.read(client, restriction.name);
      this.form.show(body);
      this.changed = { seen: body, etag };
      this.select(body);
      setText(byId("restriction-problem"), "");
      byId("publish-title").focus();
    });
  }

  private release(): void {
    this.changed = undefined;
    this.compared = "";
    setText(byId("restriction-problem"), "");
    this.page.map()?.set("selected", []);
    this.form.reset();
    this.edited();
  }

  // -- list --

  private async end(restriction: Restriction): Promise<void> {
    await this.actOnSeen(restriction, async (client, etag) => {
      const patch = { policy: { validUntil: new Date().toISOString() } };
      this.put((await client.send<Restriction>("PATCH", `/restrictions/${restriction.name}`, patch, { "If-Match": etag })).body);
    });
  }

  private async remove(restriction: Restriction): Promise<void> {
    await this.actOnSeen(restriction, async (client, etag) => {
      await client.send("DELETE", `/restrictions/${restriction.name}`, undefined, { "If-Match": etag });
      this.items = this.items.filter(({ name }) => name !== restriction.name);
      if (this.changed?.seen.name === restriction.name) this.release();
    });
  }

  /** Runs an action on the version of a restriction that the user has seen in the list. */
  private async actOnSeen(restriction: Restriction, action: (client: Api, etag: string) => Promise<void>): Promise<void> {
    await this.act("restrictions-problem", async (client) => {
      const present = await this.read(client, restriction.name);
      const text = differences(contentOf(present.body), contentOf(restriction));
      if (text !== "") {
        this.put(present.body);
        setText(byId("restrictions-problem"), `Another user changed ${restriction.name} meanwhile: ${text}. Nothing was done.`);
        return;
      }
      await action(client, present.etag);
    });
  }

  private async read(client: Api, name: string): Promise<{ body: Restriction; etag: string }> {
    return client.send<Restriction>("GET", `/restrictions/${name}`);
  }

  private put(restriction: Restriction): void {
    this.items = [...this.items.filter(({ name }) => name !== restriction.name), restriction].toSorted((a, b) => a.name.localeCompare(b.name));
  }

  /** Runs an action, and shows its error as a sentence. */
  private async act(problem: string, action: (client: Api) => Promise<void>): Promise<void> {
    const client = this.page.api();
    if (client === undefined || this.busy) return;
    this.busy = true;
    setText(byId(problem), "");
    this.showObstacle();
    try {
      await action(client);
    } catch (error) {
      setText(byId(problem), plain(error) ?? this.page.explain(error) ?? "");
    } finally {
      this.busy = false;
      this.showObstacle();
      this.show();
    }
  }
}

/** Returns a sentence about errors whose sentence of the server names no remedy, or undefined. */
function plain(error: unknown): string | undefined {
  if (!(error instanceof Problem)) return undefined;
  if (error.status === 403) return `You may not do this. An administrator can give you the roles ${EDITOR_ROLES}. The server says: ${error.message}`;
  if (error.status === 412) return "Another user changed the restriction meanwhile. Nothing was done. Look at it again, and repeat your change.";
  return undefined;
}

function contentOf({ zone, policy }: Restriction): object {
  return { zone, policy };
}

function impactItems({ plans, flights, unreadable }: Impact): HTMLLIElement[] {
  const planned = plans.map(({ namespace, name, state, drone, begin, end }) => `Plan ${namespace}/${name} (${state}${drone ? `, ${drone}` : ""}), ${timeOf(begin)} to ${timeOf(end)}`);
  const flying = flights.map(({ namespace, application, drone }) => `In the air: ${drone} with ${namespace}/${application}`);
  const unknown = unreadable.map((object) => `Not compared, because it is invalid: ${object}`);
  return [...flying, ...planned, ...unknown].map((text) => element("li", "", text));
}

function count(number: number, noun: string): string {
  return `${number} ${noun}${number === 1 ? "" : "s"}`;
}
