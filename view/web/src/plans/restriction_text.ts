// Describes restrictions to people.

import { timeOf } from "./times";
import type { ActiveTime, AltitudeBand, PolicySpec, Restriction } from "./types";

/** Classes of restrictions. Their names are those of colours of the style sheet. */
export type RestrictionClass = "exclusion" | "pictures" | "limit" | "methods";

/** Altitude references. */
export const REFERENCES: Record<string, string> = { home: "above home", amsl: "above sea level", terrain: "above the ground" };

/** Meanings of repair actions. */
export const ACTIONS: Record<string, string> = {
  ignore: "refuse the request",
  adjust: "correct the request",
  hover: "stop and hover",
  land: "land where the drone is",
  returnToLaunch: "fly home",
  abort: "withdraw all rights, and land at a place",
  revoke: "withdraw all rights, and fly home",
  enforce: "correct the value",
  refuse: "refuse",
  black: "black picture",
  blurAverage: "blur by averages",
  blurMedian: "blur by medians",
  blurFaces: "blur faces",
  removeBackground: "remove the background",
};

export function classOf({ type }: PolicySpec): RestrictionClass {
  if (type === "GeofenceControl") return "exclusion";
  if (type === "PrivacyControl") return "pictures";
  return type === "LimitControl" ? "limit" : "methods";
}

/** Returns the rule, for example "no flights". */
export function ruleOf(policy: PolicySpec): string {
  switch (classOf(policy)) {
    case "exclusion":
      return "no flights";
    case "pictures":
      return policy.action === "refuse" ? "no pictures" : `pictures: ${actionName(policy.action ?? "")}`;
    case "limit":
      return policy.kind === "speed" ? `speed ${limits(policy, "m/s")}` : `altitude ${limits(policy, "m")} ${REFERENCES[policy.altitudeReference ?? "home"]}`;
    case "methods":
      return `denied: ${(policy.methods ?? []).join(", ")}`;
  }
}

export function actionName(action: string): string {
  return ACTIONS[action] ?? action;
}

function limits({ lowerLimit, upperLimit }: PolicySpec, unit: string): string {
  const lower = typeof lowerLimit === "number" ? `at least ${lowerLimit} ${unit}` : "";
  const upper = typeof upperLimit === "number" ? `at most ${upperLimit} ${unit}` : "";
  return [lower, upper].filter(Boolean).join(", ");
}

export function bandOf(band: AltitudeBand | null | undefined): string {
  const lower = typeof band?.lower === "number" ? `from ${band.lower} m` : "";
  const upper = typeof band?.upper === "number" ? `up to ${band.upper} m` : "";
  return lower || upper ? `${[lower, upper].filter(Boolean).join(" ")} ${REFERENCES[band?.reference ?? "home"]}` : "all altitudes";
}

/** Returns when a restriction applies. */
export function validityOf({ policy, zone }: Restriction): string {
  const from = policy.validFrom ? `from ${timeOf(policy.validFrom)}` : "";
  const until = policy.validUntil ? `until ${timeOf(policy.validUntil)}` : "";
  const window = [from, until].filter(Boolean).join(" ") || "at any time";
  const times = (zone?.schedule ?? []).map(activeTime);
  return times.length > 0 ? `${window}, only ${times.join(", or ")}` : window;
}

function activeTime({ days = [], start, end }: ActiveTime): string {
  return [days.join(", ") || "every day", start && end ? `${start} to ${end} UTC` : ""].filter(Boolean).join(" ");
}

/** Returns true if a restriction is valid at some moment between two times in Unix milliseconds. Schedules are not considered. */
export function isValidBetween({ policy }: Restriction, begin: number, end: number): boolean {
  const from = policy.validFrom ? Date.parse(policy.validFrom) : -Infinity;
  const until = policy.validUntil ? Date.parse(policy.validUntil) : Infinity;
  return from <= end && begin < until;
}

/** Returns the state of a restriction at a time in Unix milliseconds. */
export function stateOf(restriction: Restriction, now: number): "Planned" | "In force" | "Ended" {
  if (isValidBetween(restriction, now, now)) return "In force";
  const until = restriction.policy.validUntil;
  return until && Date.parse(until) <= now ? "Ended" : "Planned";
}
