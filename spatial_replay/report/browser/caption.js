// What is violated now, in words below the scene.

function captionOf(clock, film, frame) {
  const {run} = clock;
  const pointed = film.witness.get(frame);
  if (pointed) return ["the arrow: ", ...pointedWords(askedAt(run, indexAt(run.times, film.times[frame])), pointed)];
  const asked = askedAt(run, clock.sample);
  const failing = asked.filter(({robustness}) => robustness < 0);
  if (failing.length) return [...failureWords(failing[0]), others(failing), "; no arrow can point at that"];
  if (film.entities.some((entity) => isViolated(entity, frame))) {
    return ["something is violated now, at which no arrow can point"];
  }
  const unknown = asked.filter(({robustness}) => Number.isNaN(robustness));
  if (unknown.length) {
    return ["nothing that can be seen is violated now; ", ...partWords(unknown[0]), " is unknown", others(unknown)];
  }
  if (asked.length) return [`nothing is violated now${lostBefore(clock)}`];
  const more = run.results.some((result) => result.concerns.length) ? "more " : "";
  return [`nothing ${more}is asked of the objects: they are grey${lostBefore(clock)}`];
}

// Which results are violated by what was before.
function lostBefore({run, sample}) {
  const lost = run.results.filter(
    (result) => standingOf(run, result, result.nodes[0], placeIn(result, sample)) === "violated");
  return lost.length ? `; ${lost[0].title} was before${others(lost)}` : "";
}

// The arrow is at the least of what is asked; where the page does not have that, its number is all there is to say.
function pointedWords(asked, {label}) {
  const finite = asked.filter(({robustness}) => robustness > -Infinity);
  const worst = finite.reduce((one, other) => other.robustness < one.robustness ? other : one, finite[0]);
  const isMeant = worst && Math.abs(worst.robustness - Number(label)) <= 0.01 * Math.abs(worst.robustness);
  return isMeant ? failureWords(worst) : [`what is violated there, by ${label.replace("-", "")}`];
}

function failureWords(part) {
  const node = atomOf(part), number = node.series[NOW][part.place];
  const how = number < 0 ? "fails" : "must not hold, and does";
  return [...partWords({...part, node}), ` ${how} by ${numberText(Math.abs(number))} now`];
}

function partWords({result, node}) {
  return [element("code", {}, node.text), ` of ${result.title}`];
}

function others({length}) {
  return length > 1 ? `, and ${length - 1} more` : "";
}

// Whether an entity has a colour between grey and vermillion.
function isViolated(entity, frame) {
  if (entity.form[frame] === ABSENT) return false;
  const place = 3 * entity.shown[frame];
  return entity.colours[place] > entity.colours[place + 2];
}
