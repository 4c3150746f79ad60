// The results of a specification's message, which of them a panel shows, and what has happened to them.

import { printable, type DrawnEvent, type Status } from "report-drawing";

import {
  nanoseconds, titleOf, type EventMessage, type RecentEventsMessage, type ResultMessage, type SpecificationMessage,
} from "./messages";
import type { Viewer } from "./viewer";

export const EVENTS = "/spatial/events";
/** The newest events, for panels that join a run late. */
export const RECENT_EVENTS = "/spatial/recent_events";

/** A change, with the time at which it is confirmed: before that, no one knows of it. */
export interface Event extends DrawnEvent {
  readonly node: number;
  readonly verdict: string;
  readonly known: number;
  /** The atom that decided, if the event is a verdict. */
  readonly witness: number | null;
}

/** Which result is shown: the reader's choice or, without one, the worst: of those violated, the one that was so first. */
export class Results {
  all: readonly ResultMessage[] = [];
  events: Event[] = [];
  private chosen: string | null;
  /** The places of all results, the worst first. */
  private order: readonly number[] = [];

  constructor(private readonly viewer: Viewer) {
    const { result } = viewer.state;
    this.chosen = typeof result === "string" ? result : null;
  }

  specify(message: SpecificationMessage): void {
    this.all = message.results;
    this.findWorst();
  }

  /** The titles of all results, the worst first. */
  get titles(): string[] {
    return this.order.map((place) => printable(titleOf(this.all[place]!.name, this.all[place]!.object)));
  }

  /** The place among the titles of the result that is shown; 0 without any. */
  get place(): number {
    const chosen = this.all.findIndex((each) => titleOf(each.name, each.object) === this.chosen);
    return Math.max(this.order.indexOf(chosen), 0);
  }

  /**
   * Finds the order of results, by the events so far: those violated, by time, those unknown, the others. Of equal
   * times the order of events counts: what only the end of a log decided comes last in it.
   */
  findWorst(): void {
    const keys = this.all.map((each, place) => {
      const newest = this.newest(each, Infinity);
      if (newest?.verdict === "violated") return [0, newest.known, this.events.indexOf(newest), place];
      return [newest?.verdict === "unknown" ? 1 : 2, 0, 0, place];
    });
    const differing = (one: number[], other: number[]) => one.findIndex((key, index) => key !== other[index]);
    this.order = this.all.map((_, place) => place).sort((one, other) => {
      const at = differing(keys[one]!, keys[other]!);
      return at < 0 ? 0 : keys[one]![at]! - keys[other]![at]!;
    });
  }

  get shown(): ResultMessage | undefined {
    return this.all[this.order[this.place]!];
  }

  choose(place: number): void {
    const result = this.all[this.order[place]!];
    if (!result) return;
    this.chosen = titleOf(result.name, result.object);
    this.viewer.save({ result: this.chosen });
  }

  find(name: string, object: string | undefined): number {
    return this.all.findIndex((each) => each.name === name && each.object === (object ?? ""));
  }

  takeEvent(time: number, message: EventMessage): void {
    const facts = new Map(message.metadata.map((each) => [each.key, each.value]));
    const start = message.start_time ? this.viewer.seconds(nanoseconds(message.start_time)) : time;
    const event: Event = {
      time: start,
      known: message.end_time ? this.viewer.seconds(nanoseconds(message.end_time)) : time,
      status: statusOfEvent(facts),
      specification: facts.get("specification") ?? "",
      object: facts.get("object"),
      parts: printable(facts.get("message") ?? "").split("`"),
      node: Number(facts.get("node") ?? 0),
      verdict: facts.has("vacuous") ? "" : facts.get("verdict") ?? "",
      witness: facts.has("witness_node") ? Number(facts.get("witness_node")) : null,
    };
    const isSame = (each: Event) => each.known === event.known && each.node === event.node && each.time === event.time
      && each.specification === event.specification && each.object === event.object && each.status === event.status;
    let place = this.events.length;
    while (place && this.events[place - 1]!.time > event.time) place -= 1;
    for (let before = place - 1; before >= 0 && this.events[before]!.time === event.time; before--) {
      if (isSame(this.events[before]!)) return;
    }
    this.events.splice(place, 0, event);
  }

  takeRecent(time: number, { events, facts = [] }: RecentEventsMessage): void {
    facts.forEach((event, place) => {
      const message = { key: "message", value: events[place]!.event };
      this.takeEvent(time, { ...event, metadata: [...event.metadata, message] });
    });
  }

  /** Returns the newest event of a result that is known at a time. */
  newest(result: ResultMessage, time: number): Event | null {
    let newest: Event | null = null;
    for (const each of this.events) {
      const isOfResult = each.node === 0 && each.verdict && each.specification === result.name
        && (each.object ?? "") === result.object;
      if (isOfResult && each.known <= time && (!newest || each.known >= newest.known)) newest = each;
    }
    return newest;
  }
}

function statusOfEvent(facts: Map<string, string>): Status {
  if (facts.has("vacuous")) return "vacuous";
  const verdict = facts.get("verdict");
  if (verdict === "satisfied" || verdict === "violated" || verdict === "unknown") return verdict;
  return facts.get("sign") === "positive" ? "holding" : "pending";
}
