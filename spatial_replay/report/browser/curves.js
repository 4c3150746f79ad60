// Robustness over time: the chosen result with the interval of its final value, and its named parts.

const CHART_HEIGHT = 250;
const AXIS_LABEL = 18;
const MOST_AXES = 3;
const LEAST_AXIS = 50;
// The width of a letter at a tick, in pixels.
const TICK_LETTER = 7;

function makeCurves(clock) {
  const place = element("div", {class: "curves", role: "group", "aria-label": "Robustness over time"});
  const line = element("div", {class: "cursor"});
  const legend = element("div", {class: "legend"});
  const chooser = quantityChooser((quantity) => { shown.quantity = quantity; build(); });
  body("timeline").append(element("div", {class: "chart-head"}, chooser, legend), place);
  const shown = {quantity: VALUE, hidden: new Set()};
  let chart = null, curves = [];

  const build = () => {
    chart?.destroy();
    chart = null;
    const result = clock.run.results[clock.result];
    curves = result ? curvesOf(clock.run, result, shown.quantity) : [];
    legend.replaceChildren(...curves.map((curve) => legendEntry(curve, shown, build)));
    if (!curves.length || !result.samples) return;
    if (shown.quantity === VALUE && clock.run.settles) {
      legend.append(element("span", {class: "legend-entry"}, element("span", {class: "swatch band"}),
        element("span", {}, `what ${result.title} may still become`)));
    }
    chart = new uPlot(options(clock, result, curves, shown, place.clientWidth), columns(result, curves), place);
    chart.over.append(line);
    scrub(chart.over, clock);
    showCursor();
  };
  const showCursor = () => {
    if (!chart) return;
    const result = clock.run.results[clock.result];
    const at = placeIn(result, clock.sample);
    const share = shareOf(clock, clock.time);
    line.hidden = share < 0 || share > 1;
    line.style.left = `${100 * share}%`;
    for (const curve of curves) {
      curve.reading.textContent = at === null ? "" : numberText(curve.numbers[Math.min(at, result.samples - 1)]);
    }
  };
  clock.on("result", build);
  followClock(clock, place, () => chart, build, showCursor);
}

// Keeps the chart that `current` returns at the view and the time of the clock, and as wide as its place.
function followClock(clock, place, current, build, showCursor) {
  clock.on("view", () => current()?.setScale("x", {min: clock.view[0], max: clock.view[1]}));
  clock.on("view", showCursor);
  clock.on("time", showCursor);
  window.addEventListener("themechange", build);
  new ResizeObserver(() => {
    if (current() && current().width !== place.clientWidth) build();
  }).observe(place);
}

function quantityChooser(choose) {
  const choice = (label, quantity, title, checked) => element("label", {title}, element("input", {
    type: "radio", name: "quantity", checked, onchange: () => choose(quantity),
  }), label);
  return element("fieldset", {class: "choice"}, element("legend", {class: "hidden"}, "Curves of"),
    choice("so far", VALUE, "the robustness of the samples so far", true),
    choice("now", NOW, "the robustness at the sample itself", false));
}

// The drawn curves: the root, the named parts, and the part that decided. The quantity `VALUE` needs parts that are
// evaluated at the first sample.
function curvesOf(run, result, quantity) {
  const named = result.nodes.filter(
    (node) => node.parent === null || (node.name && (quantity === NOW || node.initial)));
  const {curves: colours} = run.palette;
  const found = named.slice(0, colours.length + 1).map((node, index) => ({
    node,
    numbers: node.series[quantity],
    name: node.parent === null ? result.title : node.name,
    colour: index === 0 ? null : colours[index - 1],
    reading: element("span", {class: "number"}),
  }));
  const decided = result.nodes[result.decided];
  if (decided && !named.includes(decided)) {
    // an atom counts at each sample, so its curve has the numbers of the samples themselves
    found.push({node: decided, numbers: decided.series[NOW], name: shortened(decided.text, 40),
      decider: result.decided_text, isOpen: Boolean(result.left_open), at: atFault(result.fault), colour: colour("ink"), isDashed: true, reading: element("span", {class: "number"})});
  }
  return found;
}

