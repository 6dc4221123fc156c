// Map of a plan: route, track, volumes, restrictions, other plans and drones. A click adds a point to the route or area.

import { type GeoJSONSource, Map as MapLibre, NavigationControl, ScaleControl, type StyleSpecification, setWorkerUrl } from "maplibre-gl";
import "maplibre-gl/dist/maplibre-gl.css";
import workerUrl from "maplibre-gl/dist/maplibre-gl-worker.mjs?url";

import { extent } from "./shapes";
import type { Point } from "./types";

setWorkerUrl(new URL(workerUrl, window.location.href).href);

const FIT = { padding: 60, maxZoom: 18, animate: false };
/** Layers of the map in drawing order. Their names are those of colours of the style sheet, unless `COLOURS` contains another one. */
const LAYERS = ["methods", "limit", "pictures", "exclusion", "corridor", "operationArea", "selected", "area", "path", "flown", "depot", "landing"] as const;
const COLOURS: Partial<Record<Layer, string>> = { selected: "link", area: "accent", landing: "accent" };
/** Outlines differ in their dashes too, so that colours are not needed to tell them apart. */
const DASHES: Partial<Record<Layer, [number, number]>> = { methods: [2, 2], limit: [4, 1.5], pictures: [1, 1.5], corridor: [3, 2], selected: [1, 1] };
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
      locale: { "Map.Title": "Map of the plan. The tables and lists contain the same data" },
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
    const bounds = extent(features);
    if (bounds === undefined) return;
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

function style(colours: Colours): StyleSpecification {
  const source: StyleSpecification["sources"][string] = { type: "geojson", data: { type: "FeatureCollection", features: [] } };
  const layers: StyleSpecification["layers"] = [{ id: "background", type: "background", paint: { "background-color": colours("map") } }];
  for (const name of LAYERS) {
    const colour = colours(COLOURS[name] ?? name);
    layers.push({ id: `${name}-fill`, type: "fill", source: name, filter: ["==", "$type", "Polygon"], paint: { "fill-color": colour, "fill-opacity": FILL_OPACITY } });
    const dashes = DASHES[name] === undefined ? {} : { "line-dasharray": DASHES[name] };
    layers.push({ id: `${name}-line`, type: "line", source: name, filter: ["!=", "$type", "Point"], paint: { "line-color": colour, "line-width": 2, ...dashes } });
    layers.push({ id: `${name}-point`, type: "circle", source: name, filter: ["==", "$type", "Point"], paint: { "circle-color": colour, "circle-radius": 5 } });
  }
  return { version: 8, sources: Object.fromEntries(LAYERS.map((name) => [name, source])), layers };
}

/** Rounds to about a centimetre. */
function rounded(degrees: number): number {
  return Math.round(degrees * 1e7) / 1e7;
}
