// The scene from above at the cursor: objects, regions, trails, the worst violation, and the plan.

const STEPS_OF_SCENE = 65535;
const ABSENT = 65535;

function makeScene(clock, name = "scene") {
  const scene = sceneOf(clock.run);
  const place = body(name);
  if (!scene.times.length) {
    place.append(element("p", {}, "The log has no scene."));
    return;
  }
  const layers = {labels: true, trails: true, map: true};
  const {made, redraw} = canvas("The scene from above", (context, width, height) => {
    drawScene(context, clock, scene, layers, width, height);
  });
  made.className = "stage";
  made.style.aspectRatio = String(aspectOf(scene));
  const caption = element("p", {class: "caption"}), trail = element("p", {class: "key"});
  const hasMaps = clock.run.decisions.some((decision) => decision.maps.length);
  place.append(made, element("div", {class: "scene-foot"}, caption, element("span", {class: "choice"},
    layerBox("names", "labels", layers, redraw), layerBox("trails", "trails", layers, redraw),
    hasMaps ? layerBox("map", "map", layers, redraw) : null)),
  key([{ground: "positive", words: scene.entities.some((each) => each.shades)
    ? "its requirements in the chosen result hold now" : "its requirements hold now"},
    {ground: "negative", words: "one is permanently violated"},
    {ground: "neutral", words: "no requirement, still to come, or unknown"},
    ...(hasMaps ? [{ground: "hatched", words: "blocked in the map"}] : []),
    ...(clock.run.obstacles.length ? [{ground: "obstacle", words: "obstacle"}] : [])]), trail);
  clock.on("result", () => trail.replaceChildren(...trailKey(clock, scene)));
  let before = null;
  const show = () => {
    const frame = indexAt(scene.times, clock.time);
    const now = [frame, clock.sample, decisionAt(clock.run, clock.time), pointerAt(clock), clock.result];
    if (now.every((each, index) => each === before?.[index])) return;
    before = now;
    redraw();
    caption.replaceChildren(...captionOf(clock, scene, frame), ...drawnAt(clock, scene, frame));
  };
  clock.on("time", show);
  clock.on("result", show);
  window.addEventListener("themechange", redraw);
}

// A note on the time of the drawn frame, because the page of a long run may have fewer frames than samples.
function drawnAt(clock, scene, frame) {
  const time = scene.times[frame];
  if (scene.stride < 2 && !clock.run.is_thinned || Math.abs(time - clock.times[clock.sample]) < 1e-9) return [];
  return [` (drawn as it was at ${secondsText(time)})`];
}

function layerBox(label, name, layers, redraw) {
  const box = element("input", {type: "checkbox", checked: true, onchange: () => {
    layers[name] = box.checked;
    redraw();
  }});
  return element("label", {}, box, label);
}

function sceneOf(run) {
  run.drawnScene ??= readScene(run);
  return run.drawnScene;
}

// The objects at a time, regions and obstacles, with their outlines: points x and y in turn.
function outlinesAt(run, time) {
  const scene = sceneOf(run);
  const frame = indexAt(scene.times, time);
  return scene.entities.filter((entity) => scene.times.length && isThere(entity, frame))
    .map((entity) => ({kind: entity.kind, name: entity.name, rings: ringsOf(entity, frame)}))
    .concat(obstaclesOf(run));
}

function obstaclesOf({obstacles}) {
  return obstacles.map((obstacle) => ({kind: "obstacle", ...obstacle}));
}

function ringsOf(entity, frame) {
  let start = entity.starts[frame];
  return entity.forms[entity.form[frame]].map((corners) => {
    const ring = Array.from(entity.points.subarray(start, start + 2 * corners));
    start += 2 * corners;
    return ring;
  });
}

