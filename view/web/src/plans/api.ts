// Requests to the management API on the host of the page, with the token of the user.

const RECONNECT_MS = 2_000;
/** Time without a byte after which a stream counts as dead. The server sends a comment every 15 s. */
const SILENCE_MS = 40_000;
/** Statuses after which the same request may succeed. */
export const TEMPORARY = new Set([429, 503]);

/** A response with an error. The message contains the sentences of the server. */
export class Problem extends Error {
  constructor(
    readonly status: number,
    message: string,
  ) {
    super(message);
  }
}

export interface Reply<T> {
  status: number;
  body: T;
  /** Version of the object, for If-Match. Empty if the response has none. */
  etag: string;
}

export interface Page<T> {
  items: T[];
  continue?: string | null;
}

export interface Contact {
  connected(): void;
  /** The server does not respond. */
  lost(): void;
}

export class Api {
  constructor(
    private readonly token: string,
    private readonly namespace: string,
    private readonly contact: Contact,
  ) {}

  /** Sends a request. Throws a Problem if the server refuses it, and a TypeError if the server does not respond. */
  async send<T>(method: string, path: string, body?: unknown, headers: Record<string, string> = {}, signal?: AbortSignal): Promise<Reply<T>> {
    const content = body === undefined ? {} : { body: JSON.stringify(body) };
    const type = body === undefined ? {} : { "Content-Type": "application/json" };
    const response = await this.fetch(path, { method, headers: { ...type, ...headers }, ...content, signal: signal ?? null });
    const received = (response.status === 204 ? undefined : await response.json()) as T;
    return { status: response.status, body: received, etag: response.headers.get("ETag") ?? "" };
  }

  /** Returns the content of a file. Throws the errors of `send`. */
  async content(path: string, signal: AbortSignal): Promise<ArrayBuffer> {
    return (await this.fetch(path, { signal })).arrayBuffer();
  }

  /** Returns all pages of a list. */
  async list<T>(path: string): Promise<T[]> {
    const items: T[] = [];
    let next = "";
    do {
      const page = (await this.send<Page<T>>("GET", `${path}?limit=500${next && `&continue=${encodeURIComponent(next)}`}`)).body;
      items.push(...page.items);
      next = page.continue ?? "";
    } while (next);
    return items;
  }

  /** Passes each event of a stream to a function until the signal is aborted or the stream ends by itself. Reconnects after errors. */
  async follow(path: string, signal: AbortSignal, handle: (event: string, data: unknown) => void): Promise<void> {
    let lastId = "";
    while (!signal.aborted) {
      try {
        for await (const { event, data, id } of this.events(path, lastId, signal)) {
          lastId = id || lastId;
          if (signal.aborted) return;
          const content: unknown = JSON.parse(data);
          if (event === "error" && TEMPORARY.has((content as { status: number }).status)) break;
          handle(event, content);
          if (event === "deleted" || event === "error") return;
        }
      } catch (error) {
        if (signal.aborted) return;
        if (error instanceof Problem && !TEMPORARY.has(error.status)) throw error;
      }
      await new Promise((resolve) => setTimeout(resolve, RECONNECT_MS));
    }
  }

  private async *events(path: string, lastId: string, signal: AbortSignal): AsyncGenerator<{ event: string; data: string; id: string }> {
    const silent = new AbortController();
    let timer = setTimeout(() => silent.abort(), SILENCE_MS);
    try {
      const headers: Record<string, string> = lastId ? { "Last-Event-ID": lastId } : {};
      const response = await this.fetch(path, { headers, signal: AbortSignal.any([signal, silent.signal]) });
      const decoder = new TextDecoder();
      let text = "";
      for (const reader = response.body!.getReader(); ; ) {
        const { done, value } = await reader.read();
        if (done) return;
        clearTimeout(timer);
        timer = setTimeout(() => silent.abort(), SILENCE_MS);
        text += decoder.decode(value, { stream: true });
        const messages = text.split("\n\n");
        text = messages.pop()!;
        for (const message of messages) {
          const fields = new Map(message.split("\n").map((line) => [line.slice(0, line.indexOf(":")), line.slice(line.indexOf(":") + 2)]));
          if (fields.has("data")) yield { event: fields.get("event") ?? "", data: fields.get("data")!, id: fields.get("id") ?? "" };
        }
      }
    } finally {
      clearTimeout(timer);
    }
  }

  private async fetch(path: string, options: RequestInit): Promise<Response> {
    const namespace = this.namespace && `${path.includes("?") ? "&" : "?"}namespace=${encodeURIComponent(this.namespace)}`;
    const headers = { Authorization: `Bearer ${this.token}`, ...options.headers };
    let response: Response;
    try {
      response = await fetch(`/v1${path}${namespace}`, { ...options, headers, cache: "no-store", credentials: "omit" });
    } catch (error) {
      if (!options.signal?.aborted) this.contact.lost();
      throw error;
    }
    if (!TEMPORARY.has(response.status)) this.contact.connected();
    if (!response.ok) throw new Problem(response.status, await detail(response));
    return response;
  }
}

async function detail(response: Response): Promise<string> {
  try {
    return String(((await response.json()) as { detail: string }).detail);
  } catch {
    return `The server responded with the status ${response.status}.`;
  }
}
