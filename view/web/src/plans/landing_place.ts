// Selection of a landing place: the default one, or a place by coordinates or on the map.

import { element } from "../elements";
import type { MapClicks } from "./map_clicks";
import type { Point } from "./types";

const DEFAULT = "default";
const PLACE = "place";

export class LandingPlace {
  readonly field = element("fieldset");
  private readonly select = element("select");
  private readonly row = element("div");
  private readonly lat: HTMLInputElement;
  private readonly lon: HTMLInputElement;

  /**
   * `defaultPlace` describes the landing place if none is selected, and `of` the reaction that it belongs to. `id` is unique on
   * the page.
   */
  constructor(id: string, of: string, defaultPlace: string, clicks: MapClicks) {
    this.lat = coordinate(`Latitude of the landing place ${of}`, 90);
    this.lon = coordinate(`Longitude of the landing place ${of}`, 180);
    this.select.id = id;
    this.select.append(new Option("select a place", ""), new Option(defaultPlace, DEFAULT), new Option("another place", PLACE));
    this.select.required = true;
    this.select.addEventListener("input", () => this.showRow());
    const label = element("label", "", "Land at");
    label.htmlFor = id;
    const choice = element("p");
    choice.append(label, this.select);
    const inputs = element("p", "head");
    inputs.append(this.lat, this.lon, this.createPicker(clicks));
    this.row.append(inputs);
    this.field.append(element("legend", "", `Landing place ${of}`), choice, this.row);
    this.show(false);
  }

  /** Shows or hides the selection. A hidden selection is not required. */
  show(shown: boolean): void {
    this.field.hidden = !shown;
    this.field.disabled = !shown;
    this.showRow();
  }

  /** The selected place, or undefined for the default one. */
  get place(): Point | undefined {
    return this.select.value === PLACE ? { lat: this.lat.valueAsNumber, lon: this.lon.valueAsNumber } : undefined;
  }

  /** Selects a place. Undefined: the default one. */
  set place(place: Point | null | undefined) {
    this.select.value = place ? PLACE : DEFAULT;
    if (place) this.enter(place);
    this.showRow();
  }

  /** The selected place as features of the map. */
  get entered(): Point[] {
    const { place } = this;
    return !this.field.hidden && place !== undefined && Number.isFinite(place.lat + place.lon) ? [place] : [];
  }

  private enter({ lat, lon }: Point): void {
    this.lat.value = String(lat);
    this.lon.value = String(lon);
  }

  private showRow(): void {
    const shown = this.select.value === PLACE;
    this.row.hidden = !shown;
    for (const input of [this.lat, this.lon]) input.disabled = !shown;
  }

  private createPicker(clicks: MapClicks): HTMLButtonElement {
    const button = element("button", "needs-map", "Select on the map");
    button.type = "button";
    const released = (): void => {
      button.textContent = "Select on the map";
      button.setAttribute("aria-pressed", "false");
    };
    released();
    button.addEventListener("click", () => {
      if (button.getAttribute("aria-pressed") === "true") return clicks.cancel();
      clicks.wait((point) => {
        this.enter(point);
        this.lat.dispatchEvent(new Event("input", { bubbles: true }));
      }, released);
      button.textContent = "Now click the map";
      button.setAttribute("aria-pressed", "true");
    });
    return button;
  }
}

function coordinate(label: string, limit: number): HTMLInputElement {
  const input = element("input");
  Object.assign(input, { type: "number", step: "any", min: String(-limit), max: String(limit), required: true, placeholder: label.split(" ")[0] });
  input.setAttribute("aria-label", label);
  return input;
}
