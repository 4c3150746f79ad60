// The panel of the automaton: its drawing, the present states, what is still to be done, and the moves taken.

import {
  describe, drawAutomaton, element, keepInView, legendOf, light, printable, secondsText, type DrawnAutomaton, type DrawnStates,
} from "report-drawing";
import { createElement, type ReactElement } from "react";

import { TimedList } from "./event-list";
import { type AutomatonMessage, type AutomatonStateMessage, type EventMessage, type RecentEventsMessage, type ResultMessage, type SpecificationMessage } from "./messages";
import { EVENTS, RECENT_EVENTS, Results } from "./results";
import { Series } from "./series";
import { chooser, type Cursor, type View, type Viewer } from "./viewer";

const AUTOMATON = "/spatial/automaton";
const UNKNOWN = -1;

/** A move from one set of states to another, at the sample that brought it about. */
interface Taken {
  readonly time: number;
  readonly sources: readonly number[];
  readonly targets: readonly number[];
  readonly guard: string;
}

export class AutomatonView implements View {
  readonly topics = [EVENTS, AUTOMATON];
  readonly currentTopics = [RECENT_EVENTS];
  readonly body = element("div", { class: "panel-body" });
  private readonly results: Results;
  private readonly drawing = element("div", { class: "drawing" });
  private readonly tasks = element("div", { class: "tasks" });
  private readonly words = element("div", { class: "moves" });
  private readonly taken = new TimedList();
  private run: Run | null = null;
  private drawn: DrawnStates | null = null;
  private automaton: DrawnAutomaton | null = null;
  private distances = new Map<number, number>();
  private shown = "";
  private length = -1;

  constructor(private readonly viewer: Viewer) {
    this.results = new Results(viewer);
    this.body.append(this.drawing, this.tasks, element("details", { open: true },
      element("summary", {}, "Moves taken"), this.taken.made),
    element("details", {}, element("summary", {}, "Moves from here"), this.words));
  }

  specify(message: SpecificationMessage): void {
    this.results.specify(message);
    this.build();
  }

  reset(topic: string): void {
    if (topic === EVENTS) {
      this.results.events = [];
      return;
    }
    // the events of a file were read before its states
    this.results.findWorst();
    if (this.results.shown !== this.run?.result) this.build();
    this.run?.clear();
  }

  take(topic: string, time: number, message: unknown): void {
    if (topic === EVENTS) this.results.takeEvent(time, message as EventMessage);
    else if (topic === RECENT_EVENTS) this.results.takeRecent(time, message as RecentEventsMessage);
    else this.run?.take(time, message as AutomatonStateMessage);
  }

  show(cursor: Cursor): void {
    const { run, drawn, automaton } = this;
    if (!run || !drawn || !automaton) return;
    const states = run.statesAt(cursor.time);
    this.body.dataset.states = states.join(" ");
    if (states.join() !== this.shown) {
      this.shown = states.join();
      light(drawn, [...states]);
      if (states.length) keepInView(this.drawing, drawn.states.get(states[0]!));
      this.words.replaceChildren(...describe(automaton, [...states]));
      this.tasks.replaceChildren(...this.tasksIn(automaton, states));
    }
    this.showTaken(run, cursor);
  }

  head(): ReactElement {
    const { results } = this;
    if (!results.all.length) {
      return createElement("p", { className: "note" },
        "No specification here: open a log that `replay -o` or `record --spec` wrote, or a live server.");
    }
    return createElement("div", { className: "panel-head" },
      results.all.length > 1
        ? chooser("Result", results.titles, results.place, (place) => this.choose(place))
        : createElement("b", null, results.titles[0] ?? ""),
      createElement("span", { className: "quiet" }, this.automaton?.summary ?? (this.run?.isEmpty
        ? "has no automaton: `check --dfa -` says why" : "has its automaton elsewhere: replay the log again")));
  }

  private choose(place: number): void {
    const before = this.results.shown;
    this.results.choose(place);
    if (this.results.shown !== before) {
      this.build();
      this.viewer.reread([AUTOMATON]);
    }
    this.viewer.refresh();
  }

  private build(): void {
    const result = this.results.shown;
    this.automaton = result?.automaton ? drawnOf(result.automaton) : null;
    this.distances = new Map();
    for (const each of result?.automaton?.states ?? []) {
      if (each.accepting || each.distance) this.distances.set(each.number ?? 0, each.distance ?? 0);
    }
    this.run = result ? new Run(result) : null;
    this.drawn = this.automaton ? drawAutomaton(this.automaton) : null;
    this.drawing.replaceChildren(...(this.drawn && this.automaton ? [this.drawn.made, legendOf(this.automaton)] : []));
    this.tasks.replaceChildren();
    this.words.replaceChildren();
    this.body.hidden = !this.automaton;
    this.shown = " ";
    this.length = -1;
  }

