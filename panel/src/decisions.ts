// The panel of a planner's decisions: candidates, the chosen map, and the edges given up.

import {
  element, inShort, makeDecision, mapKey, nodeRow, numberText, printable, secondsText, withCode,
  type DrawnBar, type DrawnClock, type DrawnDecision, type DrawnMap, type DrawnOutline, type DrawnTarget,
} from "report-drawing";
import { createElement, type ReactElement } from "react";

import { TimedList } from "./event-list";
import {
  wide, type DecisionMessage, type GridMessage, type SceneMessage, type SpecificationMessage, type TargetMessage, type TreeMessage,
} from "./messages";
import type { Cursor, View, Viewer } from "./viewer";

const DECISION = "/plan/decision";
const MAP = "/plan/gradient_map";
const SCENE = "/spatial/scene";
const DRAWING = "/plan/map_drawing";
const TREE = "/plan/behaviour_tree";
/** Cells of all maps that are kept: 16 MiB. */
const MOST_CELLS = 1 << 22;
/** Starts of the ids of entities that are drawn on a map; their names follow. */
const DRAWN = { "object/": "object", "region/": "region", "plan/obstacle/": "obstacle" } as const;
/** A type of a field of cells. */
const UINT16 = 3;
/** Conjuncts and causes that are listed of a map. */
const MOST_LISTED = 3;
const KINDS = ["", "execute", "hold", "wait", "no path"];

interface Decision {
  readonly time: number;
  readonly message: DecisionMessage;
}

interface Owner {
  readonly edge: number;
  readonly candidate: number;
  readonly turn: number;
}

export class DecisionsView implements View {
  readonly topics = [DECISION, MAP];
  readonly currentTopics = [SCENE, TREE, DRAWING];
  readonly body = element("div", { class: "panel-body decisions" });
  private readonly card = element("ol", { class: "cards" });
  private readonly pruned = element("div", { class: "tasks" });
  private readonly nodes = element("ul", { class: "nodes" });
  private readonly tree = element("details", { open: true, hidden: true }, element("summary", {}, "Behaviour tree"), this.nodes);
  private readonly list = new TimedList();
  private readonly clock: DrawnClock;
  /** By number; with its outcome once that is known. */
  private readonly decisions = new Map<number, Decision>();
  private readonly maps = new Map<number, GridMessage>();
  /** Fields of all cells are read once. */
  private readonly drawn = new WeakMap<GridMessage, DrawnMap | null>();
  private readonly mapsByTime = new Map<number, GridMessage[]>();
  /** The objects of the newest scene, and its time. */
  private outlines: DrawnOutline[] = [];
  private sceneTime = -Infinity;
  /** The obstacles of the planner's workspace. */
  private obstacles: DrawnOutline[] = [];
  /** Whether the reader has unfolded the candidates; it stays so for other decisions. */
  private isUnfolded = false;
  private cells = 0;
  private mapsRead = 0;
  private shown = "";
  private listed = -1;

  constructor(viewer: Viewer) {
    this.clock = {
      run: {
        settles: true, results: [], lengths: "", numbers: (values) => values, outlinesAt: () => [...this.outlines, ...this.obstacles],
        palette: { positive: "#0072b2", negative: "#d55e00", neutral: "#8c8c8c", curves: [] },
      },
      view: [0, 0], time: 0, seek: (time) => viewer.seek(time), pause: () => undefined,
    };
    this.body.append(this.card, this.pruned, this.tree,
      element("details", { open: true }, element("summary", {}, "All decisions"), this.list.made));
  }

  specify({ results }: SpecificationMessage): void {
    // decisions name what they are about; lengths have the unit that all relations have
    const units = new Set(results.flatMap(({ nodes }) => nodes.map(({ unit }) => unit)).filter((unit) => unit && unit !== "1"));
    const [unit = ""] = units;
    this.clock.run.lengths = units.size === 1 && !unit.startsWith("units of") && unit !== "mixed" ? printable(unit) : "";
  }

  reset(topic: string): void {
    if (topic === DECISION) this.decisions.clear();
    else this.forgetMaps();
    [this.shown, this.listed] = ["", -1];
  }

  take(topic: string, time: number, message: unknown, isOfRange: boolean): void {
    if (topic === SCENE) {
      this.outlines = outlinesOf(message as SceneMessage);
      this.sceneTime = time;
      return;
    }
    if (topic === DRAWING) {
      const obstacles = outlinesOf(message as SceneMessage);
      if (obstacles.length !== this.obstacles.length) this.shown = "";
      this.obstacles = obstacles;
      return;
    }
    if (topic === TREE) {
      this.tree.hidden = false;
      this.nodes.replaceChildren(...rowsOf(message as TreeMessage));
      return;
    }
    if (topic === MAP) {
      this.takeMap(time, message as GridMessage, isOfRange);
      return;
    }
    const decision = message as DecisionMessage;
    const number = decision.number ?? 0;
    const known = this.decisions.get(number);
    if (known?.message.outcome && !decision.outcome) return;
    this.decisions.set(number, { time, message: decision });
    this.listed = -1;
  }

