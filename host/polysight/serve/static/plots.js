// Plots of the live view: lines on axes as SVG, and the raster with the stage on it.
const SVG = "http://www.w3.org/2000/svg";

function add(parent, name, attributes, text) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== undefined) node.textContent = text;
  parent.append(node);
  return node;
}

/** About n round numbers from low to high. */
export function ticks(low, high, n) {
  const raw = (high - low) / n;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9; i++) found.push(+(i * step).toPrecision(10));
  return found;
}

/** An empty drawing as large as its place, with the values of its upright axis: x from `left` to `right`, y by `py`. */
function frame(place, [low, high], left, below) {
  const width = place.clientWidth || 320, height = place.clientHeight || 230;
  const right = width - 14, top = 22, bottom = height - below;
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const py = (v) => bottom - ((v - low) / (high - low)) * (bottom - top);
  for (const v of ticks(low, high, 4)) {
    add(svg, "line", { x1: left, x2: right, y1: py(v), y2: py(v), class: "axis" });
    add(svg, "text", { x: left - 5, y: py(v) + 4, "text-anchor": "end" }, v);
  }
  place.replaceChildren(svg);
  return { svg, width, height, right, top, bottom, py };
}

/**
 * Lines on axes. what: { x: [low, high], y: [low, high], xLabel, yLabel, lines: [{ x, y, style, name }],
 * upright: [{ x, name }], level: [{ y, name }], scene: [low, high] with its name }. Points whose y is null are left out.
 */
export function plot(place, what) {
  const left = 42, { svg, width, height, right, top, bottom, py } = frame(place, what.y, left, 34);
  const px = (v) => left + ((v - what.x[0]) / (what.x[1] - what.x[0])) * (right - left);
  if (what.scene) {
    const [a, b] = what.scene.map((v) => Math.min(right, Math.max(left, px(v))));
    add(svg, "rect", { x: a, y: top, width: b - a, height: bottom - top, class: "scene" });
    add(svg, "text", { x: (a + b) / 2, y: top + 10, "text-anchor": "middle" }, what.sceneName);
  }
  for (const v of ticks(...what.x, Math.min(6, width / 70))) {
    add(svg, "line", { x1: px(v), x2: px(v), y1: bottom, y2: bottom + 4, class: "axis" });
    add(svg, "text", { x: px(v), y: bottom + 16, "text-anchor": "middle" }, v);
  }
  add(svg, "text", { x: right, y: height - 3, "text-anchor": "end" }, what.xLabel);
  add(svg, "text", { x: 2, y: 12 }, what.yLabel);
  for (const { y } of what.level ?? []) {
    add(svg, "line", { x1: left, x2: right, y1: py(y), y2: py(y), class: "direct" });
  }
  for (const { x, name } of what.upright ?? []) {
    add(svg, "line", { x1: px(x), x2: px(x), y1: top, y2: bottom, class: "direct" });
    add(svg, "text", { x: px(x) + 5, y: top + 10, class: "direct-name" }, name);
  }
  let named = right;
  for (const { x, y, style, name } of [...what.lines].reverse()) {
    let d = "", pen = "M";
    x.forEach((v, i) => {
      if (y[i] === null) { pen = "M"; return; }
      const clipped = Math.min(what.y[1], Math.max(what.y[0], y[i]));
      d += `${pen}${px(v).toFixed(1)} ${py(clipped).toFixed(1)}`;
      pen = "L";
    });
    if (x.length === 1) d += "h3";
    add(svg, "path", { d, class: style });
    const label = add(svg, "text", { x: named, y: 12, "text-anchor": "end", class: style }, name);
    named -= 14 + 8 * label.textContent.length;
  }
  for (const { y, name } of what.level ?? []) {
    add(svg, "text", { x: right - 2, y: py(y) - 5, "text-anchor": "end", class: "direct-name" }, name);
  }
}

