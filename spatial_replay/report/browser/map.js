// A gradient map: its cells with the objects, the way and the target, axes and a scale with numbers, and a table
// of the selected cell.

// The colours of a map, as in palette.py, and the opacity of a map under the scene.
const MAP = ["#d55e00", "#f5f5f5", "#0072b2"], OPACITY = 0.6;
const MAP_COLOURS = MAP.map(rgb);
// Colours of drawings, ground and hatches on maps. They are fixed, because cells have the same colours in dark pages.
const MAP_INK = "#24292f", MAP_GROUND = "#e4e4e4", MAP_HATCH = "#9a9a9a";
const OBSTACLE_GREY = "rgb(110 110 110 / 0.6)", REGION_DASH = [6, 4];
// Space for the axes, and for the scale and its numbers, pixels.
const FRAME = {left: 42, right: 72, top: 8, bottom: 22};
const SCALE_WIDTH = 10;
const NARROWEST = 300;

// The figure of a map: the objects are drawn as they were at the decision.
function makeMap(clock, map, decision, isTitled) {
  const {run} = clock;
  let layer = map, cell = null;
  const {made, redraw} = canvas(`Gradient map of ${map.title || "a candidate"}. Arrow keys ask a cell.`,
    (context, width, height) => drawFigure(context, run, {map, layer, cell, decision}, width, height));
  const inner = NARROWEST - FRAME.left - FRAME.right;
  const slope = (map.high[1] - map.low[1]) / (map.high[0] - map.low[0]);
  made.style.aspectRatio = `${NARROWEST} / ${Math.min(Math.max(inner * slope, 60), 600) + FRAME.top + FRAME.bottom}`;
  made.className = "gradient-map";
  made.tabIndex = 0;
  made.setAttribute("role", "application");
  window.addEventListener("themechange", redraw);
  const answer = element("div", {class: "answer", "aria-live": "polite"},
    element("p", {class: "quiet"}, "Press a cell: each demand there, and what blocks it."));
  const ask = (asked) => {
    cell = asked;
    answer.replaceChildren(...answerOf(run, map, decision, asked));
    redraw();
  };
  made.addEventListener("pointerdown", (event) => {
    const asked = cellUnder(map, event, made);
    if (asked) ask(asked);
  });
  made.addEventListener("keydown", (event) => {
    const step = {ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowDown: [-1, 0], ArrowUp: [1, 0]}[event.key];
    if (!step) return;
    event.preventDefault();
    // elsewhere on the page, arrow keys move the time
    event.stopPropagation();
    ask(steppedCell(map, cell, step));
  });
  const layers = map.layers?.length ? layerChoice(run, map, (chosen) => { layer = chosen; redraw(); }) : null;
  const why = map.chosen ? whyThere(run, map, decision) : null;
  return element("figure", {}, made, layers, why, isTitled ? element("figcaption", {}, map.title || "a candidate") : null,
    answer);
}

// Why the target of the chosen map is where it is: the cells that will do, and the rule that chooses among them.
function whyThere(run, map, {margin}) {
  if (!map.target?.at || margin === null) return null;
  const values = run.numbers(map.values), [row, column] = cellAt(map, map.target.at);
  const [inCell, target] = [values[row * map.columns + column], map.target.robustness];
  // a refined target may be better than the middle of its cell
  const best = Math.max(inCell, target);
  // blocked cells near failed motions have a value, too
  const blocked = map.blocked && run.numbers(map.blocked);
  let enough = 0, higher = 0;
  values.forEach((value, place) => {
    if (blocked?.[place]) return;
    enough += value >= margin;
    higher += value > best;
  });
  const between = numberText(inCell) === numberText(target) ? ""
    : ` The target lies between cells and has ${numberText(target)}; demands are those in the middle of its cell, which has ${numberText(inCell)}.`;
  return element("p", {class: "why"},
    `Why there? ${countText(enough)} of ${countText(values.length)} cells will do, ${higher ? countText(higher) : "none"} `
    + `with a higher robustness than the target.${map.rule ? ` ${map.rule[0].toUpperCase()}${minusWords(map.rule.slice(1))}.` : ""}${between}`);
}

