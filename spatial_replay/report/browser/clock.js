// One time for the whole page, the part of the run that is looked at, and the result that is looked into.

class Clock {
  constructor(run) {
    this.run = run;
    this.times = run.times;
    this.start = run.times.length ? run.times[0] : 0;
    this.end = run.times.length ? run.times[run.times.length - 1] : 0;
    this.view = [this.start, this.end];
    this.worst = worstOf(run.results);
    this.result = this.worst;
    this.time = this.opening;
    this.speed = 1;
    this.isPlaying = false;
    this.watchers = {time: [], view: [], result: [], play: []};
  }

  // Calls back on every change of "time", "view", "result" or "play", and once at once.
  on(what, callback) {
    this.watchers[what].push(callback);
    callback(this);
  }

  tell(what) {
    for (const callback of this.watchers[what]) callback(this);
  }

  get sample() {
    return indexAt(this.times, this.time);
  }

  // The time at which the chosen result is first shown: where it went wrong, or the end.
  get opening() {
    return this.run.results[this.result]?.fault ?? this.end;
  }

  get isAtEnd() {
    return this.time >= this.end;
  }

  seek(time) {
    const inside = Math.min(Math.max(time, this.start), this.end);
    if (inside === this.time) return;
    this.time = inside;
    this.follow();
    this.tell("time");
  }

  step(samples) {
    const last = this.times.length - 1;
    this.pause();
    this.seek(this.times[Math.min(Math.max(this.sample + samples, 0), last)]);
  }

  choose(result) {
    if (result === this.result || !this.run.results[result]) return;
    this.result = result;
    this.tell("result");
    this.tell("time");
  }

  // Looks at a part of the run, by a factor smaller or larger, around the cursor.
  zoom(factor) {
    const [from, to] = this.view;
    const share = to > from ? Math.min(Math.max((this.time - from) / (to - from), 0), 1) : 0.5;
    const shortest = Math.min(this.end - this.start, Math.max((this.end - this.start) * 1e-4, 1e-6));
    const width = Math.min(Math.max((to - from) * factor, shortest), this.end - this.start);
    const begin = Math.min(Math.max(this.time - share * width, this.start), this.end - width);
    this.look(begin, begin + width);
  }

  look(from, to) {
    this.view = [from, to];
    this.tell("view");
  }

  // Moves the part that is looked at to where the cursor is.
  follow() {
    const [from, to] = this.view;
    if (this.time >= from && this.time <= to) return;
    const begin = Math.min(Math.max(this.time - (to - from) / 2, this.start), this.end - (to - from));
    this.look(begin, begin + to - from);
  }

  play() {
    if (this.isPlaying || this.end <= this.start) return;
    if (this.isAtEnd) this.seek(this.start);
    this.isPlaying = true;
    this.tell("play");
    // for those who want little motion, a few pictures a second
    const least = window.matchMedia("(prefers-reduced-motion: reduce)").matches ? 300 : 0;
    let before = performance.now();
    const tick = (now) => {
      if (!this.isPlaying) return;
      if (now - before >= least) {
        this.seek(this.time + this.speed * (now - before) / 1000);
        before = now;
      }
      if (this.isAtEnd) this.pause();
      else requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  pause() {
    if (!this.isPlaying) return;
    this.isPlaying = false;
    this.tell("play");
  }

  toggle() {
    if (this.isPlaying) this.pause();
    else this.play();
  }
}

// The first result of those that are violated or, without any, unknown.
function worstOf(results) {
  const found = ["violated", "unknown"].map((verdict) => results.findIndex((each) => each.verdict === verdict));
  return found.find((place) => place >= 0) ?? 0;
}

// Keeps time and result in the address, so that a link leads to them: #t=4.2&r=1.
function keepInAddress(clock) {
  const given = new URLSearchParams(location.hash.slice(1));
  if (given.has("r")) clock.choose(Number(given.get("r")));
  const time = given.has("t") ? Number(given.get("t")) : NaN;
  clock.seek(Number.isFinite(time) ? time : clock.opening);
  let waiting = null, before = [clock.time, clock.result];
  const write = () => {
    waiting = null;
    const result = clock.result === clock.worst ? "" : `&r=${clock.result}`;
    history.replaceState(null, "", `#t=${Number(clock.time.toFixed(6))}${result}`);
  };
  const later = () => {
    if (before[0] === clock.time && before[1] === clock.result) return;
    before = [clock.time, clock.result];
    if (waiting !== null) clearTimeout(waiting);
    waiting = setTimeout(write, 200);
  };
  clock.on("time", later);
  clock.on("result", later);
  window.addEventListener("hashchange", () => {
    const now = new URLSearchParams(location.hash.slice(1));
    if (now.has("r")) clock.choose(Number(now.get("r")));
    if (now.has("t")) clock.seek(Number(now.get("t")) || 0);
  });
}
