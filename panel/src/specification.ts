// The panel of the specification: the tree with its numbers at the cursor, a node's curve, and the events.

import {
  branch, columns, element, eventRow, keepInSight, numberText, NOW, options, printable, scrub, secondsText, showRow,
  STATUSES, statusOf, uPlot, VALUE, type Chart, type Curve, type DrawnClock, type DrawnNode, type DrawnResult,
  type DrawnRun, type Status, type TreeRow,
} from "report-drawing";
import { createElement, type ReactElement } from "react";

import {
  titleOf, type EventMessage, type NodeMessage, type ResultMessage, type RobustnessMessage, type SpecificationMessage,
} from "./messages";
import { EVENTS, Results, type Event } from "./results";
import { Series } from "./series";
import { chooser, type Cursor, type View, type Viewer } from "./viewer";

const ROBUSTNESS = "/spatial/robustness";
const CHART_HEIGHT = 170;

const TEMPORAL = new Set(["F", "G", "U", "R", "W", "X", "WX", "Y", "O", "H", "S"]);
/** By operator, the signs in which the operands' numbers can become its own; else 1. */
const SIGNS: Record<string, (operand: number) => number[]> = {
  not: () => [-1],
  "->": (operand) => [operand ? 1 : -1],
  xor: () => [1, -1],
  "<->": () => [1, -1],
};
/** How nodes stand, by the numbers of spatial_replay.Standing. */
const STANDING: Record<number, Status> = { 28: "satisfied", 29: "violated", 32: "holding", 42: "pending", 47: "unknown" };

export class SpecificationView implements View {
  readonly topics = [EVENTS, ROBUSTNESS];
  readonly body = element("div", { class: "panel-body" });
  private readonly results: Results;
  private readonly place = element("div", { class: "tree", role: "tree", "aria-label": "Nodes of the formula" });
  private readonly chart: NodeChart;
  private readonly list = new EventList();
  private tree: Tree | null = null;
  private cursor: Cursor = { time: -Infinity, isPreview: false };

  constructor(private readonly viewer: Viewer) {
    this.results = new Results(viewer);
    this.chart = new NodeChart(viewer, () => this.choose(null));
    const head = element("div", { class: "row head", "aria-hidden": "true" }, element("span", { class: "what" }, "node"),
      ...["so far", "between", "now"].map((title) => element("span", { class: "number" }, title)));
    this.body.append(head, this.place, this.chart.made, this.list.made);
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
    // the events of a file were read before its numbers
    this.results.findWorst();
    if (this.results.shown !== this.tree?.message) this.build();
    this.tree?.series.clear();
  }

  take(topic: string, time: number, message: unknown): void {
    if (topic === EVENTS) this.results.takeEvent(time, message as EventMessage);
    else this.tree?.take(time, message as RobustnessMessage);
  }

  show(cursor: Cursor): void {
    this.cursor = cursor;
    const { tree, results } = this;
    if (!tree) return;
    const deciding = tree.show(cursor.time, results.newest(tree.message, cursor.time));
    this.body.dataset.deciding = deciding.join(" ");
    this.chart.show(tree, cursor);
    this.list.show(results.events, cursor, (event) => {
      const found = results.find(event.specification, event.object);
      if (found >= 0) this.chooseResult(found);
      this.viewer.seek(event.time);
    });
  }

  head(cursor: Cursor): ReactElement {
    const { results, tree } = this;
    if (!tree) {
      return createElement("p", { className: "note" },
        "No specification here: open a log that `replay -o` or `record --spec` wrote, or a live server.");
    }
    const place = tree.series.at(cursor.time);
    const status = statusOf(tree.run, tree.result, tree.result.nodes[0]!, place);
    const at = place === null ? "before the first sample" : `at ${secondsText(tree.result.times[place]!)}`;
    return createElement("div", { className: "panel-head" },
      results.all.length > 1
        ? chooser("Result", results.titles, results.place, (chosen) => this.chooseResult(chosen))
        : createElement("b", null, results.titles[0] ?? ""),
      createElement("span", { className: `chip is-${status}` }, STATUSES[status].words),
      createElement("span", { className: "quiet" }, `${at}${cursor.isPreview ? ", under the pointer" : ""}`));
  }

  private chooseResult(place: number): void {
    const before = this.results.shown;
    this.results.choose(place);
    if (this.results.shown !== before) {
      this.build();
      this.viewer.reread([ROBUSTNESS]);
    }
    this.viewer.refresh();
  }

