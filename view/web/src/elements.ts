// Elements of the document.

export function element<K extends keyof HTMLElementTagNameMap>(tag: K, className = "", text = ""): HTMLElementTagNameMap[K] {
  const created = document.createElement(tag);
  if (className) created.className = className;
  if (text) created.textContent = text;
  return created;
}

export function byId<T extends HTMLElement>(id: string): T {
  return document.getElementById(id) as T;
}

/** Sets a text. An equal text is not set again, because screen readers would read it again. */
export function setText(target: HTMLElement, text: string): void {
  if (target.textContent !== text) target.textContent = text;
}

/** Returns the problem of the first invalid input of a form as a sentence, or an empty text. */
export function invalidInput(form: HTMLFormElement): string {
  const invalid = form.querySelector<HTMLInputElement>(":invalid:not(fieldset)");
  if (invalid === null) return "";
  const label = invalid.getAttribute("aria-label") ?? invalid.labels?.[0]?.textContent ?? invalid.name;
  return `${label}: ${invalid.validationMessage}`;
}
