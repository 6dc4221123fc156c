// List of plans with their actions.

import { byId, element } from "../elements";
import { timeOf } from "./times";
import type { FlightPlan } from "./types";

const IN_FLIGHT = new Set(["Activated", "Nonconforming", "Contingent"]);

export interface PlanActions {
  follow(plan: FlightPlan): void;
  start(plan: FlightPlan): void;
  end(plan: FlightPlan): void;
  change(plan: FlightPlan): void;
  remove(plan: FlightPlan): void;
}

export function stateOf(plan: FlightPlan): string {
  return plan.status?.state ?? "Draft";
}

export class PlanList {
  private readonly rows = new Map<string, { key: string; item: HTMLLIElement }>();

  constructor(private readonly actions: PlanActions) {}

  /** Shows the plans, the latest start first. Rows without changes stay, so that the focus stays. */
  show(plans: FlightPlan[], followed: string): void {
    const names = new Set(plans.map(({ metadata }) => metadata.name));
    for (const [name, { item }] of this.rows) {
      if (names.has(name)) continue;
      item.remove();
      this.rows.delete(name);
    }
    const sorted = plans.toSorted((a, b) => b.spec.window.start.localeCompare(a.spec.window.start));
    const items = sorted.map((plan) => this.row(plan, plan.metadata.name === followed));
    const list = byId("plans");
    if (items.length === 0) list.replaceChildren(element("li", "empty", "No plans yet."));
    else if (items.some((item, index) => list.children[index] !== item)) list.replaceChildren(...items);
  }

  private row(plan: FlightPlan, followed: boolean): HTMLLIElement {
    const name = plan.metadata.name;
    const key = `${followed} ${JSON.stringify(plan)}`;
    const before = this.rows.get(name);
    if (before?.key === key) return before.item;
    const item = this.createItem(plan, followed);
    if (before !== undefined) {
      const focused = document.activeElement instanceof HTMLElement && before.item.contains(document.activeElement) ? document.activeElement : undefined;
      before.item.replaceWith(item);
      if (focused !== undefined) (item.querySelector<HTMLElement>(`[data-action=${focused.dataset["action"]}]`) ?? byId("plans-title")).focus();
    }
    this.rows.set(name, { key, item });
    return item;
  }

  private createItem(plan: FlightPlan, followed: boolean): HTMLLIElement {
    const { spec, status, metadata } = plan;
    const state = stateOf(plan);
    const item = element("li");
    const head = element("p", "head");
    head.append(element("span", "name", metadata.name), element("span", "badge", state), element("span", "facts", status?.drone ?? ""));
    const window = `${spec.template}, ${timeOf(spec.window.start)}, ${spec.window.duration} minutes`;
    item.append(head, element("p", "facts", window));
    const started = spec.use === "InUse" || spec.autoActivate;
    if (state === "Accepted" && started) item.append(element("p", "facts", `may take off from ${timeOf(spec.window.start)}`));
    const failed = (status?.conditions ?? []).filter(({ type, status: value }) => (type === "ChangeRefused" || type === "ConflictArose") && value === "True");
    for (const message of [status?.message, ...failed.map((condition) => condition.message)]) if (message) item.append(element("p", "facts", message));
    const buttons = element("p", "head");
    const follow = this.button(plan, "follow", "Follow");
    follow.setAttribute("aria-pressed", String(followed));
    buttons.append(follow);
    const open = state === "Accepted" || IN_FLIGHT.has(state);
    if (state === "Accepted" && spec.use !== "InUse" && !spec.autoActivate) buttons.append(this.button(plan, "start", "Start"));
    if (open) buttons.append(this.button(plan, "end", IN_FLIGHT.has(state) ? "Abort" : "End"));
    if (state !== "Ended") buttons.append(this.button(plan, "change", "Change"));
    if (!open) buttons.append(this.button(plan, "remove", "Delete"));
    item.append(buttons);
    return item;
  }

  private button(plan: FlightPlan, action: keyof PlanActions, text: string): HTMLButtonElement {
    const button = element("button", "", text);
    button.type = "button";
    button.dataset["action"] = action;
    button.setAttribute("aria-label", `${text} ${plan.metadata.name}`);
    button.addEventListener("click", () => this.actions[action](plan));
    return button;
  }
}
