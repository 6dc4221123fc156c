// Form of a plan: reads and shows a FlightPlanSpec.

import { byId, invalidInput } from "../elements";
import { Choices } from "./decision";
import { LandingPlace } from "./landing_place";
import type { MapClicks } from "./map_clicks";
import { ParameterForm } from "./parameters";
import { Route } from "./route";
import { importedPoints } from "./route_import";
import { apiTime, inputTime } from "./times";
import type { ApplicationTemplate, FlightPlanSpec, Point } from "./types";

const MIN_CORNERS = 3;
const NOT_APPROVED = "No application is approved. An authority must approve one.";
const UNREADABLE = "You may not read applications. An administrator can give you the role fractus-applicationtemplate-viewer.";
/** Time until the default start. */
const DEFAULT_DELAY_MS = 10 * 60_000;

export class PlanForm {
  readonly route: Route;
  readonly choices: Choices;
  private readonly parameters = new ParameterForm(byId("parameters"));
  private readonly form = byId<HTMLFormElement>("plan");
  private readonly template = byId<HTMLSelectElement>("template");
  private readonly start = byId<HTMLInputElement>("start");
  private readonly duration = byId<HTMLInputElement>("duration");
  private readonly stay = byId<HTMLInputElement>("stay");
  private readonly drone = byId<HTMLSelectElement>("drone");
  private readonly automatic = byId<HTMLInputElement>("automatic");
  private readonly priority = byId<HTMLSelectElement>("priority");
  private readonly contactPlace: LandingPlace;
  private templates: ApplicationTemplate[] = [];
  /** Reason why no application can be selected. */
  private noTemplate = NOT_APPROVED;
  /** Specification whose other fields are kept. */
  private base: Partial<FlightPlanSpec> = {};

  /** `changed` is called after each change of the entered values, and `imported` after the import of a file. */
  constructor(
    clicks: MapClicks,
    changed: () => void,
    private readonly imported: () => void,
  ) {
    this.route = new Route("route", changed);
    this.choices = new Choices(byId("choices"), clicks);
    this.contactPlace = new LandingPlace("contact-land-at", "after lost contact", "home", clicks);
    byId("contact-lost").append(this.contactPlace.field);
    byId("contact-lost").addEventListener("input", () => this.contactPlace.show(this.contact === "abort"));
    this.start.value = inputTime(Date.now() + DEFAULT_DELAY_MS);
    this.form.addEventListener("input", changed);
    this.template.addEventListener("input", () => this.showTemplate({}));
    byId("import").addEventListener("change", (event) => void this.import(event.target as HTMLInputElement));
  }

  /** Shows the approved applications and the drones among which the user selects. Undefined: the user may not read applications. */
  offer(templates: ApplicationTemplate[] | undefined, drones: string[]): void {
    this.noTemplate = templates === undefined ? UNREADABLE : NOT_APPROVED;
    this.templates = (templates ?? []).filter(({ status }) => status?.conditions?.some(({ type, status: value }) => type === "Ready" && value === "True"));
    this.template.replaceChildren(...this.templates.map(({ metadata }) => new Option(metadata.name, metadata.name)));
    this.drone.replaceChildren(new Option("any suitable drone", ""), ...drones.map((name) => new Option(name, name)));
    this.showTemplate({});
  }

  /** Shows which priority classes the user may select. */
  permitPriority(permitted: boolean): void {
    for (const option of this.priority.options) option.disabled = option.value !== "normal" && !permitted;
    byId("priority-help").textContent = permitted
      ? "A plan may overlap plans of a lower class."
      : "Other classes need the role fractus-flightplan-prioritizer, which an administrator can give you.";
  }

  /** Selected landing places. */
  get landingPlaces(): Point[] {
    return [...this.choices.landingPlaces, ...this.contactPlace.entered];
  }