function countText(count) {
  return count.toLocaleString("en");
}

function rowsOf(map) {
  return map.values.length / map.columns;
}

// The row and the column at a pointer; null outside the map.
function cellUnder(map, event, made) {
  const box = made.getBoundingClientRect();
  const at = figureProjection(map, box.width, box.height);
  const rows = rowsOf(map);
  const share = [(event.clientX - box.left - at.x(map.low[0])) / (at.x(map.high[0]) - at.x(map.low[0])),
    (event.clientY - box.top - at.y(map.low[1])) / (at.y(map.high[1]) - at.y(map.low[1]))];
  const [column, row] = [Math.floor(share[0] * map.columns), Math.floor(share[1] * rows)];
  return row < 0 || row >= rows || column < 0 || column >= map.columns ? null : [row, column];
}

// The cell one step further. The first selected cell is the target's cell, or the cell in the middle.
function steppedCell(map, cell, [up, right]) {
  const rows = rowsOf(map);
  if (!cell) {
    return map.target?.at ? cellAt(map, map.target.at) : [Math.floor(rows / 2), Math.floor(map.columns / 2)];
  }
  const inside = (number, count) => Math.min(Math.max(number, 0), count - 1);
  return [inside(cell[0] + up, rows), inside(cell[1] + right, map.columns)];
}

function cellAt(map, [x, y]) {
  const rows = rowsOf(map);
  const place = (number, axis, count) => Math.min(Math.max(
    Math.floor((number - map.low[axis]) / (map.high[axis] - map.low[axis]) * count), 0), count - 1);
  return [place(y, 1, rows), place(x, 0, map.columns)];
}

function centreOf(map, [row, column]) {
  return [map.low[0] + (column + 0.5) / map.columns * (map.high[0] - map.low[0]),
    map.low[1] + (row + 0.5) / rowsOf(map) * (map.high[1] - map.low[1])];
}

// The robustness of each demand in a cell and at the target, with words for what blocks or limits the cell.
function answerOf(run, map, decision, cell) {
  const place = cell[0] * map.columns + cell[1];
  const number = (values) => (values ? run.numbers(values)[place] : 0);
  const aim = map.target?.at ? cellAt(map, map.target.at) : null;
  const limits = (at) => (map.limited && at ? run.numbers(map.limited)[at[0] * map.columns + at[1]] : 0);
  const facts = {place, value: number(map.values), cause: number(map.blocked), limit: limits(cell),
    limitAtTarget: limits(aim), isAim: Boolean(aim) && aim.every((part, axis) => part === cell[axis]), centre: centreOf(map, cell),
    target: map.target ? map.target.robustness : null};
  const rows = demandRows(run, map, facts);
  const unit = run.lengths ? ` [${run.lengths}]` : "";
  const heads = ["demand", `at (${centreOf(map, cell).map(numberText).join(", ")})${unit}`,
    ...(map.target ? [`at the target${unit}`] : [])];
  const words = element("p", {}, ...cellWords(run, map, decision, facts));
  // limiting demands come first, so that they are visible without scrolling
  rows.sort((one, other) => rankOf(one) - rankOf(other));
  if (!rows.length) return [words];
  return [words, element("table", {}, element("thead", {}, element("tr", {},
    ...heads.map((head) => element("th", {scope: "col"}, head)))), element("tbody", {}, ...rows))];
}

// The rank of a row: limiting demands come first, then the row of all demands.
function rankOf(row) {
  return row.classList.contains("limits") ? 0 : row.classList.contains("all") ? 1 : 2;
}

