// The numbers of the nodes of one result, by time: whatever order messages come in, and however many there are.

import { indexAt } from "report-drawing";

/** Numbers that are kept, at most: 128 MiB. Beyond them every other sample is dropped. */
const MOST_NUMBERS = 1 << 24;
const FIRST = 256;

export class Series {
  samples = 0;
  /** In seconds; those behind `samples` are room. */
  times = new Float64Array(FIRST);
  /** By column, as long as `times`. */
  columns: Float64Array[];
  /** Whether samples were dropped. */
  isThinned = false;

  constructor(width: number, private readonly most = MOST_NUMBERS) {
    this.columns = Array.from({ length: width }, () => new Float64Array(FIRST));
  }

  /** Takes the numbers of one sample, instead of those that it had. */
  put(time: number, numbers: ArrayLike<number>): number {
    let place = this.placeAfter(time);
    if (place > 0 && this.times[place - 1] === time) place -= 1;
    else this.makeRoom(place);
    this.times[place] = time;
    for (let column = 0; column < this.columns.length; column++) this.columns[column]![place] = numbers[column]!;
    if (this.samples * this.columns.length > this.most) this.thin();
    return place;
  }

  /** Returns the last sample that is not later; null before the first. */
  at(time: number): number | null {
    const place = this.placeAfter(time) - 1;
    return place < 0 ? null : place;
  }

  clear(): void {
    this.samples = 0;
    this.isThinned = false;
  }

  private placeAfter(time: number): number {
    const { samples, times } = this;
    if (!samples || time < times[0]!) return 0;
    return time >= times[samples - 1]! ? samples : indexAt(times.subarray(0, samples), time) + 1;
  }

  private makeRoom(place: number): void {
    if (this.samples === this.times.length) {
      const grown = (numbers: Float64Array) => {
        const more = new Float64Array(2 * numbers.length);
        more.set(numbers);
        return more;
      };
      this.times = grown(this.times);
      this.columns = this.columns.map(grown);
    }
    if (place < this.samples) {
      for (const numbers of [this.times, ...this.columns]) numbers.copyWithin(place + 1, place, this.samples);
    }
    this.samples += 1;
  }

  /** Drops every other sample, but the first and the last. */
  private thin(): void {
    const last = this.samples - 1;
    let kept = 0;
    for (let place = 0; place <= last; place += place + 2 > last && place < last ? last - place : 2) {
      for (const numbers of [this.times, ...this.columns]) numbers[kept] = numbers[place]!;
      kept += 1;
    }
    this.samples = kept;
    this.isThinned = true;
  }
}
