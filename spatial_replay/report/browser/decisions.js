// The decisions of a planner: candidates with their gradient maps, the choice, and its outcome.

function makeDecisions(clock) {
  const place = body("decisions");
  if (!place) return;
  const cards = clock.run.decisions.map((decision) => makeDecision(clock, decision));
  const hasMaps = clock.run.decisions.some((decision) => decision.maps.length);
  if (hasMaps) {
    place.append(mapKey());
  }
  place.append(element("p", {class: "quiet"},
    "Edges are tried in the order of their paths' lengths, those that one motion takes first."));
  place.append(element("ol", {class: "cards"}, ...cards));
  let here = null;
  clock.on("time", () => {
    const now = clock.run.decisions.indexOf(decisionAt(clock.run, clock.time));
    if (now === here) return;
    if (here !== null && here >= 0) cards[here].removeAttribute("aria-current");
    here = now;
    if (now >= 0) cards[now].setAttribute("aria-current", "true");
  });
}

function mapKey() {
  const made = key([{ground: "map", words: "from what fails most to what holds most, 0 in the middle"},
    {ground: "hatched", words: "blocked"}]);
  const [block] = made.querySelectorAll("i");
  block.style.background = `linear-gradient(to right, ${MAP.join(", ")})`;
  block.style.width = "5rem";
  return made;
}

function makeDecision(clock, decision) {
  const title = element("button", {type: "button", class: "decision-title", onclick: () => {
    clock.pause();
    clock.seek(decision.time);
  }}, element("b", {}, `Decision ${decision.number}`), ` at ${secondsText(decision.time)}, `,
  `state ${decision.states.join(", ")}: ${inShort(decision)}`);
  const tried = decision.edges.map((edge, number) => makeEdge(clock, decision, edge, number));
  const unnamed = decision.maps.filter((map) => map.edge === null);
  const meant = chosenMap(decision);
  const later = decision.edges.flatMap((edge) => (edge.aim ? edge.later : []));
  const heading = element("div", {}, title, element("p", {}, sentence(decision.reason)),
    later.length ? element("p", {}, `Planned next: ${later.join(", then ")}.`) : null,
    decision.outcome ? element("p", {}, outcomeWords(decision.outcome)) : null);
  return element("li", {class: "card"},
    heading, meant ? makeMap(clock, meant, false) : null, makeRedone(clock, decision.redone),
    tried.length ? element("details", {}, element("summary", {}, summaryOf(decision)), ...tried,
      element("div", {class: "candidates"}, ...unnamed.map((map) => makeMap(clock, map, false)))) : null);
}

// What would have been decided otherwise, with its map beside the recorded one.
function makeRedone(clock, decision) {
  if (!decision) return null;
  const meant = chosenMap(decision);
  return element("section", {class: "redone"}, element("p", {}, element("b", {}, "Redone"), `: ${inShort(decision)}`),
    element("p", {}, sentence(decision.reason)), meant ? makeMap(clock, meant, false) : null);
}

// The map that a decision's target was found on, if the page has it.
function chosenMap({maps: drawn}) {
  return drawn.find((map) => map.chosen) ?? null;
}

function summaryOf({edges, maps: drawn}) {
  const count = (number, noun) => `${number} ${noun}${number === 1 ? "" : "s"}`;
  const candidates = edges.reduce((sum, edge) => sum + edge.candidates.length, 0);
  const parts = [count(edges.length, "edge"), count(candidates, "candidate"), count(drawn.length, "map")];
  return `Looked into ${parts.join(", ")}`;
}

function inShort({kind, target}) {
  if (kind === "execute" && target) return `move ${target.object} to ${target.words}`;
  return {hold: "nothing to do", wait: "wait", "no path": "no way is left"}[kind] ?? kind;
}

function outcomeWords(outcome) {
  const how = outcome.succeeded ? "Done" : "Failed";
  return `${how} at ${secondsText(outcome.time)}, in state ${outcome.states.join(", ")}: ${sentence(outcome.reason)}`;
}

function sentence(text) {
  return text && !/[.!?…]$/.test(text) ? `${text}.` : text;
}