// A row for each demand that depends on the cell, or limits the cell or the target. A free cell also has a row for all
// demands.
function demandRows(run, map, {place, value, cause, limit, limitAtTarget, target}) {
  const rows = [];
  const add = (title, limits, numbers) => rows.push(element("tr", {class: limits ? "limits" : null},
    element("th", {scope: "row"}, ...title, limits ? ` ${limits}` : null),
    ...numbers.slice(0, map.target ? 2 : 1).map((number) => element("td", {class: number < 0 ? "number fails" : "number"},
      number === null ? "–" : numberText(number)))));
  (map.limits ?? []).forEach((words, index) => {
    const here = layerValue(run, map, index + 1, place);
    // in a blocked cell, only a demand that fails matters
    const [isLimit, isLimitAtTarget] = [limit === index + 1 && !(cause && !(here < 0)), limitAtTarget === index + 1];
    if (here === undefined && !isLimit && !isLimitAtTarget) return;
    const atTarget = map.at_target?.[index] ?? null;
    const limits = isLimit && isLimitAtTarget ? "limits here and at the target" : isLimit ? "limits"
      : isLimitAtTarget ? "limits at the target" : null;
    // a demand without a layer has the same robustness in all cells
    add(withCode(words), limits, [here ?? (isLimit ? value : atTarget), atTarget]);
  });
  if (!cause) {
    add(["all that has to hold"], null, [value, target]);
    rows.at(-1).classList.add("all");
  }
  const rest = (map.limits?.length ?? 0) - rows.filter((row) => row.querySelector("code")).length;
  if (rest > 0 && map.layers?.length) {
    rows.push(element("tr", {}, element("td", {class: "quiet", colspan: map.target ? 3 : 2},
      `${rest} more do${rest === 1 ? "es" : ""} not depend on where ${map.object} is.`)));
  }
  return rows;
}

function cellWords(run, map, decision, facts) {
  const {place, value, cause, limit, target, isAim} = facts;
  if (cause) return ["Blocked: ", ...withCode(map.blocks[cause - 1] ?? ["something else"]), ".", ...alsoFailing(run, map, facts)];
  if (Number.isNaN(value)) return ["Blocked, or not known."];
  const demand = withCode(map.limits?.[limit - 1] ?? ["what has to hold"]);
  const {margin} = decision;
  if (value < 0) return [...demand, `: short by ${numberText(-value)}${spaced(run.lengths)}.`];
  const by = `: met by ${numberText(value)}${spaced(run.lengths)}`;
  if (margin && value < margin) return [...demand, `${by}, less than the ${numberText(margin)} needed.`];
  if (target === null) return [...demand, `${by}.`];
  const [here, there] = [value, target].map((number) => `${numberText(number)}${spaced(run.lengths)}`);
  const would = isAim ? "The target is in this cell." : map.chosen ? `It would do, too. ${whyNotHere(run, map, facts)}` : "";
  return [...demand, `${by}, and limits this cell. All that has to hold: ${here} in this cell, ${there} at the target. ${would}`];
}

// The demand that fails in a blocked cell, if one does.
function alsoFailing(run, map, {place, limit}) {
  const value = layerValue(run, map, limit, place);
  return value < 0 ? [" ", ...withCode(map.limits[limit - 1]), ` fails there, too: short by ${numberText(-value)}${spaced(run.lengths)}.`] : [];
}

// The robustness of a demand in a cell; undefined if it is the same in all cells.
function layerValue(run, map, number, place) {
  const layer = map.layers?.find((other) => other.number === number);
  return layer && run.numbers(layer.values)[place];
}

// Why the target is not in a cell that would do, by the rule that chose the target.
function whyNotHere(run, map, {place, value, target, centre}) {
  const length = (number) => `${numberText(number)}${spaced(run.lengths)}`;
  if (map.joint) return `That counts the other objects at their planned places; ${minusWords(map.rule)}.`;
  if (map.way) {
    const way = run.numbers(map.way)[place];
    if (Number.isNaN(way)) return "No free way over cells leads there.";
    const [row, column] = cellAt(map, map.target.at), targetWay = run.numbers(map.way)[row * map.columns + column] || 0;
    if (way > Math.max(map.least_way, targetWay) * (1 + 1e-6)) {
      return `The way there over cells is ${length(way)}, and the shortest to a place that will do is ${length(map.least_way)}.`;
    }
    return `The shortest way over cells to a place that will do is ${length(map.least_way)}. The target is a more robust place near its end.`;
  }
  const room = map.room && run.numbers(map.room)[place];
  if (room !== undefined && room < map.least_room) {
    return `The room around it is ${length(Math.max(room, 0))}, and the target has at least ${length(map.least_room)}.`;
  }
  const away = ([x, y]) => Math.hypot(x - map.target.way[0], y - map.target.way[1]);
  const isEqual = Math.abs(value - target) <= 1e-6 * Math.abs(target) && map.target.way.length && away(centre) >= away(map.target.at);
  return isEqual ? `It is as robust as the target, which is nearer: ${length(away(map.target.at))} instead of ${length(away(centre))}.`
    : "The target is more robust.";
}

