// Receives events from the server. The browser reconnects automatically, with the id of the last message that it received.

import type { Event, Marker } from "./events";

export interface Listener {
  events(batch: (Event | Marker)[]): void;
  connected(): void;
  /** The connection is lost. If `refused`, the browser does not reconnect. */
  lost(refused: boolean): void;
}

export function listen(listener: Listener): void {
  const source = new EventSource("/stream");
  source.onopen = () => listener.connected();
  source.onerror = () => listener.lost(source.readyState === EventSource.CLOSED);
  source.onmessage = (message: MessageEvent<string>) => {
    const batch = JSON.parse(message.data) as (Event | Marker)[];
    listener.events(batch);
    if (batch.some((event) => event.type === "end")) source.close();
  };
}
