// The time, the view and the result that the page shows, and the bar at the bottom that controls them.

class Clock {
  constructor(run) {
    this.run = run;
    this.times = run.times;
    this.start = run.times.length ? run.times[0] : 0;
    this.end = run.times.length ? run.times[run.times.length - 1] : 0;
    this.view = [this.start, this.end];
    this.worst = worstOf(run);
    this.result = this.worst;
    this.time = this.opening;
    this.speed = 1;
    this.isPlaying = false;
    // filter of the listed results: their verdict, and a part of their titles
    this.filter = {verdict: "", words: ""};
    this.listeners = {time: [], view: [], result: [], play: [], filter: []};
  }

  // Calls `callback` now, and on every change of "time", "view", "result", "play" or "filter".
  on(what, callback) {
    this.listeners[what].push(callback);
    callback(this);
  }

  emit(what) {
    for (const callback of this.listeners[what]) callback(this);
  }

  get sample() {
    return indexAt(this.times, this.time);
  }

  // The time in texts: the cursor, or the time of the shown sample if the page leaves samples out.
  get shownTime() {
    return this.run.is_thinned && this.times.length ? this.times[this.sample] : this.time;
  }

  isListed({title, verdict}) {
    const {verdict: wanted, words} = this.filter;
    return (!wanted || verdict === wanted) && title.toLowerCase().includes(words.toLowerCase());
  }

  // The time at which the chosen result is first shown: its fault, or the end of the run.
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
    this.emit("time");
  }

  step(samples) {
    const last = this.times.length - 1;
    this.pause();
    this.seek(this.times[Math.min(Math.max(this.sample + samples, 0), last)]);
  }

  choose(result) {
    if (result === this.result || !this.run.results[result]) return;
    this.result = result;
    this.emit("result");
    this.emit("time");
  }

  // Zooms the view by a factor around the cursor.
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
    this.emit("view");
  }

  // Moves the view to the cursor.
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
    this.emit("play");
    // a reader who wants little motion gets a few pictures a second
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
    this.emit("play");
  }

  toggle() {
    if (this.isPlaying) this.pause();
    else this.play();
  }
}

// The first violated result, else the first unknown result, else the planner's result, else the first result.
function worstOf({results, decisions}) {
  const places = [...["violated", "unknown"].map((verdict) => results.findIndex((result) => result.verdict === verdict)),
    results.findIndex(({name}) => name === decisions?.at(-1)?.specification)];
  return places.find((place) => place >= 0) ?? 0;
}

// Writes time and result to the address and reads them from it: #t=4.2&r=1.
function linkAddress(clock, opening = null) {
  const given = new URLSearchParams(location.hash.slice(1));
  if (given.has("r")) clock.choose(Number(given.get("r")));
  const time = given.has("t") ? Number(given.get("t")) : NaN;
  clock.seek(Number.isFinite(time) ? time : opening ?? clock.opening);
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

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10, 50];
const STEPS = 1000;
const keysOf = (run) => [
  ["Space", "play, pause"],
  ["← →", `a ${run.is_thinned ? "kept sample" : "sample"} back, on`],
  ["Shift ← →", "a second back, on"],
  ["Home End", "first, last sample"],
  ["N P", "next, previous event"],
  ["+ − 0", "zoom in, out, show all"],
];

function makeTransport(clock, events) {
  const play = button("Play", "play", () => clock.toggle());
  const slider = element("input", {
    type: "range", min: 0, max: STEPS, step: "any", "aria-label": "Time", class: "slider",
    oninput: () => clock.seek(clock.start + slider.valueAsNumber / STEPS * (clock.end - clock.start)),
  });
  const now = element("output", {class: "now", "aria-live": "off"});
  const speed = element("select", {"aria-label": "Speed", onchange: () => { clock.speed = Number(speed.value); }},
    ...SPEEDS.map((each) => element("option", {value: each, selected: each === 1}, `${each}×`)));
  const help = element("p", {class: "keys", id: "keys", hidden: true}, ...keysOf(clock.run).flatMap(([key, does]) => [
    element("kbd", {}, key), ` ${does} `]));
  const helper = button("Keys", "help", () => {
    help.hidden = !help.hidden;
    helper.setAttribute("aria-expanded", String(!help.hidden));
  });
  helper.setAttribute("aria-controls", "keys");
  helper.setAttribute("aria-expanded", "false");
  document.getElementById("transport").append(
    button("To the first sample", "first", () => clock.seek(clock.start)),
    button("Previous event", "previous", () => jump(clock, events, -1)),
    play,
    button("Next event", "next", () => jump(clock, events, 1)),
    button("To the last sample", "last", () => clock.seek(clock.end)),
    element("div", {class: "time"}, slider, eventTicks(clock, events)), now, speed, themeButton(), helper, help);
  clock.on("time", () => {
    const share = clock.end > clock.start ? (clock.time - clock.start) / (clock.end - clock.start) : 0;
    slider.value = share * STEPS;
    slider.setAttribute("aria-valuetext", secondsText(clock.shownTime));
    now.textContent = `${secondsText(clock.shownTime)} / ${secondsText(clock.end)}`;
  });
  clock.on("play", () => {
    play.className = `button ${clock.isPlaying ? "pause" : "play"}`;
    play.setAttribute("aria-label", clock.isPlaying ? "Pause" : "Play");
    play.title = play.getAttribute("aria-label");
  });
  window.addEventListener("keydown", (event) => {
    if (act(event, clock, events)) event.preventDefault();
  });
}