function spaced(unit) {
  return unit ? ` ${unit}` : "";
}

// A choice between the whole map and the layer of each relation.
function layerChoice(run, map, show) {
  const layers = map.layers.map((layer) => {
    const scale = run.numbers(layer.values).reduce((most, number) => Math.max(most, Math.abs(number) || 0), 0);
    return {...map, values: layer.values, scale, picture: undefined};
  });
  const options = ["all that has to hold", ...map.layers.map((layer) => layer.title)];
  const choose = () => {
    // a long relation does not fit, so the tooltip shows the whole text
    choice.title = options[choice.selectedIndex];
    show([map, ...layers][choice.selectedIndex]);
  };
  const choice = element("select", {"aria-label": "Layer of the map", title: options[0], onchange: choose},
    ...options.map((title) => element("option", {}, title)));
  return choice;
}

// Where a map lies within its figure.
function figureProjection(map, width, height) {
  const inner = projection(map.low, map.high, width - FRAME.left - FRAME.right, height - FRAME.top - FRAME.bottom, 0);
  return {scale: inner.scale, x: (x) => FRAME.left + inner.x(x), y: (y) => FRAME.top + inner.y(y)};
}

function drawFigure(context, run, {map, layer, cell, decision}, width, height) {
  const at = figureProjection(map, width, height);
  const [left, top, right, bottom] = [at.x(map.low[0]), at.y(map.high[1]), at.x(map.high[0]), at.y(map.low[1])];
  context.fillStyle = MAP_GROUND;
  context.fillRect(left, top, right - left, bottom - top);
  hatch(context, left, top, right - left, bottom - top, MAP_HATCH);
  context.imageSmoothingEnabled = false;
  context.drawImage(pictureOf(run, layer), left, top, right - left, bottom - top);
  context.save();
  context.beginPath();
  context.rect(left, top, right - left, bottom - top);
  context.clip();
  if (decision.margin !== null) drawContour(context, run, layer, decision.margin, at);
  const outlines = run.outlinesAt(decision.time);
  const of = (wanted) => outlines.filter(({kind}) => kind === wanted);
  for (const outline of of("obstacle")) drawObstacle(context, outline, at, MAP_INK);
  for (const outline of of("region")) drawOutline(context, outline, at, 1, REGION_DASH);
  for (const outline of of("object")) drawOutline(context, outline, at, outline.name === map.object ? 2 : 1);
  if (map.target) {
    drawWay(context, map.target.way, at, {colour: MAP_INK, width: 1.5, dash: [3, 4]});
    const moved = of("object").find(({name}) => name === map.object);
    if (moved && map.target.at && map.target.way.length) drawOutline(context, movedOutline(moved, map.target), at, 1.5, [4, 3]);
    drawTarget(context, map.target.at, at, MAP_INK);
  }
  if (cell) drawCell(context, map, cell, at);
  const objects = of("object").toSorted((one, other) => (other.name === map.object) - (one.name === map.object));
  drawNames(context, [...objects, ...of("obstacle"), ...of("region")], at, [left, top, right, bottom]);
  context.restore();
  context.strokeStyle = colour("line");
  context.lineWidth = 1;
  context.strokeRect(left, top, right - left, bottom - top);
  drawAxes(context, map, run.lengths, at, [left, top, right, bottom]);
  drawScale(context, layer.scale, decision.margin, [right + 8, top, bottom]);
}

