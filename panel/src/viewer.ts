// What a viewer gives a panel: its time, its messages, and React for the panel's head.

import type { PanelExtensionContext as FoxgloveContext } from "@foxglove/extension";
import type { PanelExtensionContext as LichtblickContext } from "@lichtblick/suite";
import { createElement, type ReactElement } from "react";
import * as ReactDom from "react-dom";
import style from "style.css";

import { nanoseconds, stampOf, wide, type EventMessage, type Long, type Received, type SpecificationMessage, type Stamp } from "./messages";

export const SPECIFICATION = "/spatial/specification";

/** The part of both viewers' contexts that is used; methods of one viewer alone are optional. */
export type Context = Pick<
  FoxgloveContext & LichtblickContext,
  "panelElement" | "initialState" | "watch" | "subscribe" | "saveState"
> & Partial<Pick<FoxgloveContext, "seekPlayback" | "setPreviewTime" | "subscribeMessageRange" | "UNSTABLE_subscribeMessageRange">>
  & Partial<Pick<LichtblickContext, "unstable_subscribeMessageRange">>
  & { onRender?: ((state: never, done: () => void) => void) | undefined };

type Batches = AsyncIterable<readonly Received[]>;
type SubscribeRange = (args: { topic: string; onNewRangeIterator: (batches: Batches) => Promise<void> }) => () => void;

/** What `onRender` is called with; what it lacks has not changed. */
interface RenderState {
  readonly currentFrame?: readonly Received[];
  readonly currentTime?: Stamp;
  readonly startTime?: Stamp;
  readonly previewTime?: number | undefined;
  readonly colorScheme?: "dark" | "light";
  readonly topics?: readonly { readonly name: string }[];
}

/** The time that a panel shows, in seconds after the first sample. */
export interface Cursor {
  readonly time: number;
  /** Whether it is where a pointer hovers, not where playback is. */
  readonly isPreview: boolean;
}

/** One panel, without the viewer around it. */
export interface View {
  /** Drawn below the head. */
  readonly body: HTMLElement;
  /** Topics besides the specification's, in the order in which their ranges are read. */
  readonly topics: readonly string[];
  /** Topics of which only the newest message before the cursor counts; their ranges are not read. */
  readonly currentTopics?: readonly string[];
  /** Takes another specification; what was taken before is about a former one. */
  specify(message: SpecificationMessage): void;
  /** Forgets the messages of a topic: all of its messages follow. */
  reset(topic: string): void;
  /** Takes messages, in any order and perhaps again. */
  take(topic: string, time: number, message: unknown, isOfRange: boolean): void;
  /** Draws. */
  show(cursor: Cursor): void;
  /** Returns what stands in the head. */
  head(cursor: Cursor): ReactElement;
}

/** What a view asks of the viewer. */
export interface Viewer {
  seek(time: number): void;
  preview(time: number | undefined): void;
  /** Draws again, and the head, too. */
  refresh(): void;
  /** Reads the ranges of some topics again. */
  reread(topics: readonly string[]): void;
  save(state: object): void;
  readonly state: Readonly<Record<string, unknown>>;
  /** Returns a time of a message in seconds after the first sample. */
  seconds(ns: bigint): number;
}

/** What tells messages apart that come before the specification. */
interface EarlyMessage {
  readonly specification?: string;
  readonly object?: string;
  readonly metadata?: EventMessage["metadata"];
}

/** A pointer's time is a double of seconds since 1970. */
const PREVIEW_TOLERANCE_S = 5e-7;

/** Connects a view with a viewer; returns what ends that. */
export function connect(context: Context, makeView: (viewer: Viewer) => View): () => void {
  const panel = new Panel(context, makeView);
  return () => panel.close();
}