  show(cursor: Cursor): void {
    const ordered = this.ordered;
    this.showList(ordered);
    this.list.show(cursor.time);
    let here: Decision | undefined;
    let end = Infinity;
    for (const each of ordered) {
      if (each.time <= cursor.time + 1e-9) here = each;
      else end = Math.min(end, each.time);
    }
    const maps = here ? this.mapsOf(here) : [];
    // after a jump, the scene arrives later than the decision
    const isSceneOfDecision = here !== undefined && this.sceneTime >= here.time - 1e-9 && this.sceneTime < end - 1e-9;
    const shown = here
      ? JSON.stringify([here.message.number ?? 0, Boolean(here.message.outcome), maps.length, isSceneOfDecision]) : "";
    if (shown === this.shown) return;
    this.shown = shown;
    this.body.dataset.decision = here ? String(here.message.number ?? 0) : "";
    if (!here) {
      this.card.replaceChildren(element("li", { class: "quiet" }, ordered.length ? "Before the first decision." : ""));
      this.pruned.replaceChildren();
      return;
    }
    const decision = drawnOf(here, maps);
    const made = makeDecision(this.clock, decision);
    this.isUnfolded = this.card.querySelector("details")?.open ?? this.isUnfolded;
    for (const details of made.querySelectorAll("details")) details.open = this.isUnfolded;
    if (maps.length) made.append(mapKey(this.clock.run, decision));
    this.card.replaceChildren(made);
    this.pruned.replaceChildren(...givenUp(here.message));
  }

  head(): ReactElement {
    const count = this.decisions.size;
    if (!count && !this.tree.hidden) return createElement("div");
    if (!count) return createElement("p", { className: "note" }, "No decisions here: open the log of a planned run.");
    return createElement("div", { className: "panel-head" }, createElement("b", null, `${count} decision${count === 1 ? "" : "s"}`));
  }

  private get ordered(): Decision[] {
    return [...this.decisions.values()].sort((a, b) => (a.message.number ?? 0) - (b.message.number ?? 0));
  }

  private showList(ordered: readonly Decision[]): void {
    if (this.listed === ordered.length) return;
    this.listed = ordered.length;
    this.shown = "";
    this.list.fill(ordered.map((each) => each.time), ordered.map((each) => element("button", {
      type: "button", class: "event", onclick: () => {
        this.clock.seek(each.time);
        this.card.scrollIntoView();
      },
    }, element("span", {}), element("time", {}, secondsText(each.time)),
    element("span", { class: "sentence" }, `${each.message.number ?? 0}: ${inShort(drawnOf(each, []))}`))));
  }

  private forgetMaps(): void {
    this.maps.clear();
    this.mapsByTime.clear();
    this.cells = this.mapsRead = 0;
  }

  /** Keeps a map; of too many, those of chosen targets. A range has all maps, so that the count is the number. */
  private takeMap(time: number, message: GridMessage, isOfRange: boolean): void {
    const number = this.mapsRead;
    if (isOfRange) this.mapsRead += 1;
    else if (this.mapsRead) return;
    const cells = message.row_stride ? Math.floor(message.data.length / message.row_stride) * message.column_count : 0;
    const isChosen = isOfRange && this.isChosen(number);
    if (this.cells + cells > (isChosen ? 2 : 1) * MOST_CELLS) return;
    this.cells += cells;
    if (isOfRange) this.maps.set(number, message);
    else this.mapsByTime.set(time, [...(this.mapsByTime.get(time) ?? []), message]);
    this.shown = "";
  }

  private isChosen(number: number): boolean {
    for (const { message } of this.decisions.values()) {
      for (const { candidates } of message.considered) {
        if (candidates.some((each) => each.chosen && each.maps.some((map) => (map.number ?? 0) === number))) return true;
      }
    }
    return false;
  }