// Draws an obstacle of the workspace in grey.
function drawObstacle(context, {rings}, at, ink) {
  context.save();
  context.fillStyle = OBSTACLE_GREY;
  context.strokeStyle = ink;
  context.lineWidth = 1;
  for (const ring of rings) {
    context.beginPath();
    for (let i = 0; i + 1 < ring.length; i += 2) context.lineTo(at.x(ring[i]), at.y(ring[i + 1]));
    context.closePath();
    context.fill();
    context.stroke();
  }
  context.restore();
}

function drawOutline(context, {rings}, at, width, dash = []) {
  context.save();
  context.strokeStyle = MAP_INK;
  context.lineWidth = width;
  context.setLineDash(dash);
  for (const ring of rings) {
    context.beginPath();
    for (let i = 0; i + 1 < ring.length; i += 2) context.lineTo(at.x(ring[i]), at.y(ring[i + 1]));
    context.closePath();
    context.stroke();
  }
  context.restore();
}

// The outline of an object at its target, turned about the object's centre, where the way begins.
function movedOutline({rings}, {at: [x, y], turn, way}) {
  const [cos, sin] = [Math.cos(turn), Math.sin(turn)];
  return {rings: rings.map((ring) => ring.map((_, i) => {
    const [u, v] = [ring[i - i % 2] - way[0], ring[i - i % 2 + 1] - way[1]];
    return i % 2 ? y + sin * u + cos * v : x + cos * u - sin * v;
  }))};
}

// Draws names of outlines. A name takes the first side without outlines and names, else the first side without names.
// A name without such a side is left out.
function drawNames(context, outlines, at, frame) {
  context.textBaseline = "middle";
  context.textAlign = "center";
  const inFrame = outlines.map((outline) => ({...outline, box: boxOf(outline, at)})).filter(({box}) => meets(box, frame));
  const outlineBoxes = inFrame.filter(({kind}) => kind !== "region").map(({box}) => box);
  const nameBoxes = [];
  for (const {kind, name, box} of inFrame) {
    context.font = kind === "region" ? `italic ${FONT}` : FONT;
    const text = shortened(name, 24), half = context.measureText(text).width / 2 + 1;
    const corner = kind === "region" ? [[Math.max(box[0], frame[0]) + 4 + half, Math.min(box[3], frame[3]) - HALF_LINE]] : [];
    const places = [...corner, ...sidesOf(box, half)].filter((middle) => isWithin(boxAround(middle, half), frame));
    const free = places.filter((middle) => !nameBoxes.some((other) => meets(boxAround(middle, half), other)));
    const middle = free.find((place) => !outlineBoxes.some((other) => meets(boxAround(place, half), other))) ?? free[0];
    if (!middle) continue;
    nameBoxes.push(boxAround(middle, half));
    context.lineWidth = 3;
    context.lineJoin = "round";
    context.strokeStyle = "rgb(255 255 255 / 0.8)";
    context.strokeText(text, ...middle);
    context.fillStyle = MAP_INK;
    context.fillText(text, ...middle);
  }
}

// The sides of an outline on which its name may stand, in the order in which they are tried.
const SIDES = [[0, -1], [0, 1], [1, 0], [-1, 0], [1, -1], [-1, -1], [1, 1], [-1, 1]];
const HALF_LINE = 8;

// The middles of a name on each side of an outline's box.
function sidesOf([left, top, right, bottom], half) {
  return SIDES.map(([across, down]) => [
    (left + right) / 2 + across * ((right - left) / 2 + half + 4), (top + bottom) / 2 + down * ((bottom - top) / 2 + HALF_LINE + 3),
  ]);
}

function boxAround([x, y], half) {
  return [x - half, y - HALF_LINE, x + half, y + HALF_LINE];
}

function boxOf({rings}, at) {
  const points = rings.flat();
  const xs = points.filter((_, index) => index % 2 === 0).map(at.x), ys = points.filter((_, index) => index % 2).map(at.y);
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
}

function meets(one, other) {
  return one[0] < other[2] && other[0] < one[2] && one[1] < other[3] && other[1] < one[3];
}

