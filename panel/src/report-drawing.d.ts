// What the scripts of the report's page draw: tools/make_panel makes one module of spatial_replay/report/browser.

declare module "report-drawing" {
  /** A node of a formula, with its numbers at all samples. */
  export interface DrawnNode {
    id: number;
    index: number;
    parent: number | null;
    depth: number;
    children: DrawnNode[];
    name: string;
    /** What its row shows, and all of its text. */
    head: string;
    text: string;
    unit: string;
    /** Whether no temporal operator is above it. */
    initial: boolean;
    /** At the last sample. */
    verdict: Status;
    value: string;
    /** By quantity: VALUE, NOW, LOWER, UPPER. */
    series: Float64Array[];
  }
  export type Status =
    "satisfied" | "holding" | "violated" | "failing" | "pending" | "unknown" | "vacuous" | "absent";
  export interface DrawnResult {
    title: string;
    name: string;
    object: string | null;
    first: number;
    samples: number;
    /** In seconds. */
    times: Float64Array;
    nodes: DrawnNode[];
  }
  export interface DrawnAutomaton {
    summary: string;
    left_out: number;
    states: {
      number: number; at: [number, number]; about: string; accepting: boolean; lost: boolean; won: boolean;
    }[];
    moves: { source: number; target: number; guard: string; label: string }[];
    legend: string[];
  }
  export interface DrawnEvent {
    time: number;
    status: Status;
    specification: string;
    object: string | undefined;
    /** Text and code, in turn. */
    parts: string[];
  }
  export interface DrawnTarget {
    object: string; at: [number, number] | null; words: string; turn: number; robustness: number | null; way: number[];
  }
  export interface DrawnMap {
    columns: number; low: [number, number]; high: [number, number]; scale: number; values: Float32Array;
    chosen: boolean; edge: number | null; candidate: number | null; object: string; title: string;
    target: DrawnTarget | null;
    limited?: Float32Array; blocked?: Float32Array; limits: string[][]; blocks: string[][];
    layers: { number: number; title: string; values: Float32Array }[]; at_target?: (number | null)[];
    room?: Float32Array; least_room?: number; way?: Float32Array; least_way?: number; rule: string; joint: boolean;
  }
  export interface DrawnBar { kind: string; words: string[]; cells: number }
  export interface DrawnEdge {
    path: number[]; aim: boolean; wanted: string[][]; rules: string[][]; pruned: string; later: string[]; once: string;
    candidates: {
      object: string; best: number | null; status: string; rejected: string; target: DrawnTarget | null;
      cells: number; bars: DrawnBar[]; room: string;
    }[];
  }
  /** What is drawn on a map, with its outlines: points x and y in turn. */
  export interface DrawnOutline { kind: "object" | "region" | "obstacle"; name: string; rings: number[][] }
  export interface DrawnDecision {
    number: number; time: number; specification: string; kind: string; states: number[]; reason: string;
    edges: DrawnEdge[]; maps: DrawnMap[]; target: DrawnTarget | null; margin: number | null;
    outcome: { time: number; succeeded: boolean; reason: string; states: number[] } | null;
  }
  export interface DrawnRun {
    settles: boolean;
    results: DrawnResult[];
    palette: { positive: string; negative: string; neutral: string; curves: string[] };
    lengths: string;
    numbers(values: Float32Array): Float32Array;
    outlinesAt(time: number): DrawnOutline[];
  }
  /** The part of the page's clock that drawings use. */
  export interface DrawnClock {
    run: DrawnRun;
    view: [number, number];
    time: number;
    seek(time: number): void;
    pause(): void;
  }
  export interface TreeRow {
    node: DrawnNode;
    parts: HTMLElement[];
    status: Status | null;
  }
  export interface Chart {
    over: HTMLElement;
    destroy(): void;
    setSize(size: { width: number; height: number }): void;
  }
  export interface Curve { node: DrawnNode; numbers: Float64Array; name: string; colour: string | null; reading: HTMLElement }

  export const VALUE: 0, NOW: 1, LOWER: 2, UPPER: 3;
  export const STATUSES: Record<Status, { sign: string; words: string; colour: string }>;
  export const uPlot: new (options: unknown, columns: unknown, place: HTMLElement) => Chart;
  export function element(tag: string, attributes?: Record<string, unknown>, ...content: unknown[]): HTMLElement;
  export function withCode(parts: string[]): (Node | string)[];
  export function printable(text: unknown): string;
  export function secondsText(seconds: number): string;
  export function numberText(number: number): string;
  export function mark(status: Status): HTMLElement;
  export function indexAt(times: Float64Array, time: number): number;
  export function statusOf(run: DrawnRun, result: DrawnResult, node: DrawnNode, place: number | null): Status;
  export function branch(node: DrawnNode, rows: TreeRow[]): HTMLElement;
  export function showRow(row: TreeRow, run: DrawnRun, result: DrawnResult, place: number | null, isLast: boolean): void;
  export function eventRow(event: DrawnEvent, choose: () => void): HTMLElement;
  export function markedEvent(
    starts: readonly number[], time: number, isChosen: (place: number) => boolean,
  ): number;
  export function keepInSight(list: HTMLElement, row: HTMLElement): void;
  export function scrub(made: HTMLElement, clock: DrawnClock): void;
  export function columns(result: DrawnResult, curves: Curve[]): unknown;
  export function options(clock: DrawnClock, result: DrawnResult, curves: Curve[],
    shown: { quantity: number; hidden: Set<number> }, width: number): { axes: { size: number }[]; height: number };
  export interface DrawnStates { made: SVGElement; states: Map<number, SVGElement> }
  export function drawAutomaton(automaton: DrawnAutomaton): DrawnStates;
  export function legendOf(automaton: DrawnAutomaton): HTMLElement;
  export function light(drawn: DrawnStates, states: number[]): void;
  export function keepInView(drawing: HTMLElement, state: SVGElement | undefined): void;
  export function describe(automaton: DrawnAutomaton, states: number[]): Node[];
  export function makeDecision(clock: DrawnClock, decision: DrawnDecision): HTMLElement;
  export function mapKey(run: DrawnRun, decision: DrawnDecision): HTMLElement;
  export function inShort(decision: DrawnDecision): string;
  export function nodeRow(node: { name: string; type: string; depth: number }, status: number): HTMLElement;
}