function readScene(run) {
  const {scene, numbers} = run;
  const size = [scene.high[0] - scene.low[0], scene.high[1] - scene.low[1]];
  const coordinates = (steps) => Float64Array.from(
    steps, (step, index) => scene.low[index % 2] + step / STEPS_OF_SCENE * size[index % 2]);
  const {labels, atoms, moments, outlines, names, ...found} = scene.violations;
  const outline = numbers(found.outline), name = numbers(found.name);
  const points = coordinates(numbers(found.points)), places = numbers(found.places);
  const robustness = numbers(found.robustness), holds = numbers(found.holds);
  // arrows of violated results, by frame
  const violations = new Map();
  numbers(found.frames).forEach((frame, index) => {
    if (!violations.has(frame)) violations.set(frame, []);
    violations.get(frame).push({
      ends: points.subarray(4 * index, 4 * index + 4), label: labels[index], atom: atoms[index],
      robustness: robustness[index],
      result: places[2 * index], node: places[2 * index + 1], holds: holds[index] === 1, moment: moments[index],
      outline: outlines[outline[index]], names: names[name[index]],
    });
  });
  const maps = run.decisions.flatMap((decision) => decision.maps);
  // two runs side by side show the same part of the plane
  const shown = [...maps, ...(run.frame ? [run.frame] : [])];
  const least = (axis) => Math.min(scene.low[axis], ...shown.map((each) => each.low[axis]));
  const greatest = (axis) => Math.max(scene.high[axis], ...shown.map((each) => each.high[axis]));
  return {
    times: numbers(scene.times),
    low: [least(0), least(1)],
    high: [greatest(0), greatest(1)],
    violations,
    stride: scene.stride,
    shades: numbers(scene.shades),
    entities: scene.entities.map((entity) => readEntity(entity, numbers, coordinates)),
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
    shades: entity.shades && numbers(entity.shades),
  };
}

function aspectOf(scene) {
  const aspect = (scene.high[0] - scene.low[0]) / (scene.high[1] - scene.low[1]);
  return Math.min(Math.max(aspect, 0.8), 2);
}

function drawScene(context, clock, scene, layers, width, height) {
  const frame = indexAt(scene.times, clock.time);
  const at = projection(scene.low, scene.high, width, height, 18);
  const decision = decisionAt(clock.run, clock.time);
  const map = decision && chosenMap(decision);
  if (layers.map && map) drawMap(context, clock.run, map, at);
  if (layers.trails) {
    drawTrails(context, scene, frame, at);
    drawTightTrails(context, clock, scene, at, [width, height]);
  }
  const labels = obstaclesOf(clock.run).map((obstacle) => obstacleLabel(context, obstacle, at));
  const colourAt = coloursOf(clock, scene, frame);
  const marked = failedObjects(clock);
  for (const entity of scene.entities) {
    const mark = marked.includes(entity.name) ? " ✕" : "";
    if (isThere(entity, frame)) drawEntity(context, entity, frame, at, labels, colourAt(entity), mark);
    else if (entity.form[frame] !== ABSENT) drawLast(context, entity, frame, at, labels);
  }
  if (decision) drawPlan(context, clock, decision, at);
  const violation = pointerAt(clock) ?? violationAt(clock, scene, frame);
  const deciding = violation?.names.flatMap((id) => labels.filter((label) => label.id === id)) ?? [];
  const names = !layers.labels ? [] : deciding.length
    ? drawDeciding(context, deciding, violation.ends, at, [width, height]) : drawLabels(context, labels, width);
  if (violation?.outline) drawDashes(context, violation.outline, at);
  const inks = clock.run.results[clock.result]?.left_open ? ["neutral", "quiet"] : ["negative-line", "negative-text"];
  const boxes = labels.filter((each) => !each.isRegion).map((each) => each.box);
  if (violation) drawViolation(context, violation, at, [names, boxes], [width, height], inks);
}

// Draws an obstacle; returns its label.
function obstacleLabel(context, {name, rings}, at) {
  drawObstacle(context, {rings}, at, colour("quiet"));
  return {id: `obstacle/${name}`, text: name, box: boxOf({rings}, at), isRegion: true};
}

// The objects that violated the chosen result, from the time of the violation on.
function failedObjects({run, result, time}) {
  const {verdict, pointer} = run.results[result] ?? {};
  return verdict === "violated" && pointer && time >= pointer.time - 1e-9 ? pointer.objects : [];
}