  /** Returns the maps of a decision: by their numbers or, of a live source, by its time, in order. */
  private mapsOf(decision: Decision): DrawnMap[] {
    const owners = new Map<number, Owner>();
    decision.message.considered.forEach(({ candidates }, edge) => candidates.forEach(({ maps }, candidate) => {
      for (const map of maps) owners.set(map.number ?? 0, { edge, candidate, turn: map.turn ?? 0 });
    }));
    const live = this.mapsByTime.get(decision.time) ?? [];
    const found: DrawnMap[] = [];
    [...owners].sort(([a], [b]) => a - b).forEach(([number, owner], place) => {
      const grid = this.maps.get(number) ?? (live.length === owners.size ? live[place] : undefined);
      if (grid && !this.drawn.has(grid)) this.drawn.set(grid, drawnMap(grid, owner, decision.message));
      const drawn = grid && this.drawn.get(grid);
      if (drawn) found.push(drawn);
    });
    return found;
  }
}

/** Returns the rows of a tree's nodes, each behind the one above it by its depth. */
function rowsOf({ nodes }: TreeMessage): HTMLElement[] {
  const depths: number[] = [];
  return nodes.map(({ name, type, parent, status }, place) => {
    const depth = typeof parent === "number" && parent < place ? depths[parent]! + 1 : 0;
    depths.push(depth);
    return nodeRow({ name: printable(name), type: printable(type), depth }, status ?? 0);
  });
}

function drawnMap(grid: GridMessage, owner: Owner, decision: DecisionMessage): DrawnMap | null {
  const values = fieldOf(grid, "robustness");
  if (!values) return null;
  const { column_count: columns } = grid;
  const { x = 0, y = 0 } = grid.pose?.position ?? {};
  const rows = values.length / columns;
  const high: [number, number] = [x + columns * (grid.cell_size?.x ?? 0), y + rows * (grid.cell_size?.y ?? 0)];
  if (![x, y, ...high].every(Number.isFinite) || high[0] <= x || high[1] <= y) return null;
  const candidate = decision.considered[owner.edge]!.candidates[owner.candidate]!;
  const { conjuncts = [], causes = [], least_way, least_room } = candidate;
  const turned = candidate.maps.length > 1 ? `, turned by ${degrees(owner.turn)}` : "";
  const target = candidate.target && (candidate.target.turn ?? 0) === owner.turn ? drawnTarget(candidate.target) : null;
  const isLast = owner.edge === decision.considered.length - 1;
  const object = printable(candidate.object);
  const layers = conjuncts.map((conjunct, index) => ({
    number: index + 1, title: demandOf(conjunct).join(""), values: fieldOf(grid, `${index + 1}: ${conjunct.text}`),
  }))
    .filter((layer): layer is { number: number; title: string; values: Float32Array } => layer.values !== null);
  const [limited, blocked, room, way] = ["limited_by", "blocked_by", "room", "way"].map((name) => fieldOf(grid, name));
  return {
    columns, low: [x, y], high, values, edge: owner.edge, candidate: owner.candidate, target, object, layers,
    scale: values.reduce((most, number) => (Number.isFinite(number) ? Math.max(most, Math.abs(number)) : most), 0),
    title: object + turned, rule: printable(candidate.rule ?? ""),
    joint: Boolean(decision.considered[owner.edge]!.joint),
    chosen: Boolean(decision.target && isLast && candidate.chosen && target),
    limits: conjuncts.map(demandOf), blocks: causes.map(({ words }) => partsOf(words ?? "")),
    ...(limited && blocked ? { limited, blocked } : {}),
    ...(target ? { at_target: conjuncts.map((conjunct) => conjunct.at_target ?? null) } : {}),
    ...(room && typeof least_room === "number" ? { room, least_room } : {}),
    ...(way && typeof least_way === "number" ? { way, least_way } : {}),
  };
}

/** Returns a field of all cells, row by row; null if the message has no such field, or sizes that do not fit. */
function fieldOf(grid: GridMessage, name: string): Float32Array | null {
  const { column_count: columns, cell_stride: cell, row_stride: row, data } = grid;
  const rows = row ? Math.floor(data.length / row) : 0;
  const field = grid.fields.find((each) => each.name === name);
  const isShort = field?.type === UINT16;
  if (!field || !rows || !columns || cell * columns > row || field.offset + (isShort ? 2 : 4) > cell) return null;
  const bytes = new DataView(data.buffer, data.byteOffset, data.byteLength);
  return Float32Array.from({ length: rows * columns }, (_, place) => {
    const offset = Math.floor(place / columns) * row + (place % columns) * cell + field.offset;
    return isShort ? bytes.getUint16(offset, true) : bytes.getFloat32(offset, true);
  });
}