  /** Shows a specification. Throws an Error with a sentence if the form cannot represent it. */
  show(spec: FlightPlanSpec): void {
    const polygon = spec.region?.polygon;
    if (spec.region && (!polygon || polygon.holes?.length)) throw new Error("The page cannot change a region that is a circle or has holes.");
    if (!this.templates.some(({ metadata }) => metadata.name === spec.template)) throw new Error(`The application ${spec.template} is not approved.`);
    this.base = spec;
    this.template.value = spec.template;
    this.showTemplate(spec.parameters ?? {});
    this.start.value = inputTime(Date.parse(spec.window.start));
    this.duration.value = String(spec.window.duration);
    if (typeof spec.stay === "number") this.stay.value = String(spec.stay);
    if (spec.drone && ![...this.drone.options].some(({ value }) => value === spec.drone)) this.drone.append(new Option(spec.drone, spec.drone));
    this.drone.value = spec.drone ?? "";
    this.automatic.checked = spec.autoActivate ?? false;
    this.priority.value = spec.priorityClass ?? "normal";
    this.contact = spec.contactLost?.action ?? "";
    if (this.contact === "abort") this.contactPlace.place = spec.contactLost?.landAt;
    this.contactPlace.show(this.contact === "abort");
    this.choices.select(spec.policyActions ?? []);
    this.route.set(polygon ? polygon.exterior : (spec.waypoints ?? []), polygon != null);
  }

  /** Forgets the shown specification. The entered values stay. */
  release(): void {
    this.base = {};
  }

  /** Returns the first problem of the entered values as a sentence, or an empty text. */
  get problem(): string {
    if (this.templates.length === 0) return this.noTemplate;
    const { route } = this;
    if (route.points.length === 0) return route.isRegion ? "Add the corners of the region." : "Add a waypoint.";
    if (route.isRegion && route.points.length < MIN_CORNERS) return "A region needs at least three corners.";
    return invalidInput(this.form);
  }

  /** The entered window in Unix milliseconds. Undefined if it is invalid. */
  get window(): [number, number] | undefined {
    const begin = Date.parse(`${this.start.value}Z`);
    const end = begin + this.duration.valueAsNumber * 60_000;
    return Number.isFinite(end) ? [begin, end] : undefined;
  }

  /** The entered specification, if it has no problem. */
  get spec(): FlightPlanSpec {
    const { route } = this;
    const { waypoints: _waypoints, region: _region, stay: _stay, drone: _drone, contactLost, ...base } = this.base;
    const place = route.isRegion
      ? { region: { polygon: { exterior: route.points } }, stay: this.stay.valueAsNumber }
      : { waypoints: route.points };
    const { landAt: _landAt, ...kept } = contactLost?.action === this.contact ? contactLost : {};
    const landAt = this.contact === "abort" ? this.contactPlace.place : undefined;
    const reaction = { ...kept, action: this.contact, ...(landAt ? { landAt } : {}) };
    return {
      ...base,
      ...place,
      template: this.template.value,
      parameters: this.parameters.values(),
      window: { start: apiTime(this.start.value), duration: this.duration.valueAsNumber },
      priorityClass: this.priority.value,
      policyActions: this.choices.actions,
      autoActivate: this.automatic.checked,
      ...(this.drone.value ? { drone: this.drone.value } : {}),
      ...(this.contact ? { contactLost: reaction } : {}),
    };
  }

  private get contact(): string {
    return this.form.querySelector<HTMLInputElement>("[name=contact]:checked")!.value;
  }

  private set contact(action: string) {
    this.form.querySelector<HTMLInputElement>(`[name=contact][value="${action}"]`)!.checked = true;
  }

  private showTemplate(values: object): void {
    const template = this.templates.find(({ metadata }) => metadata.name === this.template.value);
    const isRegion = template?.spec.navigation === "region";
    byId("template-help").textContent = template?.spec.description ?? "";
    this.parameters.show(template?.spec.parameters ?? {}, values as Record<string, unknown>);
    byId("stay-row").hidden = !isRegion;
    this.stay.disabled = !isRegion;
    this.route.set(this.route.points, isRegion);
  }

  private async import(input: HTMLInputElement): Promise<void> {
    const file = input.files?.[0];
    if (file === undefined) return;
    let problem = "";
    try {
      this.route.set(importedPoints(await file.text()), this.route.isRegion);
      this.imported();
    } catch (error) {
      problem = (error as Error).message;
    }
    byId("import-problem").textContent = problem;
    // The same file can be selected again after a correction.
    input.value = "";
  }
}
