// Map of a plan: route, volumes, other plans and drones. A click adds a point to the route.

import { type GeoJSONSource, LngLatBounds, Map as MapLibre, NavigationControl, ScaleControl, type StyleSpecification, setWorkerUrl } from "maplibre-gl";
import "maplibre-gl/dist/maplibre-gl.css";
import workerUrl from "maplibre-gl/dist/maplibre-gl-worker.mjs?url";

import type { Area, FlightPlanSpec, Point, ReservedVolume } from "./types";

setWorkerUrl(new URL(workerUrl, window.location.href).href);

const FIT = { padding: 60, maxZoom: 18, animate: false };
const CIRCLE_CORNERS = 64;
const M_PER_DEGREE = 111_195;
/** Layers of the map in drawing order. Their names are those of colours of the style sheet. */
const LAYERS = ["corridor", "operationArea", "exclusion", "path", "depot"] as const;
/** Volumes of other plans have dashed outlines, so that colours are not needed to tell them apart. */
const DASHES: Partial<Record<Layer, [number, number]>> = { corridor: [3, 2], exclusion: [1, 1] };
const FILL_OPACITY = 0.15;

export type Layer = (typeof LAYERS)[number];
type Colours = (name: string) => string;

export class PlanMap {
  private readonly map: MapLibre;
  private readonly features = new Map<Layer, GeoJSON.Feature[]>();
  private ready = false;
  private fitted = false;

  constructor(element: HTMLElement, colours: Colours, clicked: (point: Point) => void) {
    this.map = new MapLibre({
      container: element,
      style: style(colours),
      center: [0, 20],
      zoom: 1,
      attributionControl: false,
      fadeDuration: 0,
      maxPitch: 0,
      dragRotate: false,
      locale: { "Map.Title": "Map of the plan. The table contains the same points" },
    });
    this.map.addControl(new NavigationControl({ showCompass: false }), "top-right");
    this.map.addControl(new ScaleControl({}), "bottom-left");
    this.map.touchZoomRotate.disableRotation();
    this.map.keyboard.disableRotation();
    this.map.getCanvas().style.cursor = "crosshair";
    this.map.on("click", ({ lngLat }) => clicked({ lat: rounded(lngLat.lat), lon: rounded(lngLat.wrap().lng) }));
    this.map.once("load", () => {
      this.ready = true;
      this.draw();
      element.dataset["map"] = "ready";
    });
  }

  paint(colours: Colours): void {
    this.map.setStyle(style(colours), { diff: false });
    this.map.once("styledata", () => this.draw());
  }

  /** Replaces the features of a layer. The first features of all determine the extent of the map. */
  set(layer: Layer, features: GeoJSON.Feature[]): void {
    this.features.set(layer, features);
    if (!this.fitted) this.fit([...this.features.values()].flat());
    if (this.ready) this.draw();
  }

  fit(features: GeoJSON.Feature[]): void {
    const bounds = new LngLatBounds();
    for (const { geometry } of features) if ("coordinates" in geometry) extend(bounds, geometry.coordinates);
    if (bounds.isEmpty()) return;
    this.fitted = true;
    this.map.fitBounds(bounds, FIT);
  }

  private draw(): void {
    for (const layer of LAYERS) {
      const source = this.map.getSource<GeoJSONSource>(layer);
      source?.setData({ type: "FeatureCollection", features: this.features.get(layer) ?? [] });
    }
  }
}

/** Returns the features of a route: its line or area, and its points. */
export function routeFeatures(points: Point[], isRegion: boolean): GeoJSON.Feature[] {
  const placed = points.filter(({ lat, lon }) => Math.abs(lat) <= 90 && Math.abs(lon) <= 180);
  const line = placed.map(coordinates);
  const corners = placed.map((point) => feature({ type: "Point", coordinates: coordinates(point) }));
  if (placed.length < 2) return corners;
  if (isRegion && placed.length > 2) return [feature({ type: "Polygon", coordinates: [[...line, line[0]!]] }), ...corners];
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

export function pointFeature(point: Point): GeoJSON.Feature {
  return feature({ type: "Point", coordinates: coordinates(point) });
}

function areaFeatures({ circle, polygon }: Area): GeoJSON.Feature[] {
  const rings = polygon ? [polygon.exterior, ...(polygon.holes ?? [])] : [];
  if (circle) {
    const angles = Array.from({ length: CIRCLE_CORNERS }, (_, index) => (2 * Math.PI * index) / CIRCLE_CORNERS);
    const degrees = circle.radius / M_PER_DEGREE;
    const widening = 1 / Math.cos((circle.center.lat * Math.PI) / 180);
    const corner = (angle: number) => ({
      lat: circle.center.lat + degrees * Math.sin(angle),
      lon: circle.center.lon + degrees * widening * Math.cos(angle),
    });
    rings.push(angles.map(corner));
  }
  return rings.length === 0 ? [] : [feature({ type: "Polygon", coordinates: rings.map((ring) => [...ring, ring[0]!].map(coordinates)) })];
}

function style(colours: Colours): StyleSpecification {
  const source: StyleSpecification["sources"][string] = { type: "geojson", data: { type: "FeatureCollection", features: [] } };
  const layers: StyleSpecification["layers"] = [{ id: "background", type: "background", paint: { "background-color": colours("map") } }];
  for (const name of LAYERS) {
    const colour = colours(name);
    layers.push({ id: `${name}-fill`, type: "fill", source: name, filter: ["==", "$type", "Polygon"], paint: { "fill-color": colour, "fill-opacity": FILL_OPACITY } });
    const dashes = DASHES[name] === undefined ? {} : { "line-dasharray": DASHES[name] };
    layers.push({ id: `${name}-line`, type: "line", source: name, filter: ["!=", "$type", "Point"], paint: { "line-color": colour, "line-width": 2, ...dashes } });
    layers.push({ id: `${name}-point`, type: "circle", source: name, filter: ["==", "$type", "Point"], paint: { "circle-color": colour, "circle-radius": 5 } });
  }
  return { version: 8, sources: Object.fromEntries(LAYERS.map((name) => [name, source])), layers };
}

function feature(geometry: GeoJSON.Geometry): GeoJSON.Feature {
  return { type: "Feature", properties: {}, geometry };
}

function coordinates({ lat, lon }: Point): [number, number] {
  return [lon, lat];
}

function extend(bounds: LngLatBounds, value: unknown): void {
  const [first, second] = value as unknown[];
  if (typeof first === "number") bounds.extend([first, second as number]);
  else for (const each of value as unknown[]) extend(bounds, each);
}

/** Rounds to about a centimetre. */
function rounded(degrees: number): number {
  return Math.round(degrees * 1e7) / 1e7;
}