function isWithin(box, frame) {
  return box[0] >= frame[0] && box[1] >= frame[1] && box[2] <= frame[2] && box[3] <= frame[3];
}

// Draws a frame around a cell, at least 8 pixels wide, so that it is visible around a small cell.
function drawCell(context, map, cell, at) {
  const [x, y] = centreOf(map, cell);
  const half = Math.max(at.scale * (map.high[0] - map.low[0]) / map.columns / 2, 4);
  for (const [ink, width] of [["white", 4], [MAP_INK, 1.5]]) {
    context.strokeStyle = ink;
    context.lineWidth = width;
    context.strokeRect(at.x(x) - half, at.y(y) - half, 2 * half, 2 * half);
  }
}

// Draws the edges between cells that reach the margin and free cells that do not.
function drawContour(context, run, map, margin, at) {
  const values = run.numbers(map.values), rows = rowsOf(map);
  const x = (column) => at.x(map.low[0] + column / map.columns * (map.high[0] - map.low[0]));
  const y = (row) => at.y(map.low[1] + row / rows * (map.high[1] - map.low[1]));
  const parts = (one, two) => !Number.isNaN(one) && !Number.isNaN(two) && (one >= margin) !== (two >= margin);
  context.strokeStyle = MAP_INK;
  context.lineWidth = 1;
  context.beginPath();
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < map.columns; column++) {
      const place = row * map.columns + column;
      if (column + 1 < map.columns && parts(values[place], values[place + 1])) {
        context.moveTo(x(column + 1), y(row));
        context.lineTo(x(column + 1), y(row + 1));
      }
      if (row + 1 < rows && parts(values[place], values[place + map.columns])) {
        context.moveTo(x(column), y(row + 1));
        context.lineTo(x(column + 1), y(row + 1));
      }
    }
  }
  context.stroke();
}

// A round step that divides a length into a few parts.
function roundStep(length, parts) {
  const power = 10 ** Math.floor(Math.log10(length / parts));
  return power * ([1, 2, 5].find((factor) => length / (factor * power) <= parts) ?? 10);
}

function drawAxes(context, map, unit, at, [left, top, right, bottom]) {
  context.font = FONT;
  context.fillStyle = context.strokeStyle = colour("quiet");
  context.lineWidth = 1;
  context.beginPath();
  const ticks = (axis, size, room) => {
    const step = roundStep(map.high[axis] - map.low[axis], Math.max(size / room, 1));
    const first = Math.ceil(map.low[axis] / step - 1e-9), last = Math.floor(map.high[axis] / step + 1e-9);
    return Array.from({length: Math.max(last - first + 1, 0)}, (_, index) => Number(((first + index) * step).toPrecision(12)));
  };
  context.textAlign = "center";
  context.textBaseline = "top";
  const along = ticks(0, right - left, 48), last = along[along.length - 1];
  for (const tick of along) {
    context.moveTo(at.x(tick), bottom);
    context.lineTo(at.x(tick), bottom + 4);
    context.fillText(`${numberText(tick)}${tick === last ? spaced(unit) : ""}`, at.x(tick), bottom + 6);
  }
  context.textAlign = "right";
  context.textBaseline = "middle";
  for (const tick of ticks(1, bottom - top, 32)) {
    context.moveTo(left - 4, at.y(tick));
    context.lineTo(left, at.y(tick));
    context.fillText(numberText(tick), left - 6, at.y(tick));
  }
  context.stroke();
}

