// Converts values to text for people.

import type { Feature, FeatureProperties, Verdict } from "./events";

type ZoneUse = NonNullable<FeatureProperties["uses"]>[number];

const KIND_NAMES: Record<string, string> = {
  operationArea: "operation area",
  corridor: "corridor",
  path: "planned path",
  depot: "depot",
  edgeNode: "edge node",
};

const USES: Record<ZoneUse, { name: string; class: ZoneClass }> = {
  exclusion: { name: "exclusion zone", class: "exclusion" },
  noPictures: { name: "no pictures", class: "pictures" },
  inclusion: { name: "inclusion zone", class: "inclusion" },
  denial: { name: "methods denied", class: "methods" },
  pictureFilter: { name: "pictures filtered", class: "pictures" },
  altitudeLimit: { name: "altitude limit", class: "limit" },
  speedLimit: { name: "speed limit", class: "limit" },
  grant: { name: "methods permitted only here", class: "methods" },
};

/** Classes of zones, in the order in which the map draws them. The class `zone` means no policy, or an unknown use. */
export const ZONE_CLASSES = ["zone", "methods", "limit", "pictures", "inclusion", "exclusion"] as const;
export type ZoneClass = (typeof ZONE_CLASSES)[number];

/** Kinds of areas with altitude limits. */
const KINDS_WITH_ALTITUDE = new Set(["zone", "operationArea", "corridor"]);

const REFERENCES: Record<string, string> = { home: "above home", amsl: "above sea level", terrain: "above ground" };

const ACTIONS: Record<string, string> = {
  allow: "allowed",
  correct: "corrected",
  deny: "refused",
  takeover: "taken over",
  alarm: "alarm",
};

/** Class of a feature, which determines its colour. For a zone, it is the class of its most restrictive use. */
export function classOf(feature: Feature): string {
  const { kind, uses } = feature.properties;
  const use = uses?.[0];
  return use === undefined ? kind : USES[use].class;
}

export function kindName(feature: Feature): string {
  const { kind, uses, number } = feature.properties;
  if (kind === "controlPoint") return `control point ${number}`;
  if (kind !== "zone") return KIND_NAMES[kind] ?? kind;
  if (uses === undefined) return "zone";
  return uses.map((use) => USES[use].name).join(", ") || "zone without a policy";
}

/** Kind, altitude limits and state of an area or place. */
export function facts(feature: Feature): string {
  const { kind, state } = feature.properties;
  return [kindName(feature), KINDS_WITH_ALTITUDE.has(kind) ? altitudeLimits(feature) : "", state ?? ""].filter(Boolean).join(", ");
}

export function altitudeLimits(feature: Feature): string {
  const band = feature.properties.altitude;
  if (band === undefined || (band.lower === undefined && band.upper === undefined)) return "all altitudes";
  const reference = REFERENCES[band.reference ?? "home"] ?? band.reference;
  if (band.upper === undefined) return `from ${band.lower} m ${reference}`;
  return `${band.lower ?? "ground"} to ${band.upper} m ${reference}`;
}

export function actionOf(verdict: Pick<Verdict, "action" | "kind">): string {
  const action = verdict.action || verdict.kind;
  return ACTIONS[action] ?? action;
}

/** Returns true if policies changed or refused a call, or took the drone over. */
export function isIntervention(verdict: Verdict): boolean {
  return verdict.kind !== "call" || verdict.action !== "allow";
}

/** Component and method of a call. */
export function callOf(verdict: Partial<Pick<Verdict, "component" | "method">>): string {
  return [verdict.component, verdict.method].filter(Boolean).join(" ");
}

export function sentence(verdict: Verdict): string {
  const call = callOf(verdict);
  const reason = verdict.reason || verdict.code;
  return `${verdict.drone}: ${call ? `${call} ` : ""}${actionOf(verdict)}${reason ? `, ${reason}` : ""}`;
}

/** Time of day in UTC. */
export function clock(time: number): string {
  return new Date(time).toISOString().slice(11, 19);
}

export function dateAndTime(time: number): string {
  return `${new Date(time).toISOString().slice(0, 10)} ${clock(time)} UTC`;
}

export function duration(milliseconds: number): string {
  const seconds = Math.round(milliseconds / 1000);
  return seconds < 60 ? `${seconds} s` : `${Math.floor(seconds / 60)} min ${seconds % 60} s`;
}

/** A number with its unit, or a dash if the number is unknown. */
export function quantity(value: number | null | undefined, digits: number, unit: string): string {
  return value === null || value === undefined ? "–" : `${value.toFixed(digits)} ${unit}`;
}
