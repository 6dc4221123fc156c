// GeoJSON features of routes and areas.
//
// The longitudes of a feature are continuous, so that a feature across the antimeridian is not drawn around the world. They may
// therefore be outside -180 to 180.

import type { Area, FlightPlanSpec, Point, ReservedVolume, TrackPoint } from "./types";

type Coordinates = [number, number];

const CIRCLE_CORNERS = 64;
const M_PER_DEGREE = 111_195;

/** Returns the features of a route: its line or area, and its points. */
export function routeFeatures(points: Point[], isRegion: boolean): GeoJSON.Feature[] {
  const line = continuous(points.filter(({ lat, lon }) => Math.abs(lat) <= 90 && Math.abs(lon) <= 180));
  const corners = line.map((coordinates) => feature({ type: "Point", coordinates }));
  if (line.length < 2) return corners;
  if (isRegion && line.length > 2) return [feature({ type: "Polygon", coordinates: [[...line, line[0]!]] }), ...corners];
  return [feature({ type: "LineString", coordinates: line }), ...corners];
}

/** Returns the route of a specification. */
export function specFeatures(spec: FlightPlanSpec): GeoJSON.Feature[] {
  return spec.region ? areaFeatures(spec.region) : routeFeatures(spec.waypoints ?? [], false);
}

/** Returns the ground areas of volumes. */
export function volumeFeatures(volumes: ReservedVolume[]): GeoJSON.Feature[] {
  return volumes.flatMap(({ areas }) => areas.flatMap(areaFeatures));
}

/** Returns the line of a track through its known positions, and the last of them. */
export function trackFeatures(points: TrackPoint[]): GeoJSON.Feature[] {
  const line = continuous(points.filter(hasPosition));
  const features = line.slice(-1).map((coordinates) => feature({ type: "Point", coordinates }));
  if (line.length > 1) features.push(feature({ type: "LineString", coordinates: line }));
  return features;
}

export function hasPosition(point: TrackPoint): point is TrackPoint & Point {
  return typeof point.lat === "number" && typeof point.lon === "number";
}

export function pointFeature({ lat, lon }: Point): GeoJSON.Feature {
  return feature({ type: "Point", coordinates: [lon, lat] });
}

export function areaFeatures({ circle, polygon }: Area): GeoJSON.Feature[] {
  if (circle) return [feature({ type: "Polygon", coordinates: [closed(circleCorners(circle.center, circle.radius))] })];
  if (!polygon) return [];
  const exterior = continuous(polygon.exterior);
  const holes = (polygon.holes ?? []).map((hole) => continuous(hole, exterior[0]![0]));
  return [feature({ type: "Polygon", coordinates: [exterior, ...holes].map(closed) })];
}

/** Returns west, south, east and north of features, or undefined without features. Features on both sides of the antimeridian stay together. */
export function extent(features: GeoJSON.Feature[]): [number, number, number, number] | undefined {
  const positions: Coordinates[] = [];
  for (const { geometry } of features) {
    const own = "coordinates" in geometry ? flattened(geometry.coordinates) : [];
    if (own.length === 0) continue;
    const shift = nearest(own[0]![0], positions[0]?.[0]) - own[0]![0];
    for (const [lon, lat] of own) positions.push([lon + shift, lat]);
  }
  if (positions.length === 0) return undefined;
  const longitudes = positions.map(([lon]) => lon);
  const latitudes = positions.map(([, lat]) => lat);
  return [longitudes.reduce(least), latitudes.reduce(least), longitudes.reduce(greatest), latitudes.reduce(greatest)];
}

function least(a: number, b: number): number {
  return Math.min(a, b);
}

function greatest(a: number, b: number): number {
  return Math.max(a, b);
}

/** Returns the coordinates of points, each of which is less than half a turn from the point before it. */
function continuous(points: Point[], reference?: number): Coordinates[] {
  let before = reference;
  return points.map(({ lat, lon }) => {
    before = nearest(lon, before);
    return [before, lat];
  });
}

/** Returns the longitude of the same meridian that is nearest to another longitude. */
function nearest(lon: number, reference: number | undefined): number {
  return reference === undefined ? lon : lon + 360 * Math.round((reference - lon) / 360);
}

function circleCorners(center: Point, radius: number): Coordinates[] {
  const degrees = radius / M_PER_DEGREE;
  const widening = 1 / Math.cos((center.lat * Math.PI) / 180);
  return Array.from({ length: CIRCLE_CORNERS }, (_, index) => {
    const angle = (2 * Math.PI * index) / CIRCLE_CORNERS;
    return [center.lon + degrees * widening * Math.cos(angle), center.lat + degrees * Math.sin(angle)];
  });
}

function closed(ring: Coordinates[]): Coordinates[] {
  return [...ring, ring[0]!];
}

function flattened(coordinates: unknown): Coordinates[] {
  const values = coordinates as unknown[];
  return typeof values[0] === "number" ? [values as Coordinates] : values.flatMap(flattened);
}

function feature(geometry: GeoJSON.Geometry): GeoJSON.Feature {
  return { type: "Feature", properties: {}, geometry };
}
