// The tree of one result: the numbers of its nodes over time, and their rows at the cursor.

import {
  branch, element, numberText, NOW, printable, showRow, statusOf, VALUE, type DrawnNode, type DrawnResult, type DrawnRun, type Status,
  type TreeRow,
} from "report-drawing";

import { titleOf, type NodeMessage, type ResultMessage, type RobustnessMessage } from "./messages";
import type { Event } from "./results";
import { Series } from "./series";

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
export class Tree {
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

  constructor(readonly message: ResultMessage, choose: (node: number) => void) {
    const count = message.nodes.length;
    this.series = new Series(4 * count);
    this.last = new Uint8Array(count);
    this.operators = message.nodes.map((node) => node.operator);
    const nodes = message.nodes.map(
      (node, index) => new TreeNode(node, index, printable(node.written || node.text), this.series, this.last));
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
      settles: true, results: [this.result], lengths: "", outlinesAt: () => [], numbers: (values) => values,
      palette: { positive: "", negative: "", neutral: "", curves: [] },
    };
    this.made = element("ul", {}, ...(nodes[0] ? [branch(nodes[0], this.rows)] : []));
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
    // what is said at the end of the log has the time of the last sample, and takes its place
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
    // an unknown number is that of an atom which is unknown
    if (!Number.isFinite(number) && !Number.isNaN(number)) return path;
    while (node.children.length) {
      if (TEMPORAL.has(this.operators[node.index]!)) return this.belowTemporal(node, sign * number, place) ?? path;
      const found = this.operandsOf(node).find(([child, own]) => isSame(own * sign * child.series[VALUE]![place]!, number));
      if (!found) break;
      [node, sign] = [found[0], sign * found[1]];
      path.push(node.index);
    }
    return path;
  }

  private belowTemporal(top: DrawnNode, number: number, place: number): number[] | null {
    const values = top.series[VALUE]!;
    let sample = place;
    while (sample > 0 && isSame(values[sample - 1]!, values[place]!)) sample -= 1;
    const waiting: [DrawnNode, number][] = [[top, 1]];
    for (const [node, sign] of waiting) {
      if (!node.children.length && isSame(sign * node.series[NOW]![sample]!, number)) return this.above(node.index);
      waiting.push(...this.operandsOf(node).map(([child, own]): [DrawnNode, number] => [child, sign * own]));
    }
    return null;
  }

  private operandsOf(node: DrawnNode): [DrawnNode, number][] {
    const signs = SIGNS[this.operators[node.index]!] ?? (() => [1]);
    return node.children.flatMap((child, operand) => signs(operand).map((sign): [DrawnNode, number] => [child, sign]));
  }
}

/** Whether two numbers are equal, or both unknown. */
function isSame(one: number, other: number): boolean {
  return one === other || (Number.isNaN(one) && Number.isNaN(other));
}
