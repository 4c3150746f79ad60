// Lists over time: events, and whatever else has a row for each of its times.

import { element, eventRow, keepInSight } from "report-drawing";

import type { Event } from "./results";
import type { Cursor } from "./viewer";

/** A list of rows with their times, in order; the newest before the cursor is marked. */
export class TimedList {
  readonly made = element("ol", { class: "list" });
  private rows: readonly HTMLElement[] = [];
  private times: readonly number[] = [];
  private here = -1;

  fill(times: readonly number[], rows: readonly HTMLElement[]): void {
    [this.times, this.rows, this.here] = [times, rows, -1];
    this.made.replaceChildren(...rows.map((row) => element("li", {}, row)));
  }

  show(time: number): void {
    let here = -1;
    while (here + 1 < this.times.length && this.times[here + 1]! <= time + 1e-9) here += 1;
    if (here === this.here) return;
    this.rows[this.here]?.removeAttribute("aria-current");
    this.here = here;
    const row = this.rows[here];
    if (!row) return;
    row.setAttribute("aria-current", "true");
    keepInSight(this.made, row.parentElement!);
  }
}

/** The list of events. */
export class EventList {
  private readonly list = new TimedList();
  private readonly count = element("summary", {});
  readonly made = element("details", { class: "events", open: true }, this.count, this.list.made);
  private shown: readonly Event[] = [];
  private length = -1;

  show(events: readonly Event[], cursor: Cursor, choose: (event: Event) => void): void {
    if (events !== this.shown || events.length !== this.length) {
      [this.shown, this.length] = [events, events.length];
      this.list.fill(events.map((event) => event.time), events.map((event) => eventRow(event, () => choose(event))));
      this.count.textContent = events.length === 1 ? "1 event" : `${events.length} events`;
    }
    this.list.show(cursor.time);
  }
}