// Whether a frame has the entity itself, and not only its last outline.
function isThere({form, last}, frame) {
  return form[frame] !== ABSENT && !last.includes(form[frame]);
}

// Draws the last outline of a missing object.
function drawLast(context, entity, frame, at, labels) {
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  let place = entity.starts[frame];
  context.strokeStyle = colour("quiet");
  context.lineWidth = 1.25;
  context.setLineDash([4, 4]);
  for (const ring of entity.forms[entity.form[frame]]) {
    context.beginPath();
    for (let corner = 0; corner < ring; corner++, place += 2) {
      const x = at.x(entity.points[place]), y = at.y(entity.points[place + 1]);
      context.lineTo(x, y);
      [box[0], box[1], box[2], box[3]] = [Math.min(box[0], x), Math.min(box[1], y), Math.max(box[2], x), Math.max(box[3], y)];
    }
    context.closePath();
    context.stroke();
  }
  context.setLineDash([]);
  labels.push({id: `object/${entity.name}`, text: `${entity.name}, last seen`, box, isRegion: false});
}

// Draws the outlines at an arrow with the number of an earlier sample, as they were in that sample.
function drawDashes(context, points, at) {
  context.strokeStyle = colour("quiet");
  context.lineWidth = 1.25;
  context.beginPath();
  for (let place = 0; place < points.length; place += 2) {
    context[place % 4 ? "lineTo" : "moveTo"](at.x(points[place]), at.y(points[place + 1]));
  }
  context.stroke();
}

// The arrow of the chosen result in a frame.
function violationAt({result}, scene, frame) {
  return scene.violations.get(frame)?.find((each) => each.result === result);
}

// The colours of entities in a frame. With several results, the chosen result's requirements decide the colours.
function coloursOf(clock, scene, frame) {
  const {run, result} = clock;
  // objects at the arrow of an open verdict are grey, because it is unknown whether their requirements hold
  const open = run.results[result]?.left_open ? pointerAt(clock)?.objects ?? [] : [];
  return (entity) => {
    if (open.includes(entity.name)) return rgb(run.palette.neutral);
    const place = entity.shown[frame];
    if (!entity.shades) return entity.colours.subarray(3 * place, 3 * place + 3);
    const shade = entity.shades[run.results.length * place + result];
    return scene.shades.subarray(3 * shade, 3 * shade + 3);
  };
}

function drawEntity(context, entity, frame, at, labels, [red, green, blue], mark) {
  const form = entity.form[frame];
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
  labels.push({id: `${entity.kind}/${entity.name}`, text: entity.name + mark, box, isRegion});
}

// Draws names of objects, then names of regions, without names that would cover another name. Returns their places.
function drawLabels(context, labels, width) {
  const taken = [];
  for (const label of labels.toSorted((one, other) => one.isRegion - other.isRegion)) {
    context.font = `${label.isRegion ? "italic " : ""}${FONT}`;
    const name = label.text.length > 32 ? `${label.text.slice(0, 31)}…` : label.text;
    const half = context.measureText(name).width / 2;
    const [x, y] = placeOfLabel(label, half, width);
    if (covers(taken, x, y, half)) continue;
    taken.push([x - half, x + half, y]);
    outlined(context, name, x, y, colour(label.isRegion ? "quiet" : "ink"));
  }
  return taken;
}

// Draws the names at the ends of an arrow, each at the first free side, as `place_names` does in an annotated log.
function drawDeciding(context, labels, [x0, y0, x1, y1], at, [width, height]) {
  const xs = [at.x(x0), at.x(x1)], ys = [at.y(y0), at.y(y1)];
  const blocked = labels.filter(({isRegion}) => !isRegion).map(({box}) => box);
  blocked.push([Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)]);
  return labels.map(({text, box, isRegion}) => {
    context.font = `${isRegion ? "italic " : "600 "}${FONT}`;
    const half = context.measureText(text).width / 2 + 2;
    const places = sidesOf(box, half);
    const above = Math.min(...blocked.map((other) => other[1])), below = Math.max(...blocked.map((other) => other[3]));
    const middle = Math.min(Math.max((box[0] + box[2]) / 2, half), width - half);
    places.push([middle, above - HALF_LINE - 3], [middle, below + HALF_LINE + 3]);
    const boxes = places.map((place) => boxAround(place, half));
    const isFree = (own) => !blocked.some((other) => meets(own, other));
    const index = Math.max(boxes.findIndex((own) => isFree(own) && isWithin(own, [0, 0, width, height])), 0);
    const place = places[index];
    blocked.push(boxes[index]);
    outlined(context, text, ...place, colour(isRegion ? "quiet" : "ink"));
    return [place[0] - half, place[0] + half, place[1]];
  });
}

