// The bar at the bottom: play, pause, speed, the slider, and the keys that do the same.

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10, 50];
const STEPS = 1000;
const keysOf = (run) => [
  ["Space", "play, pause"],
  ["← →", `a ${run.is_thinned ? "kept sample" : "sample"} back, on`],
  ["Shift ← →", "a second back, on"],
  ["Home End", "first, last sample"],
  ["N P", "next, previous event"],
  ["+ − 0", "look closer, wider, at all"],
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
    slider, now, speed, themeButton(), helper, help);
  clock.on("time", () => {
    const share = clock.end > clock.start ? (clock.time - clock.start) / (clock.end - clock.start) : 0;
    slider.value = share * STEPS;
    slider.setAttribute("aria-valuetext", secondsText(clock.time));
    now.textContent = `${secondsText(clock.time)} / ${secondsText(clock.end)}`;
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

// What a key does; whether it did anything.
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
  // what has the focus keeps the key that presses it
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
  // what is drawn for paper has other colours, too
  for (const query of [dark, window.matchMedia("print")]) {
    query.addEventListener("change", () => {
      show();
      window.dispatchEvent(new Event("themechange"));
    });
  }
  show();
  return made;
}
