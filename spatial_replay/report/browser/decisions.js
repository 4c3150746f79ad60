// What a planner decided: what it aimed at, tried, rejected and chose, with its maps, and how it went.

function makeDecisions(clock) {
  const place = body("decisions");
  if (!place) return;
  const cards = clock.run.decisions.map((decision) => makeDecision(clock, decision));
  const hasMaps = clock.run.decisions.some((decision) => decision.maps.length);
  if (hasMaps) {
    place.append(key([{ground: "positive", words: "there it would hold"},
      {ground: "negative", words: "there it would not"}, {ground: "hatched", words: "blocked"}]));
  }
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

function makeDecision(clock, decision) {
  const title = element("button", {type: "button", class: "decision-title", onclick: () => {
    clock.pause();
    clock.seek(decision.time);
  }}, element("b", {}, `Decision ${decision.number}`), ` at ${secondsText(decision.time)}, `,
  `state ${decision.states.join(", ")}: ${inShort(decision)}`);
  const tried = decision.edges.map((edge, number) => makeEdge(clock, decision, edge, number));
  const unnamed = decision.maps.filter((map) => map.edge === null);
  const meant = chosenMap(decision);
  const said = element("div", {}, title, element("p", {}, sentence(decision.reason)),
    decision.outcome ? element("p", {}, outcomeWords(decision.outcome)) : null);
  return element("li", {class: "card"},
    said, meant ? makeMap(clock, meant, false) : null,
    tried.length ? element("details", {}, element("summary", {}, lookedInto(decision)), ...tried,
      element("div", {class: "candidates"}, ...unnamed.map((map) => makeMap(clock, map, false)))) : null);
}

// The map that a decision's target was found on, if the page has it.
function chosenMap({maps: drawn}) {
  return drawn.find((map) => map.chosen) ?? null;
}

function lookedInto({edges, maps: drawn}) {
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
      ...edge.candidates.map((candidate, place) => makeCandidate(clock, candidate, mapsOf(place)))),
    edge.pruned ? element("p", {class: "pruned"}, `Given up: ${sentence(edge.pruned)}`) : null);
}

function makeCandidate(clock, candidate, own) {
  const {object, target, rejected, best} = candidate;
  const standing = {chosen: "satisfied", possible: "holding", rejected: "violated"}[candidate.standing];
  const why = rejected || `to ${target.words}, robustness ${target.robustness}; at best ${best}`;
  return element("div", {class: "candidate"}, ...own.map((map) => makeMap(clock, map, own.length > 1)),
    element("p", {}, mark(standing), element("b", {}, object), ` ${candidate.standing}: ${sentence(why)}`));
}

function makeMap(clock, map, isTitled) {
  const {made, redraw} = canvas(`Gradient map of ${map.title || "a candidate"}`, (context, width, height) => {
    const at = projection(map.low, map.high, width, height, 1);
    drawMap(context, clock.run, map, at);
    if (!map.target) return;
    drawWay(context, map.target.way, at, {colour: colour("ink"), width: 1.5, dash: [3, 4]});
    drawTarget(context, map.target.at, at);
  });
  made.style.aspectRatio = String((map.high[0] - map.low[0]) / (map.high[1] - map.low[1]));
  window.addEventListener("themechange", redraw);
  return element("figure", {}, made, isTitled ? element("figcaption", {}, map.title || "a candidate") : null);
}
