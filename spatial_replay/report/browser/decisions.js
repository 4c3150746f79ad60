// The decisions of a planner: candidates with their gradient maps, the choice, and its outcome.

const MOST_REJECTIONS = 3;

function makeDecisions(clock) {
  const place = body("decisions");
  if (!place) return;
  const cards = clock.run.decisions.map((decision) => makeDecision(clock, decision));
  const mapped = clock.run.decisions.find((decision) => decision.maps.length);
  if (mapped) place.append(mapKey(clock.run, mapped));
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

function mapKey(run, {time, margin}) {
  const kinds = run.outlinesAt(time).map(({kind}) => kind);
  const made = key([{ground: "map", words: "fails, 0, holds"},
    ...(margin === null ? [] : [{ground: "contour", words: `at least ${numberText(margin)}${spaced(run.lengths)}, as a target needs`}]),
    {ground: "hatched", words: "blocked"},
    ...(kinds.includes("obstacle") ? [{ground: "obstacle", words: "obstacle"}] : []),
    ...(kinds.includes("region") ? [{ground: "region", words: "region"}] : []),
    {ground: "moved", words: "way and target"}]);
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
  // the edge that is aimed at comes first
  const tried = decision.edges.map((edge, number) => makeEdge(clock, decision, edge, number)).reverse();
  const unnamed = decision.maps.filter((map) => map.edge === null);
  const meant = chosenMap(decision);
  const later = decision.edges.flatMap((edge) => (edge.aim ? edge.later : []));
  const heading = element("div", {}, title, element("p", {}, reasonWords(decision)),
    ...decision.edges.filter(({aim}) => aim).flatMap((edge) => [demandsOf(edge), rejectionsOf(edge)]),
    later.length ? element("p", {}, `Planned next: ${minusWords(later.join(", then "))}.`) : null,
    decision.outcome ? element("p", {}, outcomeWords(decision.outcome)) : null);
  return element("li", {class: "card", "data-decision": decision.number},
    heading, meant ? makeMap(clock, meant, decision, false) : null, makeRedone(clock, decision.redone),
    tried.length ? element("details", {}, element("summary", {}, summaryOf(decision)), ...tried,
      element("div", {class: "candidates"}, ...unnamed.map((map) => makeMap(clock, map, decision, false)))) : null);
}

// The decision of `plan --redo` if it differs, with its map beside the recorded map.
function makeRedone(clock, decision) {
  if (!decision) return null;
  const meant = chosenMap(decision);
  return element("section", {class: "redone"}, element("p", {}, element("b", {}, "Redone"), `: ${inShort(decision)}`),
    element("p", {}, reasonWords(decision)), meant ? makeMap(clock, meant, decision, false) : null);
}

// The reason of a decision, with the states that an edge of the automaton joins.
function reasonWords({reason}) {
  return minusWords(sentence(reason)).replace(/for the edge (\d+) -> (\d+)/, "to bring the automaton from state $1 to state $2");
}

// The map on which the target of a decision was found, if the page has the map.
function chosenMap({maps: drawn}) {
  return drawn.find((map) => map.chosen) ?? null;
}

function summaryOf({edges, maps: drawn}) {
  const count = (number, noun) => `${number} ${noun}${number === 1 ? "" : "s"}`;
  const candidates = edges.reduce((sum, edge) => sum + edge.candidates.length, 0);
  const parts = [count(edges.length, "edge") + " of the automaton", count(candidates, "candidate"), count(drawn.length, "map")];
  return `Looked into ${parts.join(", ")}`;
}

function inShort({kind, target}) {
  if (kind === "execute" && target) return `move ${target.object} to ${minusWords(target.words)}`;
  return {hold: "nothing to do", wait: "wait", "no path": "no way is left"}[kind] ?? kind;
}

function outcomeWords(outcome) {
  const how = outcome.succeeded ? "Done" : "Failed";
  return `${how} at ${secondsText(outcome.time)}, in state ${outcome.states.join(", ")}: ${minusWords(sentence(outcome.reason))}`;
}

function sentence(text) {
  return text && !/[.!?…]$/.test(text) ? `${text}.` : text;
}

// The relations that an edge wants, and the rules for the way.
function demandsOf({wanted, rules}) {
  const row = (head, sentences) => (sentences.length ? element("p", {class: "demands"}, element("b", {}, head), ...sentences.flatMap(
    (words, index) => [index ? "; " : " ", ...withCode(words)])) : null);
  return element("div", {}, row(wanted.length > 1 ? "Wanted, one of" : "Wanted", wanted), row("On the way", rules));
}

// The rejected objects of an edge, with the reasons.
function rejectionsOf({candidates}) {
  const texts = candidates.filter(({status}) => status === "rejected").map(({object, rejected}) => `${object} (${minusWords(rejected)})`);
  const more = texts.length > MOST_REJECTIONS ? ` and ${texts.length - MOST_REJECTIONS} more` : "";
  return texts.length ? element("p", {}, element("b", {}, "Cannot do it"), ` ${texts.slice(0, MOST_REJECTIONS).join(", ")}${more}`) : null;
}

function makeEdge(clock, decision, edge, number) {
  const mapsOf = (place) => decision.maps.filter((map) => map.edge === number && map.candidate === place);
  return element("section", {class: "edge"},
    element("h3", {title: "An edge joins two states of the automaton."},
      `${edge.aim ? "Aimed at" : "Looked into"} the edge ${edge.path.slice(0, 2).join(" → ")}`,
      element("span", {class: "quiet"}, ` on the path of states ${edge.path.join(" → ")}`)),
    demandsOf(edge),
    element("div", {class: "candidates"},
      ...edge.candidates.map((candidate, place) => [candidate, place])
        .sort(([one], [other]) => RANKS[one.status] - RANKS[other.status])
        .map(([candidate, place]) => makeCandidate(clock, decision, candidate, mapsOf(place), edge.once))),
    edge.pruned ? element("p", {class: "pruned"}, `Given up: ${minusWords(sentence(edge.pruned))}`) : null);
}

const RANKS = {chosen: 0, possible: 1, rejected: 2};

function makeCandidate(clock, decision, candidate, maps, once) {
  const {object, target, rejected, best} = candidate;
  const status = {chosen: "satisfied", possible: "holding", rejected: "violated"}[candidate.status];
  const more = best > target?.robustness ? `; at best ${numberText(best)}` : "";
  const why = minusWords(rejected) || `to ${minusWords(target.words)}, robustness ${numberText(target.robustness ?? NaN)}${candidate.status === "chosen" ? once : ""}${more}`;
  // the map of a decision's target stands beside its heading
  const drawn = maps.filter((map) => !map.chosen);
  return element("div", {class: "candidate"}, element("p", {}, mark(status), element("b", {}, object), ` ${candidate.status}: ${sentence(why)}`),
    makeBars(candidate), candidate.room ? element("p", {class: "quiet"}, candidate.room) : null,
    ...drawn.map((map) => makeMap(clock, map, decision, maps.length > 1)));
}

// How many cells each demand limits, and how many each cause blocks.
function makeBars({bars, cells}) {
  if (!bars.length) return null;
  const most = Math.max(...bars.map((bar) => bar.cells));
  return element("table", {class: "bars"}, element("tbody", {}, ...bars.map(({kind, words, cells: count}) => {
    const block = element("i", {class: `block ${kind === "blocked" ? "hatched" : "neutral"}`});
    block.style.width = `${Math.max(100 * count / most, 1)}%`;
    return element("tr", {title: `${count} of ${cells} cells`},
      element("th", {scope: "row"}, `${kind}: `, ...withCode(words)), element("td", {}, block),
      element("td", {class: "number"}, shareText(count / cells)));
  })));
}

function shareText(share) {
  return share < 0.005 ? "< 1 %" : `${Math.round(100 * share)} %`;
}
