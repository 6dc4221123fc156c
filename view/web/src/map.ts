// The map: areas and paths by MapLibre on a plain background, drones on a canvas of their own above it.

import { type GeoJSONSource, LngLatBounds, Map as MapLibre, NavigationControl, Popup, ScaleControl, type StyleSpecification, prewarm, setWorkerUrl } from "maplibre-gl";
import "maplibre-gl/dist/maplibre-gl.css";
import workerUrl from "maplibre-gl/dist/maplibre-gl-worker.mjs?url";

import type { Feature, Link } from "./events";
import { GAP_MS, type Drone, type Model } from "./model";
import { band, facts } from "./words";

setWorkerUrl(new URL(workerUrl, window.location.href).href);
// It takes as long to start as the first events take to come.
prewarm();

const PERIOD_MS = 400;
/** MapLibre cuts paths into tiles and draws the whole map again: what was flown since is drawn above it. */
const PATH_PERIOD_MS = 5_000;
const MAX_TAIL_MS = 60_000;
const REACH_PX = 18;
const PATH_PX = 3;
const FIT = { padding: 40, maxZoom: 18 };
/** A zone that is drawn smaller has its name in the list alone. */
const MIN_NAMED_PX = 40;

const KINDS = ["operationArea", "corridor", "depot", "zone"] as const;

export interface Colours {
  background: string;
  text: string;
  flown: string;
  zone: string;
  operationArea: string;
  corridor: string;
  path: string;
  depot: string;
  link: string;
  place: string;
}

type Lines = GeoJSON.Feature<GeoJSON.MultiLineString>[];

export class FlightMap {
  private readonly map: MapLibre;
  private readonly overlay: HTMLCanvasElement;
  private readonly popup = new Popup({ closeButton: false, maxWidth: "320px" });
  private lookedAt = -Infinity;
  private pathsAt = -Infinity;
  /** Up to which moment MapLibre draws what was flown. */
  private drawn = -Infinity;
  private features: Feature[];
  private ready = false;
  private whole = false;
  private moved = false;
  private shown: { x: number; y: number; name: string }[] = [];

  constructor(
    private readonly element: HTMLElement,
    private model: Model,
    private colours: Colours,
    private readonly still: boolean,
    private readonly pick: (drone: string) => void,
    time: number,
  ) {
    this.features = model.features(time);
    const bounds = this.bounds(time);
    const place = bounds.isEmpty() ? { center: [0, 20] as [number, number], zoom: 1 } : { bounds, fitBoundsOptions: FIT };
    this.map = new MapLibre({
      container: element,
      style: this.style(),
      validateStyle: false,
      ...place,
      attributionControl: false,
      fadeDuration: 0,
      maxPitch: 0,
      dragRotate: false,
      locale: { "Map.Title": "Map of zones, areas and drones; the lists say the same" },
    });
    // Where there is no graphics processor, each frame that is seen is copied: none is before there is something to see.
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
    for (const what of ["dragstart", "wheel", "dblclick"] as const) this.map.on(what, () => (this.moved = true));
    element.addEventListener("keydown", () => (this.moved = true));
    this.map.on("click", (event) => this.clicked(event.point, event.lngLat));
  }

