// The scene from above at the cursor, with the map and the way of the decision that is in force.

const STEPS_OF_SCENE = 65535;
const ABSENT = 65535;

function makeScene(clock) {
  const film = readFilm(clock.run);
  const place = body("scene");
  if (!film.times.length) {
    place.append(element("p", {}, "The log has no scene."));
    return;
  }
  const layers = {labels: true, trails: true, map: true};
  const {made, redraw} = canvas("The scene from above", (context, width, height) => {
    drawScene(context, clock, film, layers, width, height);
  });
  made.className = "stage";
  made.style.aspectRatio = String(aspectOf(film));
  const caption = element("p", {class: "caption"});
  const hasMaps = clock.run.decisions.some((decision) => decision.maps.length);
  place.append(made, element("div", {class: "scene-foot"}, caption, element("span", {class: "choice"},
    layerBox("names", "labels", layers, redraw), layerBox("trails", "trails", layers, redraw),
    hasMaps ? layerBox("map", "map", layers, redraw) : null)),
  key([{ground: "positive", words: "all that is asked of it holds now"},
    {ground: "negative", words: "something does not"}, {ground: "neutral", words: "nothing is asked, or unknown"}]));
  let before = null;
  const show = () => {
    const frame = indexAt(film.times, clock.time);
    const now = [frame, clock.sample, decisionAt(clock.run, clock.time)];
    if (now.every((each, index) => each === before?.[index])) return;
    before = now;
    redraw();
    caption.replaceChildren(...captionOf(clock, film, frame));
  };
  clock.on("time", show);
  window.addEventListener("themechange", redraw);
}

function layerBox(label, name, layers, redraw) {
  const box = element("input", {type: "checkbox", checked: true, onchange: () => {
    layers[name] = box.checked;
    redraw();
  }});
  return element("label", {}, box, label);
}

function readFilm(run) {
  const {film, numbers} = run;
  const size = [film.high[0] - film.low[0], film.high[1] - film.low[1]];
  const coordinates = (steps) => Float64Array.from(
    steps, (step, index) => film.low[index % 2] + step / STEPS_OF_SCENE * size[index % 2]);
  const frames = numbers(film.witness.frames);
  const points = coordinates(numbers(film.witness.points));
  const witness = new Map(Array.from(frames, (frame, index) => [
    frame, {ends: points.subarray(4 * index, 4 * index + 4), label: film.witness.labels[index]}]));
  const maps = run.decisions.flatMap((decision) => decision.maps);
  const least = (axis) => Math.min(film.low[axis], ...maps.map((map) => map.low[axis]));
  const greatest = (axis) => Math.max(film.high[axis], ...maps.map((map) => map.high[axis]));
  return {
    times: numbers(film.times),
    low: [least(0), least(1)],
    high: [greatest(0), greatest(1)],
    witness,
    entities: film.entities.map((entity) => readEntity(entity, numbers, coordinates)),
  };
}

function readEntity(entity, numbers, coordinates) {
  const form = numbers(entity.form);
  const lengths = entity.forms.map((rings) => 2 * rings.reduce((sum, ring) => sum + ring, 0));
  const starts = new Uint32Array(form.length), shown = new Uint32Array(form.length);
  let start = 0, count = 0;
  for (let frame = 0; frame < form.length; frame++) {
    starts[frame] = start;
    shown[frame] = count;
    if (form[frame] === ABSENT) continue;
    start += lengths[form[frame]];
    count += 1;
  }
  return {
    ...entity, form, starts, shown,
    points: coordinates(numbers(entity.points)),
    colours: numbers(entity.colours),
  };
}

function aspectOf(film) {
  const aspect = (film.high[0] - film.low[0]) / (film.high[1] - film.low[1]);
  return Math.min(Math.max(aspect, 0.8), 2);
}

function drawScene(context, clock, film, layers, width, height) {
  const frame = indexAt(film.times, clock.time);
  const at = projection(film.low, film.high, width, height, 18);
  const decision = decisionAt(clock.run, clock.time);
  const map = decision && chosenMap(decision);
  if (layers.map && map) drawMap(context, clock.run, map, at);
  if (layers.trails) drawTrails(context, film, frame, at);
  const labels = [];
  for (const entity of film.entities) drawEntity(context, entity, frame, at, labels);
  if (decision) drawPlan(context, clock, decision, at);
  if (layers.labels) drawLabels(context, labels, width);
  const pointed = film.witness.get(frame);
  if (pointed) drawWitness(context, pointed, at, width);
}

