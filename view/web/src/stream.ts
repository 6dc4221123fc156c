// Events from the server; the browser comes back by itself, and says what it heard last.

import type { Event, Sign } from "./events";

export interface Listener {
  events(all: (Event | Sign)[]): void;
  connected(): void;
  lost(forGood: boolean): void;
}

export function listen(listener: Listener): void {
  const source = new EventSource("/stream");
  source.onopen = () => listener.connected();
  source.onerror = () => listener.lost(source.readyState === EventSource.CLOSED);
  source.onmessage = (message: MessageEvent<string>) => {
    const all = JSON.parse(message.data) as (Event | Sign)[];
    listener.events(all);
    if (all.some((one) => one.type === "end")) source.close();
  };
}
