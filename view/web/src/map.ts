// Map of a flight. MapLibre draws areas and flown paths on a plain background. Drones, links and labels are drawn on a canvas above
// it, because they move in every frame, and MapLibre would render the whole map again for each of them.

import { type GeoJSONSource, LngLatBounds, Map as MapLibre, NavigationControl, Popup, ScaleControl, type StyleSpecification, prewarm, setWorkerUrl } from "maplibre-gl";
import "maplibre-gl/dist/maplibre-gl.css";
import workerUrl from "maplibre-gl/dist/maplibre-gl-worker.mjs?url";

import type { BaseMap } from "./base_map";
import type { Feature, Link } from "./events";
import { type Drone, MAX_GAP_MS, type Model } from "./model";
import { policiesAt } from "./places";
import { ZONE_CLASSES, altitudeLimits, classOf, facts, kindName } from "./text";

setWorkerUrl(new URL(workerUrl, window.location.href).href);
// Start the workers while the first events are being received.
prewarm();

const AREAS_INTERVAL_MS = 400;
/** Interval of updates of flown paths in MapLibre, which are expensive. The latest part of each path is drawn on the canvas. */
const PATHS_INTERVAL_MS = 5_000;
/** If the shown time is further ahead of MapLibre's paths, the user has moved it, and the paths are updated sooner. */
const MAX_TAIL_MS = 60_000;
/** Maximum distance between a click and the drone that it selects. */
const CLICK_RADIUS_PX = 18;
const OFFSCREEN_MARGIN_PX = 50;
const PATH_WIDTH_PX = 3;
const FIT = { padding: 40, maxZoom: 18 };
/** Minimum width and height of a zone that is labelled. Smaller zones are named only in the list. */
const MIN_LABELLED_PX = 40;
/** The base map is paler than zones and paths. */
const BASE_MAP_OPACITY = 0.7;
const STALE_OPACITY = 0.45;
const NOT_READY_OPACITY = 0.55;

/** Classes of areas, in drawing order. */
const AREAS = ["operationArea", "corridor", "depot", ...ZONE_CLASSES] as const;
/** Kinds of features that belong to the flight of an application. */
const FLIGHT_KINDS = new Set(["operationArea", "corridor", "path", "controlPoint"]);
/** Classes of areas and lines, each with its own outline. */
const OUTLINES = [...AREAS, "path"] as const;
const FILL_OPACITY: Record<string, number> = { exclusion: 0.22, pictures: 0.18, limit: 0.14 };
const DEFAULT_FILL_OPACITY = 0.06;
/** Outlines differ in their dashes too, so that colours are not needed to tell them apart. An exclusion zone has a solid outline. */
const DASHES: Record<string, [number, number]> = { inclusion: [6, 2], pictures: [1, 1.5], limit: [4, 1.5], methods: [2, 2], zone: [1, 3] };
const DEFAULT_DASHES: [number, number] = [3, 2];

/** Returns the colour with a name, which is a custom property of the style sheet. */
export type Colours = (name: string) => string;

export class FlightMap {
  private readonly map: MapLibre;
  private readonly overlay: HTMLCanvasElement;
  private readonly popup = new Popup({ closeOnClick: false, maxWidth: "320px" });
  /** Time of the latest update of the areas and paths, on the clock of animation frames. */
  private areasUpdated = -Infinity;
  private pathsUpdated = -Infinity;
  /** Time up to which MapLibre draws flown paths. The canvas draws the tail of each path after this time. */
  private pathsEnd = -Infinity;
  private features: Feature[];
  private ready = false;
  /** True to draw the complete paths of a recording. */
  private showsWhole = false;
  /** True if the user has moved the map. */
  private moved = false;
  /** Names of the flying drones to which the map was fitted. */
  private flying = "";
  private drawnDrones: { x: number; y: number; name: string }[] = [];

