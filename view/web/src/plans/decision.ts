// Decision on a plan: reasons, drones, volumes, and the choices of repair actions.

import { byId, element } from "../elements";
import { LandingPlace } from "./landing_place";
import type { MapClicks } from "./map_clicks";
import { actionName } from "./restriction_text";
import { timeOf } from "./times";
import type { FlightPlanStatus, PlanFinding, PlanRestriction, Point, PolicyAction } from "./types";

/** Radio groups for the policies that have several repair actions, with the landing place of an abort. */
export class Choices {
  private readonly selected = new Map<string, PolicyAction>();
  private readonly places = new Map<string, LandingPlace>();
  private policies: PlanRestriction[] = [];
  private shown = "";

  constructor(
    private readonly parent: HTMLElement,
    private readonly clicks: MapClicks,
  ) {}

  /** Shows the policies of a decision. The same policies are not shown again, so that the focus stays. */
  show(restrictions: PlanRestriction[]): void {
    this.policies = restrictions.filter(({ choices }) => (choices ?? []).length > 1);
    const names = new Set(this.policies.map(({ policy }) => policy));
    for (const policy of this.selected.keys()) if (!names.has(policy)) this.selected.delete(policy);
    for (const { policy, chosen } of this.policies) if (chosen && !this.selected.has(policy)) this.selected.set(policy, { policy, action: chosen });
    const key = JSON.stringify(this.policies.map(({ policy, choices }) => [policy, choices]));
    if (key === this.shown) return;
    this.shown = key;
    this.places.clear();
    this.parent.replaceChildren(...this.policies.map((restriction) => this.createGroup(restriction)));
  }

  /** Replaces all selections. */
  select(actions: PolicyAction[]): void {
    this.selected.clear();
    for (const action of actions) this.selected.set(action.policy, action);
    this.shown = "";
  }

  /** Selected actions of the shown policies. */
  get actions(): PolicyAction[] {
    return [...this.selected.values()].map((selected) => {
      const place = this.places.get(selected.policy);
      if (place === undefined) return selected;
      const { policy, action } = selected;
      return action === "abort" && place.place !== undefined ? { policy, action, landAt: place.place } : { policy, action };
    });
  }

  /** Policies without a selected action. */
  get missing(): string[] {
    return this.policies.map(({ policy }) => policy).filter((policy) => !this.selected.has(policy));
  }

  /** Selected landing places. */
  get landingPlaces(): Point[] {
    return [...this.places.values()].flatMap(({ entered }) => entered);
  }

  private createGroup({ policy, choices = [] }: PlanRestriction): HTMLFieldSetElement {
    const group = element("fieldset");
    group.append(element("legend", "", `If the flight violates the policy ${policy}`));
    const before = this.selected.get(policy);
    const place = choices.includes("abort") ? this.createPlace(policy, before) : undefined;
    for (const choice of choices) {
      const radio = element("input");
      Object.assign(radio, { type: "radio", name: `choice-${policy}`, value: choice, checked: before?.action === choice });
      radio.addEventListener("input", () => {
        this.selected.set(policy, { policy, action: choice });
        place?.show(choice === "abort");
      });
      const label = element("label");
      label.append(radio, choice === actionName(choice) ? choice : `${choice}: ${actionName(choice)}`);
      group.append(label);
    }
    if (place !== undefined) group.append(place.field);
    return group;
  }

  private createPlace(policy: string, selected: PolicyAction | undefined): LandingPlace {
    const place = new LandingPlace(`land-at-${policy}`, `for ${policy}`, "the place of the policy, or home", this.clicks);
    if (selected?.action === "abort") place.place = selected.landAt;
    place.show(selected?.action === "abort");
    this.places.set(policy, place);
    return place;
  }
}

/** Shows the reasons and results of a decision. `select` shows another plan on the map. */
export function showFindings(status: FlightPlanStatus | undefined, select: (plan: string) => void): void {
  if (status === undefined) return byId("findings").replaceChildren();
  const { refusals = [], advisories = [], candidates = [], rejected = [], volumes = [], restrictions = [] } = status;
  const parts = [
    list("Reasons", refusals.map((finding) => findingItem(finding, select))),
    list("Advisories", advisories.map((finding) => findingItem(finding, select))),
    list("Suitable drones", candidates.map(({ node }) => element("li", "", node))),
    list("Unsuitable drones", rejected.map(({ node, message }) => element("li", "", `${node}: ${message}`))),
    list("Policies", restrictions.map(({ policy, chosen }) => element("li", "", chosen ? `${policy}: ${chosen}` : policy))),
    list("Reserved airspace", volumes.map(({ begin, end, lower, upper }) => {
      const bottom = typeof lower === "number" ? `${Math.round(lower)} m` : "the ground";
      const top = typeof upper === "number" ? `${Math.round(upper)} m above sea level` : "any altitude";
      return element("li", "", `${timeOf(begin)} to ${timeOf(end)}, from ${bottom} to ${top}`);
    })),
  ];
  byId("findings").replaceChildren(...parts.flat());
}

function list(title: string, items: HTMLLIElement[]): HTMLElement[] {
  if (items.length === 0) return [];
  const rows = element("ul", "rows");
  rows.append(...items);
  return [element("h3", "", title), rows];
}

function findingItem({ message, plan }: PlanFinding, select: (plan: string) => void): HTMLLIElement {
  const item = element("li", "", message);
  if (plan) {
    const button = element("button", "", `Show ${plan}`);
    button.type = "button";
    button.addEventListener("click", () => select(plan));
    item.append(" ", button);
  }
  return item;
}