function shortened(text, longest) {
  return text.length > longest ? `${text.slice(0, longest - 1)}…` : text;
}

function legendEntry(curve, shown, build) {
  const key = curve.node.id;
  const swatch = element("span", {class: `swatch ${curve.colour ? "" : "root"}`});
  if (curve.isDashed) swatch.classList.add("dashed");
  else if (curve.colour) swatch.style.background = curve.colour;
  return element("button", {
    type: "button", class: "legend-entry", "aria-pressed": String(!shown.hidden.has(key)),
    onclick: () => {
      if (!shown.hidden.delete(key)) shown.hidden.add(key);
      build();
    },
  }, swatch, element("span", {}, curve.isDashed ? element("code", {}, curve.name) : curve.name,
    curve.isDashed ? " now, " : null, curve.decider ? element("code", {}, curve.decider) : null,
    curve.isDashed ? curve.decider ? ` of it ${curve.isOpen ? "was uncertain" : "decided"}${curve.at}` : curve.isOpen ? "which is uncertain" : "which decided" : null), curve.reading);
}

function columns(result, curves) {
  const drawable = (numbers) => Array.from(numbers, (number) => Number.isFinite(number) ? number : null);
  return [Array.from(result.times), ...curves.map((curve) => drawable(curve.numbers))];
}

function options(clock, result, curves, shown, width) {
  const ink = colour("quiet"), grid = colour("grid");
  const axis = {stroke: ink, grid: {stroke: grid, width: 1}, ticks: {stroke: grid, width: 1, size: 4}, font: FONT,
    labelFont: FONT};
  const root = result.nodes[0];
  const scales = scalesOf(curves, root, shown.hidden);
  // a narrow screen has room for the axis of the root only
  const drawn = gutter() / scales.length < LEAST_AXIS ? scales.slice(0, 1) : scales;
  const axisSize = gutter() / drawn.length - AXIS_LABEL;
  return {
    width, height: CHART_HEIGHT, padding: [8, 0, 0, 0],
    cursor: {show: false}, legend: {show: false},
    scales: {
      x: {time: false, min: clock.view[0], max: clock.view[1]},
      ...Object.fromEntries(scales.map(({key, range}) => [key, {range: () => range}])),
    },
    axes: [
      {...axis, size: 30, values: (chart, ticks) => ticks.map((tick) => timeTick(chart, tick))},
      ...drawn.map(({key, unit}) => ({...axis, scale: key, side: 3, size: axisSize, label: unitText(unit),
        labelSize: AXIS_LABEL, grid: {...axis.grid, show: key === "y"}, values: (_, ticks) => ticks.map(numberText)})),
    ],
    series: [{}, ...curves.map((curve) => ({
      scale: scales.find(({curves}) => curves.includes(curve)).key, label: curve.name, show: !shown.hidden.has(curve.node.id), points: {show: result.samples === 1, size: 8},
      width: curve.colour ? 1.5 : 2.5, dash: curve.isDashed ? [6, 4] : undefined, stroke: curve.colour ?? ((chart) => signGradient(chart)),
    }))],
    hooks: {
      drawClear: [(chart) => {
        shadeSigns(chart);
        if (shown.quantity === VALUE && clock.run.settles) drawBand(chart, result, root);
      }],
    },
  };
}

// The words at a tick; none where the edge of the chart would cut them.
function timeTick(chart, tick) {
  const words = `${Number(tick.toFixed(6))} s`;
  const room = (chart.scales.x.max - tick) / (chart.scales.x.max - chart.scales.x.min) * 0.8 * chart.width;
  return room < TICK_LETTER * words.length / 2 ? null : words;
}

