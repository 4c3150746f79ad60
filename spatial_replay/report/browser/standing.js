// How a node stands at a sample: in words, in a sign, in a colour.

const STANDINGS = {
  satisfied: {sign: "✓", words: "satisfied", colour: "positive"},
  holding: {sign: "+", words: "holds so far", colour: "positive"},
  violated: {sign: "✕", words: "violated", colour: "negative"},
  failing: {sign: "−", words: "fails so far", colour: "negative"},
  unknown: {sign: "?", words: "unknown", colour: "neutral"},
  absent: {sign: "·", words: "not evaluated here", colour: "neutral"},
};

// A node that is asked at the first sample alone stands as its value on the samples so far, and, once they are
// all there, as its verdict; one below a temporal operator stands as it does at the sample.
function standingOf(run, result, node, place) {
  const last = result.samples - 1;
  if (place === null || (place > last && !node.asked)) return "absent";
  const [value, now, lower, upper] = node.series;
  if (!node.asked) return signOf(now[place]);
  if (place >= last) return node.verdict;
  if (run.settles && lower[place] >= 0) return "satisfied";
  if (run.settles && upper[place] < 0) return "violated";
  return signOf(value[place]);
}

function signOf(number) {
  if (number >= 0) return "holding";
  return number < 0 ? "failing" : "unknown";
}

// Stretches of a node's samples during which it stands in one way: [from, to, standing], in seconds.
function stretchesOf(run, result, node) {
  const stretches = [];
  const {times, samples} = result;
  let from = 0, standing = samples ? standingOf(run, result, node, 0) : "absent";
  for (let place = 1; place < samples; place++) {
    const after = standingOf(run, result, node, place);
    if (after === standing) continue;
    stretches.push([times[from], times[place], standing]);
    from = place;
    standing = after;
  }
  if (samples) stretches.push([times[from], run.times[run.times.length - 1], standing]);
  return stretches;
}

function mark(standing) {
  return element("span", {class: `mark is-${standing}`, "aria-hidden": "true"}, STANDINGS[standing].sign);
}

function setMark(made, standing) {
  made.className = `mark is-${standing}`;
  made.textContent = STANDINGS[standing].sign;
}