  constructor(
    private readonly element: HTMLElement,
    private model: Model,
    private colours: Colours,
    private readonly reducedMotion: boolean,
    private readonly select: (drone: string) => void,
    baseMap: BaseMap | null,
    private time: number,
  ) {
    this.features = model.features(time);
    const bounds = this.bounds(time);
    const world = { center: [0, 20] as [number, number], zoom: 1 };
    this.map = new MapLibre({
      container: element,
      style: this.style(baseMap),
      validateStyle: false,
      ...(bounds.isEmpty() ? world : { bounds, fitBoundsOptions: FIT }),
      attributionControl: false,
      fadeDuration: 0,
      maxPitch: 0,
      dragRotate: false,
      locale: { "Map.Title": "Map of zones, areas and drones. The lists contain the same data" },
    });
    // Hide the map until it has content. Without a GPU, every visible frame is copied, which is slow.
    this.map.getCanvasContainer().style.visibility = "hidden";
    this.map.addControl(new NavigationControl({ showCompass: false }), "top-right");
    this.map.addControl(new ScaleControl({}), "bottom-left");
    this.overlay = document.createElement("canvas");
    this.overlay.className = "overlay";
    this.overlay.setAttribute("aria-hidden", "true");
    this.map.getCanvasContainer().append(this.overlay);
    this.map.touchZoomRotate.disableRotation();
    this.map.keyboard.disableRotation();
    this.map.on("style.load", () => this.map.on("render", this.rendered));
    for (const gesture of ["dragstart", "wheel", "dblclick"] as const) this.map.on(gesture, () => (this.moved = true));
    element.addEventListener("keydown", () => (this.moved = true));
    this.map.on("click", (event) => this.clicked(event.point, event.lngLat));
  }

  /** Returns a style that already contains the known areas, so that the first frame shows them. */
  private style(baseMap: BaseMap | null): StyleSpecification {
    const source = (features: GeoJSON.Feature[]) =>
      ({ type: "geojson", data: { type: "FeatureCollection", features }, buffer: 32, tolerance: 0.2 }) as const;
    const filter = (name: string) => ["==", ["get", "class"], name] as ["==", ["get", string], string];
    const colours = this.colours;
    const layers: StyleSpecification["layers"] = [{ id: "background", type: "background", paint: { "background-color": colours("map") } }];
    const base: StyleSpecification["sources"] = {};
    if (baseMap !== null) {
      const tiles = [`${window.location.origin}/tiles/{z}/{x}/{y}`];
      base["base"] = { type: "raster", tiles, tileSize: 256, minzoom: baseMap.min_zoom, maxzoom: baseMap.max_zoom };
      layers.push({ id: "base", type: "raster", source: "base", paint: { "raster-opacity": BASE_MAP_OPACITY, "raster-fade-duration": 0 } });
    }
    for (const name of AREAS) {
      // Line layers draw the outlines.
      const paint = { "fill-antialias": false, "fill-color": colours(name), "fill-opacity": FILL_OPACITY[name] ?? DEFAULT_FILL_OPACITY };
      layers.push({ id: `${name}-fill`, type: "fill", source: "areas", filter: filter(name), paint });
    }
    for (const name of OUTLINES) {
      const paint = { "line-color": colours(name), "line-width": 2, ...(name === "exclusion" ? {} : { "line-dasharray": DASHES[name] ?? DEFAULT_DASHES }) };
      layers.push({ id: `${name}-line`, type: "line", source: "areas", filter: filter(name), paint });
    }
    const earlier = { "line-color": colours("earlier"), "line-width": 2, "line-dasharray": [1, 2] };
    layers.push({ id: "earlier-line", type: "line", source: "earlier", paint: earlier });
    for (const [id, width, opacity] of [["whole", 2, 0.3], ["flown", PATH_WIDTH_PX, 1]] as const) {
      const paint = { "line-color": colours("flown"), "line-width": width, "line-opacity": opacity };
      layers.push({ id: `${id}-line`, type: "line", source: id, layout: { "line-join": "round", "line-cap": "round" }, paint });
    }
    return { version: 8, sources: { ...base, areas: source(this.shapes()), whole: source([]), earlier: source([]), flown: source([]) }, layers };
  }

  /** Makes the map visible after the first frame that contains all areas. */
  private readonly rendered = (): void => {
    if (!this.map.isSourceLoaded("areas")) return;
    if (!this.ready) {
      this.ready = true;
      this.map.getCanvasContainer().style.visibility = "";
      if (this.showsWhole) {
        this.showWhole();
        this.fit(this.time);
      }
    }
    if (this.features.length === 0) return;
    this.map.off("render", this.rendered);
    this.element.dataset["map"] = "ready";
    performance.mark("map shown");
  };

