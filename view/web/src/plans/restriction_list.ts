// List of restrictions with their actions. It is equivalent to the restrictions on the map.

import { byId, element } from "../elements";
import { actionName, bandOf, classOf, ruleOf, stateOf, validityOf } from "./restriction_text";
import type { Restriction } from "./types";

export interface RestrictionActions {
  show(restriction: Restriction): void;
  change(restriction: Restriction): void;
  end(restriction: Restriction): void;
  remove(restriction: Restriction): void;
}

export class RestrictionList {
  private shown = "";

  constructor(private readonly actions: RestrictionActions) {}

  /** Shows restrictions, or a sentence if there are none. Equal restrictions are not shown again, so that the focus stays. */
  show(restrictions: Restriction[], editable: boolean, empty: string): void {
    const now = Date.now();
    const states = restrictions.map((restriction) => stateOf(restriction, now));
    const key = JSON.stringify([restrictions, states, editable, empty]);
    if (key === this.shown) return;
    this.shown = key;
    const list = byId("restrictions");
    const focused = list.contains(document.activeElement) ? (document.activeElement as HTMLElement).getAttribute("aria-label") : null;
    const items = restrictions.map((restriction, index) => this.createItem(restriction, states[index]!, editable));
    list.replaceChildren(...(items.length > 0 ? items : [element("li", "empty", empty)]));
    if (focused !== null) ([...list.querySelectorAll("button")].find((button) => button.getAttribute("aria-label") === focused) ?? byId("restrictions-title")).focus();
  }

  private createItem(restriction: Restriction, state: string, editable: boolean): HTMLLIElement {
    const { name, zone, policy, status } = restriction;
    const item = element("li");
    const head = element("p", "head");
    head.append(element("span", `swatch ${classOf(policy)}`), element("span", "name", name), element("span", "badge", state), element("span", "facts", ruleOf(policy)));
    item.append(head);
    if (zone?.description) item.append(element("p", "", zone.description));
    const action = policy.action && classOf(policy) === "exclusion" ? `violation: ${actionName(policy.action)}` : "";
    const facts = [zone ? bandOf(zone.altitude) : "its zone was deleted", validityOf(restriction), action];
    item.append(element("p", "facts", facts.filter(Boolean).join("; ")));
    for (const { type, status: value, message } of status?.conditions ?? []) {
      if (type === "Ready" && value !== "True") item.append(element("p", "problem", `Not enforced yet: ${message ?? ""}`));
    }
    const buttons = element("p", "head");
    buttons.append(this.button(restriction, "show", "Show"));
    if (editable) {
      if (state !== "Ended") buttons.append(this.button(restriction, "change", "Change"));
      if (state === "In force") buttons.append(this.button(restriction, "end", "End now"));
      buttons.append(this.button(restriction, "remove", "Delete"));
    }
    item.append(buttons);
    return item;
  }

  private button(restriction: Restriction, action: keyof RestrictionActions, text: string): HTMLButtonElement {
    const button = element("button", "", text);
    button.type = "button";
    button.setAttribute("aria-label", `${text} ${restriction.name}`);
    button.addEventListener("click", () => this.actions[action](restriction));
    return button;
  }
}
