// A lane for each result, and for the named parts of the chosen one: how it stands over time; and below them
// what the automaton and a planner do.

// How much room names and the scale of curves take at the left, so that all times stand below each other.
function gutter() {
  return window.matchMedia("(max-width: 640px)").matches ? 92 : 168;
}

function makeLanes(clock) {
  const place = element("div", {class: "lanes"});
  const cursor = element("div", {class: "cursor"});
  const over = element("div", {class: "over"}, cursor);
  body("timeline").append(place, laneKey());
  let lanes = [];
  clock.on("result", () => {
    lanes = clock.run.results.flatMap((result, number) => lanesOf(clock, result, number));
    const chosen = clock.run.results[clock.result];
    if (chosen?.automaton) lanes.push(stateLane(clock, chosen));
    if (clock.run.decisions.length) lanes.push(decisionLane(clock));
    place.replaceChildren(...lanes.map((lane) => lane.made), over);
    for (const lane of lanes) lane.redraw();
  });
  clock.on("view", () => lanes.forEach((lane) => lane.redraw()));
  const moveCursor = () => {
    const share = shareOf(clock, clock.time);
    cursor.hidden = share < 0 || share > 1;
    cursor.style.left = `${100 * share}%`;
    for (const lane of lanes) lane.tell();
  };
  clock.on("time", moveCursor);
  clock.on("view", moveCursor);
  clock.on("result", moveCursor);
  window.addEventListener("themechange", () => lanes.forEach((lane) => lane.redraw()));
}

function laneKey() {
  return key(Object.keys(HEIGHTS).map((standing) => {
    const {colour: ground, words} = STANDINGS[standing];
    const isFinal = standing === "violated" || standing === "satisfied";
    const [height, opacity] = [HEIGHTS[standing], OPACITIES[standing]];
    return {ground, words: isFinal ? `${words}, whatever comes` : words, height, opacity};
  }));
}

function shareOf(clock, time) {
  const [from, to] = clock.view;
  return to > from ? (time - from) / (to - from) : 0;
}

function lanesOf(clock, result, number) {
  const made = [makeLane(clock, result, result.nodes[0], number)];
  if (number !== clock.result) return made;
  const named = result.nodes.filter((node) => node.parent !== null && node.name && node.asked);
  return made.concat(named.map((node) => makeLane(clock, result, node, number)));
}

function makeLane(clock, result, node, number) {
  const stretches = stretchesOf(clock.run, result, node);
  const isResult = node.parent === null;
  const sign = mark("unknown");
  const name = isResult ? result.title : node.name;
  const label = element("button", {
    type: "button", class: `lane-name ${isResult ? "" : "part"}`, title: node.text,
    "aria-pressed": isResult ? String(number === clock.result) : null,
    onclick: () => clock.choose(number),
  }, sign, element("span", {}, name));
  const strip = canvas(`How ${name} stands over time`, (context, width, height) => {
    const fills = {positive: colour("positive"), negative: colour("negative"), neutral: colour("neutral")};
    for (const stretch of stretches) drawStretch(context, clock, stretch, fills, width, height);
  });
  strip.made.className = "strip";
  scrub(strip.made, clock);
  return {
    made: element("div", {class: "lane"}, label, strip.made),
    redraw: strip.redraw,
    tell: () => setMark(sign, standingOf(clock.run, result, node, placeIn(result, clock.sample))),
  };
}

// What fails is drawn higher than what holds, and that higher than what is unknown; what is final is full.
const HEIGHTS = {violated: 1, failing: 1, holding: 0.6, satisfied: 0.6, unknown: 0.3};
const OPACITIES = {violated: 1, failing: 0.5, holding: 0.4, satisfied: 1, unknown: 0.6};

function drawStretch(context, clock, [from, to, standing], fills, width, height) {
  const left = shareOf(clock, from) * width, right = shareOf(clock, to) * width;
  if (right < 0 || left > width) return;
  const begin = Math.max(left, 0), size = Math.max(Math.min(right, width) - begin, 1);
  const high = HEIGHTS[standing] * (height - 6);
  context.globalAlpha = OPACITIES[standing];
  context.fillStyle = fills[STANDINGS[standing].colour];
  context.fillRect(begin, height - 3 - high, size, high);
}

// Pressing and dragging on something whose width is the part of the run that is looked at moves the cursor.
function scrub(made, clock, left = () => 0, right = () => 0) {
  const seek = (event) => {
    const box = made.getBoundingClientRect();
    const share = (event.clientX - box.left - left()) / (box.width - left() - right());
    const [from, to] = clock.view;
    clock.seek(from + Math.min(Math.max(share, 0), 1) * (to - from));
  };
  made.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    made.setPointerCapture(event.pointerId);
    clock.pause();
    seek(event);
  });
  made.addEventListener("pointermove", (event) => {
    if (made.hasPointerCapture(event.pointerId)) seek(event);
  });
}
