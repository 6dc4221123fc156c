// Table of the points of a path or area. It is equivalent to drawing on the map.

import { byId, element } from "../elements";
import { REFERENCES } from "./restriction_text";
import type { Position } from "./types";

const DEFAULT_ALTITUDE_M = 20;

interface Column {
  name: "lat" | "lon" | "alt";
  label: string;
  min: number;
  max: number;
}

const COLUMNS: Column[] = [
  { name: "lat", label: "Latitude", min: -90, max: 90 },
  { name: "lon", label: "Longitude", min: -180, max: 180 },
  { name: "alt", label: "Altitude", min: -1_000, max: 20_000 },
];

export class Route {
  points: Position[] = [];
  /** True for an area, whose points have no altitude. */
  isRegion = false;

  /** The ids of the elements begin with `id`. */
  constructor(
    private readonly id: string,
    private readonly changed: () => void,
    private readonly areaTitle = "Corners of the region",
  ) {
    byId(`${id}-add`).addEventListener("click", () => {
      this.add({ lat: NaN, lon: NaN });
      this.focus(this.points.length - 1);
    });
    byId(`${id}-clear`).addEventListener("click", () => this.set([], this.isRegion));
  }

  /** Replaces all points. */
  set(points: Position[], isRegion: boolean): void {
    this.isRegion = isRegion;
    this.points = points.map((point) => (isRegion ? { lat: point.lat, lon: point.lon } : { ...point, alt: point.alt ?? DEFAULT_ALTITUDE_M }));
    this.show();
    this.changed();
  }

  /** Adds a point with the altitude of the last one, above the same reference. */
  add(point: Position): void {
    const { alt = DEFAULT_ALTITUDE_M, altitudeReference = "home" } = this.points.at(-1) ?? {};
    this.set([...this.points, { ...point, alt, altitudeReference }], this.isRegion);
  }

  private get columns(): Column[] {
    return this.isRegion ? COLUMNS.slice(0, 2) : COLUMNS;
  }

  private show(): void {
    byId(`${this.id}-title`).textContent = this.isRegion ? this.areaTitle : "Waypoints";
    const head = element("tr");
    const names = ["Point", ...this.columns.map(({ label, name }) => (name === "alt" ? "Altitude (m)" : `${label} (°)`)), "Remove"];
    head.append(...names.map((name) => element("th", name.startsWith("Altitude") ? "altitude" : "", name)));
    byId(`${this.id}-head`).replaceChildren(head);
    byId(this.id).replaceChildren(...this.points.map((point, index) => this.createRow(point, index)));
  }

  private createRow(point: Position, index: number): HTMLTableRowElement {
    const row = element("tr");
    const number = element("th", "", String(index + 1));
    number.scope = "row";
    row.append(number);
    for (const { name, label, min, max } of this.columns) {
      const input = element("input");
      Object.assign(input, { type: "number", step: "any", required: true, min: String(min), max: String(max) });
      input.value = Number.isFinite(point[name]) ? String(point[name]) : "";
      input.setAttribute("aria-label", `${label} of point ${index + 1}`);
      input.addEventListener("input", () => {
        // The form receives the same event, and calls its listener for changes.
        point[name] = input.valueAsNumber;
      });
      const cell = element("td");
      cell.append(input);
      if (name === "alt") cell.append(element("span", "facts", REFERENCES[point.altitudeReference ?? "home"]));
      row.append(cell);
    }
    const remove = element("button", "", "×");
    remove.type = "button";
    remove.setAttribute("aria-label", `Remove point ${index + 1}`);
    remove.addEventListener("click", () => {
      this.set(this.points.toSpliced(index, 1), this.isRegion);
      this.focus(Math.min(index, this.points.length - 1));
    });
    const cell = element("td");
    cell.append(remove);
    row.append(cell);
    return row;
  }

  private focus(index: number): void {
    (byId(this.id).querySelectorAll("tr")[index]?.querySelector("input") ?? byId(`${this.id}-add`)).focus();
  }
}
