// Form of the parameters of an application, from their JSON schema. Parameters that are no simple values are entered as JSON.

import { element } from "../elements";

interface Schema {
  properties?: Record<string, Property>;
  required?: string[];
}

interface Property {
  type?: string;
  title?: string;
  description?: string;
  default?: unknown;
  enum?: unknown[];
  minimum?: number;
  maximum?: number;
}

type Control = HTMLInputElement | HTMLSelectElement | HTMLTextAreaElement;

export class ParameterForm {
  private readonly readers = new Map<string, () => unknown>();
  /** Values that the schema does not describe. They are kept. */
  private others: [string, unknown][] = [];

  constructor(private readonly parent: HTMLElement) {}

  /** Shows the parameters of a schema with their values, or their defaults. */
  show(schema: Schema, values: Record<string, unknown>): void {
    this.readers.clear();
    this.others = Object.entries(values).filter(([name]) => !(name in (schema.properties ?? {})));
    const rows = Object.entries(schema.properties ?? {}).flatMap(([name, property]) =>
      this.createRow(name, property, values[name] ?? property.default, schema.required?.includes(name) ?? false),
    );
    this.parent.replaceChildren(...rows);
  }

  /** Returns the entered values. Empty parameters are omitted. */
  values(): Record<string, unknown> {
    const entries = [...this.readers].map(([name, read]) => [name, read()] as const);
    return Object.fromEntries([...this.others, ...entries].filter(([, value]) => value !== undefined));
  }

  private createRow(name: string, property: Property, value: unknown, required: boolean): HTMLElement[] {
    const [control, read] = createControl(property, value);
    control.id = `parameter-${name}`;
    control.required = required && !(control instanceof HTMLInputElement && control.type === "checkbox");
    this.readers.set(name, read);
    const label = element("label", "", property.title ?? name);
    label.htmlFor = control.id;
    const row = element("p");
    row.append(label, control);
    if (!property.description) return [row];
    const help = element("p", "facts", property.description);
    help.id = `${control.id}-help`;
    control.setAttribute("aria-describedby", help.id);
    return [row, help];
  }
}

/** Returns a control with a value, and the function that reads it. The function returns undefined for an empty control. */
function createControl(property: Property, value: unknown): [Control, () => unknown] {
  if (property.enum !== undefined) {
    const choices = property.enum;
    const select = element("select");
    select.append(new Option("", ""), ...choices.map((choice, index) => new Option(String(choice), String(index), false, choice === value)));
    return [select, () => (select.value === "" ? undefined : choices[Number(select.value)])];
  }
  const input = element("input");
  switch (property.type) {
    case "boolean":
      input.type = "checkbox";
      input.checked = value === true;
      return [input, () => input.checked];
    case "integer":
    case "number":
      input.type = "number";
      input.step = property.type === "integer" ? "1" : "any";
      input.min = String(property.minimum ?? "");
      input.max = String(property.maximum ?? "");
      input.value = String(value ?? "");
      return [input, () => (input.value === "" ? undefined : Number(input.value))];
    case "string":
      input.value = String(value ?? "");
      return [input, () => input.value || undefined];
    default:
      return createJsonControl(value);
  }
}

function createJsonControl(value: unknown): [Control, () => unknown] {
  const area = element("textarea");
  area.value = value === undefined ? "" : JSON.stringify(value);
  area.addEventListener("input", () => {
    try {
      if (area.value) JSON.parse(area.value);
      area.setCustomValidity("");
    } catch {
      area.setCustomValidity("Enter the value as JSON.");
    }
  });
  return [area, () => (area.value ? (JSON.parse(area.value) as unknown) : undefined)];
}
