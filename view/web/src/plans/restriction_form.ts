// Form of a restriction: reads and shows its zone and policy. The server validates them.

import { byId, element, invalidInput } from "../elements";
import { LandingPlace } from "./landing_place";
import type { MapClicks } from "./map_clicks";
import { ACTIONS } from "./restriction_text";
import { Route } from "./route";
import { importedPoints } from "./route_import";
import { apiTime, inputTime } from "./times";
import type { AltitudeBand, Area, NewRestriction, Point, PolicySpec, Restriction, ZoneSpec } from "./types";

const MIN_CORNERS = 3;
const GEOFENCE_ACTIONS = ["returnToLaunch", "land", "hover", "ignore", "adjust", "abort", "revoke"];
const PICTURE_ACTIONS = ["refuse", "black", "blurAverage", "blurMedian", "blurFaces", "removeBackground"];
const LIMIT_ACTIONS = ["enforce", "refuse"];

interface Rule {
  text: string;
  type: string;
  kind: string;
  actions: string[];
}

const RULES: Record<string, Rule> = {
  exclusion: { text: "No flights", type: "GeofenceControl", kind: "exclusion", actions: GEOFENCE_ACTIONS },
  pictures: { text: "No pictures, or filtered ones", type: "PrivacyControl", kind: "camera", actions: PICTURE_ACTIONS },
  altitude: { text: "Altitude limit", type: "LimitControl", kind: "altitude", actions: LIMIT_ACTIONS },
  speed: { text: "Speed limit", type: "LimitControl", kind: "speed", actions: LIMIT_ACTIONS },
  denial: { text: "Deny calls of applications", type: "AccessControl", kind: "denial", actions: [] },
};

export class RestrictionForm {
  private readonly form = byId<HTMLFormElement>("restriction");
  private readonly area: Route;
  private readonly landing: LandingPlace;
  private readonly name = byId<HTMLInputElement>("restriction-name");
  private readonly description = byId<HTMLInputElement>("restriction-description");
  private readonly rule = byId<HTMLSelectElement>("restriction-rule");
  private readonly action = byId<HTMLSelectElement>("restriction-action");
  /** Restriction whose other fields are kept. */
  private base: Restriction | undefined;

  /** `changed` is called after each change of the entered values, and `imported` after the import of a file. */
  constructor(
    clicks: MapClicks,
    private readonly changed: () => void,
    private readonly imported: () => void,
  ) {
    this.area = new Route("area", () => this.changed(), "Corners of the area");
    this.landing = new LandingPlace("restriction-land-at", "of the restriction", "home", clicks);
    byId("restriction-landing").append(this.landing.field);
    this.rule.append(...Object.entries(RULES).map(([name, { text }]) => new Option(text, name)));
    this.form.addEventListener("input", (event) => {
      if (event.target === this.rule) this.showActions();
      this.showFields();
      this.changed();
    });
    byId("area-import").addEventListener("change", (event) => void this.import(event.target as HTMLInputElement));
    this.reset();
  }

  /** Empties the form. */
  reset(): void {
    this.base = undefined;
    this.form.reset();
    this.name.readOnly = false;
    this.showActions();
    this.landing.place = undefined;
    this.area.set([], true);
    this.showFields();
  }

  /** Shows a restriction. Throws an Error with a sentence if the form cannot represent it. */
  show(restriction: Restriction): void {
    const { name, zone, policy } = restriction;
    const rule = Object.keys(RULES).find((key) => RULES[key]!.type === policy.type && RULES[key]!.kind === policy.kind);
    if (rule === undefined) throw new Error(`The page does not know the rule of ${name}.`);
    if (zone?.area.polygon?.holes?.length) throw new Error("The page cannot change an area with holes.");
    this.reset();
    this.base = restriction;
    this.name.value = name;
    this.name.readOnly = true;
    this.description.value = zone?.description ?? "";
    if (zone) this.showArea(zone.area);
    setNumber("restriction-lower", zone?.altitude?.lower);
    setNumber("restriction-upper", zone?.altitude?.upper);
    byId<HTMLSelectElement>("restriction-reference").value = zone?.altitude?.reference ?? "home";
    setTime("restriction-from", policy.validFrom);
    setTime("restriction-until", policy.validUntil);
    this.rule.value = rule;
    this.showActions(policy.choices ?? []);
    this.action.value = policy.action ?? (rule === "exclusion" ? "ignore" : "enforce");
    setNumber("limit-lower", policy.lowerLimit);
    setNumber("limit-upper", policy.upperLimit);
    byId<HTMLSelectElement>("limit-reference").value = policy.altitudeReference ?? "home";
    byId<HTMLInputElement>("restriction-methods").value = (policy.methods ?? []).join(", ");
    this.landing.place = policy.landAt;
    this.showFields();
    this.changed();
  }