  private build(): void {
    const { shown } = this.results;
    this.tree = shown ? new Tree(shown, this.results, (node) => this.choose(node)) : null;
    this.place.replaceChildren(...(this.tree ? [this.tree.made] : []));
    const { node } = this.viewer.state;
    this.tree?.mark(typeof node === "number" ? node : null);
    this.chart.draw(this.tree, typeof node === "number" ? node : null);
  }

  private choose(node: number | null): void {
    this.viewer.save({ node });
    this.tree?.mark(node);
    this.chart.draw(this.tree, node);
    if (this.tree) this.chart.show(this.tree, this.cursor);
  }
}

/** A node, whose numbers are those that have been taken so far. */
class TreeNode implements DrawnNode {
  readonly id: number;
  readonly parent: number | null;
  readonly name: string;
  readonly text: string;
  readonly unit: string;
  readonly children: TreeNode[] = [];
  depth = 0;
  initial = true;

  constructor(
    message: NodeMessage, readonly index: number, readonly head: string,
    private readonly store: Series, private readonly last: Uint8Array,
  ) {
    this.id = message.id ?? 0;
    this.parent = index === 0 ? null : message.parent ?? 0;
    [this.name, this.text, this.unit] = [message.name, message.text, message.unit].map(printable) as [string, string, string];
  }

  get series(): Float64Array[] {
    return this.store.columns.slice(4 * this.index, 4 * this.index + 4);
  }

  get verdict(): Status {
    return STANDING[this.last[this.index]!] ?? "unknown";
  }

  get value(): string {
    return numberText(this.final);
  }

  private get final(): number {
    return this.store.columns[4 * this.index]![this.store.samples - 1] ?? NaN;
  }
}

/** The tree of one result: its numbers, and its rows. */
class Tree {
  readonly series: Series;
  readonly result: DrawnResult;
  readonly run: DrawnRun;
  readonly made: HTMLElement;
  private readonly rows: TreeRow[] = [];
  private readonly lines: HTMLElement[];
  private readonly folds: (HTMLDetailsElement | null)[];
  /** Nodes that the reader has folded or unfolded. */
  private readonly touched = new Set<number>();
  private readonly operators: string[];
  private last: Uint8Array;
  private lit = new Set<number>();

  constructor(readonly message: ResultMessage, results: Results, choose: (node: number) => void) {
    const count = message.nodes.length;
    this.series = new Series(4 * count);
    this.last = new Uint8Array(count);
    this.operators = message.nodes.map((node) => node.operator);
    const written = results.written(message);
    const nodes = message.nodes.map(
      (node, index) => new TreeNode(node, index, written[index]!, this.series, this.last));
    for (const node of nodes) {
      if (node.parent === null) continue;
      const above = nodes[node.parent]!;
      node.depth = above.depth + 1;
      node.initial = above.initial && !TEMPORAL.has(this.operators[above.index]!);
      above.children.push(node);
    }
    this.result = {
      title: titleOf(message.name, message.object), name: message.name, object: message.object || null,
      first: 0, samples: 0, times: this.series.times, nodes,
    };
    this.run = {
      settles: true, results: [this.result], numbers: (values) => values,
      palette: { positive: "", negative: "", neutral: "", curves: [] },
    };
    this.made = element("ul", {}, ...(nodes[0] ? [branch(nodes[0], this.rows, true)] : []));
    this.lines = this.rows.map((row) => row.parts[0]!.closest<HTMLElement>(".row")!);
    this.folds = this.lines.map((line) => line.tagName === "SUMMARY" ? line.parentElement as HTMLDetailsElement : null);
    this.lines.forEach((line, place) => this.listen(line, place, choose));
  }

  private listen(line: HTMLElement, place: number, choose: (node: number) => void): void {
    line.tabIndex = 0;
    line.addEventListener("click", (event) => {
      const isFold = (event.target as HTMLElement).closest(".mark") || event.detail === 0;
      if (this.folds[place] && isFold) this.touched.add(place);
      else event.preventDefault();
      if (!isFold || !this.folds[place]) choose(place);
    });
    line.addEventListener("keydown", (event) => {
      if (event.key !== "Enter") return;
      event.preventDefault();
      choose(place);
    });
  }

