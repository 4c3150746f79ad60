// The behaviour tree of the robot: each node with its status at the cursor, and the failures.

const NODE_STATUSES = [
  {mark: "absent", words: "not ticked"},
  {mark: "pending", words: "running"},
  {mark: "satisfied", words: "success"},
  {mark: "violated", words: "failure"},
];

const FAILURE = "3";

function makeBehaviourTree(clock) {
  const place = body("ticks");
  if (!place) return;
  const stretches = clock.run.ticks;
  const starts = stretches.map(({times}) => times[0]);
  const nodes = element("ul", {class: "nodes", "aria-label": "Nodes of the behaviour tree"});
  const failures = stretches.flatMap(failuresOf);
  const rows = failures.map((failure) => eventRow(failure, () => {
    clock.pause();
    clock.seek(failure.time);
  }));
  const list = element("ol", {class: "list"}, ...rows.map((row) => element("li", {}, row)));
  place.append(nodes, rows.length ? list : element("p", {class: "quiet"}, "No node failed."));
  let now = "", newest = -1;
  clock.on("time", () => {
    const isBefore = clock.time + 1e-9 < starts[0];
    const stretch = stretches[indexAt(starts, clock.time)];
    const tick = indexAt(stretch.times, clock.time);
    const shown = isBefore ? "" : `${starts.indexOf(stretch.times[0])} ${tick}`;
    if (shown !== now) nodes.replaceChildren(...isBefore ? [] : stretch.nodes.map((node, place) => nodeRow(node, Number(stretch.statuses[tick][place]))));
    now = shown;
    rows[newest]?.removeAttribute("aria-current");
    newest = markedEvent(failures.map(({time}) => time), clock.time, () => true);
    rows[newest]?.setAttribute("aria-current", "true");
  });
}

function nodeRow({name, type, depth}, status) {
  const {mark: sign, words} = NODE_STATUSES[status] ?? NODE_STATUSES[0];
  const made = element("li", {"data-status": words}, mark(sign), element("b", {}, name),
    element("span", {class: "quiet"}, ` ${[type, words].filter(Boolean).join(", ")}`));
  made.style.paddingLeft = `${depth}rem`;
  return made;
}

// The ticks in which a node begins to fail, as events.
function failuresOf(stretch) {
  return stretch.times.flatMap((time, tick) => stretch.nodes.flatMap(({name}, node) => {
    const begins = stretch.statuses[tick][node] === FAILURE && stretch.statuses[tick - 1]?.[node] !== FAILURE;
    return begins ? [{time, status: "violated", parts: ["", name, " fails"]}] : [];
  }));
}