  /** Adds a corner to the polygon, or moves the centre of the circle. */
  addPoint(point: Point): void {
    if (!this.isCircle) return this.area.add(point);
    setNumber("circle-lat", point.lat);
    setNumber("circle-lon", point.lon);
    this.changed();
  }

  /** Returns the first problem of the entered values as a sentence, or an empty text. */
  get problem(): string {
    if (!this.isCircle && this.area.points.length < MIN_CORNERS) return "The area needs at least three corners.";
    return invalidInput(this.form);
  }

  /** The entered restriction, if it has no problem. */
  get content(): NewRestriction {
    return { name: this.name.value, zone: this.zone, policy: this.policy };
  }

  /** The entered area, as far as it is complete. */
  get enteredArea(): { area: Area | undefined; points: Point[] } {
    if (!this.isCircle) return { area: undefined, points: this.area.points };
    const center = { lat: numberOf("circle-lat"), lon: numberOf("circle-lon") };
    if (!Number.isFinite(center.lat + center.lon)) return { area: undefined, points: [] };
    const radius = numberOf("circle-radius");
    return { area: radius > 0 ? { circle: { center, radius } } : undefined, points: [center] };
  }

  get landingPlaces(): Point[] {
    return this.landing.entered;
  }

  private get isCircle(): boolean {
    return byId<HTMLInputElement>("shape-circle").checked;
  }

  private get zone(): ZoneSpec {
    const { description: _description, area: _area, altitude: _altitude, ...base } = this.base?.zone ?? { area: {} };
    const circle = { center: { lat: numberOf("circle-lat"), lon: numberOf("circle-lon") }, radius: numberOf("circle-radius") };
    const area: Area = this.isCircle ? { circle } : { polygon: { exterior: this.area.points } };
    const band: AltitudeBand = { ...optional("lower", "restriction-lower"), ...optional("upper", "restriction-upper") };
    const altitude = Object.keys(band).length > 0 ? { altitude: { ...band, reference: valueOf("restriction-reference") } } : {};
    return { ...base, area, ...altitude, ...(this.description.value ? { description: this.description.value } : {}) };
  }

  private get policy(): PolicySpec {
    const { type, kind, actions } = this.selectedRule;
    const choices = this.choices;
    const limits = type === "LimitControl" ? { ...optional("lowerLimit", "limit-lower"), ...optional("upperLimit", "limit-upper") } : {};
    const place = this.landing.field.hidden ? undefined : this.landing.place;
    return {
      ...this.keptFields,
      type,
      kind,
      ...limits,
      ...(actions.length > 0 ? { action: this.action.value } : {}),
      ...(choices.length > 0 ? { choices } : {}),
      ...(kind === "altitude" ? { altitudeReference: valueOf("limit-reference") } : {}),
      ...(kind === "denial" ? { methods: methodsOf(valueOf("restriction-methods")) } : {}),
      ...(place ? { landAt: place } : {}),
      ...(valueOf("restriction-from") ? { validFrom: apiTime(valueOf("restriction-from")) } : {}),
      ...(valueOf("restriction-until") ? { validUntil: apiTime(valueOf("restriction-until")) } : {}),
    };
  }