class Panel implements Viewer {
  readonly state: Readonly<Record<string, unknown>>;
  private readonly view: View;
  private readonly root: HTMLElement;
  private readonly head: Mounted;
  private readonly ranges = new Map<string, () => void>();
  private specification = "";
  private origin: bigint | null = null;
  private start: bigint | null = null;
  private current: bigint | null = null;
  private hover: number | undefined;
  /** Messages that came before the specification: all events, and the newest of each other kind. */
  private readonly early = new Map<string, Received>();
  private frame: readonly Received[] | undefined;
  private topics: ReadonlySet<string> | undefined;
  private waiting = 0;
  private isClosed = false;

  constructor(private readonly context: Context, makeView: (viewer: Viewer) => View) {
    this.state = (context.initialState as Record<string, unknown> | undefined) ?? {};
    this.view = makeView(this);
    this.root = document.createElement("div");
    this.root.className = "spatial-replay";
    const sheet = document.createElement("style");
    sheet.textContent = style;
    const head = document.createElement("div");
    this.root.append(sheet, head, this.view.body);
    context.panelElement.append(this.root);
    this.head = mount(head);
    context.onRender = (state: RenderState, done: () => void) => {
      try {
        this.render(state);
      } finally {
        done();
      }
    };
    const fields = ["currentFrame", "currentTime", "startTime", "previewTime", "colorScheme", "didSeek", "topics"] as const;
    for (const field of fields) context.watch(field);
    context.subscribe([SPECIFICATION, ...this.view.topics, ...(this.view.currentTopics ?? [])].map((topic) => ({ topic })));
    this.readRange(SPECIFICATION).catch(report);
    this.refresh();
  }

  close(): void {
    this.isClosed = true;
    for (const unsubscribe of this.ranges.values()) unsubscribe();
    this.ranges.clear();
    cancelAnimationFrame(this.waiting);
    this.context.onRender = undefined;
    this.head.unmount();
    this.root.remove();
  }

  seek(time: number): void {
    this.context.seekPlayback?.(stampOf(this.stamp(time)));
  }

  preview(time: number | undefined): void {
    this.context.setPreviewTime?.(time === undefined ? undefined : Number(this.stamp(time)) / 1e9);
  }

  save(state: object): void {
    this.context.saveState({ ...this.state, ...state } as never);
    Object.assign(this.state, state);
  }

  seconds(ns: bigint): number {
    return Number(ns - (this.origin ?? this.start ?? 0n)) / 1e9;
  }

  refresh(): void {
    if (this.isClosed) return;
    const cursor = this.cursor();
    this.view.show(cursor);
    this.head.render(this.view.head(cursor));
  }

  reread(topics: readonly string[]): void {
    this.readAll(topics).catch(report);
  }

  private stamp(time: number): bigint {
    return (this.origin ?? this.start ?? 0n) + BigInt(Math.round(time * 1e9));
  }

  private cursor(): Cursor {
    if (this.hover !== undefined) {
      const offset = this.seconds(BigInt(Math.floor(this.hover)) * 1_000_000_000n);
      return { time: offset + (this.hover % 1) + PREVIEW_TOLERANCE_S, isPreview: true };
    }
    return { time: this.current === null ? -Infinity : this.seconds(this.current), isPreview: false };
  }

  private render(state: RenderState): void {
    if (state.colorScheme) this.root.dataset.theme = state.colorScheme;
    if (state.topics) this.topics = new Set(state.topics.map((each) => each.name));
    if (state.startTime) this.start = nanoseconds(state.startTime);
    if (state.currentTime) this.current = nanoseconds(state.currentTime);
    if ("previewTime" in state) this.hover = state.previewTime;
    // viewers give the frame before again where only the time of the pointer is new
    if (state.currentFrame && state.currentFrame !== this.frame) {
      this.frame = state.currentFrame;
      const [first, others] = [[], []] as [Received[], Received[]];
      for (const each of state.currentFrame) (each.topic === SPECIFICATION ? first : others).push(each);
      for (const each of [...first, ...others]) this.take(each, false);
    }
    this.refresh();
  }

