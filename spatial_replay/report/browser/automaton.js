// The automaton of the chosen result: its states, the current one highlighted, and the transitions from there.

const COLUMN = 128, ROW = 64, RADIUS = 17;
// twice the largest distance of a curve from its straight line, pixels
const HIGHEST = 84;

function makeAutomaton(clock) {
  const place = body("automaton");
  const drawing = element("div", {class: "drawing"});
  const words = element("div", {class: "moves"});
  place.append(drawing, words);
  let drawn = null;
  clock.on("result", () => {
    const result = clock.run.results[clock.result];
    const automaton = result?.automaton;
    drawn = automaton ? drawAutomaton(automaton) : null;
    drawing.replaceChildren(...(drawn ? [drawn.made, legendOf(automaton)] : whyNone(result)));
    words.replaceChildren();
  });
  clock.on("time", () => {
    const result = clock.run.results[clock.result];
    if (!drawn) return;
    const sample = placeIn(result, clock.sample);
    const set = sample === null ? -1 : result.automaton.path[Math.min(sample, result.samples - 1)];
    if (set === drawn.set) return;
    drawn.set = set;
    const states = set < 0 ? [] : result.automaton.sets[set];
    light(drawn, states);
    if (states.length) keepInView(drawing, drawn.states.get(states[0]));
    words.replaceChildren(...describe(result.automaton, states));
  });
}

function legendOf({legend}) {
  return element("p", {class: "legend-words"}, ...legend.flatMap((each) => [element("code", {}, each), " "]));
}

function whyNone(result) {
  if (!result) return ["Nothing was evaluated."];
  return [element("p", {}, `${result.title} has no automaton: `, ...withCode(result.no_automaton), ".")];
}

function drawAutomaton(automaton) {
  const place = ({at: [column, row]}) => [column * COLUMN, row * ROW];
  const places = new Map(automaton.states.map((state) => [state.number, place(state)]));
  const rows = automaton.states.map((state) => place(state)[1]);
  const columns = automaton.states.map((state) => place(state)[0]);
  const low = Math.min(...rows) - 62, high = Math.max(...rows) + 44, wide = Math.max(...columns);
  const moves = automaton.moves.filter((move) => move.source !== move.target).map((move) => ({
    ...move,
    made: svg("path", {class: "move", d: curve(places.get(move.source), places.get(move.target)),
      "marker-end": "url(#tip)"}),
  }));
  const states = new Map(automaton.states.map(
    (state) => [state.number, drawState(state, places.get(state.number))]));
  const [x, y] = places.get(automaton.states[0].number);
  const made = svg("svg", {
    viewBox: `-52 ${low} ${wide + 94} ${high - low}`, width: wide + 94, height: high - low, role: "img",
    "aria-label": `Automaton with ${automaton.summary}`, class: wide < 6 * COLUMN ? "small" : null,
  }, svg("defs", {}, tip("tip"), tip("tip-ahead")),
  svg("path", {class: "move", d: `M${x - 46} ${y} H${x - RADIUS - 5}`, "marker-end": "url(#tip)"}),
  ...moves.map((move) => move.made), ...moves.map(pointerArea), ...states.values());
  const labels = svg("g");
  made.append(labels);
  const isLarge = moves.length > MOST_LABELLED;
  if (!isLarge) labels.replaceChildren(...labelsOf(moves, places));
  return {made, moves, states, set: null, label: isLarge ? (ahead) => labels.replaceChildren(...labelsOf(ahead, places)) : null};
}

// Limit of labels. With more moves, only the moves from the current states have labels, because others would overlap.
const MOST_LABELLED = 16;

// A wide and transparent copy of a move, which is easy to point at.
function pointerArea({made, guard}) {
  return svg("path", {class: "area", d: made.getAttribute("d")}, svg("title", {}, guard));
}

function tip(id) {
  return svg("marker", {id, viewBox: "0 0 8 8", refX: 7, refY: 4, markerUnits: "userSpaceOnUse", markerWidth: 9,
    markerHeight: 9, orient: "auto"}, svg("path", {class: "tip", d: "M0 0 L8 4 L0 8 Z"}));
}

// characters that fit between two neighbouring states
const LONGEST_LABEL = 16;

// places along a curve at which a label may stand, the best first
const SHARES = [0.5, 0.4, 0.6, 0.32, 0.68, 0.25, 0.75];
const LETTER = 5.6, LINE = 12;

