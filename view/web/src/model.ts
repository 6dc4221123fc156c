// All that was told, in the order of time, so that any moment of it can be shown.

import type { Applications, Areas, Contact, Event, Feature, Fix, Link, Links, Note, Picture, Policies, Problem, State, Verdict } from "./events";

const MAX_FIXES = 20_000;
const MAX_OTHERS = 5_000;
/** Between two positions further apart in time the drone was not seen: no line is drawn. */
export const GAP_MS = 10_000;
/** A drone that was not heard of for so long is drawn pale: on the ground it may report every 30 s. */
const STALE_MS = 45_000;

/** Values in the order of their times; when there are too many, the oldest go, or every second one of the older half. */
export class Series<T extends { time_ms: number }> {
  readonly values: T[] = [];

  constructor(
    private readonly bound: number,
    private readonly thin = false,
  ) {}

  add(value: T): void {
    let place = this.values.length;
    while (place > 0 && this.values[place - 1]!.time_ms > value.time_ms) place--;
    this.values.splice(place, 0, value);
    if (this.values.length > this.bound) this.shrink();
  }

  /** How many are no later than a moment. */
  count(time: number): number {
    let low = 0;
    let high = this.values.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.values[middle]!.time_ms <= time) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /** The last one that is no later than a moment. */
  at(time: number): T | undefined {
    return this.values[this.count(time) - 1];
  }

  private shrink(): void {
    const half = this.values.length >> 1;
    const older = this.values.splice(0, half);
    if (this.thin) this.values.unshift(...older.filter((_, index) => index % 2 === 0));
  }
}

/** One drone. */
export class Drone {
  readonly fixes = new Series<Fix>(MAX_FIXES, true);
  readonly states = new Series<State>(MAX_OTHERS, true);
  readonly pictures = new Series<Picture>(200);

  constructor(readonly name: string) {}

  /** Whether nothing was heard of it for long. */
  stale(time: number): boolean {
    const state = this.states.at(time);
    const heard = Math.max(state?.seen_ms ?? state?.time_ms ?? -Infinity, this.fixes.at(time)?.time_ms ?? -Infinity);
    return time - (state?.seen_ms ?? heard) > STALE_MS;
  }

  /** Where it was at a moment, between the two positions around it. */
  position(time: number): { lat: number; lon: number; heading: number | null; seen: number } | undefined {
    const count = this.fixes.count(time);
    const before = this.fixes.values[count - 1];
    if (before === undefined) return undefined;
    const after = this.fixes.values[count];
    const found = { lat: before.lat, lon: before.lon, heading: before.heading_deg, seen: before.time_ms };
    if (after !== undefined && after.time_ms - before.time_ms < GAP_MS && after.time_ms > before.time_ms) {
      const share = (time - before.time_ms) / (after.time_ms - before.time_ms);
      found.lat += (after.lat - before.lat) * share;
      found.lon += (after.lon - before.lon) * share;
      if (before.heading_deg !== null && after.heading_deg !== null) {
        const turn = ((after.heading_deg - before.heading_deg + 540) % 360) - 180;
        found.heading = before.heading_deg + turn * share;
      }
    }
    return found;
  }
}

/** Everything that was told. */
export class Model {
  readonly drones = new Map<string, Drone>();
  readonly verdicts = new Series<Verdict>(MAX_OTHERS);
  readonly notes = new Series<Note>(MAX_OTHERS);
  readonly problems: Problem[] = [];
  readonly applications = new Series<Applications>(1_000);
  readonly policies = new Series<Policies>(100);
  private readonly links = new Series<Links>(1_000);
  contact: Contact | undefined;
  private readonly areas = new Map<string, Series<Areas>>();
  begin = Infinity;
  end = -Infinity;
  /** Changes with everything that is told. */
  version = 0;

  take(event: Event): void {
    this.version++;
    if (event.time_ms > 0) {
      this.begin = Math.min(this.begin, event.time_ms);
      this.end = Math.max(this.end, event.time_ms);
    }
    switch (event.type) {
      case "fix":
        return this.drone(event.drone).fixes.add(event);
      case "state":
        return this.drone(event.drone).states.add(event);
      case "gone":
        return void this.drones.delete(event.drone);
      case "applications":
        return this.applications.add(event);
      case "links":
        return this.links.add(event);
      case "policies":
        return this.policies.add(event);
      case "contact":
        this.contact = event;
        return;
      case "picture":
        return this.drone(event.drone).pictures.add(event);
      case "verdict":
        return this.verdicts.add(event);
      case "note":
        return this.notes.add(event);
      case "areas": {
        const known = this.areas.get(event.origin) ?? new Series<Areas>(100);
        this.areas.set(event.origin, known);
        return known.add(event);
      }
      case "problem":
        this.problems.push(event);
    }
  }

  /** The zones and areas that hold at a moment; before the first were told, those. */
  features(time: number): Feature[] {
    return [...this.areas.values()].flatMap((known) => (known.at(time) ?? known.values[0])?.features ?? []);
  }

  linksAt(time: number): Link[] {
    return this.links.at(time)?.links ?? [];
  }

  /** All pictures taken by a moment, the newest first. */
  pictures(time: number, most: number): Picture[] {
    const found = [...this.drones.values()].flatMap((drone) => drone.pictures.values.slice(0, drone.pictures.count(time)));
    return found.sort((a, b) => b.time_ms - a.time_ms).slice(0, most);
  }

  private drone(name: string): Drone {
    let drone = this.drones.get(name);
    if (drone === undefined) {
      drone = new Drone(name);
      this.drones.set(name, drone);
    }
    return drone;
  }
}