// Whether a text around a place would cover an earlier text.
function covers(taken, x, y, half) {
  return taken.some(([left, right, row]) => x - half < right && x + half > left && Math.abs(y - row) < 13);
}

// The middle of a name: within an outline that is large enough, else above it, or in a region's lower left corner.
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

function drawViolation(context, {ends, label, text: atom}, at, [names, boxes], [width, height], [line, ink]) {
  const [x0, y0, x1, y1] = [at.x(ends[0]), at.y(ends[1]), at.x(ends[2]), at.y(ends[3])];
  const length = Math.hypot(x1 - x0, y1 - y0), angle = Math.atan2(y1 - y0, x1 - x0);
  const head = Math.min(11, length / 2);
  context.strokeStyle = context.fillStyle = colour(line);
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
  const number = minusWords(label);
  const halfOf = (words) => context.measureText(words).width / 2 + 4;
  const texts = atom ? [48, 32, 20, 12].map((most) => `${shortened(atom, most)}: ${number}`) : [];
  const text = [...texts, number].find((words) => 2 * halfOf(words) <= width) ?? number;
  const half = halfOf(text), x = Math.min(Math.max((x0 + x1) / 2, half), width - half);
  // the text is above or below the arrow, in the nearest row without names and objects
  const along = [x - half, x + half].map((side) => Math.min(Math.max((side - x0) / (x1 - x0 || 1), 0), 1));
  const [low, high] = along.map((share) => y0 + share * (y1 - y0)).sort((one, other) => one - other);
  const rows = Array.from({length: 16}, (_, step) => [low - 13 - 14 * step, high + 15 + 14 * step]).flat()
    .filter((row) => row >= 10 && row <= height - 10);
  const isFree = (row) => !covers(names, x, row, half);
  const isOff = (row) => boxes.every(([left, top, right, bottom]) =>
    x - half > right || x + half < left || row - 8 > bottom || row + 8 < top);
  const row = rows.find((each) => isFree(each) && isOff(each)) ?? rows.find(isFree) ?? rows[0] ?? 10;
  outlined(context, text, x, row, colour(ink));
}

