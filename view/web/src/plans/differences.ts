// Differences between two versions of a plan, as a sentence.

import type { FlightPlanSpec } from "./types";

/** Returns the values that differ between the present version and the version of the user, or an empty text. */
export function differences(present: FlightPlanSpec, mine: FlightPlanSpec): string {
  const [theirs, own] = [values(present), values(mine)];
  const paths = [...new Set([...theirs.keys(), ...own.keys()])].filter((path) => theirs.get(path) !== own.get(path));
  return paths.map((path) => `${path} is now ${theirs.get(path) ?? "unset"}, and ${own.get(path) ?? "unset"} in your version`).join("; ");
}

/** Returns the values by their path, such as window.start. Lists are one value. */
function values(object: object, prefix = ""): Map<string, string> {
  const found = new Map<string, string>();
  for (const [name, value] of Object.entries(object)) {
    if (value === null || value === undefined) continue;
    if (typeof value === "object" && !Array.isArray(value)) for (const entry of values(value, `${prefix}${name}.`)) found.set(...entry);
    else found.set(prefix + name, JSON.stringify(value));
  }
  return found;
}