  /** Shows another model. */
  follow(model: Model): void {
    this.model = model;
    this.areasUpdated = -Infinity;
    this.pathsUpdated = -Infinity;
    this.pathsEnd = -Infinity;
  }

  paint(colours: Colours): void {
    this.colours = colours;
    this.map.setPaintProperty("background", "background-color", colours("map"));
    if (!this.ready) return;
    for (const name of AREAS) this.map.setPaintProperty(`${name}-fill`, "fill-color", colours(name));
    for (const name of OUTLINES) this.map.setPaintProperty(`${name}-line`, "line-color", colours(name));
    this.map.setPaintProperty("earlier-line", "line-color", colours("earlier"));
    for (const id of ["whole", "flown"]) this.map.setPaintProperty(`${id}-line`, "line-color", colours("flown"));
  }

  /** Draws the state at a time. `now` is the time of the animation frame. */
  draw(time: number, selected: string, now: number): void {
    this.time = time;
    if (!this.ready || !Number.isFinite(this.model.begin)) return;
    if (now - this.areasUpdated > AREAS_INTERVAL_MS) {
      this.areasUpdated = now;
      this.showAreas(time);
      this.fitToNewFlights(time);
    }
    const jumped = time < this.pathsEnd || time - this.pathsEnd > MAX_TAIL_MS;
    const interval = jumped ? AREAS_INTERVAL_MS : PATHS_INTERVAL_MS;
    if (time !== this.pathsEnd && now - this.pathsUpdated > interval) {
      this.pathsUpdated = now;
      this.pathsEnd = time;
      this.setPaths("flown", (drone) => flownPath(drone, drone.flightStart(time), time));
      this.setPaths("earlier", (drone) => flownPath(drone, -Infinity, Math.min(drone.flightStart(time) - 1, time)));
    }
    this.drawOverlay(time, selected);
  }

  /** Draws the complete paths of a recording. */
  showWhole(): void {
    this.showsWhole = true;
    if (this.ready) this.setPaths("whole", (drone) => flownPath(drone, -Infinity, Infinity));
  }

  /** Fits the map to the flights, or to everything if no drone flies, unless the user has moved it. */
  fit(time: number): void {
    if (this.ready && !this.moved) this.showBounds(this.bounds(time));
  }

  /** Fits the map to the flight of a drone, or to all flights if no drone is selected. */
  zoomToFlight(time: number, selected: string): void {
    this.moved = true;
    const drones = [...this.model.drones.values()];
    const chosen = drones.filter((drone) => (selected ? drone.name === selected : drone.isFlying(time)));
    this.showBounds(this.flightBounds(chosen.length > 0 ? chosen : drones, time));
  }

  zoomToAll(): void {
    this.moved = true;
    this.showBounds(this.allBounds());
  }

  private showBounds(bounds: LngLatBounds): void {
    if (!bounds.isEmpty()) this.map.fitBounds(bounds, { ...FIT, animate: false });
  }

  private bounds(time: number): LngLatBounds {
    const drones = [...this.model.drones.values()];
    // A recording is shown from its beginning, when its drones do not fly yet.
    const flying = this.showsWhole ? drones : drones.filter((drone) => drone.isFlying(time));
    const bounds = this.flightBounds(flying, this.showsWhole ? Infinity : time);
    return bounds.isEmpty() ? this.allBounds() : bounds;
  }

  private allBounds(): LngLatBounds {
    const bounds = new LngLatBounds();
    for (const feature of this.model.features(this.time)) extend(bounds, feature.geometry.coordinates);
    for (const drone of this.model.drones.values()) for (const fix of drone.fixes.values) bounds.extend([fix.lon, fix.lat]);
    return bounds;
  }

