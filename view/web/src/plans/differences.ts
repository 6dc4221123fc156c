// Differences between two versions of an object, as a sentence and as a merge patch.

/** Returns the values that differ between the present version and the version of the user, or an empty text. */
export function differences(present: object, mine: object): string {
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

/** Returns the JSON merge patch (RFC 7396) that turns an object into another one. */
export function mergePatch(before: object, after: object): Record<string, unknown> {
  const removed = Object.keys(before).filter((name) => !(name in after));
  const patch: Record<string, unknown> = Object.fromEntries(removed.map((name) => [name, null]));
  for (const [name, value] of Object.entries(after) as [string, unknown][]) {
    const old = (before as Record<string, unknown>)[name];
    patch[name] = isObject(old) && isObject(value) ? mergePatch(old, value) : value;
  }
  return patch;
}

function isObject(value: unknown): value is object {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}
