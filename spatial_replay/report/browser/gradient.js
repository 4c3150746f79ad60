// Gradient maps: where an object would do how well, as pictures.

// How far the colour of the slightest robustness is from grey, and how much of a map's colours covers the page.
const LEAST = 0.4, OPACITY = 0.6;

// The picture of a map, a pixel for each cell, lowest row at the bottom; what is blocked stays clear.
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
  const good = rgb(run.palette.positive), bad = rgb(run.palette.negative), grey = rgb(run.palette.neutral);
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < map.columns; column++) {
      const number = values[row * map.columns + column];
      if (Number.isNaN(number)) continue;
      const place = 4 * ((rows - 1 - row) * map.columns + column);
      const share = LEAST + (1 - LEAST) * (map.scale > 0 ? Math.min(Math.abs(number) / map.scale, 1) : 0);
      const hue = number >= 0 ? good : bad;
      for (let part = 0; part < 3; part++) image.data[place + part] = grey[part] + share * (hue[part] - grey[part]);
      image.data[place + 3] = 255;
    }
  }
  context.putImageData(image, 0, 0);
  return made;
}

function rgb(text) {
  return [1, 3, 5].map((place) => parseInt(text.slice(place, place + 2), 16));
}

// How a part of the plane is shown in a rectangle of the screen, as large as fits, y upwards.
function projection(low, high, width, height, margin) {
  const scale = Math.min((width - 2 * margin) / (high[0] - low[0]), (height - 2 * margin) / (high[1] - low[1]));
  const left = (width - scale * (high[0] - low[0])) / 2, bottom = (height + scale * (high[1] - low[1])) / 2;
  return {
    scale,
    x: (x) => left + scale * (x - low[0]),
    y: (y) => bottom - scale * (y - low[1]),
  };
}

function drawMap(context, run, map, at) {
  const left = at.x(map.low[0]), top = at.y(map.high[1]);
  const width = at.x(map.high[0]) - left, height = at.y(map.low[1]) - top;
  hatch(context, left, top, width, height);
  context.save();
  context.imageSmoothingEnabled = false;
  context.globalCompositeOperation = "destination-out";
  context.drawImage(pictureOf(run, map), left, top, width, height);
  context.globalCompositeOperation = "source-over";
  context.globalAlpha = OPACITY;
  context.drawImage(pictureOf(run, map), left, top, width, height);
  context.restore();
}

// Oblique lines, which stay where a map is clear.
function hatch(context, left, top, width, height) {
  context.save();
  context.beginPath();
  context.rect(left, top, width, height);
  context.clip();
  context.strokeStyle = colour("neutral");
  context.lineWidth = 1;
  context.beginPath();
  for (let x = left - height; x < left + width; x += 7) {
    context.moveTo(x, top + height);
    context.lineTo(x + height, top);
  }
  context.stroke();
  context.restore();
}

// Points x and y in turn, as a line.
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

function drawTarget(context, target, at) {
  if (!target) return;
  const [x, y] = target;
  context.save();
  context.strokeStyle = colour("ink");
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