/**
 * A control chart. points: [{ value (null: missing), bar, known, band, level, href, name }]; band: half width around
 * `known`, bar: half height of the error bar. A point is a link to its scan.
 */
export function control(place, points, label) {
  const left = 46, ends = points.flatMap((p) => [p.known - p.band, p.known + p.band, ...(p.value === null ? [] : [p.value - p.bar, p.value + p.bar])]);
  let [low, high] = [Math.min(...ends), Math.max(...ends)];
  if (low === high) [low, high] = [low - 0.01, high + 0.01];
  const { svg, height, right, bottom, py } = frame(place, [low, high], left, 24);
  const slot = (right - left) / points.length, px = (i) => left + (i + 0.5) * slot;
  points.forEach((p, i) => {
    const from = px(i) - slot / 2;
    add(svg, "rect", { x: from, y: py(p.known + p.band), width: slot, height: Math.max(py(p.known - p.band) - py(p.known + p.band), 1), class: "known" });
    add(svg, "line", { x1: from, x2: from + slot, y1: py(p.known), y2: py(p.known), class: "value" });
  });
  points.forEach((p, i) => {
    const link = add(svg, "a", { href: p.href, "data-level": p.level, "aria-label": p.name });
    add(link, "title", {}, p.name);
    if (p.value === null) {
      add(link, "circle", { cx: px(i), cy: bottom, r: 5 });
      add(link, "text", { x: px(i), y: bottom - 8, "text-anchor": "middle" }, "missing");
      return;
    }
    add(link, "line", { x1: px(i), x2: px(i), y1: py(p.value - p.bar), y2: py(p.value + p.bar), class: "bar" });
    add(link, "circle", { cx: px(i), cy: py(p.value), r: 5 });
  });
  add(svg, "text", { x: 2, y: 12 }, label);
  add(svg, "text", { x: right, y: height - 3, "text-anchor": "end" }, "scans, oldest to newest");
}

/** The rows as bands (row 0 at the bottom, as y grows upwards), the running row's part, and the stage. */
export function raster(canvas, state, motion) {
  const { columns, rows, step_x_mm: dx, step_y_mm: dy } = state.scan;
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const ratio = window.devicePixelRatio || 1, margin = 7;
  const width = canvas.clientWidth, wide = columns * dx, high = rows * dy;
  const inner = width - 2 * margin;
  const height = Math.min(inner * high / wide, 1.1 * inner) + 2 * margin;
  canvas.style.height = `${height}px`;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  const band = (height - 2 * margin) / rows, gap = band > 6 ? 1 : 0;
  const edge = (row) => Math.round((height - margin - row * band) * ratio) / ratio; // whole pixels: no seams
  const fill = (row, from, width) => pen.fillRect(from, edge(row + 1), width, Math.max(edge(row) - edge(row + 1) - gap, 1 / ratio));
  const colours = { c: colour("--h"), k: colour("--mark-k"), r: colour("--mark-r"), ".": colour("--well") };
  for (let row = 0; row < rows; row++) {
    pen.fillStyle = colours[state.scan.marks[row]];
    fill(row, margin, inner);
  }
  if (motion.row >= 0 && motion.point > 0) {
    const part = inner * Math.min(1, motion.point / columns);
    pen.fillStyle = colour("--ink");
    fill(motion.row, motion.row % 2 ? margin + inner - part : margin, part);
  }
  if (motion.stage) {
    const x = margin + inner * Math.min(1, Math.max(0, motion.stage[0] / wide + 0.5));
    const y = height - margin - (height - 2 * margin) * Math.min(1, Math.max(0, motion.stage[1] / high + 0.5));
    pen.beginPath();
    pen.arc(x, y, 5.5, 0, 7);
    pen.fillStyle = colour("--mark-k");
    pen.fill();
    pen.lineWidth = 2;
    pen.strokeStyle = colour("--ink");
    pen.stroke();
  }
}
