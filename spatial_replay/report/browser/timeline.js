// The timeline: a lane for each result and each named part of the chosen one, for the states of its
// automaton, and for the decisions of a planner.

// Width of the lanes' names and of the curves' scale, pixels. It is equal, because both share one time axis.
function gutter() {
  return window.matchMedia("(max-width: 640px)").matches ? 92 : 168;
}

function makeLanes(clock) {
  const place = element("div", {class: "lanes"});
  const cursor = element("div", {class: "cursor"});
  const over = element("div", {class: "over"}, cursor);
  body("timeline").append(place, laneKey());
  let lanes = [];
  const build = () => {
    lanes = clock.run.results.flatMap((result, number) =>
      number === clock.result || clock.isListed(result) ? lanesOf(clock, result, number) : []);
    const chosen = clock.run.results[clock.result];
    if (chosen?.automaton) lanes.push(stateLane(clock, chosen));
    if (clock.run.decisions.length) lanes.push(decisionLane(clock));
    place.replaceChildren(...lanes.map((lane) => lane.made), over);
    for (const lane of lanes) {
      lane.redraw();
      lane.update();
    }
  };
  clock.on("result", build);
  clock.on("filter", build);
  clock.on("view", () => lanes.forEach((lane) => lane.redraw()));
  const moveCursor = () => {
    const share = shareOf(clock, clock.time);
    cursor.hidden = share < 0 || share > 1;
    cursor.style.left = `${100 * share}%`;
    for (const lane of lanes) lane.update();
  };
  clock.on("time", moveCursor);
  clock.on("view", moveCursor);
  clock.on("result", moveCursor);
  window.addEventListener("themechange", () => lanes.forEach((lane) => lane.redraw()));
}

function laneKey() {
  return key(Object.keys(HEIGHTS).map((status) => {
    const {colour: ground, words} = STATUSES[status];
    const isFinal = status === "violated" || status === "satisfied";
    const [height, opacity] = [HEIGHTS[status], OPACITIES[status]];
    return {ground, words: isFinal ? `${words}, final` : words, height, opacity};
  }));
}

function shareOf(clock, time) {
  const [from, to] = clock.view;
  return to > from ? (time - from) / (to - from) : 0;
}

function lanesOf(clock, result, number) {
  const made = [makeLane(clock, result, result.nodes[0], number)];
  if (number !== clock.result) return made;
  const named = result.nodes.filter((node) => node.parent !== null && node.name && node.initial);
  return made.concat(named.map((node) => makeLane(clock, result, node, number)));
}

function makeLane(clock, result, node, number) {
  const isResult = node.parent === null;
  const sign = mark("unknown");
  const name = isResult ? result.title : node.name;
  const label = element("button", {
    type: "button", class: `lane-name ${isResult ? "" : "part"}`, title: node.text,
    "aria-pressed": isResult ? String(number === clock.result) : null,
    onclick: () => clock.choose(number),
  }, sign, element("span", {}, name));
  const strip = nodeLane(clock, result, node, `How ${name} stands over time`);
  return {
    made: element("div", {class: "lane"}, label, strip.made),
    redraw: strip.redraw,
    update: () => setMark(sign, statusOf(clock.run, result, node, placeIn(result, clock.sample))),
  };
}

// A strip with the status of a node over time, within the view.
function nodeLane(clock, result, node, title = `How ${node.text} stands over time`) {
  let stretches = null;
  const strip = canvas(title, (context, width, height) => {
    // the stretches of a lane that is never visible are never computed
    stretches ??= stretchesOf(clock.run, result, node);
    const fills = Object.fromEntries(["positive", "negative", "pending", "neutral"].map((name) => [name, colour(name)]));
    for (const stretch of stretches) drawStretch(context, clock, stretch, fills, width, height);
  });
  strip.made.className = "strip";
  scrub(strip.made, clock);
  // a click on a strip within a summary must not fold the details
  strip.made.addEventListener("click", (event) => event.preventDefault());
  return strip;
}

