// Elements of the page. Texts are inserted as text, never as HTML.

const SVG = "http://www.w3.org/2000/svg";
const FONT = "12px system-ui, sans-serif";

function element(tag, attributes = {}, ...content) {
  return filled(document.createElement(tag), attributes, content);
}

function svg(tag, attributes = {}, ...content) {
  return filled(document.createElementNS(SVG, tag), attributes, content);
}

function filled(made, attributes, content) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...content.filter((each) => each !== null && each !== undefined));
  return made;
}

function body(name) {
  return document.getElementById(`${name}-body`);
}

// A sentence from parts that are text and code in turn. Code keeps the ASCII minus, as in specifications.
function withCode(parts) {
  return parts.map((part, number) => number % 2 ? element("code", {}, part) : minusWords(part));
}

function secondsText(seconds) {
  return `${seconds.toFixed(3)} s`;
}

function numberText(number) {
  if (Number.isNaN(number)) return "?";
  if (!Number.isFinite(number)) return number > 0 ? "∞" : "−∞";
  if (number === 0) return "0";
  const size = Math.abs(number);
  const text = size >= 1e5 || size < 1e-4 ? size.toExponential(2) : String(Number(size.toPrecision(4)));
  return `${number < 0 ? "−" : ""}${text.replace("-", "−")}`;
}

// A text with the minus sign and ∞ of `numberText` in its numbers; names such as run-1 keep their hyphens.
function minusWords(text) {
  return text.replace(/(?<![\p{L}\p{N}_.\]-])-(?=[\d.]|inf\b)/gu, "−").replace(/(?<![\p{L}\p{N}_.-])inf\b/gu, "∞");
}

// A legend of grounds, each with its words, height and opacity.
function key(entries) {
  return element("p", {class: "key"}, ...entries.map(({ground, words, height = 0.8, opacity = 1}) => {
    const block = element("i", {class: `block ${ground}`});
    block.style.height = `${height * 0.75}rem`;
    block.style.opacity = opacity;
    return element("span", {}, block, words);
  }));
}

// The value of a colour by name; a viewer has the colours of the panels.
function colour(name) {
  return getComputedStyle(document.querySelector(".spatial-replay") ?? document.documentElement).getPropertyValue(`--${name}`).trim();
}

// A canvas that is as sharp as the screen, with units of CSS pixels; draws again whenever its size changes.
function canvas(label, draw) {
  const made = element("canvas", {role: "img", "aria-label": label});
  const redraw = () => {
    const {clientWidth: width, clientHeight: height} = made;
    if (!width || !height) return;
    const ratio = window.devicePixelRatio || 1;
    if (made.width !== Math.round(width * ratio) || made.height !== Math.round(height * ratio)) {
      made.width = Math.round(width * ratio);
      made.height = Math.round(height * ratio);
    }
    const context = made.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    draw(context, width, height);
  };
  new ResizeObserver(redraw).observe(made);
  return {made, redraw};
}