  /** Returns what is still to be done, and what must not happen, for acceptance to come nearer and not be lost. */
  private tasksIn(automaton: DrawnAutomaton, states: readonly number[]): HTMLElement[] {
    if (states.length !== 1) return [];
    const [state] = states as [number];
    const drawn = automaton.states.find((each) => each.number === state);
    if (!drawn) return [element("p", {}, `State ${state} is not drawn.`)];
    const distance = this.distances.get(state);
    if (distance === undefined) return [element("p", {}, "Acceptance is lost: nothing can be done any more.")];
    if (drawn.won) return [element("p", {}, "Accepted, whatever happens: nothing is left to be done.")];
    const moves = automaton.moves.filter((move) => move.source === state);
    const next = moves.filter((move) => (this.distances.get(move.target) ?? Infinity) < distance);
    const lost = moves.filter((move) => !this.distances.has(move.target));
    const away = moves.filter((move) => distance === 0 && move.target !== state && (this.distances.get(move.target) ?? 0) > 0);
    const listed = (title: string, found: typeof moves) => found.length
      ? [element("h3", {}, title), element("ul", {}, ...found.map((move) => element("li", {},
        element("code", {}, move.guard), element("span", { class: "quiet" }, ` → state ${move.target}`))))]
      : [];
    const still = distance === 0 ? [element("p", {}, "Accepted if the run ends here.")]
      : listed(distance === 1 ? "Still to be done" : `Still to be done, first of ${distance} steps`, next);
    return [...still, ...listed("Must not happen", [...lost, ...away])];
  }

  private showTaken(run: Run, cursor: Cursor): void {
    const taken = run.taken();
    if (taken.length !== this.length) {
      this.length = taken.length;
      this.taken.fill(taken.map((each) => each.time), taken.map((each) => element("button", {
        type: "button", class: "event", onclick: () => this.viewer.seek(each.time),
      }, element("span", {}), element("time", {}, secondsText(each.time)), element("span", { class: "sentence" },
        `${each.sources.length ? each.sources.join(" or ") : "?"} → ${each.targets.join(" or ")} `, each.guard ? element("code", {}, printable(each.guard)) : ""))));
    }
    this.taken.show(cursor.time);
  }
}

/** The states of one result over time: of each sample the set of states, and the move that led there. */
class Run {
  private readonly series = new Series(2);
  private readonly codes = new Map<string, number>();
  private readonly sets: (readonly number[])[] = [];
  private readonly guards = new Map<string, string>();
  private known: Taken[] | null = null;

  constructor(readonly result: ResultMessage) {}

  get isEmpty(): boolean {
    return this.series.samples === 0;
  }

  clear(): void {
    this.series.clear();
    this.known = null;
  }

  take(time: number, message: AutomatonStateMessage): void {
    if (message.specification !== this.result.name || message.object !== this.result.object) return;
    const states = Array.from(message.states);
    const key = states.join();
    let code = this.codes.get(key);
    if (code === undefined) {
      code = this.sets.push(states) - 1;
      this.codes.set(key, code);
    }
    const source = message.source ?? (message.guard ? 0 : UNKNOWN);
    if (message.guard) this.guards.set(`${source} ${key}`, message.guard);
    this.series.put(time, [code, source]);
    this.known = null;
  }

  statesAt(time: number): readonly number[] {
    const place = this.series.at(time);
    return place === null ? [] : this.sets[this.series.columns[0]![place]!]!;
  }

  /** Returns the samples at which the states changed. */
  taken(): readonly Taken[] {
    if (this.known) return this.known;
    const { samples, times, columns: [codes, sources] } = this.series;
    const found: Taken[] = [];
    for (let place = 0; place < samples; place++) {
      const targets = this.sets[codes![place]!]!;
      const source = sources![place]!;
      const before = place ? this.sets[codes![place - 1]!]! : [source];
      if (before.join() === targets.join()) continue;
      const known = before.length === 1 ? before[0]! : null;
      found.push({
        time: times[place]!, targets, sources: known === UNKNOWN ? [] : before,
        guard: known === null ? "" : this.guards.get(`${known} ${targets.join()}`) ?? "",
      });
    }
    this.known = found;
    return found;
  }
}

function drawnOf(message: AutomatonMessage): DrawnAutomaton {
  return {
    summary: printable(message.summary),
    left_out: message.left_out,
    states: message.states.map((each) => ({
      number: each.number ?? 0,
      at: [each.column ?? 0, each.row ?? 0],
      about: printable(each.about),
      accepting: each.accepting,
      lost: !each.accepting && !each.distance,
      won: !each.can_reject,
    })),
    moves: message.moves.map((each) => ({
      source: each.source ?? 0, target: each.target ?? 0, guard: printable(each.guard), label: printable(each.label ?? ""),
    })),
    legend: (message.legend ?? []).map(printable),
  };
}