  /** Bounds of the paths that drones have flown since their takeoff, and of the areas of their applications. */
  private flightBounds(drones: Drone[], time: number): LngLatBounds {
    const bounds = new LngLatBounds();
    if (drones.length === 0) return bounds;
    for (const drone of drones) {
      const begin = this.showsWhole ? -Infinity : drone.flightStart(time);
      for (const fix of drone.fixes.values) if (fix.time_ms >= begin && fix.time_ms <= time) bounds.extend([fix.lon, fix.lat]);
    }
    const names = new Set(drones.map((drone) => drone.name));
    const applications = this.model.applications.at(time)?.applications ?? [];
    const flown = new Set(applications.filter((application) => names.has(application.drone)).map((application) => application.name));
    for (const feature of this.model.features(time)) {
      const { kind, application } = feature.properties;
      // Areas without an application are those of the recorded drones.
      if (FLIGHT_KINDS.has(kind) && (application === undefined || flown.has(application))) extend(bounds, feature.geometry.coordinates);
    }
    return bounds;
  }

  /** Centres the map on a drone. */
  centre(name: string, time: number): void {
    const position = this.model.drones.get(name)?.position(time);
    if (position === undefined) return;
    this.moved = true;
    const center: [number, number] = [position.lon, position.lat];
    if (this.reducedMotion) this.map.jumpTo({ center });
    else this.map.easeTo({ center, duration: 400 });
  }

  /** Fits the map again if the flying drones have changed. The extent of a recording contains all its flights from the beginning. */
  private fitToNewFlights(time: number): void {
    const flying = [...this.model.drones.values()].filter((drone) => drone.isFlying(time)).map((drone) => drone.name);
    const key = flying.join();
    if (key === this.flying) return;
    this.flying = key;
    if (key && !this.showsWhole) this.fit(time);
  }

  private showAreas(time: number): void {
    const features = this.model.features(time);
    if (features.length === this.features.length && features.every((feature, index) => feature === this.features[index])) return;
    const first = this.features.length === 0;
    this.features = features;
    this.source("areas").setData({ type: "FeatureCollection", features: this.shapes() });
    if (first) this.fit(time);
  }

  /** Features without duplicates. Components share areas, and an area drawn twice would be darker. */
  private shapes(): GeoJSON.Feature[] {
    const drawn = new Set<string>();
    return this.features
      .map((feature, id) => ({ ...feature, properties: { class: classOf(feature) }, id }) as GeoJSON.Feature)
      .filter(({ geometry }) => geometry.type !== "Point" && drawn.size < drawn.add(JSON.stringify(geometry)).size);
  }

  private setPaths(source: string, path: (drone: Drone) => GeoJSON.Feature[]): void {
    const features = [...this.model.drones.values()].flatMap(path);
    this.source(source).setData({ type: "FeatureCollection", features });
  }

  private source(name: string): GeoJSONSource {
    return this.map.getSource(name) as GeoJSONSource;
  }

  private drawOverlay(time: number, selected: string): void {
    const canvas = this.map.getCanvas();
    const ratio = window.devicePixelRatio;
    const width = canvas.clientWidth;
    const height = canvas.clientHeight;
    if (this.overlay.width !== Math.round(width * ratio) || this.overlay.height !== Math.round(height * ratio)) {
      this.overlay.width = Math.round(width * ratio);
      this.overlay.height = Math.round(height * ratio);
    }
    const context = this.overlay.getContext("2d")!;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.font = "600 12px system-ui, sans-serif";
    context.lineJoin = "round";
    for (const feature of this.features) {
      if (feature.properties.kind === "zone") this.drawZoneLabel(context, feature);
      else if (feature.properties.kind === "controlPoint") this.drawControlPoint(context, feature);
      else if (feature.geometry.type === "Point") this.drawEdgeNode(context, feature);
    }
    for (const link of this.model.linksAt(time)) this.drawLink(context, link, time);
    this.drawnDrones = [];
    for (const drone of this.model.drones.values()) this.drawTail(context, drone, time);
    for (const drone of this.model.drones.values()) {
      const position = drone.position(time);
      if (position === undefined) continue;
      const { x, y } = this.map.project([position.lon, position.lat]);
      const margin = OFFSCREEN_MARGIN_PX;
      if (x < -margin || y < -margin || x > width + margin || y > height + margin) continue;
      this.drawnDrones.push({ x, y, name: drone.name });
      context.globalAlpha = drone.isStale(time) ? STALE_OPACITY : 1;
      this.drawDrone(context, x, y, position.heading, drone.name === selected);
      this.drawText(context, x + 14, y + 4, drone.name, "left");
    }
    context.globalAlpha = 1;
  }

