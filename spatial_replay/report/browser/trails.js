// Trails: where the objects of a scene were a short while before.

// The part of the film that trails reach back over.
const REACH = 0.15;

function drawTrails(context, film, frame, at) {
  const first = Math.max(0, frame - Math.ceil(REACH * film.times.length));
  context.save();
  context.strokeStyle = colour("quiet");
  context.globalAlpha = 0.6;
  context.lineWidth = 1;
  for (const entity of film.entities) {
    if (entity.kind === "object") drawTrail(context, entity, first, frame, at);
  }
  context.restore();
}

// A line through the middles of an object, with a gap where it was not seen.
function drawTrail(context, entity, first, last, at) {
  entity.middles ??= middlesOf(entity);
  context.beginPath();
  let isSeen = false;
  for (let frame = first; frame <= last; frame++) {
    const x = entity.middles[2 * frame], y = entity.middles[2 * frame + 1];
    if (Number.isNaN(x)) {
      isSeen = false;
      continue;
    }
    if (isSeen) context.lineTo(at.x(x), at.y(y));
    else context.moveTo(at.x(x), at.y(y));
    isSeen = true;
  }
  context.stroke();
}

// The middle of an entity's first ring in each frame, x and y in turn.
function middlesOf(entity) {
  const middles = new Float64Array(2 * entity.form.length).fill(NaN);
  for (let frame = 0; frame < entity.form.length; frame++) {
    if (entity.form[frame] === ABSENT) continue;
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