function makeEdge(clock, decision, edge, number) {
  const guards = (texts) => element("ul", {}, ...texts.map((text) => element("li", {}, element("code", {}, text))));
  const mapsOf = (place) => decision.maps.filter((map) => map.edge === number && map.candidate === place);
  return element("section", {class: "edge"},
    element("h3", {}, `${edge.aim ? "Aimed at" : "Looked into"} ${edge.path.slice(0, 2).join(" → ")}`,
      element("span", {class: "quiet"}, ` on the path ${edge.path.join(" → ")}`)),
    element("p", {class: "quiet"}, edge.progress.length > 1 ? "To reach one of" : "To reach"),
    guards(edge.progress),
    edge.constraints.length ? element("p", {class: "quiet"}, "Never on the way") : null,
    edge.constraints.length ? guards(edge.constraints) : null,
    element("div", {class: "candidates"},
      ...edge.candidates.map((candidate, place) => makeCandidate(clock, candidate, mapsOf(place), edge.once))),
    edge.pruned ? element("p", {class: "pruned"}, `Given up: ${sentence(edge.pruned)}`) : null);
}

function makeCandidate(clock, candidate, own, once) {
  const {object, target, rejected, best} = candidate;
  const status = {chosen: "satisfied", possible: "holding", rejected: "violated"}[candidate.status];
  const why = rejected || `to ${target.words}, robustness ${target.robustness}${candidate.status === "chosen" ? once : ""}; at best ${best}`;
  return element("div", {class: "candidate"}, ...own.map((map) => makeMap(clock, map, own.length > 1)),
    element("p", {}, mark(status), element("b", {}, object), ` ${candidate.status}: ${sentence(why)}`),
    candidate.why?.length ? element("ul", {class: "quiet"}, ...candidate.why.map((line) => element("li", {}, line))) : null);
}

function makeMap(clock, map, isTitled) {
  let shown = map;
  const {made, redraw} = canvas(`Gradient map of ${map.title || "a candidate"}`, (context, width, height) => {
    const at = projection(map.low, map.high, width, height, 1);
    drawMap(context, clock.run, shown, at);
    if (!map.target) return;
    drawWay(context, map.target.way, at, {colour: colour("ink"), width: 1.5, dash: [3, 4]});
    drawTarget(context, map.target.at, at);
  });
  made.style.aspectRatio = String((map.high[0] - map.low[0]) / (map.high[1] - map.low[1]));
  window.addEventListener("themechange", redraw);
  if (map.limited) made.addEventListener("mousemove", (event) => { made.title = cellWords(clock.run, map, event, made); });
  const layers = map.layers?.length ? layerChoice(clock.run, map, (layer) => { shown = layer; redraw(); }) : null;
  return element("figure", {}, made, layers, isTitled ? element("figcaption", {}, map.title || "a candidate") : null);
}

// A choice between the map and each relation that it is made of.
function layerChoice(run, map, show) {
  const layers = map.layers.map((layer) => {
    const scale = run.numbers(layer.values).reduce((most, each) => Math.max(most, Math.abs(each) || 0), 0);
    return {...map, values: layer.values, scale, picture: undefined};
  });
  const options = ["all that has to hold", ...map.layers.map((layer) => layer.title)];
  const choose = () => {
    // a long relation does not fit
    choice.title = options[choice.selectedIndex];
    show([map, ...layers][choice.selectedIndex]);
  };
  const choice = element("select", {"aria-label": "Layer of the map", title: options[0], onchange: choose},
    ...options.map((title) => element("option", {}, title)));
  return choice;
}

// What a cell under the pointer says: what blocks it, or what limits it and its robustness.
function cellWords(run, map, event, made) {
  const box = made.getBoundingClientRect();
  const at = projection(map.low, map.high, box.width, box.height, 1);
  const rows = run.numbers(map.values).length / map.columns;
  const column = Math.floor((event.clientX - box.left - at.x(map.low[0])) / at.scale / (map.high[0] - map.low[0]) * map.columns);
  const row = Math.floor((at.y(map.low[1]) - event.clientY + box.top) / at.scale / (map.high[1] - map.low[1]) * rows);
  if (row < 0 || row >= rows || column < 0 || column >= map.columns) return "";
  const cell = row * map.columns + column, cause = run.numbers(map.blocked)[cell];
  if (cause) return `blocked by ${map.blocks[cause - 1] ?? "something else"}`;
  const limit = map.limits[run.numbers(map.limited)[cell] - 1];
  return `${numberText(run.numbers(map.values)[cell])}${limit ? `, limited by ${limit}` : ""}`;
}

