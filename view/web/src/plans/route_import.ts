// Points of GeoJSON files and of QGroundControl plans.

import type { Position } from "./types";

const NAV_WAYPOINT = 16;
const NAV_RETURN_TO_LAUNCH = 20;
const NAV_TAKEOFF = 22;
const FRAME_GLOBAL_RELATIVE_ALT = 3;
const MAX_POINTS = 1_000;

interface MissionItem {
  type?: string;
  command?: number;
  frame?: number;
  params?: (number | null)[];
}

/** Returns the points of a file. Throws an Error with a sentence if the page cannot use the file. */
export function importedPoints(text: string): Position[] {
  let content: unknown;
  try {
    content = JSON.parse(text);
  } catch {
    throw new Error("The file is not JSON. Export it as GeoJSON or as a QGroundControl plan.");
  }
  const plan = content as { fileType?: string; mission?: { items?: MissionItem[] } } | null;
  const points = plan?.fileType === "Plan" ? missionPoints(list(plan.mission?.items) as MissionItem[]) : geometryPoints(content);
  if (points.length === 0) throw new Error("The file contains no points.");
  if (points.length > MAX_POINTS) throw new Error(`The file contains ${points.length} points. A plan may have ${MAX_POINTS}.`);
  for (const { lat, lon, alt } of points) {
    const valid = Math.abs(lat) <= 90 && Math.abs(lon) <= 180 && (alt === undefined || Number.isFinite(alt));
    if (!valid) throw new Error(`The file contains the position ${lat}, ${lon}, ${alt ?? "without altitude"}, which does not exist.`);
  }
  return points;
}

function missionPoints(items: MissionItem[]): Position[] {
  const points: Position[] = [];
  for (const [index, { type, command, frame, params }] of items.entries()) {
    if (command === NAV_TAKEOFF || command === NAV_RETURN_TO_LAUNCH) continue;
    if (type !== "SimpleItem" || command !== NAV_WAYPOINT) {
      throw new Error(`Item ${index + 1} of the mission is not a waypoint. Only waypoints, a takeoff and a return are supported.`);
    }
    if (frame !== FRAME_GLOBAL_RELATIVE_ALT) {
      throw new Error(`The altitude of item ${index + 1} of the mission is not relative to home. Change its altitude frame in QGroundControl.`);
    }
    points.push({ lat: number(params?.[4]), lon: number(params?.[5]), alt: number(params?.[6]) });
  }
  return points;
}

function geometryPoints(content: unknown): Position[] {
  const object = content as { type?: string; features?: unknown[]; geometry?: unknown; coordinates?: unknown } | null;
  switch (object?.type) {
    case "FeatureCollection":
      if (object.features?.length !== 1) throw new Error("The file contains several features, or none. Export a single one.");
      return geometryPoints(object.features[0]);
    case "Feature":
      return geometryPoints(object.geometry);
    case "LineString":
      return list(object.coordinates).map(point);
    case "Polygon": {
      const rings = list(object.coordinates);
      if (rings.length !== 1) throw new Error("The region has holes. Regions with holes are not supported.");
      // The last position of a ring repeats the first one.
      return list(rings[0]).slice(0, -1).map(point);
    }
    case "Point":
      return [point(object.coordinates)];
    default:
      throw new Error("The file contains no point, line or polygon, and is no QGroundControl plan.");
  }
}

function point(position: unknown): Position {
  const [lon, lat, height] = list(position);
  if (height) throw new Error("The file contains heights above the ellipsoid, which are not altitudes of a flight. Remove them.");
  return { lat: number(lat), lon: number(lon) };
}

function list(value: unknown): unknown[] {
  if (!Array.isArray(value)) throw new Error("The coordinates of the file are incomplete. Export it again.");
  return value;
}

/** Returns NaN for everything that is not a number. */
function number(value: unknown): number {
  return typeof value === "number" ? value : NaN;
}