  /** Draws the path of a drone after `pathsEnd`. */
  private drawTail(context: CanvasRenderingContext2D, drone: Drone, time: number): void {
    const fixes = drone.fixes.values.slice(drone.fixes.count(this.pathsEnd), drone.fixes.count(time));
    // A drone that appeared after `pathsEnd` has no position at that time.
    const before = drone.position(this.pathsEnd);
    const begin = before === undefined ? fixes[0] : { ...before, time_ms: before.reported };
    const end = drone.position(time);
    if (begin === undefined || end === undefined || time <= this.pathsEnd || time - end.reported > MAX_GAP_MS) return;
    let last = begin.time_ms;
    context.beginPath();
    let { x, y } = this.map.project([begin.lon, begin.lat]);
    context.moveTo(x, y);
    for (const fix of [...fixes, { ...end, time_ms: time }]) {
      ({ x, y } = this.map.project([fix.lon, fix.lat]));
      if (fix.time_ms - last > MAX_GAP_MS) context.moveTo(x, y);
      else context.lineTo(x, y);
      last = fix.time_ms;
    }
    context.strokeStyle = this.colours("flown");
    context.lineWidth = PATH_WIDTH_PX;
    context.stroke();
  }

  /** Draws an arrow in the direction of the heading, or a dot if the heading is unknown. */
  private drawDrone(context: CanvasRenderingContext2D, x: number, y: number, heading: number | null, selected: boolean): void {
    context.save();
    context.translate(x, y);
    context.beginPath();
    if (heading === null) context.arc(0, 0, 6, 0, 2 * Math.PI);
    else {
      context.rotate((heading * Math.PI) / 180);
      context.moveTo(0, -12);
      context.lineTo(8, 10);
      context.lineTo(0, 5);
      context.lineTo(-8, 10);
      context.closePath();
    }
    context.fillStyle = this.colours("flown");
    context.strokeStyle = selected ? this.colours("text") : this.colours("map");
    context.lineWidth = selected ? 3 : 2;
    context.stroke();
    context.fill();
    context.restore();
  }

  private drawEdgeNode(context: CanvasRenderingContext2D, feature: Feature): void {
    const [lon, lat] = (feature.geometry as GeoJSON.Point).coordinates as [number, number];
    const { x, y } = this.map.project([lon, lat]);
    context.globalAlpha = feature.properties.state === "ready" ? 1 : NOT_READY_OPACITY;
    context.fillStyle = this.colours("edgeNode");
    context.fillRect(x - 5, y - 5, 10, 10);
    this.drawText(context, x + 9, y + 4, feature.properties.name, "left");
    context.globalAlpha = 1;
  }

  /** Draws a control point as a diamond with its number. */
  private drawControlPoint(context: CanvasRenderingContext2D, feature: Feature): void {
    const [lon, lat] = (feature.geometry as GeoJSON.Point).coordinates as [number, number];
    const { x, y } = this.map.project([lon, lat]);
    context.beginPath();
    context.moveTo(x, y - 7);
    context.lineTo(x + 7, y);
    context.lineTo(x, y + 7);
    context.lineTo(x - 7, y);
    context.closePath();
    context.fillStyle = this.colours("map");
    context.strokeStyle = this.colours("path");
    context.lineWidth = 2;
    context.fill();
    context.stroke();
    this.drawText(context, x, y + 20, String(feature.properties.number), "center");
  }

  /** Draws a direct link: dashed unless it is up, thick if it carries traffic. */
  private drawLink(context: CanvasRenderingContext2D, link: Link, time: number): void {
    const drone = this.model.drones.get(link.drone)?.position(time);
    if (drone === undefined || link.phase === "Idle") return;
    const from = this.map.project([drone.lon, drone.lat]);
    const to = this.map.project([link.lon, link.lat]);
    context.save();
    context.beginPath();
    context.moveTo(from.x, from.y);
    context.lineTo(to.x, to.y);
    context.setLineDash(link.phase === "Up" ? [] : [4, 4]);
    context.lineWidth = link.traffic === "direct" ? 4 : 1.5;
    context.strokeStyle = this.colours("link");
    context.stroke();
    context.restore();
  }