  take(time: number, message: RobustnessMessage): void {
    const { name, object, nodes } = this.message;
    if (message.specification !== name || message.object !== object || message.nodes.length !== nodes.length) return;
    if (message.final) {
      message.nodes.forEach((node, index) => { this.last[index] = node.standing; });
      return;
    }
    const numbers = new Float64Array(4 * nodes.length);
    message.nodes.forEach((node, index) => {
      numbers.set([node.value ?? NaN, node.now ?? NaN, node.lower ?? NaN, node.upper ?? NaN], 4 * index);
    });
    const place = this.series.put(time, numbers);
    if (place >= this.series.samples - 1) message.nodes.forEach((node, index) => { this.last[index] = node.standing; });
  }

  /** Shows the numbers at a time; returns the nodes on the path to the atom that decides. */
  show(time: number, event: Event | null): number[] {
    const { result, series } = this;
    result.samples = series.samples;
    result.times = series.times;
    const place = series.at(time);
    const isLast = place !== null && place === series.samples - 1;
    const path = place === null ? [] : this.deciding(place, event);
    const lit = new Set(path);
    const open = this.unfolded(place, lit);
    this.rows.forEach((row, index) => {
      const fold = this.folds[index];
      if (fold && !this.touched.has(index) && fold.open !== open.has(index)) fold.open = open.has(index);
      showRow(row, this.run, result, place, isLast);
      if (lit.has(index) !== this.lit.has(index)) this.lines[index]!.classList.toggle("lit", lit.has(index));
    });
    this.lit = lit;
    return path;
  }

  mark(chosen: number | null): void {
    this.lines.forEach((line, place) => {
      if (place === chosen) line.setAttribute("aria-current", "true");
      else line.removeAttribute("aria-current");
    });
  }

  /** Returns the nodes that are unfolded: above what decides against the result, and above what is violated. */
  private unfolded(place: number | null, lit: Set<number>): Set<number> {
    const { nodes } = this.result;
    const open = new Set([0]);
    const root = statusOf(this.run, this.result, nodes[0]!, place);
    const isFine = root === "satisfied" || root === "holding" || root === "absent";
    for (const node of nodes) {
      if (node.parent === null) continue;
      const isWrong = node.initial && !isFine && statusOf(this.run, this.result, node, place) === "violated";
      if (!isWrong && (isFine || !lit.has(node.index))) continue;
      for (let above = nodes[node.parent]; above; above = above.parent === null ? undefined : nodes[above.parent]) {
        if (open.has(above.index) && above.index) break;
        open.add(above.index);
      }
    }
    return open;
  }

  /** Returns the path to the atom that decides: of a verdict, the one found by the replay; else by numbers. */
  private deciding(place: number, event: Event | null): number[] {
    const { nodes } = this.result;
    if (event?.witness !== null && event?.witness !== undefined && event.verdict !== "pending" && nodes[event.witness]) {
      return this.above(event.witness);
    }
    return this.byNumber(place);
  }

  private above(index: number): number[] {
    const path: number[] = [];
    for (let node: DrawnNode | undefined = this.result.nodes[index]; node;
      node = node.parent === null ? undefined : this.result.nodes[node.parent]) path.unshift(node.index);
    return path;
  }

  /**
   * Robustness is made of minima and maxima, so the root's number is that of an atom at some sample. Below a temporal
   * operator, that is the sample at which the operator's value last changed. Ends where no number is equal.
   */
  private byNumber(place: number): number[] {
    const path = [0];
    let node = this.result.nodes[0]!;
    let sign = 1;
    const number = node.series[VALUE]![place]!;
    if (!Number.isFinite(number)) return path;
    while (node.children.length) {
      if (TEMPORAL.has(this.operators[node.index]!)) return this.belowTemporal(node, sign * number, place) ?? path;
      const found = this.operandsOf(node).find(([child, own]) => own * sign * child.series[VALUE]![place]! === number);
      if (!found) break;
      [node, sign] = [found[0], sign * found[1]];
      path.push(node.index);
    }
    return path;
  }

  private belowTemporal(top: DrawnNode, number: number, place: number): number[] | null {
    const values = top.series[VALUE]!;
    let sample = place;
    while (sample > 0 && values[sample - 1] === values[place]) sample -= 1;
    const waiting: [DrawnNode, number][] = [[top, 1]];
    for (const [node, sign] of waiting) {
      if (!node.children.length && sign * node.series[NOW]![sample]! === number) return this.above(node.index);
      waiting.push(...this.operandsOf(node).map(([child, own]): [DrawnNode, number] => [child, sign * own]));
    }
    return null;
  }

