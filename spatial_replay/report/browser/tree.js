// The formula of the chosen result as a tree: every node with its numbers and its status at the cursor.

function makeTree(clock) {
  const place = body("tree");
  const title = element("p", {class: "which"});
  const head = element("div", {class: "row head", "aria-hidden": "true"},
    element("span", {class: "what"}, "node"));
  const list = element("ul", {class: "tree", "aria-label": "Nodes of the formula"});
  place.append(title, head, list);
  let rows = [], lanes = [];
  const redraw = () => lanes.forEach((lane) => lane.redraw());
  clock.on("view", redraw);
  window.addEventListener("themechange", redraw);
  clock.on("result", () => {
    const result = clock.run.results[clock.result];
    [rows, lanes] = [[], []];
    title.replaceChildren();
    if (!result) {
      list.replaceChildren(element("li", {}, "Nothing was evaluated."));
      return;
    }
    const unit = commonUnit(result.nodes);
    head.replaceChildren(head.firstChild,
      ...["so far", "between", "now"].map((words) => element("span", {class: "number"}, words + unit)));
    list.replaceChildren(branch(result.nodes[0], rows));
    lanes = rows.map((row) => {
      const lane = nodeLane(clock, result, row.node);
      row.parts[0].parentElement.append(lane.made);
      return lane;
    });
    fit(list);
    lightPath(list, rows, result);
  });
  window.addEventListener("resize", () => fit(list));
  clock.on("time", () => {
    const result = clock.run.results[clock.result];
    if (!result) return;
    const sample = placeIn(result, clock.sample);
    const isLast = sample !== null && sample >= result.samples - 1;
    title.textContent = `${result.title} at ${secondsText(clock.shownTime)}${isLast ? ", the last sample" : ""}`;
    for (const row of rows) showRow(row, clock.run, result, sample, isLast);
  });
}

// The unit that a log declares for the number of a node, or "".
function declaredUnit({unit, divisor}) {
  return divisor !== 1 || unit === "1" || unit === "mixed" || unit.startsWith("units of") ? "" : unit;
}

// The common unit of all nodes, for a heading; "" if there is none, or if it is too long.
function commonUnit(nodes) {
  const [unit, ...others] = new Set(nodes.map(declaredUnit));
  return unit && !others.length && unit.length <= 4 ? ` [${unit}]` : "";
}

// A list that would scroll by little is shown whole, so that a wheel over it moves the page.
function fit(list) {
  list.classList.remove("whole");
  const rest = list.scrollHeight - list.clientHeight;
  list.classList.toggle("whole", rest > 0 && rest < list.clientHeight / 4);
}

// Marks the way to the node that decided the verdict, and scrolls to it.
function lightPath(list, rows, {nodes, decided, fault, decided_text: decider}) {
  for (let place = decided; place !== null; place = nodes[place].parent) {
    const row = rows.find((each) => each.node.index === place);
    if (!row) continue;
    row.isOnPath = true;
    row.parts[0].parentElement.classList.add("decides");
  }
  const last = rows.find((row) => row.node.index === decided)?.parts[0];
  if (!last) return;
  // the deciding atom of a quantifier names the deciding objects
  if (decider) last.append(` decided${atFault(fault)} by `, element("code", {}, decider));
  const box = last.getBoundingClientRect(), frame = list.getBoundingClientRect();
  if (box.bottom > frame.bottom) list.scrollTop += box.bottom - frame.bottom + frame.height / 3;
  else if (box.top < frame.top) list.scrollTop += box.top - frame.top - frame.height / 3;
}

function atFault(fault) {
  return fault === null ? "" : ` at ${secondsText(fault)}`;
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
    interval: element("span", {class: "number quiet"}),
    now: element("span", {class: "number"}),
    status: null,
  };
  const what = element("span", {class: "what", title: node.text}, row.sign,
    node.name ? element("b", {}, node.name) : null, node.name ? " " : null,
    element("code", {}, node.head), row.words);
  row.parts = [what, row.soFar, row.interval, row.now];
  return row;
}

function showRow(row, run, result, place, isLast) {
  const {node} = row;
  // uncertainty left the node open, although its number alone seems to hold or to fail
  const isLeftOpen = result.left_open && row.isOnPath && place === indexAt(result.times, result.fault);
  const status = isLeftOpen ? "unknown" : statusOf(run, result, node, place);
  if (status !== row.status) {
    row.status = status;
    setMark(row.sign, status);
    row.words.textContent = ` ${STATUSES[status].words} `;
  }
  const isPresent = place !== null && place < result.samples;
  const isPending = status === "pending" || status === "unknown";
  showNumber(row.now, isPresent ? node.series[NOW][place] : NaN, !isPresent, isPending);
  const hasValue = node.initial && place !== null;
  const at = Math.min(place ?? 0, result.samples - 1);
  showNumber(row.soFar, hasValue ? node.series[VALUE][at] : NaN, !hasValue, isPending);
  const [lower, upper] = [node.series[LOWER][at], node.series[UPPER][at]];
  write(row.interval, hasValue && lower < upper ? `${numberText(lower)} … ${numberText(upper)}` : "");
  row.soFar.title = hasValue && isLast ? node.value : "";
}

// Shows a number. A pending number has the colour of unknown numbers, because its sign is not final.
function showNumber(made, number, isEmpty, isPending) {
  write(made, isEmpty ? "" : numberText(number));
  const sign = isPending || isEmpty || Number.isNaN(number) ? "unknown" : signOf(number);
  if (made.sign === sign) return;
  made.sign = sign;
  made.className = `number is-${sign}`;
}

// Writes only a text that has changed, because each change costs the browser a layout.
function write(made, text) {
  if (made.written === text) return;
  made.written = text;
  made.textContent = text;
}