/** Returns what of a scene is drawn on maps, with its outlines; the dashes of a region follow its outline. */
function outlinesOf({ entities }: SceneMessage): DrawnOutline[] {
  return entities.flatMap(({ id, lines }) => Object.entries(DRAWN).filter(([start]) => id.startsWith(start)).map(([start, kind]) => ({
    kind,
    name: printable(id.slice(start.length)),
    rings: lines.map(({ pose, points }) => {
      const { x = 0, y = 0 } = pose?.position ?? {};
      const { z = 0, w = 1 } = pose?.orientation ?? {};
      const [sin, cos] = [2 * z * w, 1 - 2 * z * z];
      return points.flatMap((point) => [x + cos * point.x - sin * point.y, y + sin * point.x + cos * point.y]);
    }),
  })));
}

function drawnOf({ time, message }: Decision, maps: DrawnMap[]): DrawnDecision {
  const last = message.considered[message.considered.length - 1];
  return {
    number: message.number ?? 0, time, specification: printable(message.specification), kind: KINDS[message.kind] ?? "",
    states: [...message.states], reason: printable(message.reason), maps,
    target: message.target ? drawnTarget(message.target) : null,
    margin: message.margin ?? null,
    outcome: !message.outcome ? null : {
      time: time + Number(wide(message.outcome.end_ns) - wide(message.time_ns)) / 1e9, succeeded: message.outcome.succeeded ?? false, reason: printable(message.outcome.reason),
      states: [...message.outcome.states],
    },
    edges: message.considered.map((edge) => ({
      path: [...edge.path], aim: edge === last && !edge.pruned, wanted: (edge.wanted ?? []).map(partsOf),
      rules: (edge.rules ?? []).map(partsOf), pruned: printable(edge.pruned),
      later: (edge.motions ?? []).slice(1).map((motion) => `${printable(motion.object)} to ${drawnTarget(motion).words}`),
      once: edge.joint && (edge.motions?.length ?? 0) > 1 ? ` once all ${edge.motions!.length} motions are done` : "",
      candidates: edge.candidates.map((each) => ({
        object: printable(each.object), best: Math.max(each.best ?? NaN, each.target?.robustness ?? -Infinity),
        status: each.rejected ? "rejected" : each.chosen ? "chosen" : "possible", rejected: printable(each.rejected),
        ...barsOf(each),
        target: each.target ? drawnTarget(each.target) : null,
      })),
    })),
  };
}

type Candidate = DecisionMessage["considered"][number]["candidates"][number];

/** How many cells each demand limits and each cause blocks; logs of earlier planners do not say. */
function barsOf({ conjuncts = [], causes = [], room, target }: Candidate): { cells: number; bars: DrawnBar[]; room: string } {
  const limits = conjuncts.filter((each) => each.limits).sort((a, b) => (b.limits ?? 0) - (a.limits ?? 0))
    .map((each) => ({ kind: "limited by", words: demandOf(each), cells: each.limits ?? 0 }));
  const blocks = causes.map((each) => ({ kind: "blocked", words: partsOf(each.words ?? ""), cells: each.cells ?? 0 }));
  return {
    cells: [...limits, ...blocks].reduce((sum, { cells }) => sum + cells, 0),
    bars: [...limits.slice(0, MOST_LISTED), ...blocks.slice(0, MOST_LISTED)],
    room: room && target ? `${numberText(target.robustness ?? NaN)} chosen, ${numberText(room.possible ?? NaN)} possible with `
      + `less room (${numberText(Math.max(room.clearance ?? NaN, 0))} of ${numberText(room.wanted ?? NaN)})` : "",
  };
}

/** Returns a conjunct as a demand; logs of earlier planners have its formula alone. */
function demandOf({ text, words }: { readonly text: string; readonly words?: string }): string[] {
  return partsOf(words || `\`${text}\``);
}

/** Returns a sentence as text and code, in turn. */
function partsOf(sentence: string): string[] {
  return printable(sentence).split("`");
}

function drawnTarget(target: TargetMessage): DrawnTarget {
  const { x = NaN, y = NaN, turn = 0 } = target;
  const way = Array.from(target.waypoints);
  const isDrawn = [x, y, ...way].every(Number.isFinite);
  return {
    object: printable(target.object), at: isDrawn ? [x, y] : null, way: isDrawn ? way : [],
    words: `(${numberText(x)}, ${numberText(y)})${turn ? `, turned by ${degrees(turn)}` : ""}`,
    turn, robustness: target.robustness ?? null,
  };
}

function degrees(radians: number): string {
  return `${Number((radians * 180 / Math.PI).toPrecision(3))}°`;
}

function givenUp(message: DecisionMessage): HTMLElement[] {
  if (!message.pruned.length) return [];
  return [element("h3", {}, "Edges given up so far"), element("ul", {}, ...message.pruned.map((edge) => element("li", {},
    element("b", {}, `${edge.source ?? 0} → ${edge.target ?? 0}`), " ", ...withCode(partsOf(edge.reason)))))];
}
