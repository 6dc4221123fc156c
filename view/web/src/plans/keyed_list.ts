// List of records that is updated often.

import { element } from "../elements";

/** List whose items stay in the document as long as their records are shown, so that focus and reading position stay. */
export class KeyedList<T> {
  private readonly items = new Map<string, HTMLLIElement>();

  constructor(
    private readonly list: HTMLElement,
    private readonly empty: string,
    private readonly create: (record: T) => HTMLLIElement,
  ) {}

  /** Shows records in their order, by their keys. Returns the records that were not shown before. */
  show(records: Map<string, T>): T[] {
    for (const [key, item] of this.items) {
      if (records.has(key)) continue;
      item.remove();
      this.items.delete(key);
    }
    const added: T[] = [];
    if (records.size > 0) this.list.querySelector(".empty")?.remove();
    for (const [index, [key, record]] of [...records].entries()) {
      let item = this.items.get(key);
      if (item === undefined) {
        item = this.create(record);
        this.items.set(key, item);
        added.push(record);
      }
      if (this.list.children[index] !== item) this.list.insertBefore(item, this.list.children[index] ?? null);
    }
    if (this.list.children.length === 0) this.list.append(element("li", "empty", this.empty));
    return added;
  }

  item(key: string): HTMLLIElement | undefined {
    return this.items.get(key);
  }

  clear(): void {
    this.items.clear();
    this.list.replaceChildren();
  }
}