function unitText(unit) {
  if (unit === "") return "robustness in footprint units";
  if (unit === "1") return "robustness, no unit";
  return unit === "mixed" ? "robustness, several units" : `robustness in ${unit}`;
}

// A scale for each unit, the root's unit first. All scales have zero at one height, because verdicts change there.
function scalesOf(curves, root, hidden) {
  const units = [...new Set([root.unit, ...curves.map((curve) => curve.node.unit ?? root.unit)])];
  const last = Math.min(units.length, MOST_AXES) - 1;
  const scales = units.slice(0, last + 1).map((unit, index) => ({
    key: index ? `y${index}` : "y",
    unit: index === last && units.length > MOST_AXES ? "mixed" : unit,
    curves: curves.filter((curve) => Math.min(units.indexOf(curve.node.unit ?? root.unit), last) === index),
  }));
  for (const scale of scales) {
    scale.ends = endsOf(scale.curves.filter((curve) => !hidden.has(curve.node.id)));
    scale.greatest = Math.max(-scale.ends[0], scale.ends[1]) || 1;
  }
  const [low, high] = [0, 1].map((end) => Math.max(...scales.map(({ends, greatest}) => Math.abs(ends[end]) / greatest)));
  const air = 0.08 * (low + high) || 1;
  for (const scale of scales) scale.range = [-(low + air) * scale.greatest, (high + air) * scale.greatest];
  return scales;
}

// The least and the greatest finite number of curves; zero counts as one of their numbers.
function endsOf(curves) {
  let low = 0, high = 0;
  for (const {numbers} of curves) {
    for (const number of numbers) {
      if (number < low && number > -Infinity) low = number;
      else if (number > high && number < Infinity) high = number;
    }
  }
  return [low, high];
}

function zeroOf(chart) {
  const {top, height} = chart.bbox;
  return Math.min(Math.max(chart.valToPos(0, "y", true), top), top + height);
}

function shadeSigns(chart) {
  const {left, top, width, height} = chart.bbox, zero = zeroOf(chart), context = chart.ctx;
  context.save();
  context.globalAlpha = 0.06;
  context.fillStyle = colour("positive");
  context.fillRect(left, top, width, zero - top);
  context.fillStyle = colour("negative");
  context.fillRect(left, zero, width, top + height - zero);
  context.globalAlpha = 1;
  context.fillStyle = colour("quiet");
  context.fillRect(left, zero - 0.5, width, 1);
  context.restore();
}

// The colours of the root's curve: blue above zero, vermillion below.
function signGradient(chart) {
  const {top, height} = chart.bbox;
  const share = Math.min(Math.max((zeroOf(chart) - top) / (height || 1), 0), 1);
  const gradient = chart.ctx.createLinearGradient(0, top, 0, top + height);
  gradient.addColorStop(share, colour("positive-line"));
  gradient.addColorStop(share, colour("negative-line"));
  return gradient;
}

// Draws the interval of the final value, by columns of pixels.
function drawBand(chart, result, node) {
  const {left, top, width, height} = chart.bbox, context = chart.ctx, {times} = result;
  const lower = node.series[LOWER], upper = node.series[UPPER];
  const {min, max} = chart.scales.x;
  const row = (number) => Math.min(Math.max(chart.valToPos(number, "y", true), top), top + height);
  context.save();
  context.fillStyle = colour("band");
  let place = indexAt(times, min);
  for (let x = 0; x < width; x++) {
    const until = min + (max - min) * (x + 1) / width;
    let low = lower[place], high = upper[place];
    while (place + 1 < times.length && times[place + 1] <= until) {
      place += 1;
      low = Math.min(low, lower[place]);
      high = Math.max(high, upper[place]);
    }
    if (until < times[0] || min + (max - min) * x / width > times[times.length - 1]) continue;
    const from = high === Infinity ? top : row(high), to = low === -Infinity ? top + height : row(low);
    context.fillRect(left + x, from, 1, to - from);
  }
  context.restore();
}
