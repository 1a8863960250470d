// The surfaces of a scan as points that turn with the mouse: reads surface.ply, draws on a canvas.
import { begin, by, complain, make, nest, pageOf, query, reach, scanName } from "./common.js";

const SIZE_PX = 3;
const NORMAL_MM = 12;
const FEW_NORMALS = 400;
const NO_VALUE = "#9aa3ad";
// Viridis, from low to high.
const COLOURS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
const COLOUR_NAMES = { permittivity: "permittivity, real part", loss: "loss", permittivity_std: "standard error", incidence_deg: "incidence, degrees", segment: "surface" };
const canvas = by("points");
const pen = canvas.getContext("2d");
const view = { turn: 0, rise: 0, zoom: 1 };
let cloud = null;
let middle = [0, 0, 0];
let reach_mm = 1;

/** Columns of a binary little-endian PLY of which all properties take four bytes, by name. */
export function readPly(buffer) {
  const bytes = new Uint8Array(buffer);
  const mark = "end_header\n";
  const head = new TextDecoder("ascii").decode(bytes.subarray(0, 4096));
  const end = head.indexOf(mark) + mark.length;
  const lines = head.slice(0, end).split("\n");
  const count = +lines.find((line) => line.startsWith("element vertex")).split(" ")[2];
  const comment = lines.find((line) => line.startsWith("comment"))?.slice(8) ?? "";
  const properties = lines.filter((line) => line.startsWith("property")).map((line) => line.split(" ").slice(1));
  const data = new DataView(buffer, end);
  const columns = { count, comment };
  properties.forEach(([type, name], place) => {
    const values = new Float32Array(count);
    for (let i = 0; i < count; i++) {
      const at = 4 * (i * properties.length + place);
      values[i] = type === "int" ? data.getInt32(at, true) : data.getFloat32(at, true);
    }
    columns[name] = values;
  });
  return columns;
}

function colourOf(value, low, high) {
  if (!Number.isFinite(value)) return NO_VALUE;
  const place = Math.min(1, Math.max(0, (value - low) / (high - low || 1))) * (COLOURS.length - 1);
  const first = Math.min(COLOURS.length - 2, Math.floor(place));
  const mixed = COLOURS[first].map((part, i) => Math.round(part + (COLOURS[first + 1][i] - part) * (place - first)));
  return `rgb(${mixed.join(" ")})`;
}

/** Turned place of a vector: x to the right, y up, z away from the rig. */
function turned(x, y, z) {
  const [c, s, cr, sr] = [Math.cos(view.turn), Math.sin(view.turn), Math.cos(view.rise), Math.sin(view.rise)];
  const across = c * x + s * z;
  const away = c * z - s * x;
  return [across, cr * y + sr * away, cr * away - sr * y];
}

/** The lowest and the highest of the values that are numbers. */
function findEnds(values) {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) {
    if (!Number.isFinite(value)) continue;
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  return [low, high];
}

function draw() {
  if (!cloud) return;
  const shown = cloud[by("colour").value];
  const [low, high] = findEnds(shown);
  const scale = (0.45 * Math.min(canvas.width, canvas.height) * view.zoom) / reach_mm;
  const place = (x, y) => [canvas.width / 2 + scale * x, canvas.height / 2 - scale * y];
  const points = Array.from({ length: cloud.count }, (_, i) => [i, ...turned(cloud.x[i] - middle[0], cloud.y[i] - middle[1], cloud.z[i] - middle[2])]);
  points.sort((a, b) => b[3] - a[3]); // far ones first
  pen.clearRect(0, 0, canvas.width, canvas.height);
  for (const [i, x, y] of points) {
    const [across, down] = place(x, y);
    pen.fillStyle = colourOf(shown[i], low, high);
    pen.fillRect(across - SIZE_PX / 2, down - SIZE_PX / 2, SIZE_PX, SIZE_PX);
  }
  if (by("normals").checked) {
    const every = Math.ceil(cloud.count / FEW_NORMALS);
    pen.strokeStyle = getComputedStyle(canvas).color;
    pen.beginPath();
    for (const [i, x, y] of points) {
      if (i % every) continue;
      const [nx, ny] = turned(cloud.nx[i], cloud.ny[i], cloud.nz[i]);
      pen.moveTo(...place(x, y));
      pen.lineTo(...place(x + NORMAL_MM * nx, y + NORMAL_MM * ny));
    }
    pen.stroke();
  }
  by("scale").textContent = low <= high ? `${COLOUR_NAMES[by("colour").value]}: ${low.toFixed(2)} (dark) to ${high.toFixed(2)} (bright); grey: none` : "no surface has this figure";
}

function turnBy(turn, rise) {
  view.turn += turn;
  view.rise = Math.max(-1.5, Math.min(1.5, view.rise + rise));
  draw();
}

function zoomBy(factor) {
  view.zoom = Math.max(0.2, Math.min(20, view.zoom * factor));
  draw();
}

canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
canvas.addEventListener("pointermove", (event) => { if (event.buttons) turnBy(event.movementX / 150, -event.movementY / 150); });
canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoomBy(Math.exp(-event.deltaY / 500)); }, { passive: false });
canvas.addEventListener("keydown", (event) => {
  const keys = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
  if (keys[event.key]) { event.preventDefault(); turnBy(...keys[event.key]); }
  if (event.key === "+") zoomBy(1.2);
  if (event.key === "-") zoomBy(1 / 1.2);
});
by("colour").addEventListener("change", draw);
by("normals").addEventListener("change", draw);
by("front").addEventListener("click", () => { Object.assign(view, { turn: 0, rise: 0, zoom: 1 }); draw(); });

async function start() {
  by("scan").href = pageOf("scan", scanName);
  nest(by("colour"), ...Object.entries(COLOUR_NAMES).map(([value, text]) => make("option", text, null, { value })));
  const reply = await reach("file/surface.ply", { scan: scanName, of: query.get("of") }).catch((error) => {
    if (error.status !== 404) throw error;
    throw Object.assign(error, { what: "no surfaces were measured in this scan", why: "", do: "`polysight surface SCAN --out DIR` measures them" });
  });
  cloud = readPly(await reply.arrayBuffer());
  // A surface without permittivity begins with the first figure that it has: points without one are pale.
  by("colour").value = Object.keys(COLOUR_NAMES).find((name) => cloud[name]?.some(Number.isFinite)) ?? "segment";
  const ends = [cloud.x, cloud.y, cloud.z].map(findEnds);
  middle = ends.map(([low, high]) => (low + high) / 2);
  reach_mm = Math.max(10, ...ends.map(([low, high]) => (high - low) / 2));
  by("name").textContent = `Surfaces of ${scanName}`;
  by("facts").textContent = `${cloud.comment}, ${cloud.count} points`;
  draw();
}

await begin();
start().catch((error) => complain("told", error));