  /** Sources with what is known by now, so that the first thing drawn is the map. */
  private style(): StyleSpecification {
    const source = (features: GeoJSON.Feature[]) =>
      ({ type: "geojson", data: { type: "FeatureCollection", features }, buffer: 32, tolerance: 0.2 }) as const;
    const filter = (kind: string) => ["==", ["get", "kind"], kind] as ["==", ["get", string], string];
    const colours = this.colours;
    const layers: StyleSpecification["layers"] = [{ id: "background", type: "background", paint: { "background-color": colours.background } }];
    for (const kind of KINDS) {
      // Each has a line of its own around it.
      const paint = { "fill-antialias": false, "fill-color": colours[kind], "fill-opacity": kind === "zone" ? 0.22 : 0.06 };
      layers.push({ id: `${kind}-fill`, type: "fill", source: "areas", filter: filter(kind), paint });
    }
    for (const kind of [...KINDS, "path" as const]) {
      const paint = { "line-color": colours[kind], "line-width": 2, ...(kind === "zone" ? {} : { "line-dasharray": [3, 2] }) };
      layers.push({ id: `${kind}-line`, type: "line", source: "areas", filter: filter(kind), paint });
    }
    for (const [id, width, opacity] of [["whole", 2, 0.3], ["flown", PATH_PX, 1]] as const) {
      const paint = { "line-color": colours.flown, "line-width": width, "line-opacity": opacity };
      layers.push({ id: `${id}-line`, type: "line", source: id, layout: { "line-join": "round", "line-cap": "round" }, paint });
    }
    return { version: 8, sources: { areas: source(this.shapes()), whole: source([]), flown: source([]) }, layers };
  }

  /** The first picture that is seen has all areas in it. */
  private readonly rendered = (): void => {
    if (!this.map.isSourceLoaded("areas")) return;
    if (!this.ready) {
      this.ready = true;
      this.map.getCanvasContainer().style.visibility = "";
      if (this.whole) this.showWhole();
    }
    if (this.features.length === 0) return;
    this.map.off("render", this.rendered);
    this.element.dataset["map"] = "ready";
    performance.mark("map shown");
  };

  /** Show what another model knows. */
  follow(model: Model): void {
    this.model = model;
    this.lookedAt = this.pathsAt = this.drawn = -Infinity;
  }

  /** Take other colours. */
  paint(colours: Colours): void {
    this.colours = colours;
    this.map.setPaintProperty("background", "background-color", colours.background);
    if (!this.ready) return;
    for (const kind of KINDS) this.map.setPaintProperty(`${kind}-fill`, "fill-color", colours[kind]);
    for (const kind of [...KINDS, "path" as const]) this.map.setPaintProperty(`${kind}-line`, "line-color", colours[kind]);
    for (const id of ["whole", "flown"]) this.map.setPaintProperty(`${id}-line`, "line-color", colours.flown);
  }

  /** Show a moment. */
  draw(time: number, selected: string, now: number): void {
    if (!this.ready || !Number.isFinite(this.model.begin)) return;
    if (now - this.lookedAt > PERIOD_MS) {
      this.lookedAt = now;
      this.showAreas(time);
    }
    const jumped = time < this.drawn || time - this.drawn > MAX_TAIL_MS;
    if (time !== this.drawn && now - this.pathsAt > (jumped ? PERIOD_MS : PATH_PERIOD_MS)) {
      this.pathsAt = now;
      this.drawn = time;
      this.setLines("flown", [...this.model.drones.values()].map((drone) => line(drone, time)));
    }
    this.drawAbove(time, selected);
  }

  /** Draw the whole of a recording's paths. */
  showWhole(): void {
    this.whole = true;
    if (this.ready) this.setLines("whole", [...this.model.drones.values()].map((drone) => line(drone, Infinity)));
  }

  /** Let all that is known be seen, unless the user chose what to look at. */
  fit(time: number): void {
    if (!this.ready || this.moved) return;
    const bounds = this.bounds(time);
    if (!bounds.isEmpty()) this.map.fitBounds(bounds, { ...FIT, animate: false });
  }

  private bounds(time: number): LngLatBounds {
    const bounds = new LngLatBounds();
    for (const feature of this.model.features(time)) extend(bounds, feature.geometry.coordinates);
    for (const drone of this.model.drones.values()) for (const fix of drone.fixes.values) bounds.extend([fix.lon, fix.lat]);
    return bounds;
  }

  /** Bring a drone to the middle. */
  centre(name: string, time: number): void {
    const position = this.model.drones.get(name)?.position(time);
    if (position === undefined) return;
    this.moved = true;
    const center: [number, number] = [position.lon, position.lat];
    if (this.still) this.map.jumpTo({ center });
    else this.map.easeTo({ center, duration: 400 });
  }