  /** Fields of the changed policy that the form does not show. */
  private get keptFields(): object {
    const { type: _type, kind: _kind, action: _action, choices: _choices, methods: _methods, ...limits } = this.base?.policy ?? { type: "", kind: "" };
    const { lowerLimit: _lower, upperLimit: _upper, altitudeReference: _reference, landAt: _landAt, validFrom: _from, validUntil: _until, ...others } = limits;
    if (this.action.value === "blurFaces") return others;
    const { faces: _faces, fallback: _fallback, ...kept } = others;
    return kept;
  }

  private get selectedRule(): Rule {
    return RULES[this.rule.value]!;
  }

  private get choices(): string[] {
    return [...byId("restriction-choices").querySelectorAll<HTMLInputElement>(":checked")].map(({ value }) => value);
  }

  private showArea({ circle, polygon }: Area): void {
    byId<HTMLInputElement>(circle ? "shape-circle" : "shape-polygon").checked = true;
    if (circle) {
      setNumber("circle-lat", circle.center.lat);
      setNumber("circle-lon", circle.center.lon);
      setNumber("circle-radius", circle.radius);
    }
    this.area.set(polygon?.exterior ?? [], true);
  }

  private showActions(choices: string[] = []): void {
    const { actions } = this.selectedRule;
    this.action.replaceChildren(...actions.map((action) => new Option(ACTIONS[action], action)));
    const boxes = actions.map((action) => {
      const box = element("input");
      Object.assign(box, { type: "checkbox", value: action, checked: choices.includes(action) });
      const label = element("label");
      label.append(box, ACTIONS[action]!);
      return label;
    });
    byId("restriction-choices").replaceChildren(element("legend", "", "Users may select instead"), ...boxes);
  }

  /** Shows the fields of the selected shape and rule, and disables the others, so that they are not validated. */
  private showFields(): void {
    const { type, kind, actions } = this.selectedRule;
    enable("circle", this.isCircle);
    enable("polygon", !this.isCircle);
    enable("limits", type === "LimitControl");
    enable("limit-reference-row", kind === "altitude");
    enable("methods-row", kind === "denial");
    enable("action-row", actions.length > 0);
    byId("action-label").textContent = type === "PrivacyControl" ? "Pictures" : "If a drone would violate it";
    byId("limits-title").textContent = kind === "speed" ? "Speed in m/s" : "Altitude in m";
    byId<HTMLFieldSetElement>("restriction-choices").hidden = actions.length === 0;
    this.landing.show(type === "GeofenceControl" && [this.action.value, ...this.choices].includes("abort"));
  }

  private async import(input: HTMLInputElement): Promise<void> {
    const file = input.files?.[0];
    if (file === undefined) return;
    let problem = "";
    try {
      const points = importedPoints(await file.text());
      const isCircle = points.length === 1;
      byId<HTMLInputElement>(isCircle ? "shape-circle" : "shape-polygon").checked = true;
      if (isCircle) this.addPoint(points[0]!);
      else this.area.set(points, true);
      this.showFields();
      this.changed();
      this.imported();
    } catch (error) {
      problem = (error as Error).message;
    }
    byId("area-problem").textContent = problem;
    // The same file can be selected again after a correction.
    input.value = "";
  }
}

/** Shows or hides an element with inputs. Hidden inputs are not validated. */
function enable(id: string, shown: boolean): void {
  const parent = byId(id);
  parent.hidden = !shown;
  for (const input of parent.querySelectorAll<HTMLInputElement>("input, select")) input.disabled = !shown;
}

function valueOf(id: string): string {
  return byId<HTMLInputElement>(id).value.trim();
}

function numberOf(id: string): number {
  return byId<HTMLInputElement>(id).valueAsNumber;
}

function optional<Name extends string>(name: Name, id: string): { [key in Name]?: number } {
  const number = numberOf(id);
  return (Number.isFinite(number) ? { [name]: number } : {}) as { [key in Name]?: number };
}

function setNumber(id: string, value: number | null | undefined): void {
  byId<HTMLInputElement>(id).value = String(value ?? "");
}

function setTime(id: string, time: string | null | undefined): void {
  byId<HTMLInputElement>(id).value = time ? inputTime(Date.parse(time)) : "";
}

function methodsOf(text: string): string[] {
  return text.split(",").map((method) => method.trim()).filter(Boolean);
}
