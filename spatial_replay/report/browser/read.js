// Reads the runs that the page carries.

const ARRAYS = {
  f8: Float64Array, f4: Float32Array, i4: Int32Array, u2: Uint16Array, u1: Uint8Array,
};
const VALUE = 0, NOW = 1, LOWER = 2, UPPER = 3;

// Reads one run. In a page of two runs, ids of elements end with the name of the run: facts-a, numbers-a.
async function readRun(name = "") {
  const facts = JSON.parse(document.getElementById(`facts${name}`).textContent, (_, value) => printable(value));
  const buffer = await unpacked(document.getElementById(`numbers${name}`).textContent);
  const arrays = new Map();
  const numbers = (reference) => {
    // the key has the length, because an empty array has the offset of the next array
    const key = `${reference.offset} ${reference.length}`;
    if (!arrays.has(key)) arrays.set(key, unpackArray(reference, buffer));
    return arrays.get(key);
  };
  const times = numbers(facts.times);
  const run = {
    ...facts,
    numbers,
    times,
    results: facts.results.map((result) => readResult(result, numbers, times)),
    outlinesAt: (time) => outlinesAt(run, time),
  };
  return run;
}

// A text with spaces instead of control characters, such as characters that reverse the direction of the text.
function printable(value) {
  return typeof value === "string" ? value.replace(/[\p{C}\p{Z}]/gu, " ") : value;
}

async function unpacked(text) {
  const letters = atob(text);
  const packed = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) packed[i] = letters.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

const CODES = {1: Uint8Array, 2: Uint16Array, 4: Uint32Array, 8: Uint32Array};

// Unpacks an array of `packed_bytes` in report/panels.py: differences of bits, the lowest bytes of all numbers first.
function unpackArray({kind, offset, length}, buffer) {
  const size = ARRAYS[kind].BYTES_PER_ELEMENT;
  const bytes = new Uint8Array(buffer, offset, size * length);
  const codes = new CODES[size](size * length / Math.min(size, 4));
  const byte = (place, plane) => bytes[plane * length + place] << 8 * (plane % 4);
  let low = 0, high = 0;
  for (let place = 0; place < length; place++) {
    let difference = byte(place, 0);
    for (let plane = 1; plane < Math.min(size, 4); plane++) difference |= byte(place, plane);
    const sum = low + (difference >>> 0);
    low = sum >>> 0;
    if (size < 8) codes[place] = low;
    else {
      const upper = byte(place, 4) | byte(place, 5) | byte(place, 6) | byte(place, 7);
      high = (high + (upper >>> 0) + (sum > low ? 1 : 0)) >>> 0;
      codes[2 * place] = low;
      codes[2 * place + 1] = high;
    }
  }
  return new ARRAYS[kind](codes.buffer);
}

function readResult(result, numbers, times) {
  const {first, samples} = result;
  const series = numbers(result.series);
  const nodes = result.nodes.map((node, index) => ({
    ...node,
    index,
    depth: 0,
    children: [],
    // (4, samples) of this node
    series: [VALUE, NOW, LOWER, UPPER].map(
      (quantity) => series.subarray((4 * index + quantity) * samples, (4 * index + quantity + 1) * samples)),
  }));
  for (const node of nodes) {
    if (node.parent === null) continue;
    node.depth = nodes[node.parent].depth + 1;
    nodes[node.parent].children.push(node);
  }
  const requirements = result.requirements.map((each) => ({...each, standing: numbers(each.standing)}));
  const automaton = result.automaton && {...result.automaton, path: numbers(result.automaton.path)};
  return {...result, nodes, requirements, automaton, times: times.subarray(first, first + samples)};
}

// The index of the page's sample in a result: null before the result's first sample, `result.samples` after its last.
function placeIn(result, sample) {
  const place = sample - result.first;
  return place < 0 || !result.samples ? null : Math.min(place, result.samples);
}

// The last index whose time is not later than `time`; 0 before the first time.
function indexAt(times, time) {
  let low = 0, high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time + 1e-9) low = middle + 1;
    else high = middle;
  }
  return Math.max(low - 1, 0);
}

// Reports an error. Verdicts and explanations stay visible, because they are in the page itself.
function sayWhyNot(error) {
  const said = element("p", {class: "notice alert", role: "alert"},
    `This browser cannot show the run: ${error.message}. Verdicts and explanations are complete.`);
  document.getElementById("main").prepend(said);
  console.error(error);
}
