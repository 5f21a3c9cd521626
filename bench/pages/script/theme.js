// Colours, dashes and markers; light and dark.

function dark() {
  const theme = document.documentElement.dataset.theme;
  return theme === "dark" || (theme !== "light" && matchMedia("(prefers-color-scheme: dark)").matches);
}

function styled(look) {
  const [light, night, dashes, marker] = look;
  return { colour: dark() ? night : light, dashes, marker };
}

function ink(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

function faint(colour, share) {
  const [r, g, b] = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
  return `rgba(${r},${g},${b},${share})`;
}

// Outlines of markers by matplotlib's letters, within a circle of radius 1.
const POLYGONS = {
  s: [[-0.8, -0.8], [0.8, -0.8], [0.8, 0.8], [-0.8, 0.8]],
  D: [[0, -1.1], [1.1, 0], [0, 1.1], [-1.1, 0]],
  "^": [[0, -1], [0.95, 0.8], [-0.95, 0.8]],
  v: [[0, 1], [0.95, -0.8], [-0.95, -0.8]],
  "<": [[-1, 0], [0.8, -0.95], [0.8, 0.95]],
  ">": [[1, 0], [-0.8, -0.95], [-0.8, 0.95]],
  P: [[-0.4, -1], [0.4, -1], [0.4, -0.4], [1, -0.4], [1, 0.4], [0.4, 0.4], [0.4, 1], [-0.4, 1], [-0.4, 0.4], [-1, 0.4], [-1, -0.4], [-0.4, -0.4]],
  X: [[0, -0.5], [0.5, -1], [1, -0.5], [0.5, 0], [1, 0.5], [0.5, 1], [0, 0.5], [-0.5, 1], [-1, 0.5], [-0.5, 0], [-1, -0.5], [-0.5, -1]],
  "*": Array.from({ length: 10 }, (_, i) => [Math.sin((i * Math.PI) / 5) * (i % 2 ? 0.5 : 1.2), -Math.cos((i * Math.PI) / 5) * (i % 2 ? 0.5 : 1.2)]),
};

function markerPath(marker, x, y, size) {
  const path = new Path2D();
  const corners = POLYGONS[marker];
  if (!corners) path.arc(x, y, size * 0.9, 0, 2 * Math.PI);
  else corners.forEach(([a, b], i) => (i ? path.lineTo(x + a * size, y + b * size) : path.moveTo(x + a * size, y + b * size)));
  path.closePath();
  return path;
}

// A piece of the line with its marker, for legends.
function swatch(look, draw) {
  const { colour, dashes, marker } = styled(look);
  const picture = shapes("svg", { viewBox: "0 0 34 14", width: 34, height: 14, "aria-hidden": "true" });
  if (draw === "bars") {
    picture.append(shapes("rect", { x: 11, y: 1, width: 12, height: 12, fill: colour }));
    return picture;
  }
  if (draw !== "points") {
    picture.append(shapes("line", { x1: 1, x2: 33, y1: 7, y2: 7, stroke: colour, "stroke-width": 2, "stroke-dasharray": dashes.map((d) => 2 * d).join(" ") || "none" }));
  }
  if (!marker) return picture;
  const corners = POLYGONS[marker];
  picture.append(
    corners
      ? shapes("polygon", { points: corners.map(([a, b]) => `${17 + 4.5 * a},${7 + 4.5 * b}`).join(" "), fill: colour })
      : shapes("circle", { cx: 17, cy: 7, r: 4, fill: colour }),
  );
  return picture;
}
