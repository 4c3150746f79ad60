// The panel of the specification: the tree with its numbers at the cursor, a node's curve, and the events.

import { element, secondsText, STATUSES, statusOf } from "report-drawing";
import { createElement, type ReactElement } from "react";

import { NodeChart } from "./curve";
import { EventList } from "./event-list";
import type { EventMessage, RecentEventsMessage, RobustnessMessage, SpecificationMessage } from "./messages";
import { EVENTS, RECENT_EVENTS, Results } from "./results";
import { Tree } from "./tree";
import { chooser, type Cursor, type View, type Viewer } from "./viewer";

const ROBUSTNESS = "/spatial/robustness";

export class SpecificationView implements View {
  readonly topics = [EVENTS, ROBUSTNESS];
  readonly currentTopics = [RECENT_EVENTS];
  readonly body = element("div", { class: "panel-body" });
  private readonly results: Results;
  private readonly place = element("div", { class: "tree" });
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
    else if (topic === RECENT_EVENTS) this.results.takeRecent(time, message as RecentEventsMessage);
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
    }, (event) => results.find(event.specification, event.object) === results.all.indexOf(tree.message));
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
    this.tree = shown ? new Tree(shown, (node) => this.choose(node)) : null;
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
