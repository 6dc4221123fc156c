// Values as people read them.

import type { Feature, Verdict } from "./events";

const KIND_NAMES: Record<string, string> = {
  zone: "zone",
  operationArea: "operation area",
  corridor: "corridor",
  path: "planned path",
  depot: "depot",
  edgeNode: "edge node",
};

/** What has heights. */
const TALL = new Set(["zone", "operationArea", "corridor"]);

const REFERENCES: Record<string, string> = { home: "above home", amsl: "above sea level", terrain: "above ground" };

const ACTIONS: Record<string, string> = {
  allow: "allowed",
  correct: "corrected",
  deny: "refused",
  takeover: "taken over",
};

export function kindName(feature: Feature): string {
  return KIND_NAMES[feature.properties.kind] ?? feature.properties.kind;
}

/** What is said of something on the map beside its name. */
export function facts(feature: Feature): string {
  const { kind, state } = feature.properties;
  return [kindName(feature), TALL.has(kind) ? band(feature) : "", state ?? ""].filter(Boolean).join(", ");
}

/** The heights that an area has. */
export function band(feature: Feature): string {
  const found = feature.properties.altitude;
  if (found === undefined || (found.lower === undefined && found.upper === undefined)) return "all heights";
  const reference = REFERENCES[found.reference ?? "home"] ?? found.reference;
  if (found.upper === undefined) return `from ${found.lower} m ${reference}`;
  return `${found.lower ?? "ground"} to ${found.upper} m ${reference}`;
}

export function actionOf(verdict: Verdict): string {
  const action = verdict.action || verdict.kind;
  return ACTIONS[action] ?? action;
}

/** Whether policies changed what was asked, or took over. */
export function decided(verdict: Verdict): boolean {
  return verdict.kind !== "call" || verdict.action !== "allow";
}

export function sentence(verdict: Verdict): string {
  const asked = [verdict.component, verdict.method].filter(Boolean).join(" ");
  const why = verdict.reason || verdict.code;
  return `${verdict.drone}: ${asked ? `${asked} ` : ""}${actionOf(verdict)}${why ? `, ${why}` : ""}`;
}

/** Time of day, UTC. */
export function clock(time: number): string {
  return new Date(time).toISOString().slice(11, 19);
}

export function moment(time: number): string {
  return `${new Date(time).toISOString().slice(0, 10)} ${clock(time)} UTC`;
}

export function duration(milliseconds: number): string {
  const seconds = Math.round(milliseconds / 1000);
  return seconds < 60 ? `${seconds} s` : `${Math.floor(seconds / 60)} min ${seconds % 60} s`;
}

/** A number with its unit, or a dash. */
export function quantity(value: number | null | undefined, digits: number, unit: string): string {
  return value === null || value === undefined ? "–" : `${value.toFixed(digits)} ${unit}`;
}
