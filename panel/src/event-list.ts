// The list of events.

import { element, eventRow, keepInSight } from "report-drawing";

import type { Event } from "./results";
import type { Cursor } from "./viewer";

/** The list of events; the newest before the cursor is marked. */
export class EventList {
  private readonly list = element("ol", { class: "list" });
  private readonly count = element("summary", {});
  readonly made = element("details", { class: "events", open: true }, this.count, this.list);
  private rows: HTMLElement[] = [];
  private shown: readonly Event[] = [];
  private length = -1;
  private here = -1;

  show(events: readonly Event[], cursor: Cursor, choose: (event: Event) => void): void {
    if (events !== this.shown || events.length !== this.length) {
      [this.shown, this.length, this.here] = [events, events.length, -1];
      this.rows = events.map((event) => eventRow(event, () => choose(event)));
      this.list.replaceChildren(...this.rows.map((row) => element("li", {}, row)));
      this.count.textContent = events.length === 1 ? "1 event" : `${events.length} events`;
    }
    let here = -1;
    while (here + 1 < events.length && events[here + 1]!.time <= cursor.time + 1e-9) here += 1;
    if (here === this.here) return;
    this.rows[this.here]?.removeAttribute("aria-current");
    this.here = here;
    const row = this.rows[here];
    if (!row) return;
    row.setAttribute("aria-current", "true");
    keepInSight(this.list, row.parentElement!);
  }
}