  /** Draws the name, effect and altitude limits of a zone at its centre, if the zone is large enough on the screen. */
  private drawZoneLabel(context: CanvasRenderingContext2D, feature: Feature): void {
    const bounds = new LngLatBounds();
    extend(bounds, feature.geometry.coordinates);
    const southWest = this.map.project(bounds.getSouthWest());
    const northEast = this.map.project(bounds.getNorthEast());
    if (northEast.x - southWest.x < MIN_LABELLED_PX || southWest.y - northEast.y < MIN_LABELLED_PX) return;
    const x = (southWest.x + northEast.x) / 2;
    const y = (southWest.y + northEast.y) / 2;
    const altitude = feature.properties.altitude === undefined ? "" : `, ${altitudeLimits(feature)}`;
    this.drawText(context, x, y - 4, feature.properties.name, "center");
    const effect = `${kindName(feature)}${altitude}`;
    if (context.measureText(effect).width < northEast.x - southWest.x + MIN_LABELLED_PX) this.drawText(context, x, y + 12, effect, "center");
  }

  private drawText(context: CanvasRenderingContext2D, x: number, y: number, text: string, align: CanvasTextAlign): void {
    context.textAlign = align;
    context.strokeStyle = this.colours("map");
    context.lineWidth = 3;
    context.strokeText(text, x, y);
    context.fillStyle = this.colours("text");
    context.fillText(text, x, y);
  }

  /** Selects the drone at a clicked point, or shows the areas and policies there. */
  private clicked(point: { x: number; y: number }, position: { lng: number; lat: number }): void {
    const clickedDrone = this.drawnDrones.find((drone) => Math.hypot(drone.x - point.x, drone.y - point.y) < CLICK_RADIUS_PX);
    if (clickedDrone !== undefined) return this.select(clickedDrone.name);
    const layers = AREAS.map((name) => `${name}-fill`);
    const rendered = this.map.queryRenderedFeatures([point.x, point.y], { layers });
    const areas = rendered.map((shape) => this.features[Number(shape.id)]).filter((area) => area !== undefined);
    const lines = new Set(areas.map((area) => `${area.properties.name}: ${facts(area)}`));
    if (lines.size === 0) lines.add("no zone or area here");
    lines.add(policiesAt(this.model, this.time, position.lng, position.lat) ?? "policies are not known");
    this.popup.setLngLat(position).setText([...lines].join("\n")).addTo(this.map);
  }
}

/** Returns the path of a drone between two times. It is interrupted if the drone has reported no position for `MAX_GAP_MS`. */
function flownPath(drone: Drone, begin: number, end: number): GeoJSON.Feature<GeoJSON.MultiLineString>[] {
  const parts: [number, number][][] = [];
  let last = -Infinity;
  for (const fix of drone.fixes.values) {
    if (fix.time_ms < begin || fix.time_ms > end) continue;
    if (fix.time_ms - last > MAX_GAP_MS) parts.push([]);
    parts.at(-1)!.push([fix.lon, fix.lat]);
    last = fix.time_ms;
  }
  const position = drone.position(end);
  if (position !== undefined && position.reported >= begin && end - position.reported < MAX_GAP_MS) {
    parts.at(-1)?.push([position.lon, position.lat]);
  }
  const coordinates = parts.filter((part) => part.length > 1);
  if (coordinates.length === 0) return [];
  return [{ type: "Feature", properties: { drone: drone.name }, geometry: { type: "MultiLineString", coordinates } }];
}

/** Extends bounds by nested GeoJSON coordinates. */
function extend(bounds: LngLatBounds, coordinates: unknown): void {
  if (!Array.isArray(coordinates)) return;
  if (typeof coordinates[0] === "number") bounds.extend([coordinates[0], coordinates[1] as number]);
  else for (const inner of coordinates) extend(bounds, inner);
}