  private showAreas(time: number): void {
    const features = this.model.features(time);
    if (features.length === this.features.length && features.every((one, index) => one === this.features[index])) return;
    const first = this.features.length === 0;
    this.features = features;
    this.source("areas").setData({ type: "FeatureCollection", features: this.shapes() });
    if (first) this.fit(time);
  }

  /** Components share areas: what lies on itself would be drawn darker. */
  private shapes(): GeoJSON.Feature[] {
    const drawn = new Set<string>();
    return this.features
      .map((feature, id) => ({ ...feature, id }) as GeoJSON.Feature)
      .filter(({ geometry }) => drawn.size < drawn.add(JSON.stringify(geometry)).size);
  }

  private setLines(name: string, lines: Lines[]): void {
    this.source(name).setData({ type: "FeatureCollection", features: lines.flat() });
  }

  private source(name: string): GeoJSONSource {
    return this.map.getSource(name) as GeoJSONSource;
  }

  private drawAbove(time: number, selected: string): void {
    const canvas = this.map.getCanvas();
    const ratio = window.devicePixelRatio;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
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
      if (feature.properties.kind === "zone") this.name(context, feature);
      else if (feature.geometry.type === "Point") this.place(context, feature);
    }
    for (const link of this.model.linksAt(time)) this.link(context, link, time);
    this.shown = [];
    for (const drone of this.model.drones.values()) this.tail(context, drone, time);
    for (const drone of this.model.drones.values()) {
      const position = drone.position(time);
      if (position === undefined) continue;
      const { x, y } = this.map.project([position.lon, position.lat]);
      if (x < -50 || y < -50 || x > width + 50 || y > height + 50) continue;
      this.shown.push({ x, y, name: drone.name });
      context.globalAlpha = drone.stale(time) ? 0.45 : 1;
      this.marker(context, x, y, position.heading, drone.name === selected);
      this.label(context, x, y, drone.name);
    }
    context.globalAlpha = 1;
  }

  /** What a drone flew since MapLibre was told. */
  private tail(context: CanvasRenderingContext2D, drone: Drone, time: number): void {
    const fixes = drone.fixes.values.slice(drone.fixes.count(this.drawn), drone.fixes.count(time));
    // It may have been seen first after MapLibre was told.
    const before = drone.position(this.drawn);
    const begin = before === undefined ? fixes[0] : { ...before, time_ms: before.seen };
    const end = drone.position(time);
    if (begin === undefined || end === undefined || time <= this.drawn || time - end.seen > GAP_MS) return;
    let last = begin.time_ms;
    context.beginPath();
    let { x, y } = this.map.project([begin.lon, begin.lat]);
    context.moveTo(x, y);
    for (const fix of [...fixes, { ...end, time_ms: time }]) {
      ({ x, y } = this.map.project([fix.lon, fix.lat]));
      if (fix.time_ms - last > GAP_MS) context.moveTo(x, y);
      else context.lineTo(x, y);
      last = fix.time_ms;
    }
    context.strokeStyle = this.colours.flown;
    context.lineWidth = PATH_PX;
    context.stroke();
  }

  private marker(context: CanvasRenderingContext2D, x: number, y: number, heading: number | null, selected: boolean): void {
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
    context.fillStyle = this.colours.flown;
    context.strokeStyle = selected ? this.colours.text : this.colours.background;
    context.lineWidth = selected ? 3 : 2;
    context.stroke();
    context.fill();
    context.restore();
  }

  /** An edge node: a square. */
  private place(context: CanvasRenderingContext2D, feature: Feature): void {
    const [lon, lat] = (feature.geometry as GeoJSON.Point).coordinates as [number, number];
    const { x, y } = this.map.project([lon, lat]);
    context.globalAlpha = feature.properties.state === "ready" ? 1 : 0.55;
    context.fillStyle = this.colours.place;
    context.fillRect(x - 5, y - 5, 10, 10);
    context.textAlign = "left";
    this.write(context, x + 9, y + 4, feature.properties.name);
    context.globalAlpha = 1;
  }

  /** A direct link from drone to node: dashed until it is up, thick while traffic takes it. */
  private link(context: CanvasRenderingContext2D, link: Link, time: number): void {
    const drone = this.model.drones.get(link.drone)?.position(time);
    if (drone === undefined || link.phase === "Idle") return;
    const [from, to] = [this.map.project([drone.lon, drone.lat]), this.map.project([link.lon, link.lat])];
    context.save();
    context.beginPath();
    context.moveTo(from.x, from.y);
    context.lineTo(to.x, to.y);
    context.setLineDash(link.phase === "Up" ? [] : [4, 4]);
    context.lineWidth = link.traffic === "direct" ? 4 : 1.5;
    context.strokeStyle = this.colours.link;
    context.stroke();
    context.restore();
  }

  private label(context: CanvasRenderingContext2D, x: number, y: number, name: string): void {
    context.textAlign = "left";
    this.write(context, x + 14, y + 4, name);
  }

  /** A zone's name and heights, in the middle of it, where there is room. */
  private name(context: CanvasRenderingContext2D, feature: Feature): void {
    const bounds = new LngLatBounds();
    extend(bounds, feature.geometry.coordinates);
    const [west, east] = [this.map.project(bounds.getSouthWest()), this.map.project(bounds.getNorthEast())];
    const [x, y] = [(west.x + east.x) / 2, (west.y + east.y) / 2];
    if (east.x - west.x < MIN_NAMED_PX || west.y - east.y < MIN_NAMED_PX) return;
    context.textAlign = "center";
    this.write(context, x, y - 4, feature.properties.name);
    if (feature.properties.altitude !== undefined) this.write(context, x, y + 12, band(feature));
  }

  private write(context: CanvasRenderingContext2D, x: number, y: number, text: string): void {
    context.strokeStyle = this.colours.background;
    context.lineWidth = 3;
    context.strokeText(text, x, y);
    context.fillStyle = this.colours.text;
    context.fillText(text, x, y);
  }

  private clicked(point: { x: number; y: number }, place: { lng: number; lat: number }): void {
    const near = this.shown.find((one) => Math.hypot(one.x - point.x, one.y - point.y) < REACH_PX);
    if (near !== undefined) return this.pick(near.name);
    const layers = KINDS.map((kind) => `${kind}-fill`);
    const found = this.map.queryRenderedFeatures([point.x, point.y], { layers }).map((one) => this.features[Number(one.id)]);
    const lines = new Set(found.filter((one) => one !== undefined).map((one) => `${one.properties.name}: ${facts(one)}`));
    if (lines.size === 0) return void this.popup.remove();
    this.popup.setLngLat(place).setText([...lines].join("\n")).addTo(this.map);
  }
}

/** Where a drone flew up to a moment; broken where it was not seen. */
function line(drone: Drone, time: number): Lines {
  const parts: [number, number][][] = [];
  let last = -Infinity;
  const count = Number.isFinite(time) ? drone.fixes.count(time) : drone.fixes.values.length;
  for (const fix of drone.fixes.values.slice(0, count)) {
    if (fix.time_ms - last > GAP_MS) parts.push([]);
    parts.at(-1)!.push([fix.lon, fix.lat]);
    last = fix.time_ms;
  }
  const position = drone.position(time);
  if (position !== undefined && time - position.seen < GAP_MS) parts.at(-1)?.push([position.lon, position.lat]);
  const coordinates = parts.filter((part) => part.length > 1);
  if (coordinates.length === 0) return [];
  return [{ type: "Feature", properties: { drone: drone.name }, geometry: { type: "MultiLineString", coordinates } }];
}

function extend(bounds: LngLatBounds, coordinates: unknown): void {
  if (!Array.isArray(coordinates)) return;
  if (typeof coordinates[0] === "number") bounds.extend([coordinates[0], coordinates[1] as number]);
  else for (const inner of coordinates) extend(bounds, inner);
}