  private take(received: Received, isOfRange: boolean): void {
    const { topic, message } = received;
    const ns = nanoseconds(received.receiveTime);
    if (topic === SPECIFICATION) {
      // a live source sends it again whenever playback jumps, with the time of the jump
      const specification = message as SpecificationMessage;
      this.specify(specification, isOfRange ? ns : wide(specification.start_ns));
      return;
    }
    if (this.origin === null) {
      const { specification = "", object = "", metadata } = message as EarlyMessage;
      this.early.set(JSON.stringify([topic, specification, object, metadata]), received);
      return;
    }
    const own = (message as { time_ns?: Long | null }).time_ns;
    this.view.take(topic, this.seconds(own === undefined || own === null ? ns : wide(own)), message, isOfRange);
  }

  private specify(message: SpecificationMessage, ns: bigint): void {
    const text = JSON.stringify(message, (_, value: unknown) => typeof value === "bigint" ? String(value) : value);
    if (text === this.specification && ns === this.origin) return;
    this.specification = text;
    this.origin = ns;
    for (const topic of this.view.topics) this.view.reset(topic);
    this.view.specify(message);
    for (const each of this.early.values()) this.take(each, false);
    this.early.clear();
    this.reread(this.view.topics);
  }

  /** Reads what a file has of topics, one after the other; live sources have nothing to read. */
  private async readAll(topics: readonly string[]): Promise<void> {
    for (const topic of topics) {
      // a viewer need not answer for a topic that it does not have
      if (!this.topics || this.topics.has(topic)) await this.readRange(topic);
    }
  }

  /** Reads all messages of a topic, now and whenever its data change; resolves once they were read. */
  private readRange(topic: string): Promise<void> {
    const { context } = this;
    const subscribe = (context.subscribeMessageRange ?? context.unstable_subscribeMessageRange
      ?? context.UNSTABLE_subscribeMessageRange) as SubscribeRange | undefined;
    this.ranges.get(topic)?.();
    this.ranges.delete(topic);
    if (!subscribe) return Promise.resolve();
    return new Promise((resolve) => {
      let isOver = false;
      const unsubscribe = subscribe.call(context, {
        topic,
        onNewRangeIterator: async (batches) => {
          if (topic !== SPECIFICATION) this.view.reset(topic);
          for await (const batch of batches) {
            if (isOver) break;
            for (const each of batch) this.take(each, true);
            this.refreshSoon();
          }
          resolve();
        },
      });
      this.ranges.set(topic, () => {
        isOver = true;
        unsubscribe();
        resolve();
      });
    });
  }

  private refreshSoon(): void {
    cancelAnimationFrame(this.waiting);
    this.waiting = requestAnimationFrame(() => this.refresh());
  }
}

function report(error: unknown): void {
  console.error("spatial-replay:", error);
}

interface Mounted {
  render(element: ReactElement): void;
  unmount(): void;
}

/** Prepares a place for React, as the viewer's version has it. */
function mount(place: HTMLElement): Mounted {
  const dom = ReactDom as unknown as {
    createRoot?: (place: HTMLElement) => Mounted;
    render?: (element: ReactElement, place: HTMLElement) => void;
    unmountComponentAtNode?: (place: HTMLElement) => void;
  };
  if (dom.createRoot) return dom.createRoot(place);
  if (!dom.render) throw new Error("this viewer's React is not one of the versions 16 to 18");
  return {
    render: (element) => dom.render?.(element, place),
    unmount: () => dom.unmountComponentAtNode?.(place),
  };
}

/** Returns a list to choose from, for the head. */
export function chooser(label: string, titles: readonly string[], chosen: number, choose: (place: number) => void): ReactElement {
  return createElement("select", {
    "aria-label": label, value: chosen, onChange: (event: { target: { value: string } }) => choose(Number(event.target.value)),
  }, ...titles.map((title, place) => createElement("option", { key: place, value: place }, title)));
}