// The colours of a map, as palette.py has them, and how much of them covers the page.
const MAP = ["#00204d", "#414d6b", "#7c7b78", "#bcae6c", "#ffea46"], OPACITY = 0.6;

// The picture of a map, a pixel for each cell, lowest row at the bottom; what is blocked stays clear.
function pictureOf(run, map) {
  map.picture ??= painted(run, map);
  return map.picture;
}

function painted(run, map) {
  const values = run.numbers(map.values);
  const rows = values.length / map.columns;
  const made = document.createElement("canvas");
  made.width = map.columns;
  made.height = rows;
  const context = made.getContext("2d");
  const image = context.createImageData(map.columns, rows);
  const colours = MAP.map(rgb), last = colours.length - 1;
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < map.columns; column++) {
      const number = values[row * map.columns + column];
      if (Number.isNaN(number)) continue;
      const place = 4 * ((rows - 1 - row) * map.columns + column);
      const share = map.scale > 0 ? Math.min(Math.max(number / map.scale, -1), 1) : 0;
      const at = (share + 1) / 2 * last, low = Math.min(Math.floor(at), last - 1);
      for (let part = 0; part < 3; part++) {
        image.data[place + part] = colours[low][part] + (at - low) * (colours[low + 1][part] - colours[low][part]);
      }
      image.data[place + 3] = 255;
    }
  }
  context.putImageData(image, 0, 0);
  return made;
}

function rgb(text) {
  return [1, 3, 5].map((place) => parseInt(text.slice(place, place + 2), 16));
}

// How a part of the plane is shown in a rectangle of the screen, as large as fits, y upwards.
function projection(low, high, width, height, margin) {
  const scale = Math.min((width - 2 * margin) / (high[0] - low[0]), (height - 2 * margin) / (high[1] - low[1]));
  const left = (width - scale * (high[0] - low[0])) / 2, bottom = (height + scale * (high[1] - low[1])) / 2;
  return {
    scale,
    x: (x) => left + scale * (x - low[0]),
    y: (y) => bottom - scale * (y - low[1]),
  };
}

function drawMap(context, run, map, at) {
  const left = at.x(map.low[0]), top = at.y(map.high[1]);
  const width = at.x(map.high[0]) - left, height = at.y(map.low[1]) - top;
  hatch(context, left, top, width, height);
  context.save();
  context.imageSmoothingEnabled = false;
  context.globalCompositeOperation = "destination-out";
  context.drawImage(pictureOf(run, map), left, top, width, height);
  context.globalCompositeOperation = "source-over";
  context.globalAlpha = OPACITY;
  context.drawImage(pictureOf(run, map), left, top, width, height);
  context.restore();
}

// Oblique lines, which stay where a map is clear.
function hatch(context, left, top, width, height) {
  context.save();
  context.beginPath();
  context.rect(left, top, width, height);
  context.clip();
  context.strokeStyle = colour("neutral");
  context.lineWidth = 1;
  context.beginPath();
  for (let x = left - height; x < left + width; x += 7) {
    context.moveTo(x, top + height);
    context.lineTo(x + height, top);
  }
  context.stroke();
  context.restore();
}

// Points x and y in turn, as a line.
function drawWay(context, points, at, style) {
  if (points.length < 4) return;
  context.save();
  context.strokeStyle = style.colour;
  context.lineWidth = style.width;
  context.setLineDash(style.dash ?? []);
  context.lineJoin = "round";
  context.beginPath();
  for (let i = 0; i + 1 < points.length; i += 2) context.lineTo(at.x(points[i]), at.y(points[i + 1]));
  context.stroke();
  context.restore();
}

function drawTarget(context, target, at) {
  if (!target) return;
  const [x, y] = target;
  context.save();
  context.strokeStyle = colour("ink");
  context.lineWidth = 2;
  context.beginPath();
  context.arc(at.x(x), at.y(y), 6, 0, 2 * Math.PI);
  context.moveTo(at.x(x) - 10, at.y(y));
  context.lineTo(at.x(x) + 10, at.y(y));
  context.moveTo(at.x(x), at.y(y) - 10);
  context.lineTo(at.x(x), at.y(y) + 10);
  context.stroke();
  context.restore();
}
