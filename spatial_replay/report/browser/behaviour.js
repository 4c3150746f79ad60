// The behaviour tree of the robot: each node with its status at the cursor, and the failures.

const NODE_STATUSES = [
  {mark: "absent", words: "not ticked"},
  {mark: "pending", words: "running"},
  {mark: "satisfied", words: "success"},
  {mark: "violated", words: "failure"},
];

function nodeStatus(stretch, tick, node) {
  return NODE_STATUSES[Number(stretch.statuses[tick][node])] ?? NODE_STATUSES[0];
}

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
    if (shown !== now) nodes.replaceChildren(...isBefore ? [] : stretch.nodes.map((_, node) => nodeRow(stretch, tick, node)));
    now = shown;
    rows[newest]?.removeAttribute("aria-current");
    newest = markedEvent(failures.map(({time}) => time), clock.time, () => true);
    rows[newest]?.setAttribute("aria-current", "true");
  });
}

function nodeRow(stretch, tick, node) {
  const {name, type, depth} = stretch.nodes[node];
  const status = nodeStatus(stretch, tick, node);
  const made = element("li", {"data-status": status.words}, mark(status.mark), element("b", {}, name),
    element("span", {class: "quiet"}, ` ${[type, status.words].filter(Boolean).join(", ")}`));
  made.style.paddingLeft = `${depth}rem`;
  return made;
}

// The ticks in which a node begins to fail, as events.
function failuresOf(stretch) {
  return stretch.times.flatMap((time, tick) => stretch.nodes.flatMap(({name}, node) => {
    const fails = nodeStatus(stretch, tick, node).words === "failure";
    const failed = tick > 0 && nodeStatus(stretch, tick - 1, node).words === "failure";
    return fails && !failed ? [{time, status: "violated", parts: ["", name, " fails"]}] : [];
  }));
}
