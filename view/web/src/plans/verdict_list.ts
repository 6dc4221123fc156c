// Lists of the verdicts of a flight: first refusals, corrections, takeovers and alarms, then the other calls.

import { byId, element } from "../elements";
import { actionOf, callOf, clock } from "../text";
import { KeyedList } from "./keyed_list";
import type { FlightVerdict } from "./types";

const MAX_INTERVENTIONS = 200;
const MAX_CALLS = 100;

export interface Zones {
  /** Returns true if the area of a policy can be shown. */
  has(policy: string): boolean;
  show(policy: string): void;
}

/** Returns the latest verdicts. Calls without effect on the flight do not displace the others. */
export function latestVerdicts(verdicts: FlightVerdict[]): FlightVerdict[] {
  const others = verdicts.filter((verdict) => !isIntervention(verdict));
  return [...verdicts.filter(isIntervention).slice(-MAX_INTERVENTIONS), ...others.slice(-MAX_CALLS)];
}

/** Returns a verdict as a sentence without its time. */
export function verdictSentence(verdict: FlightVerdict): string {
  return [`${callOf(verdict)} ${actionOf(verdict)}`.trim(), reasonOf(verdict)].filter(Boolean).join(", ");
}

export class VerdictList {
  private readonly interventions = new KeyedList<FlightVerdict>(byId("verdicts"), "No refusals, corrections, takeovers or alarms yet.", (verdict) => this.createItem(verdict));
  private readonly calls = new KeyedList<FlightVerdict>(byId("calls"), "No other calls yet.", (verdict) => this.createItem(verdict));

  constructor(private readonly zones: Zones) {}

  /** Shows verdicts, the latest first. Returns the refusals, corrections, takeovers and alarms that were not shown before. */
  show(verdicts: FlightVerdict[]): FlightVerdict[] {
    this.calls.show(byKey(verdicts.filter((verdict) => !isIntervention(verdict))));
    return this.interventions.show(byKey(verdicts.filter(isIntervention)));
  }

  clear(): void {
    this.interventions.clear();
    this.calls.clear();
  }

  private createItem(verdict: FlightVerdict): HTMLLIElement {
    const item = element("li", `verdict ${verdict.action || verdict.kind}`);
    const head = element("p", "head");
    head.append(element("span", "facts", clock(Date.parse(verdict.time))), element("span", "badge", actionOf(verdict)), element("span", "", callOf(verdict)));
    item.append(head);
    const reason = reasonOf(verdict);
    if (reason) item.append(element("p", "facts", reason));
    for (const policy of verdict.policies ?? []) item.append(this.createPolicy(policy));
    return item;
  }

  private createPolicy(policy: string): HTMLParagraphElement {
    const line = element("p", "facts", `policy ${policy}`);
    if (this.zones.has(policy)) {
      const button = element("button", "needs-map", "Show the area");
      button.type = "button";
      button.setAttribute("aria-label", `Show the area of ${policy}`);
      button.addEventListener("click", () => this.zones.show(policy));
      line.append(" ", button);
    }
    return line;
  }
}

/** Returns verdicts by their content, the latest first. Equal verdicts of the same millisecond are shown once. */
function byKey(verdicts: FlightVerdict[]): Map<string, FlightVerdict> {
  return new Map(verdicts.toReversed().map((verdict) => [JSON.stringify(verdict), verdict]));
}

/** Returns true if policies changed or refused a call, the system took control, or there was an alarm. */
function isIntervention({ kind, action }: FlightVerdict): boolean {
  return kind === "call" ? action !== "allow" : kind !== "control";
}

function reasonOf({ reason, code }: FlightVerdict): string {
  return reason || code || "";
}
