// What the results ask of objects at a sample: their largest parts without a temporal operator inside.

// The parts of all results that are asked at a sample, each with its robustness in the sign that counts.
function askedAt(run, sample) {
  return run.results.flatMap((result) => {
    const place = placeIn(result, sample);
    if (place === null || place >= result.samples) return [];
    return result.concerns.filter((concern) => !isDone(result, concern, place)).map(({node, sign}) => ({
      result, node: result.nodes[node], place, robustness: sign * result.nodes[node].series[NOW][place],
    }));
  });
}

// Whether no later sample can undo what a part is asked for.
function isDone(result, {duty, duty_sign: sign}, place) {
  if (duty === null) return false;
  const series = result.nodes[duty].series;
  return sign > 0 ? series[LOWER][place] >= 0 : series[UPPER][place] < 0;
}

// The atom that a part has its number from; the part itself where that is none of those shown.
function atomOf({node, place}) {
  const size = Math.abs(node.series[NOW][place]);
  const leaves = (each) => each.children.length ? each.children.flatMap(leaves) : [each];
  return leaves(node).find((leaf) => Math.abs(leaf.series[NOW][place]) === size) ?? node;
}
