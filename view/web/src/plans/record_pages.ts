// Reads a list of records that grows during a flight, page by page.

import type { Api, Page } from "./api";

const PAGE_SIZE = 200;
/** Maximum number of pages of one reading, so that a long flight does not block the other records. */
const MAX_PAGES = 10;

export class RecordPages<T> {
  /** Records of the complete pages, as far as they are kept. */
  private complete: T[] = [];
  /** Records of the last page, which grows. */
  private last: T[] = [];
  private passed = 0;
  private next = "";

  /** `keep` limits the number of records. */
  constructor(
    private readonly path: string,
    private readonly keep: (records: T[]) => T[],
  ) {}

  get records(): T[] {
    return this.keep([...this.complete, ...this.last]);
  }

  /** Reads the last page again, and the pages after it. Returns true if there are new records. Throws the errors of `Api.send`. */
  async read(client: Api, signal: AbortSignal): Promise<boolean> {
    const before = this.passed + this.last.length;
    for (let page = 0; page < MAX_PAGES; page++) {
      const position = this.next && `&continue=${encodeURIComponent(this.next)}`;
      const { body } = await client.send<Page<T>>("GET", `${this.path}?limit=${PAGE_SIZE}${position}`, undefined, {}, signal);
      this.last = body.items;
      if (!body.continue) break;
      this.complete = this.records;
      this.passed += body.items.length;
      this.last = [];
      this.next = body.continue;
    }
    return this.passed + this.last.length !== before;
  }
}
