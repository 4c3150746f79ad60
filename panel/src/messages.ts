// Messages as viewers decode them: fields by their names in schemas/, what is absent left out or null.

/** A time of a viewer. */
export interface Stamp {
  readonly sec: number;
  readonly nsec: number;
}

/** A 64-bit number, whichever way a viewer decodes it. */
export type Long = bigint | number | string | { readonly low: number; readonly high: number };

/** The part of a viewer's message event that is read. */
export interface Received {
  readonly topic: string;
  readonly receiveTime: Stamp;
  readonly message: unknown;
}

export interface NodeMessage {
  readonly id?: number;
  readonly parent?: number | null;
  readonly operator: string;
  readonly name: string;
  readonly text: string;
  readonly unit: string;
  readonly written?: string;
}

export interface AutomatonMessage {
  readonly summary: string;
  readonly states: readonly {
    readonly number?: number;
    readonly about: string;
    readonly column?: number;
    readonly row?: number;
    readonly accepting: boolean;
    readonly can_reject: boolean;
    readonly distance?: number | null;
  }[];
  readonly moves: readonly {
    readonly source?: number;
    readonly target?: number;
    readonly guard: string;
    /** Absent in logs of earlier versions, as are `legend` and `written`. */
    readonly label?: string;
  }[];
  readonly left_out: number;
  readonly legend?: readonly string[];
}

export interface ResultMessage {
  readonly name: string;
  readonly object: string;
  readonly file?: number;
  readonly nodes: readonly NodeMessage[];
  readonly propositions: readonly number[];
  readonly automaton?: AutomatonMessage | null;
}

export interface SpecificationMessage {
  readonly files: readonly { readonly name: string; readonly source: string }[];
  readonly results: readonly ResultMessage[];
  readonly start_ns?: Long | null;
}

export interface RobustnessMessage {
  readonly specification: string;
  readonly object: string;
  readonly nodes: readonly {
    readonly id?: number;
    readonly value?: number;
    readonly now?: number;
    readonly lower?: number;
    readonly upper?: number;
    readonly standing: number;
  }[];
}

export interface AutomatonStateMessage {
  readonly specification: string;
  readonly object: string;
  readonly states: readonly number[];
  readonly source?: number | null;
  readonly guard: string;
}

export interface EventMessage {
  readonly start_time?: Stamp | null;
  readonly end_time?: Stamp | null;
  readonly metadata: readonly { readonly key: string; readonly value: string }[];
}

export interface RecentEventsMessage {
  readonly events: readonly { readonly event: string }[];
  /** Absent in logs of earlier versions. */
  readonly facts?: readonly EventMessage[];
}

export interface TargetMessage {
  readonly object: string;
  readonly x?: number;
  readonly y?: number;
  readonly turn?: number;
  readonly waypoints: ArrayLike<number>;
  readonly robustness?: number;
}

export interface DecisionMessage {
  readonly time_ns?: Long | null;
  readonly number?: number;
  readonly specification: string;
  readonly kind: number;
  readonly states: readonly number[];
  readonly considered: readonly {
    readonly path: readonly number[];
    /** Absent in logs of earlier versions, as are `words`. */
    readonly wanted?: readonly string[];
    readonly rules?: readonly string[];
    readonly candidates: readonly {
      readonly object: string;
      readonly best?: number;
      readonly target?: TargetMessage | null;
      readonly rejected: string;
      readonly chosen: boolean;
      readonly maps: readonly { readonly number?: number; readonly turn?: number }[];
      readonly conjuncts?: readonly { readonly text: string; readonly words?: string; readonly limits?: number; readonly at_target?: number }[];
      readonly causes?: readonly { readonly words?: string; readonly cells?: number }[];
      readonly rule?: string; readonly least_way?: number; readonly least_room?: number;
      readonly room?: { readonly wanted?: number; readonly possible?: number; readonly clearance?: number } | null;
    }[];
    readonly pruned: string;
    readonly motions?: readonly TargetMessage[];
    readonly joint?: boolean;
  }[];
  readonly margin?: number;
  readonly target?: TargetMessage | null;
  readonly pruned: readonly { readonly source?: number; readonly target?: number; readonly reason: string }[];
  readonly reason: string;
  readonly outcome?: {
    readonly end_ns?: Long;
    readonly succeeded?: boolean;
    readonly reason: string;
    readonly states: readonly number[];
  } | null;
}

export interface TreeMessage {
  readonly nodes: readonly {
    readonly name: string;
    readonly type: string;
    readonly parent?: number | null;
    readonly status?: number;
  }[];
}

export interface GridMessage {
  readonly pose?: { readonly position?: { readonly x: number; readonly y: number } | null } | null;
  readonly column_count: number;
  readonly cell_size?: { readonly x: number; readonly y: number } | null;
  readonly row_stride: number;
  readonly cell_stride: number;
  readonly fields: readonly { readonly name: string; readonly offset: number; readonly type: number }[];
  readonly data: Uint8Array;
}

export interface SceneMessage {
  readonly entities: readonly {
    readonly id: string;
    readonly lines: readonly {
      readonly pose?: {
        readonly position?: { readonly x: number; readonly y: number } | null;
        readonly orientation?: { readonly z: number; readonly w: number } | null;
      } | null;
      readonly points: readonly { readonly x: number; readonly y: number }[];
    }[];
  }[];
}

/** Returns a time in nanoseconds. */
export function nanoseconds(stamp: Stamp): bigint {
  return BigInt(stamp.sec) * 1_000_000_000n + BigInt(stamp.nsec);
}

/** Returns a time in nanoseconds as a viewer's. */
export function stampOf(ns: bigint): Stamp {
  return { sec: Number(ns / 1_000_000_000n), nsec: Number(ns % 1_000_000_000n) };
}

/** Returns a 64-bit number; one of two halves is not negative. */
export function wide(number: Long | undefined | null): bigint {
  if (number === undefined || number === null) return 0n;
  if (typeof number !== "object") return BigInt(number);
  return (BigInt(number.high >>> 0) << 32n) | BigInt(number.low >>> 0);
}

/** Returns what a result is known by: its name, and what a template stands for. */
export function titleOf(name: string, object: string | null | undefined): string {
  return object ? `${name}(${object})` : name;
}