function drawEntity(context, entity, frame, at, labels) {
  const form = entity.form[frame];
  if (form === ABSENT) return;
  const [red, green, blue] = entity.colours.subarray(3 * entity.shown[frame], 3 * entity.shown[frame] + 3);
  const isRegion = entity.kind === "region";
  let place = entity.starts[frame];
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  context.lineWidth = isRegion ? 1.25 : 2;
  context.setLineDash(isRegion ? [6, 4] : []);
  context.strokeStyle = `rgb(${red} ${green} ${blue})`;
  context.fillStyle = `rgb(${red} ${green} ${blue} / ${isRegion ? 0.06 : 0.4})`;
  for (const ring of entity.forms[form]) {
    context.beginPath();
    for (let corner = 0; corner < ring; corner++, place += 2) {
      const x = at.x(entity.points[place]), y = at.y(entity.points[place + 1]);
      context.lineTo(x, y);
      box[0] = Math.min(box[0], x);
      box[1] = Math.min(box[1], y);
      box[2] = Math.max(box[2], x);
      box[3] = Math.max(box[3], y);
    }
    context.closePath();
    context.fill();
    context.stroke();
  }
  context.setLineDash([]);
  labels.push({text: entity.name, box, isRegion});
}

// Names of objects, then those of regions; one that would cover another is left out.
function drawLabels(context, labels, width) {
  const taken = [];
  for (const label of labels.toSorted((one, other) => one.isRegion - other.isRegion)) {
    context.font = `${label.isRegion ? "italic " : ""}${FONT}`;
    const name = label.text.length > 32 ? `${label.text.slice(0, 31)}…` : label.text;
    const half = context.measureText(name).width / 2;
    const [x, y] = placeOfLabel(label, half, width);
    const covers = ([left, right, row]) => x - half < right && x + half > left && Math.abs(y - row) < 13;
    if (taken.some(covers)) continue;
    taken.push([x - half, x + half, y]);
    outlined(context, name, x, y, colour(label.isRegion ? "quiet" : "ink"));
  }
}

// The middle of a name: within what is large enough for it, else above; a region's in its lower left corner.
function placeOfLabel({box: [left, top, right, bottom], isRegion}, half, width) {
  if (isRegion) return [left + 5 + half, bottom - 9];
  const fits = 2 * half < right - left - 6 && bottom - top > 16;
  const x = Math.min(Math.max((left + right) / 2, half + 2), Math.max(width - half - 2, half + 2));
  return [x, fits ? (top + bottom) / 2 : top - 8];
}

function outlined(context, text, x, y, fill) {
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.lineWidth = 3;
  context.lineJoin = "round";
  context.strokeStyle = colour("panel");
  context.strokeText(text, x, y);
  context.fillStyle = fill;
  context.fillText(text, x, y);
}

function drawWitness(context, {ends, label}, at, width) {
  const [x0, y0, x1, y1] = [at.x(ends[0]), at.y(ends[1]), at.x(ends[2]), at.y(ends[3])];
  const length = Math.hypot(x1 - x0, y1 - y0), angle = Math.atan2(y1 - y0, x1 - x0);
  const head = Math.min(11, length / 2);
  context.strokeStyle = context.fillStyle = colour("negative-line");
  context.lineWidth = 3;
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1 - head * Math.cos(angle), y1 - head * Math.sin(angle));
  context.stroke();
  context.beginPath();
  context.moveTo(x1, y1);
  for (const side of [-0.45, 0.45]) {
    context.lineTo(x1 - 1.4 * head * Math.cos(angle + side), y1 - 1.4 * head * Math.sin(angle + side));
  }
  context.closePath();
  context.fill();
  context.font = `600 ${FONT}`;
  const text = label.replace("-", "−"), half = context.measureText(text).width / 2 + 4;
  const x = Math.min(Math.max((x0 + x1) / 2, half), width - half);
  outlined(context, text, x, Math.max((y0 + y1) / 2 - 12, 10), colour("negative-text"));
}

function drawPlan(context, clock, {target, outcome, time}, at) {
  if (!target) return;
  drawWay(context, target.way, at, {colour: colour("ink"), width: 1.5, dash: [3, 4]});
  drawTarget(context, target.at, at);
  if (!outcome) return;
  // a point for each sample, of which those up to now are shown
  const points = clock.run.numbers(outcome.travelled);
  const share = outcome.time > time ? Math.min((clock.time - time) / (outcome.time - time), 1) : 1;
  const travelled = points.subarray(0, 2 * Math.ceil(share * points.length / 2));
  drawWay(context, travelled, at, {colour: colour("quiet"), width: 2});
}

// The last decision that is not later than a time.
function decisionAt(run, time) {
  const {decisions} = run;
  let found = null;
  for (const decision of decisions) if (decision.time <= time + 1e-9) found = decision;
  return found;
}
