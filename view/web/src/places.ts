// Zones and policies at a place.

import type { Feature, Policy } from "./events";
import type { Model } from "./model";

type Ring = [number, number][];

/** Returns true if a ring contains a point: if a ray from the point to the east crosses it an odd number of times. */
function ringContains(ring: Ring, lon: number, lat: number): boolean {
  let inside = false;
  ring.forEach(([x, y], index) => {
    const [previousX, previousY] = ring.at(index - 1)!;
    if (y > lat !== previousY > lat && lon < x + ((previousX - x) * (lat - y)) / (previousY - y)) inside = !inside;
  });
  return inside;
}

/** Returns true if the area of a feature contains a point, at any altitude. */
function contains({ geometry }: Feature, lon: number, lat: number): boolean {
  let polygons: Ring[][] = [];
  if (geometry.type === "Polygon") polygons = [geometry.coordinates as Ring[]];
  if (geometry.type === "MultiPolygon") polygons = geometry.coordinates as Ring[][];
  return polygons.some(([outer, ...holes]) => ringContains(outer!, lon, lat) && !holes.some((hole) => ringContains(hole, lon, lat)));
}

export function zonesAt(model: Model, time: number, lon: number, lat: number): Feature[] {
  return model.features(time).filter((feature) => feature.properties.kind === "zone" && contains(feature, lon, lat));
}

/** Sentence about the policies that apply at a place. Undefined if the source does not contain policies. */
export function policiesAt(model: Model, time: number, lon: number, lat: number): string | undefined {
  const policies = model.policies.at(time)?.policies;
  if (policies === undefined) return undefined;
  const zones = new Set(zonesAt(model, time, lon, lat).map((zone) => zone.properties.name));
  const here = (policy: Policy) => policy.zones.length === 0 || policy.zones.some((name) => zones.has(name));
  const names = policies.filter(here).map((policy) => policy.name);
  if (names.length === 0) return "no policy restricts this place";
  return `${names.length > 1 ? "policies" : "policy"} here: ${names.join(", ")}`;
}
