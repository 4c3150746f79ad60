// The curve of one node over the whole log.

import {
  columns, element, numberText, NOW, options, scrub, uPlot, VALUE, type Chart, type DrawnClock, type DrawnNode, type DrawnResult,
} from "report-drawing";

import type { Tree } from "./tree";
import type { Cursor, Viewer } from "./viewer";

const CHART_HEIGHT = 170;

/** The curve of the node that was chosen. */
export class NodeChart {
  readonly made = element("section", { class: "node-chart", hidden: true });
  private readonly title = element("code", {});
  private readonly reading = element("span", { class: "number" });
  private readonly plot = element("div", { class: "curves" });
  private readonly line = element("div", { class: "cursor" });
  private chart: Chart | null = null;
  private clock: DrawnClock | null = null;
  private node: DrawnNode | null = null;
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
    const curve = { node: drawn.nodes[0]!, numbers: drawn.nodes[0]!.series[quantity]!, name: "", colour: null, reading: this.reading };
    const times = drawn.times;
    this.clock = {
      run: { ...tree.run, results: [drawn] }, view: [times[0]!, times[times.length - 1]!], time: 0,
      seek: (time) => this.viewer.seek(time), pause: () => undefined,
    };
    const made = options(this.clock, drawn, [curve], { quantity, hidden: new Set() }, this.width);
    made.height = CHART_HEIGHT;
    Object.assign(made.axes[1]!, { size: 64, label: node.unit || "robustness" });
    this.chart = new uPlot(made, columns(drawn, [curve]), this.plot);
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