// The scale of the colours, with numbers at its ends, at 0 and at the margin.
function drawScale(context, scale, margin, [left, top, bottom]) {
  const gradient = context.createLinearGradient(0, bottom, 0, top);
  MAP.forEach((shade, index) => gradient.addColorStop(index / (MAP.length - 1), shade));
  context.fillStyle = gradient;
  context.fillRect(left, top, SCALE_WIDTH, bottom - top);
  context.font = FONT;
  context.textAlign = "left";
  context.textBaseline = "middle";
  const y = (number) => (top + bottom) / 2 - (scale > 0 ? number / scale : 0) * (bottom - top) / 2;
  const rows = [];
  for (const number of [0, ...(scale > 0 ? [scale, -scale] : []), ...(margin ? [margin] : [])]) {
    if (Math.abs(number) > scale * (1 + 1e-9)) continue;
    const height = y(number), nearest = Math.min(Math.max(height, top + 5), bottom - 5);
    // a small margin is written above 0
    const row = number === margin && Math.abs(nearest - rows[0]) < 12 ? rows[0] - 12 : nearest;
    context.fillStyle = MAP_INK;
    context.fillRect(left, height - 0.5, SCALE_WIDTH, 1);
    context.fillStyle = number === margin ? colour("ink") : colour("quiet");
    context.fillRect(left + SCALE_WIDTH, height - 0.5, 3, 1);
    if (rows.some((other) => Math.abs(other - row) < 12)) continue;
    rows.push(row);
    context.fillText(numberText(number), left + SCALE_WIDTH + 5, row);
  }
}

// The picture of a map: a pixel for each cell, the lowest row at the bottom, blocked cells transparent.
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
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < map.columns; column++) {
      const number = values[row * map.columns + column];
      if (Number.isNaN(number)) continue;
      const place = 4 * ((rows - 1 - row) * map.columns + column);
      const shade = mixOf(map.scale > 0 ? number / map.scale : 0);
      for (let part = 0; part < 3; part++) image.data[place + part] = shade[part];
      image.data[place + 3] = 255;
    }
  }
  context.putImageData(image, 0, 0);
  return made;
}

// The colour of a number from −1 to 1, as red, green and blue.
function mixOf(number) {
  const at = (Math.min(Math.max(number, -1), 1) + 1) / 2 * (MAP.length - 1), low = Math.min(Math.floor(at), MAP.length - 2);
  return MAP_COLOURS[low].map((part, index) => part + (at - low) * (MAP_COLOURS[low + 1][index] - part));
}

function shadeOf(number) {
  return `rgb(${mixOf(number).map(Math.round).join(" ")})`;
}

function rgb(text) {
  return [1, 3, 5].map((place) => parseInt(text.slice(place, place + 2), 16));
}

// The projection of a part of the plane to a rectangle of the screen, as large as fits, with y upwards.
function projection(low, high, width, height, margin) {
  const scale = Math.min((width - 2 * margin) / (high[0] - low[0]), (height - 2 * margin) / (high[1] - low[1]));
  const left = (width - scale * (high[0] - low[0])) / 2, bottom = (height + scale * (high[1] - low[1])) / 2;
  return {
    scale,
    x: (x) => left + scale * (x - low[0]),
    y: (y) => bottom - scale * (y - low[1]),
  };
}

// Draws a map under the scene.
function drawMap(context, run, map, at) {
  const left = at.x(map.low[0]), top = at.y(map.high[1]);
  const width = at.x(map.high[0]) - left, height = at.y(map.low[1]) - top;
  hatch(context, left, top, width, height, colour("neutral"));
  context.save();
  context.imageSmoothingEnabled = false;
  context.globalCompositeOperation = "destination-out";
  context.drawImage(pictureOf(run, map), left, top, width, height);
  context.globalCompositeOperation = "source-over";
  context.globalAlpha = OPACITY;
  context.drawImage(pictureOf(run, map), left, top, width, height);
  context.restore();
}

// Draws oblique lines, which stay visible where a map is transparent.
function hatch(context, left, top, width, height, ink) {
  context.save();
  context.beginPath();
  context.rect(left, top, width, height);
  context.clip();
  context.strokeStyle = ink;
  context.lineWidth = 1;
  context.beginPath();
  for (let x = left - height; x < left + width; x += 7) {
    context.moveTo(x, top + height);
    context.lineTo(x + height, top);
  }
  context.stroke();
  context.restore();
}

// Draws a line through points, given as x and y in turn.
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

function drawTarget(context, target, at, ink) {
  if (!target) return;
  const [x, y] = target;
  context.save();
  context.strokeStyle = ink;
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