// Failures are drawn highest, then parts that hold, then unknown parts. Final statuses are opaque.
const HEIGHTS = {violated: 1, failing: 1, pending: 0.6, holding: 0.6, satisfied: 0.6, unknown: 0.3};
const OPACITIES = {violated: 1, failing: 0.5, pending: 1, holding: 0.4, satisfied: 1, unknown: 0.6};

function drawStretch(context, clock, [from, to, status], fills, width, height) {
  const left = shareOf(clock, from) * width, right = shareOf(clock, to) * width;
  if (right < 0 || left > width) return;
  const begin = Math.max(left, 0), size = Math.max(Math.min(right, width) - begin, 1);
  const air = height > 12 ? 3 : 1, high = HEIGHTS[status] * (height - 2 * air);
  context.globalAlpha = OPACITIES[status];
  context.fillStyle = fills[STATUSES[status].colour];
  context.fillRect(begin, height - air - high, size, high);
}

// Moves the cursor when the pointer is pressed or dragged on an element that spans the view.
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

function stateLane(clock, result) {
  const {automaton, times} = result;
  const blocks = [];
  automaton.path.forEach((code, place) => {
    if (place && code === automaton.path[place - 1]) return;
    if (blocks.length) blocks.at(-1).to = times[place];
    const states = automaton.sets[code];
    blocks.push({from: times[place], to: clock.end, text: states.join(", "), ground: groundOf(automaton, states)});
  });
  return blockLane(clock, "state", `States of the automaton of ${result.title}`, blocks);
}

// The colour of states: whether the run is accepted as it stands, lost, pending, or not known.
function groundOf(automaton, numbers) {
  const states = automaton.states.filter(({number}) => numbers.includes(number));
  if (states.length && states.every(({lost}) => lost)) return "negative";
  if (states.length && states.every(({accepting}) => accepting)) return "positive";
  return states.some(({accepting, lost}) => accepting || lost) ? "neutral" : "pending";
}

function decisionLane(clock) {
  const {decisions} = clock.run;
  const blocks = decisions.map(({time, kind, target}, index) => ({
    from: time, to: decisions[index + 1]?.time ?? clock.end, text: target ? `move ${target.object}` : kind,
  }));
  const lane = blockLane(clock, "decision", "Decisions of the planner", blocks);
  const link = element("button", {type: "button", class: "lane-name part", onclick: () => {
    document.querySelector("#decisions .card[aria-current]")?.scrollIntoView({block: "start"});
  }});
  lane.made.replaceChild(link, lane.made.firstChild);
  lane.update = () => {
    const decision = decisionAt(clock.run, clock.time);
    link.textContent = decision ? `decision ${decision.number} ↓` : "decision";
    link.disabled = !decision;
    link.title = decision ? `Show decision ${decision.number}, with its map` : "Before the first decision";
  };
  return lane;
}

function blockLane(clock, name, title, blocks) {
  const strip = canvas(title, (context, width, height) => {
    const ink = colour("ink");
    context.font = FONT;
    context.textBaseline = "middle";
    for (const {from, to, text, ground = "line"} of blocks) {
      const left = Math.max(shareOf(clock, from) * width, 0), right = Math.min(shareOf(clock, to) * width, width);
      if (right < left) continue;
      context.fillStyle = colour(ground);
      context.globalAlpha = ground === "line" ? 1 : 0.4;
      context.fillRect(left, 3, Math.max(right - left - 1, 1), height - 6);
      context.globalAlpha = 1;
      if (context.measureText(text).width + 10 > right - left) continue;
      context.fillStyle = ink;
      context.fillText(text, left + 5, height / 2 + 0.5);
    }
  });
  strip.made.className = "strip";
  scrub(strip.made, clock);
  return {
    made: element("div", {class: "lane"}, element("span", {class: "lane-name part"}, name), strip.made),
    redraw: strip.redraw,
    update: () => {},
  };
}