  private operandsOf(node: DrawnNode): [DrawnNode, number][] {
    const signs = SIGNS[this.operators[node.index]!] ?? (() => [1]);
    return node.children.flatMap((child, operand) => signs(operand).map((sign): [DrawnNode, number] => [child, sign]));
  }
}

/** The curve of the node that was chosen. */
class NodeChart {
  readonly made = element("section", { class: "node-chart", hidden: true });
  private readonly title = element("code", {});
  private readonly reading = element("span", { class: "number" });
  private readonly plot = element("div", { class: "curves" });
  private readonly line = element("div", { class: "cursor" });
  private chart: Chart | null = null;
  private clock: DrawnClock | null = null;
  private node: DrawnNode | null = null;
  private curve: Curve | null = null;
  private samples = -1;
  private width = 0;

  constructor(private readonly viewer: Viewer, close: () => void) {
    const button = element("button", { type: "button", class: "close", title: "Close the curve", onclick: close }, "✕");
    this.made.append(element("div", { class: "chart-head" }, this.title, this.reading, button), this.plot);
    this.plot.addEventListener("pointermove", (event) => this.hover(event));
    this.plot.addEventListener("pointerleave", () => this.viewer.preview(undefined));
    new ResizeObserver(() => { if (this.plot.clientWidth !== this.width) this.samples = -1; this.viewer.refresh(); })
      .observe(this.plot);
  }

  draw(tree: Tree | null, node: number | null): void {
    this.node = (node === null ? null : tree?.result.nodes[node]) ?? null;
    this.made.hidden = this.node === null;
    this.samples = -1;
    this.title.textContent = this.node ? this.node.name || this.node.head : "";
  }

  show(tree: Tree, cursor: Cursor): void {
    const { node } = this;
    if (!node) return;
    // while a file is read, its curve is drawn again only when it has grown by a tenth
    const grown = tree.series.samples;
    if (grown < this.samples || grown > this.samples + Math.max(this.samples / 10, 0)) this.build(tree, node);
    const { clock } = this;
    if (!clock) return;
    clock.time = cursor.time;
    const [from, to] = clock.view;
    const share = to > from ? (cursor.time - from) / (to - from) : 0;
    this.line.hidden = !(share >= 0 && share <= 1);
    this.line.style.left = `${100 * share}%`;
    const place = tree.series.at(cursor.time);
    const numbers = node.series[node.initial ? VALUE : NOW]!;
    this.reading.textContent = place === null ? "" : numberText(numbers[place]!);
  }

  private build(tree: Tree, node: DrawnNode): void {
    this.chart?.destroy();
    this.chart = this.clock = null;
    this.samples = tree.series.samples;
    this.width = this.plot.clientWidth;
    if (!this.samples || !this.width) return;
    const drawn = alone(tree.result, node);
    const quantity = node.initial ? VALUE : NOW;
    this.curve = { node: drawn.nodes[0]!, numbers: drawn.nodes[0]!.series[quantity]!, name: "", colour: null, reading: this.reading };
    const times = drawn.times;
    this.clock = {
      run: { ...tree.run, results: [drawn] }, view: [times[0]!, times[times.length - 1]!], time: 0,
      seek: (time) => this.viewer.seek(time), pause: () => undefined,
    };
    const made = options(this.clock, drawn, [this.curve], { quantity, hidden: new Set() }, this.width);
    made.height = CHART_HEIGHT;
    Object.assign(made.axes[1]!, { size: 64, label: node.unit || "robustness" });
    this.chart = new uPlot(made, columns(drawn, [this.curve]), this.plot);
    this.chart.over.append(this.line);
    scrub(this.chart.over, this.clock);
  }

  private hover(event: PointerEvent): void {
    if (!this.chart || !this.clock || event.buttons) return;
    const box = this.chart.over.getBoundingClientRect();
    const share = (event.clientX - box.left) / box.width;
    const [from, to] = this.clock.view;
    this.viewer.preview(share >= 0 && share <= 1 ? from + share * (to - from) : undefined);
  }
}

/** Returns a result with one node, for the curve. */
function alone(result: DrawnResult, node: DrawnNode): DrawnResult {
  const take = (numbers: Float64Array) => numbers.subarray(0, result.samples);
  const { head, name, unit, initial, id, text, verdict, value } = node;
  const series = node.series.map(take);
  const only = { id, text, head, name, unit, initial, verdict, value, series, index: 0, parent: null, depth: 0, children: [] };
  return { ...result, times: take(result.times), nodes: [only] };
}

/** The list of events; the newest before the cursor is marked. */
class EventList {
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
