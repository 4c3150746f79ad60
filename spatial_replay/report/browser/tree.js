// The tree of the chosen result's formula: every node with its numbers, and how it stands at the cursor.

function makeTree(clock) {
  const place = body("tree");
  const title = element("p", {class: "which"});
  const head = element("div", {class: "row head", "aria-hidden": "true"},
    element("span", {class: "what"}, "node"), element("span", {class: "number"}, "so far"),
    element("span", {class: "number"}, "now"));
  const list = element("ul", {class: "tree", "aria-label": "Nodes of the formula"});
  place.append(title, head, list);
  let rows = [];
  clock.on("result", () => {
    const result = clock.run.results[clock.result];
    rows = [];
    title.replaceChildren();
    if (!result) {
      list.replaceChildren(element("li", {}, "Nothing was evaluated."));
      return;
    }
    list.replaceChildren(branch(result.nodes[0], rows));
  });
  clock.on("time", () => {
    const result = clock.run.results[clock.result];
    if (!result) return;
    const sample = placeIn(result, clock.sample);
    const isLast = sample !== null && sample >= result.samples - 1;
    title.textContent = `${result.title} at ${secondsText(clock.time)}${isLast ? ", when all is seen" : ""}`;
    for (const row of rows) showRow(row, clock.run, result, sample, isLast);
  });
}

function branch(node, rows) {
  const row = makeRow(node);
  rows.push(row);
  if (!node.children.length) return element("li", {}, element("div", {class: "row leaf"}, ...row.parts));
  const children = element("ul", {}, ...node.children.map((child) => branch(child, rows)));
  return element("li", {}, element("details", {open: true},
    element("summary", {class: "row"}, ...row.parts), children));
}

function makeRow(node) {
  const row = {
    node,
    sign: mark("unknown"),
    words: element("span", {class: "hidden"}),
    soFar: element("span", {class: "number"}),
    now: element("span", {class: "number"}),
    standing: null,
  };
  const what = element("span", {class: "what", title: node.text}, row.sign,
    node.name ? element("b", {}, node.name) : null, node.name ? " " : null,
    element("code", {}, node.head), row.words);
  row.parts = [what, row.soFar, row.now];
  return row;
}

function showRow(row, run, result, place, isLast) {
  const {node} = row;
  const standing = standingOf(run, result, node, place);
  if (standing !== row.standing) {
    row.standing = standing;
    setMark(row.sign, standing);
    row.words.textContent = ` ${STANDINGS[standing].words} `;
  }
  const isSeen = place !== null && place < result.samples;
  showNumber(row.now, isSeen ? node.series[NOW][place] : NaN, !isSeen);
  const hasValue = node.asked && place !== null;
  const at = Math.min(place ?? 0, result.samples - 1);
  showNumber(row.soFar, hasValue ? node.series[VALUE][at] : NaN, !hasValue);
  if (hasValue && isLast) row.soFar.title = node.value;
  else row.soFar.title = hasValue && run.settles ? intervalText(node.series[LOWER][at], node.series[UPPER][at]) : "";
}

function intervalText(lower, upper) {
  return `between ${numberText(lower)} and ${numberText(upper)}, whatever comes`;
}

function showNumber(made, number, isEmpty) {
  made.textContent = isEmpty ? "" : numberText(number);
  const sign = isEmpty || Number.isNaN(number) ? "unknown" : signOf(number);
  made.className = `number is-${sign}`;
}
