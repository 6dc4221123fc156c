// Base map, which the server reads from a file or directory.

import { byId } from "./elements";

export interface BaseMap {
  min_zoom: number;
  max_zoom: number;
  attribution: string;
}

/** Returns the base map, or null if the server has none. Without it, the map has a plain background. */
export async function loadBaseMap(): Promise<BaseMap | null> {
  const response = await fetch("/map.json");
  const map = response.ok ? ((await response.json()) as BaseMap | null) : null;
  byId("attribution").textContent = map?.attribution ?? "";
  return map;
}
