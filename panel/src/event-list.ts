// Lists over time: events, and whatever else has a row for each of its times.

import { element, eventRow, keepInSight, markedEvent } from "report-drawing";

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

  /** Marks the newest row; of several at once one that is chosen. */
  show(time: number, isChosen: (place: number) => boolean = () => false): void {
    const here = markedEvent(this.times, time, isChosen);
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

  show(
    events: readonly Event[], cursor: Cursor, choose: (event: Event) => void, isChosen: (event: Event) => boolean,
  ): void {
    if (events !== this.shown || events.length !== this.length) {
      [this.shown, this.length] = [events, events.length];
      this.list.fill(events.map((event) => event.time), events.map((event) => eventRow(event, () => choose(event))));
      this.count.textContent = events.length === 1 ? "1 event" : `${events.length} events`;
    }
    this.list.show(cursor.time, (place) => isChosen(events[place]!));
  }
}