function drawPlan(context, clock, {target, outcome, time}, at) {
  if (!target) return;
  drawWay(context, target.way, at, {colour: colour("ink"), width: 1.5, dash: [3, 4]});
  drawTarget(context, target.at, at, colour("ink"));
  if (!outcome) return;
  // `travelled` has a point for each sample, of which only the points up to the cursor are drawn
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

// Length of trails, as a share of the run.
const REACH = 0.15;

function drawTrails(context, scene, frame, at) {
  const first = Math.max(0, frame - Math.ceil(REACH * scene.times.length));
  context.save();
  context.strokeStyle = colour("quiet");
  context.globalAlpha = 0.6;
  context.lineWidth = 1;
  for (const entity of scene.entities) {
    if (entity.kind === "object") drawTrail(context, entity, first, frame, at);
  }
  context.restore();
}

// The objects that decide the chosen result, and the number of its deciding part in each frame; null without objects.
function tightnessOf(clock, scene) {
  const {run, result: chosen} = clock;
  const result = run.results[chosen];
  const names = result?.pointer?.objects ?? [];
  const node = result && (result.nodes[result.decided] ?? result.nodes[0]);
  if (!names.length || !node) return null;
  result.tightness ??= Float64Array.from(scene.times, (time) => {
    const place = placeIn(result, indexAt(run.times, time));
    return place === null || place >= result.samples ? NaN : node.series[NOW][place] * node.divisor;
  });
  const scale = result.tightness.reduce((most, number) => (Number.isFinite(number) ? Math.max(most, Math.abs(number)) : most), 0);
  return scale > 0 ? {names, node, numbers: result.tightness, scale} : null;
}

const TRAIL_SHADES = 16;

// Draws whole trails of the deciding objects, coloured by the deciding number, which show where the run was tight.
function drawTightTrails(context, clock, scene, at, size) {
  const tightness = tightnessOf(clock, scene);
  if (!tightness) return;
  const key = [clock.result, ...size].join();
  if (scene.tight?.key !== key) scene.tight = {key, paths: tightPaths(scene, tightness, at)};
  context.save();
  context.lineCap = "round";
  context.strokeStyle = colour("quiet");
  context.lineWidth = 4.5;
  for (const {path} of scene.tight.paths) context.stroke(path);
  context.lineWidth = 3;
  for (const {path, shade} of scene.tight.paths) {
    context.strokeStyle = shade;
    context.stroke(path);
  }
  context.restore();
}

function tightPaths(scene, {names, numbers, scale}, at) {
  const paths = Array.from({length: TRAIL_SHADES}, (_, index) => ({path: new Path2D(), shade: shadeOf(2 * (index + 0.5) / TRAIL_SHADES - 1)}));
  for (const entity of scene.entities.filter(({kind, name}) => kind === "object" && names.includes(name))) {
    entity.middles ??= middlesOf(entity);
    for (let frame = 1; frame < scene.times.length; frame++) {
      const [x0, y0, x1, y1] = entity.middles.subarray(2 * frame - 2, 2 * frame + 2);
      if (Number.isNaN(x0 + x1 + numbers[frame]) || (x0 === x1 && y0 === y1)) continue;
      const share = (Math.min(Math.max(numbers[frame] / scale, -1), 1) + 1) / 2;
      const {path} = paths[Math.min(Math.floor(share * TRAIL_SHADES), TRAIL_SHADES - 1)];
      path.moveTo(at.x(x0), at.y(y0));
      path.lineTo(at.x(x1), at.y(y1));
    }
  }
  return paths;
}

// The legend of the trails' colours, in words and numbers.
function trailKey(clock, scene) {
  const tightness = tightnessOf(clock, scene);
  if (!tightness) return [];
  const {names, node, scale} = tightness;
  const block = element("i", {class: "block"});
  block.style.cssText = `width: 5rem; height: 0.6rem; background: linear-gradient(to right, ${MAP.join(", ")})`;
  const unit = spaced(declaredUnit(node) || (node.divisor === 1 ? "" : clock.run.lengths));
  return [element("span", {}, numberText(-scale), block, `${numberText(scale)}${unit}`),
    element("span", {}, `trail of ${names.join(" and ")}: `, element("code", {}, shortened(node.text, 48)), " at each place")];
}

// A line through the middles of an object, with a gap where it was absent.
function drawTrail(context, entity, first, last, at) {
  entity.middles ??= middlesOf(entity);
  context.beginPath();
  let isPresent = false;
  for (let frame = first; frame <= last; frame++) {
    const x = entity.middles[2 * frame], y = entity.middles[2 * frame + 1];
    if (Number.isNaN(x)) {
      isPresent = false;
      continue;
    }
    if (isPresent) context.lineTo(at.x(x), at.y(y));
    else context.moveTo(at.x(x), at.y(y));
    isPresent = true;
  }
  context.stroke();
}

// The middle of an entity's first ring in each frame, x and y in turn.
function middlesOf(entity) {
  const middles = new Float64Array(2 * entity.form.length).fill(NaN);
  for (let frame = 0; frame < entity.form.length; frame++) {
    if (!isThere(entity, frame)) continue;
    const [corners] = entity.forms[entity.form[frame]];
    const start = entity.starts[frame];
    for (const axis of [0, 1]) {
      let sum = 0;
      for (let corner = 0; corner < corners; corner++) sum += entity.points[start + 2 * corner + axis];
      middles[2 * frame + axis] = sum / corners;
    }
  }
  return middles;
}

// The arrow at the atom that decided the chosen result; null outside the deciding sample.
function pointerAt({run, result, sample}) {
  const pointer = run.results[result]?.pointer;
  return pointer && indexAt(run.times, pointer.time) === sample ? pointer : null;
}

function captionOf(clock, scene, frame) {
  const words = wordsOf(clock, scene, frame);
  const {results} = clock.run;
  return results.length > 1 && !words.join("").includes(results[clock.result].title)
    ? [`${results[clock.result].title}: `, ...words] : words;
}

function wordsOf(clock, scene, frame) {
  const {run} = clock;
  const pointer = pointerAt(clock);
  if (pointer) {
    const {title, left_open: between} = run.results[clock.result];
    if (between) {
      return ["the grey arrow, what leaves the verdict open: ", element("code", {}, pointer.text),
        ` of ${title} lies ${minusWords(between)}`];
    }
    if (pointer.is_condition) {
      return ["the arrow: ", element("code", {}, pointer.text),
        ` of ${run.results[clock.result].title} held here, and what had to follow did not`];
    }
    return [`the arrow, ${roleWords(pointer)}: `, element("code", {}, pointer.text),
      ` of ${run.results[clock.result].title} ${signWords(pointer.number, run.lengths)}`];
  }
  const violation = violationAt(clock, scene, frame);
  if (violation) return ["the arrow: ", ...violationWords(run, scene.times[frame], violation)];
  const chosen = run.results.slice(clock.result, clock.result + 1);
  const open = requirementsAt(chosen, clock.sample);
  const inState = (state) => open.filter(({standing}) => standing === state);
  // a condition of an implication is no failure; after the result is violated, only invariants still count
  const isLost = chosen.some((result) =>
    statusOf(run, result, result.nodes[0], placeIn(result, clock.sample)) === "violated");
  const violated = inState(VIOLATED).filter((each) => !each.isCondition && (each.isInvariant || !isLost));
  const decided = decidedAt(clock);
  if (decided) return decided;
  if (violated.length) return [...failureWords(violated[0]), others(violated), "; no arrow shows it"];
  const unknown = inState(UNKNOWN);
  if (unknown.length) {
    return ["no violation is known now; ", ...partWords(unknown[0]), " is unknown", others(unknown)];
  }
  // nothing is pending after the last sample, and the condition of an implication need not come true
  const pending = clock.isAtEnd ? [] : inState(PENDING).filter((each) => !each.isCondition && each.isDue);
  if (pending.length) {
    return [`nothing is violated now${lostBefore(clock)}; `, ...partWords(pending[0]), " is still to come",
      others(pending)];
  }
  if (open.length) return [`nothing is violated now${lostBefore(clock)}`];
  const more = chosen.some((result) => result.requirements.length) ? "more " : "";
  return [`no ${more}requirements on the objects: ${coloursNow(clock, scene, frame)}${lostBefore(clock)}`];
}

// Words for the colours of objects without further requirements: objects with fulfilled requirements stay blue.
function coloursNow(clock, scene, frame) {
  const colourAt = coloursOf(clock, scene, frame);
  const isBlue = scene.entities.some((entity) => {
    if (entity.kind !== "object" || !isThere(entity, frame)) return false;
    const [red, , blue] = colourAt(entity);
    return blue > red;
  });
  return isBlue ? "blue ones have fulfilled theirs, grey ones had none" : "they are grey";
}

// Words for the part that decided the chosen result, in the deciding sample, where no arrow shows the part.
function decidedAt({run, sample, result: chosen}) {
  const result = run.results[chosen];
  if (!result || result.fault === null || result.decided === null) return null;
  const place = placeIn(result, sample), node = result.nodes[result.decided];
  if (indexAt(run.times, result.fault) !== sample || place === null || place >= result.samples) return null;
  const number = node.series[NOW][place] * node.divisor;
  if (Number.isNaN(number)) return null;
  const part = partWords({result, node: {...node, text: result.decided_text || node.text}});
  if (result.left_open) {
    return ["what leaves the verdict open: ", ...part, ` lies ${minusWords(result.left_open)}; no arrow shows it`];
  }
  return ["what decided the verdict: ", ...part,
    ` ${signWords(number, declaredUnit(node))} now; no arrow shows it`];
}

// Words for a chosen result that was violated before; "" if it was not.
function lostBefore({run, sample, result: chosen}) {
  const lost = run.results.slice(chosen, chosen + 1).filter(
    (result) => statusOf(run, result, result.nodes[0], placeIn(result, sample)) === "violated");
  return lost.length ? `; ${lost[0].title} was before${others(lost)}` : "";
}

// Words for the arrow of a violation; only the number if the page leaves the requirement out.
function violationWords(run, time, {result: which, node: index, label, atom, robustness, holds, moment}) {
  const number = holds ? -robustness : robustness;
  if (index < 0) return [`${label.replace(": -", ": −")}, which is violated there`];
  const result = run.results[which], node = result.nodes[index];
  if (moment !== null) {
    return [...partWords({result, node}),
      ` ${signWords(number, run.lengths, true)} at ${secondsText(moment)}, ${roleWords(result.pointer)}`];
  }
  const sample = indexAt(run.times, time), place = placeIn(result, sample);
  if (Math.abs(run.times[sample] - time) < 1e-9 && place !== null && place < result.samples) {
    if (!atom) return failureWords({result, node, place});
    return [...partWords({result, node: {text: atom}}), ` ${signWords(number, run.lengths)} now`];
  }
  // the deciding atom is unknown, because the page of a long run leaves samples out
  return [...partWords({result, node}), ` is violated by ${numberText(-robustness)}${spaced(run.lengths)} now`];
}

function failureWords(part) {
  // the number is in the unit of the log, as beside the arrow
  const node = atomOf(part), number = node.series[NOW][part.place] * node.divisor;
  return [...partWords({...part, node}), ` ${signWords(number, declaredUnit(node))} now`];
}

// Words for the number of a deciding atom. In a violation, an atom that holds must not hold, or is the condition of a
// failed response.
function signWords(number, unit, isPast = false) {
  const [fails, holds] = isPast ? ["failed", "held"] : ["fails", "must not hold, and holds"];
  return `${number < 0 ? fails : holds} by ${numberText(Math.abs(number))}${spaced(unit)}`;
}

// The role of the arrow's atom in the verdict, in words.
function roleWords(pointer) {
  return pointer?.is_response ? "what came nearest to what had to follow" : "what decided the verdict";
}

function partWords({result, node}) {
  return [element("code", {}, node.text), ` of ${result.title}`];
}

function others({length}) {
  return length > 1 ? `, and ${length - 1} more` : "";
}

// Codes for the standing of a requirement in a sample, see annotate/requirements.py.
const FULFILLED = 0, HOLDING = 1, VIOLATED = 2, PENDING = 3, UNKNOWN = 4;

// The requirements of results that count at a sample.
function requirementsAt(results, sample) {
  return results.flatMap((result) => {
    const place = placeIn(result, sample);
    if (place === null || place >= result.samples) return [];
    return result.requirements
      .map(({node, standing, is_condition: isCondition, is_invariant: isInvariant, obligation}) => ({
        result, node: result.nodes[node], place, standing: standing[place], isCondition, isInvariant,
        // the obligation is not met so far; for a response, its condition held
        isDue: obligation && obligation.sign * result.nodes[obligation.node].series[VALUE][place] < 0,
      }))
      .filter(({standing}) => standing !== FULFILLED);
  });
}

// The atom that gives a requirement its number; the requirement itself if the page shows no such atom.
function atomOf({node, place}) {
  const size = Math.abs(node.series[NOW][place]);
  const leaves = (each) => each.children.length ? each.children.flatMap(leaves) : [each];
  return leaves(node).find((leaf) => Math.abs(leaf.series[NOW][place]) === size) ?? node;
}