// Half the width of the slider's thumb, pixels: the ends of the scale lie this far inside the slider.
const THUMB = 8;

// A tick for each event below the slider; a press goes to the nearest event.
function eventTicks(clock, events) {
  if (!events.length || clock.end <= clock.start) return null;
  const place = (event, width) => THUMB + (event.time - clock.start) / (clock.end - clock.start) * (width - 2 * THUMB);
  const {made, redraw} = canvas(`${events.length} events over time`, (context, width, height) => {
    for (const event of events) {
      const ground = STATUSES[event.status].colour;
      context.fillStyle = colour({neutral: "quiet", pending: "pending"}[ground] ?? `${ground}-line`);
      context.fillRect(place(event, width) - 1, 3, 2, 9);
    }
  });
  made.className = "ticks";
  made.title = "Press to go to the nearest event; keys N and P";
  made.addEventListener("pointerdown", (pointer) => {
    const box = made.getBoundingClientRect();
    const distance = (event) => Math.abs(place(event, box.width) - (pointer.clientX - box.left));
    clock.pause();
    goTo(clock, events.reduce((nearest, event) => (distance(event) < distance(nearest) ? event : nearest)));
  });
  window.addEventListener("themechange", redraw);
  return made;
}

const ICONS = {
  play: "M3 1 L14 8 L3 15 Z", pause: "M3 1 H6.5 V15 H3 Z M9.5 1 H13 V15 H9.5 Z",
  first: "M2 2 H4 V14 H2 Z M14 2 L5 8 L14 14 Z", last: "M12 2 H14 V14 H12 Z M2 2 L11 8 L2 14 Z",
  previous: "M10 2 L4 8 L10 14", next: "M6 2 L12 8 L6 14",
};

function button(label, kind, onclick) {
  const icon = ICONS[kind] ? picture(kind) : label;
  const made = element("button", {
    type: "button", class: `button ${kind}`, title: label, "aria-label": ICONS[kind] ? label : null, onclick,
  }, icon);
  if (kind === "play") made.append(picture("pause"));
  return made;
}

function picture(kind) {
  return svg("svg", {viewBox: "0 0 16 16", class: `icon icon-${kind}`, "aria-hidden": "true"},
    svg("path", {d: ICONS[kind]}));
}

// Goes to the event before or after the cursor.
function jump(clock, events, direction) {
  const ahead = events.filter((event) => direction * (event.time - clock.time) > 1e-6);
  if (!ahead.length) return;
  clock.pause();
  goTo(clock, direction > 0 ? ahead[0] : ahead[ahead.length - 1]);
}

function goTo(clock, event) {
  const found = clock.run.results.findIndex(
    (result) => result.name === event.specification && (result.object ?? null) === (event.object ?? null));
  if (found >= 0) clock.choose(found);
  clock.seek(event.time);
}

// Runs the command of a key; returns whether the key has one.
function act(event, clock, events) {
  if (event.ctrlKey || event.metaKey || event.altKey) return false;
  const target = event.target;
  if (target.closest("select, textarea, input:not([type=range], [type=checkbox])")) return false;
  const does = {
    ArrowLeft: () => event.shiftKey ? clock.seek(clock.time - 1) : clock.step(-1),
    ArrowRight: () => event.shiftKey ? clock.seek(clock.time + 1) : clock.step(1),
    Home: () => clock.seek(clock.start),
    End: () => clock.seek(clock.end),
    n: () => jump(clock, events, 1),
    p: () => jump(clock, events, -1),
    "+": () => clock.zoom(0.5),
    "=": () => clock.zoom(0.5),
    "-": () => clock.zoom(2),
    "0": () => clock.look(clock.start, clock.end),
  }[event.key];
  if (does) {
    does();
    return true;
  }
  // space presses the element that has the focus
  if (event.key !== " " || target.closest("button, summary, input, a")) return false;
  clock.toggle();
  return true;
}

function themeButton() {
  const root = document.documentElement;
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const isDark = () => root.dataset.theme ? root.dataset.theme === "dark" : dark.matches;
  const made = element("button", {type: "button", class: "button theme", onclick: () => {
    root.dataset.theme = isDark() ? "light" : "dark";
    show();
    window.dispatchEvent(new Event("themechange"));
  }});
  const show = () => { made.textContent = isDark() ? "Light" : "Dark"; };
  // print has its own colours
  for (const query of [dark, window.matchMedia("print")]) {
    query.addEventListener("change", () => {
      show();
      window.dispatchEvent(new Event("themechange"));
    });
  }
  show();
  return made;
}
