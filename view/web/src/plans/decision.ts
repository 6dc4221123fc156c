// Decision on a plan: reasons, drones, volumes, and the choices of repair actions.

import { byId, element } from "../elements";
import { timeOf } from "./times";
import type { FlightPlanStatus, PlanFinding, PlanRestriction, PolicyAction } from "./types";

/** Radio groups for the policies that have several repair actions. */
export class Choices {
  private readonly selected = new Map<string, string>();
  private policies: PlanRestriction[] = [];
  private shown = "";

  constructor(private readonly parent: HTMLElement) {}

  /** Shows the policies of a decision. The same policies are not shown again, so that the focus stays. */
  show(restrictions: PlanRestriction[]): void {
    this.policies = restrictions.filter(({ choices }) => (choices ?? []).length > 1);
    const names = new Set(this.policies.map(({ policy }) => policy));
    for (const policy of this.selected.keys()) if (!names.has(policy)) this.selected.delete(policy);
    for (const { policy, chosen } of this.policies) if (chosen && !this.selected.has(policy)) this.selected.set(policy, chosen);
    const key = JSON.stringify(this.policies.map(({ policy, choices }) => [policy, choices]));
    if (key === this.shown) return;
    this.shown = key;
    this.parent.replaceChildren(...this.policies.map((restriction) => this.createGroup(restriction)));
  }

  /** Replaces all selections. */
  select(actions: PolicyAction[]): void {
    this.selected.clear();
    for (const { policy, action } of actions) this.selected.set(policy, action);
    this.shown = "";
  }

  /** Selected actions of the shown policies. */
  get actions(): PolicyAction[] {
    return [...this.selected].map(([policy, action]) => ({ policy, action }));
  }

  /** Policies without a selected action. */
  get missing(): string[] {
    return this.policies.map(({ policy }) => policy).filter((policy) => !this.selected.has(policy));
  }

  private createGroup({ policy, choices }: PlanRestriction): HTMLFieldSetElement {
    const group = element("fieldset");
    group.append(element("legend", "", `If the flight violates the policy ${policy}`));
    for (const choice of choices ?? []) {
      const radio = element("input");
      Object.assign(radio, { type: "radio", name: `choice-${policy}`, value: choice, checked: this.selected.get(policy) === choice });
      radio.addEventListener("input", () => this.selected.set(policy, choice));
      const label = element("label");
      label.append(radio, choice);
      group.append(label);
    }
    return group;
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
