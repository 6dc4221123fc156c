// Stores all received events in order of time, so that the page can show any past time.

import type { Applications, Areas, Contact, Event, Feature, Fix, Link, Links, Note, Picture, PictureSource, Policies, Problem, Records, State, Verdict } from "./events";

const MAX_FIXES = 20_000;
const MAX_EVENTS = 5_000;
const MAX_PICTURES = 200;
const MAX_LISTS = 1_000;
const MAX_VERSIONS = 100;
/** Maximum time between two positions that a line connects. */
export const MAX_GAP_MS = 10_000;
/** Time without a report after which a drone is drawn pale. On the ground, a drone may report only every 30 s. */
const STALE_AFTER_MS = 45_000;

/** Phases in which a drone does not fly. A drone that last reported from the air may still be flying. */
const GROUND_PHASES = new Set(["on the ground", "charging", "not reporting", "not reporting, last on the ground", "not reporting, last charging"]);

/** Values in order of time. A full series drops every second value of its older half (`thin`), or its older half. */
export class Series<T extends { time_ms: number }> {
  readonly values: T[] = [];

  constructor(
    private readonly capacity: number,
    private readonly thin = false,
  ) {}

  add(value: T): void {
    let index = this.values.length;
    while (index > 0 && this.values[index - 1]!.time_ms > value.time_ms) index--;
    this.values.splice(index, 0, value);
    if (this.values.length > this.capacity) this.shrink();
  }

  /** Number of values up to a time. */
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

  /** Latest value up to a time. */
  at(time: number): T | undefined {
    return this.values[this.count(time) - 1];
  }

  private shrink(): void {
    const half = this.values.length >> 1;
    const older = this.values.splice(0, half);
    if (this.thin) this.values.unshift(...older.filter((_, index) => index % 2 === 0));
  }
}

export interface DronePosition {
  lat: number;
  lon: number;
  heading: number | null;
  /** Time of the latest reported position. */
  reported: number;
}

export class Drone {
  readonly fixes = new Series<Fix>(MAX_FIXES, true);
  readonly states = new Series<State>(MAX_EVENTS, true);
  readonly pictures = new Series<Picture>(MAX_PICTURES);

  constructor(readonly name: string) {}

  /** Returns true if the drone had not reported for `STALE_AFTER_MS` at a time. */
  isStale(time: number): boolean {
    const state = this.states.at(time);
    if (state?.seen_ms != null) return time - state.seen_ms > STALE_AFTER_MS;
    const reported = Math.max(state?.time_ms ?? -Infinity, this.fixes.at(time)?.time_ms ?? -Infinity);
    return time - reported > STALE_AFTER_MS;
  }

  /** Start of the flight that is current or latest at a time. Minus infinity if there was none. */
  flightStart(time: number): number {
    return this.states.at(time)?.flight_ms ?? -Infinity;
  }

  isFlying(time: number): boolean {
    const phase = this.states.at(time)?.phase;
    return phase !== undefined && !GROUND_PHASES.has(phase);
  }

  /** Position at a time, interpolated between the positions before and after it. */
  position(time: number): DronePosition | undefined {
    const count = this.fixes.count(time);
    const before = this.fixes.values[count - 1];
    if (before === undefined) return undefined;
    const after = this.fixes.values[count];
    const position = { lat: before.lat, lon: before.lon, heading: before.heading_deg, reported: before.time_ms };
    if (after !== undefined && after.time_ms - before.time_ms < MAX_GAP_MS && after.time_ms > before.time_ms) {
      const share = (time - before.time_ms) / (after.time_ms - before.time_ms);
      position.lat += (after.lat - before.lat) * share;
      position.lon += (after.lon - before.lon) * share;
      if (before.heading_deg !== null && after.heading_deg !== null) {
        const turn = ((after.heading_deg - before.heading_deg + 540) % 360) - 180;
        position.heading = before.heading_deg + turn * share;
      }
    }
    return position;
  }
}

export class Model {
  readonly drones = new Map<string, Drone>();
  readonly verdicts = new Series<Verdict>(MAX_EVENTS);
  readonly notes = new Series<Note>(MAX_EVENTS);
  readonly problems: Problem[] = [];
  readonly applications = new Series<Applications>(MAX_LISTS);
  readonly policies = new Series<Policies>(MAX_VERSIONS);
  private readonly links = new Series<Links>(MAX_LISTS);
  contact: Contact | undefined;
  records: Records | undefined;
  pictureSource: PictureSource | undefined;
  private readonly areas = new Map<string, Series<Areas>>();
  /** Time of the first and of the last event. */
  begin = Infinity;
  end = -Infinity;

  add(event: Event): void {
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
      case "records":
        this.records = event;
        return;
      case "picturesource":
        this.pictureSource = event;
        return;
      case "picture":
        return this.drone(event.drone).pictures.add(event);
      case "verdict":
        return this.verdicts.add(event);
      case "note":
        return this.notes.add(event);
      case "areas": {
        const versions = this.areas.get(event.origin) ?? new Series<Areas>(MAX_VERSIONS);
        this.areas.set(event.origin, versions);
        return versions.add(event);
      }
      case "problem":
        this.problems.push(event);
    }
  }

  /** Zones and areas at a time. Before the first version was received, the first version is returned. */
  features(time: number): Feature[] {
    return [...this.areas.values()].flatMap((versions) => (versions.at(time) ?? versions.values[0])?.features ?? []);
  }

  linksAt(time: number): Link[] {
    return this.links.at(time)?.links ?? [];
  }

  /** Pictures taken up to a time, newest first. */
  pictures(time: number, limit: number): Picture[] {
    const pictures = [...this.drones.values()].flatMap((drone) => drone.pictures.values.slice(0, drone.pictures.count(time)));
    return pictures.sort((a, b) => b.time_ms - a.time_ms).slice(0, limit);
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
