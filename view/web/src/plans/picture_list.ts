// Pictures of a flight. Each one is read with the token of the user, and shown from a blob of the browser.

import { byId, element } from "../elements";
import { clock } from "../text";
import type { Api } from "./api";
import { KeyedList } from "./keyed_list";
import type { RecordedPicture } from "./types";

const MAX_PICTURES = 12;
/** Size up to which pictures are read without a request of the user. They use the link of the drone. */
const MAX_AUTOMATIC_BYTES = 1_000_000;

export function latestPictures(pictures: RecordedPicture[]): RecordedPicture[] {
  return pictures.slice(-MAX_PICTURES);
}

export class PictureList {
  private pictures: RecordedPicture[] = [];
  private readonly list = new KeyedList<RecordedPicture>(byId("pictures"), "No pictures yet.", (picture) => this.createItem(picture));
  /** Pictures that were requested, by their ids. */
  private readonly states = new Map<string, "loading" | "shown" | "failed">();
  private readonly urls = new Map<string, string>();

  /** `path` is that of the pictures. `explain` returns a sentence about an error. */
  constructor(
    private readonly client: Api,
    private readonly path: string,
    private readonly signal: AbortSignal,
    private readonly explain: (error: unknown) => string,
  ) {}

  /** Shows pictures, the latest first. */
  show(pictures: RecordedPicture[]): void {
    this.pictures = pictures;
    const shown = new Map(pictures.toReversed().map((picture) => [picture.id, picture]));
    this.list.show(shown);
    for (const id of this.states.keys()) if (!shown.has(id)) this.forget(id);
  }

  /** Reads the latest picture that was not requested yet, unless it is large. Returns false if there is none. */
  async loadNext(): Promise<boolean> {
    const next = this.pictures.findLast(({ id, sizeBytes }) => !this.states.has(id) && sizeBytes <= MAX_AUTOMATIC_BYTES);
    if (next !== undefined) await this.load(next);
    return next !== undefined;
  }

  clear(): void {
    for (const id of [...this.states.keys()]) this.forget(id);
    this.list.clear();
  }

  private forget(id: string): void {
    this.states.delete(id);
    const url = this.urls.get(id);
    if (url !== undefined) URL.revokeObjectURL(url);
    this.urls.delete(id);
  }

  private createItem(picture: RecordedPicture): HTMLLIElement {
    const item = element("li");
    const button = element("button", "", `Load ${megabytes(picture)}`);
    button.type = "button";
    button.setAttribute("aria-label", `Load ${titleOf(picture)}, ${megabytes(picture)}`);
    button.addEventListener("click", () => void this.load(picture));
    item.append(button, element("p", "facts", `${picture.component} ${clock(Date.parse(picture.time))}`));
    return item;
  }

  private async load(picture: RecordedPicture): Promise<void> {
    const { id } = picture;
    const state = this.states.get(id);
    const item = this.list.item(id);
    if (item === undefined || state === "loading" || state === "shown") return;
    this.states.set(id, "loading");
    try {
      const content = await this.client.content(`${this.path}/${id}`, this.signal);
      if (this.list.item(id) !== item) return;
      // The content comes from a drone. With this type, a browser never opens it as a document with scripts.
      const url = URL.createObjectURL(new Blob([content], { type: "image/jpeg" }));
      this.urls.set(id, url);
      this.states.set(id, "shown");
      this.showImage(item, picture, url);
    } catch (error) {
      if (this.list.item(id) !== item) return;
      this.states.set(id, "failed");
      item.querySelector(".problem")?.remove();
      item.append(element("p", "problem", this.explain(error)));
    }
  }

  private showImage(item: HTMLLIElement, picture: RecordedPicture, url: string): void {
    const image = element("img");
    image.src = url;
    image.alt = titleOf(picture);
    const link = element("a");
    link.href = url;
    link.target = "_blank";
    link.append(image);
    const focused = item.contains(document.activeElement);
    item.querySelector(".problem")?.remove();
    item.querySelector("button")!.replaceWith(link);
    if (focused) link.focus();
  }
}

function titleOf({ component, time }: RecordedPicture): string {
  return `picture of ${component} at ${clock(Date.parse(time))} UTC`;
}

function megabytes({ sizeBytes }: RecordedPicture): string {
  return `${(sizeBytes / 1e6).toFixed(1)} MB`;
}
