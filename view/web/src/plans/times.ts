// Times of the API and of inputs, in UTC.

/** Returns a time of the API as it is shown. */
export function timeOf(time: string): string {
  return `${new Date(time).toISOString().slice(0, 19).replace("T", " ")} UTC`;
}

/** Returns a time in Unix milliseconds as the value of an input of the type datetime-local. */
export function inputTime(time: number): string {
  return new Date(time).toISOString().slice(0, 19);
}

/** Returns the value of an input of the type datetime-local as a time of the API. */
export function apiTime(value: string): string {
  return `${new Date(`${value}Z`).toISOString().slice(0, 19)}Z`;
}