// The guards of the moves beside their curves, with short names for long propositions. A label takes the first place
// without a state, another curve or an earlier label. Without such a place, only the tooltip shows the guard.
function labelsOf(moves, places) {
  const taken = [...places.values()].map(([x, y]) => [x - RADIUS, y - RADIUS, x + RADIUS, y + RADIUS]);
  const curves = moves.map(({source, target}) => pointsAlong(places.get(source), places.get(target)));
  return moves.flatMap(({source, target, label, guard}, number) => {
    if (!label) return [];
    const text = label.length > LONGEST_LABEL ? `${label.slice(0, LONGEST_LABEL - 1)}…` : label;
    const half = text.length * LETTER / 2;
    const boxes = SHARES.map((share) => {
      const [x, y] = alongCurve(places.get(source), places.get(target), share);
      return [x - half, y - LINE, x + half, y];
    });
    const isCrossed = ([left, top, right, bottom]) => curves.some((points, other) => other !== number
      && points.some(([x, y]) => left < x && x < right && top < y && y < bottom));
    const box = boxes.find((place) => !taken.some((other) => meets(place, other)) && !isCrossed(place));
    if (!box) return [];
    taken.push(box);
    return svg("text", {class: "guard", x: (box[0] + box[2]) / 2, y: box[3], "text-anchor": "middle", dy: "-0.3em"},
      text, svg("title", {}, guard));
  });
}

function alongCurve([x0, y0], [x1, y1], share) {
  const [cx, cy] = controlOf([x0, y0], [x1, y1]), rest = 1 - share;
  const along = (from, by, to) => rest * rest * from + 2 * rest * share * by + share * share * to;
  return [along(x0, cx, x1), along(y0, cy, y1)];
}

function pointsAlong(begin, end) {
  const steps = Math.ceil(Math.hypot(end[0] - begin[0], end[1] - begin[1]) / LETTER);
  return Array.from({length: steps}, (_, step) => alongCurve(begin, end, (step + 0.5) / steps));
}

// A curve from rim to rim. Moves over several columns, back, or within a column bend around the states between.
function curve([x0, y0], [x1, y1]) {
  const [cx, cy] = controlOf([x0, y0], [x1, y1]);
  const rim = (x, y, gap) => {
    const away = Math.hypot(cx - x, cy - y);
    return `${(x + gap * (cx - x) / away).toFixed(1)} ${(y + gap * (cy - y) / away).toFixed(1)}`;
  };
  return `M${rim(x0, y0, RADIUS)} Q${cx.toFixed(1)} ${cy.toFixed(1)} ${rim(x1, y1, RADIUS + 3)}`;
}

function controlOf([x0, y0], [x1, y1]) {
  const dx = x1 - x0, dy = y1 - y0, length = Math.hypot(dx, dy);
  const spans = Math.round(dx / COLUMN);
  const share = spans === 1 ? 0.06 : spans > 1 && dy !== 0 ? 0.12 : 0.28;
  const bend = Math.min(share * length, HIGHEST);
  const [nx, ny] = [dy / length, -dx / length];
  return [(x0 + x1) / 2 + bend * nx, (y0 + y1) / 2 + bend * ny];
}

function drawState(state, [x, y]) {
  const kind = state.won ? "won" : state.lost ? "lost" : "";
  return svg("g", {class: `state ${kind}`, transform: `translate(${x} ${y})`},
    svg("title", {}, `state ${state.number}: ${state.about}`),
    svg("circle", {r: RADIUS}),
    state.accepting ? svg("circle", {r: RADIUS - 4, class: "inner"}) : null,
    svg("text", {"text-anchor": "middle", dy: "0.35em"}, String(state.number)));
}

function light(drawn, states) {
  for (const [number, made] of drawn.states) made.classList.toggle("here", states.includes(number));
  for (const move of drawn.moves) move.made.classList.toggle("ahead", states.includes(move.source));
  drawn.label?.(drawn.moves.filter((move) => states.includes(move.source)));
}

// Scrolls a wide drawing sideways, so that a state shows.
function keepInView(drawing, state) {
  if (!state || drawing.scrollWidth <= drawing.clientWidth) return;
  const box = state.getBoundingClientRect(), frame = drawing.getBoundingClientRect();
  if (box.left < frame.left || box.right > frame.right) {
    drawing.scrollLeft += (box.left + box.right - frame.left - frame.right) / 2;
  }
}

function describe(automaton, states) {
  if (!states.length) return [element("p", {}, "Before the first sample.")];
  const parts = [];
  for (const number of states) {
    const state = automaton.states.find((each) => each.number === number);
    if (!state) continue;
    parts.push(element("p", {}, element("b", {}, `State ${number}`), `: ${state.about}.`));
    const moves = automaton.moves.filter((move) => move.source === number);
    parts.push(element("ul", {}, ...moves.map((move) => element("li", {},
      move.target === number ? "stays if " : `to ${move.target} if `,
      element("code", {title: move.guard}, move.label || move.guard)))));
  }
  if (automaton.left_out) parts.push(element("p", {class: "quiet"}, `${automaton.left_out} states are not drawn.`));
  return states.length > 1
    ? [element("p", {}, `In one of the states ${states.join(", ")}: unknown propositions leave it open.`), ...parts]
    : parts;
}
