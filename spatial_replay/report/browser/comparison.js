// Two runs, or one run under two specifications, with one time cursor, which shows the time of run A.

function makeComparison([a, b, pairs]) {
  document.documentElement.dataset.read = "true";
  const low = (axis) => Math.min(a.scene.low[axis], b.scene.low[axis]);
  const high = (axis) => Math.max(a.scene.high[axis], b.scene.high[axis]);
  a.frame = b.frame = {low: [low(0), low(1)], high: [high(0), high(1)]};
  const clock = new Clock(a), other = new Clock(b);
  // run B may go on after run A has ended
  clock.end = Math.max(clock.end, beside(pairs.knots, other.end, 1, 0));
  clock.start = Math.min(clock.start, beside(pairs.knots, other.start, 1, 0));
  clock.look(clock.start, clock.end);
  makeTransport(clock, a.events);
  makeScene(clock, "scene-a");
  makeScene(other, "scene-b");
  if (pairs.decision !== null) {
    const fromB = {
      run: other.run, pause: () => clock.pause(), seek: (time) => clock.seek(beside(pairs.knots, time, 1, 0)),
    };
    makeDecisionOf(clock, "decision-a", pairs.decision);
    makeDecisionOf(fromB, "decision-b", pairs.decision);
  }
  makeCurvesOfBoth(clock, other, pairs);
  clock.on("time", () => other.seek(beside(pairs.knots, clock.time, 0, 1)));
  for (const time of document.querySelectorAll(".change [data-time-ns]")) {
    const seconds = Number(time.dataset.timeNs) / 1e9;
    const own = time.dataset.run === "b" ? beside(pairs.knots, seconds, 1, 0) : seconds;
    time.replaceWith(element("button", {type: "button", class: "link", onclick: () => {
      clock.pause();
      clock.seek(own);
    }}, time.textContent));
  }
  linkAddress(clock, pairs.first ?? clock.end);
  document.documentElement.dataset.ready = "true";
}

// The decision of one run that differs from the other run's decision, with all its candidates and maps.
function makeDecisionOf(clock, name, number) {
  const decision = clock.run.decisions[number];
  if (!decision) {
    body(name).append(element("p", {}, "The run has no such decision."));
    return;
  }
  const card = makeDecision(clock, decision);
  for (const details of card.querySelectorAll("details")) details.open = true;
  body(name).append(element("ol", {class: "cards"}, card));
}

// The time in one run that corresponds to a time in the other run. Outside the knots, both times advance equally fast.
function beside(knots, time, from, to) {
  const last = knots.length - 1;
  if (time <= knots[0][from]) return time - knots[0][from] + knots[0][to];
  if (time >= knots[last][from]) return time - knots[last][from] + knots[last][to];
  let at = 0;
  while (knots[at + 1][from] < time) at += 1;
  const [one, two] = [knots[at], knots[at + 1]];
  return one[to] + (time - one[from]) / (two[from] - one[from]) * (two[to] - one[to]);
}

function makeCurvesOfBoth(clock, other, pairs) {
  const place = element("div", {class: "curves", role: "group", "aria-label": "Robustness over time, of both"});
  const line = element("div", {class: "cursor"});
  const legend = element("div", {class: "legend"});
  if (!pairs.nodes.length) {
    body("timeline").append(element("p", {}, "No specification was evaluated."));
    return;
  }
  const shown = {quantity: NOW, hidden: new Set()};
  let quantity = VALUE, chosen = 0, chart = null, curves = [];
  const chooser = quantityChooser((which) => { quantity = which; build(); });
  const which = element("select", {"aria-label": "Curves of", onchange: () => {
    chosen = Number(which.value);
    build();
  }}, ...pairs.nodes.map(({label}, index) => element("option", {value: index}, label)));
  body("timeline").append(element("div", {class: "chart-head"}, which, chooser, legend), place);

  const build = () => {
    chart?.destroy();
    const pair = pairs.nodes[chosen];
    clock.choose(pair.a[0]);
    other.choose(pair.b[0]);
    const results = [clock.run.results[pair.a[0]], other.run.results[pair.b[0]]];
    const nodes = [results[0].nodes[pair.a[1]], results[1].nodes[pair.b[1]]];
    const times = [results[0].times, Float64Array.from(results[1].times, (time) => beside(pairs.knots, time, 1, 0))];
    const both = Float64Array.from(new Set([...times[0], ...times[1]])).sort();
    curves = nodes.map((node, index) => ({
      node: {id: index, unit: node.unit},
      name: pairs.labels[index],
      colour: clock.run.palette.curves[index],
      reading: element("span", {class: "number"}),
      numbers: held(both, times[index], node.series[quantity]),
    }));
    legend.replaceChildren(...curves.map((curve) => legendEntry(curve, shown, build)));
    const result = {times: both, samples: both.length, nodes: [nodes[0]]};
    chart = new uPlot(options(clock, result, curves, shown, place.clientWidth), columns(result, curves), place);
    chart.both = both;
    chart.over.append(line);
    scrub(chart.over, clock);
    showCursor();
  };
  const showCursor = () => {
    if (!chart) return;
    const share = shareOf(clock, clock.time);
    line.hidden = share < 0 || share > 1;
    line.style.left = `${100 * share}%`;
    for (const curve of curves) {
      curve.reading.textContent = numberText(curve.numbers[indexAt(chart.both, clock.time)]);
    }
  };
  build();
  followClock(clock, place, () => chart, build, showCursor);
}

// Numbers at other times: each holds until the next one; NaN before the first and after the last.
function held(at, times, numbers) {
  const last = times[times.length - 1];
  return Float64Array.from(at, (time) => (
    !times.length || time < times[0] - 1e-9 || time > last + 1e-9 ? NaN : numbers[indexAt(times, time)]));
}

const pairs = JSON.parse(document.getElementById("pairs").textContent);
Promise.all([readRun("-a"), readRun("-b"), pairs]).then(makeComparison).catch(sayWhyNot);
