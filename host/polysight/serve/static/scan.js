// One scan: its images, what was found in them, and what can be done with it.
import { ImageView, caption, outline } from "./view.js";
import { INTERRUPTED, badge, begin, by, bytes, called, address, complain, day, fill, finding, get, make, nest, pageOf, permittivity, picture, post, rich, scanName, showProgram, showScale, signed, STATES, VERDICTS } from "./common.js";
import { Labels } from "./label.js";
import { clearProbe, showProbe } from "./probe.js";

const scan = { scan: scanName };
let server = {}, summary = {}, result = null, view = null, labels = null, shown = "h_amplitude", running = "", loads = 0;
let metal = null, drawsMetal = false; // the box of "Process again"

// --- the head ---

function showHead() {
  by("name").textContent = scanName;
  const [state, level] = STATES[summary.state] ?? [summary.state, "warn"];
  const verdict = VERDICTS[result?.verdict?.level]; // of the same products as everything below
  by("badges").replaceChildren(badge([state, level]), ...(verdict ? [badge(verdict)] : []), ...(summary.simulated ? [make("span", "simulated", "stamp")] : []));
  by("head").dataset.level = verdict?.[1] ?? "";
  const rows = summary.rows ? `${summary.committed} of ${summary.rows} rows` : "";
  by("facts").textContent = [summary.seconds && day(summary.seconds), summary.rig, rows, bytes(summary.bytes), summary.folder].filter(Boolean).join(" · ");
  const recorded = summary.rows > 0, live = ["running", "paused"].includes(summary.state);
  by("watch").hidden = !recorded && summary.state !== "begun";
  by("watch").href = pageOf("watch", scanName);
  by("with").href = `/compare?${new URLSearchParams({ a: scanName })}`;
  by("with").hidden = Boolean(server.only) || !result?.referenced;
  by("resume").hidden = !(server.starts && recorded && !live && summary.committed < summary.rows);
  by("repeat").hidden = !(server.starts && recorded);
  by("repeat").href = `/new?${new URLSearchParams({ from: scanName })}`;
  by("away").hidden = !(server.starts && !live);
  by("process-open").hidden = !(server.starts && recorded && !live);
  by("layers-open").hidden = !(server.starts && result?.patches.length && !live);
  by("report").hidden = !result?.files.some((f) => f.name === "report.html");
  by("report").href = address("file/report.html", scan);
  by("surface").hidden = !result?.files.some((f) => f.name === "surface.ply");
  by("surface").href = pageOf("surface", scanName);
}

function showReasons() {
  by("reasons").replaceChildren(...(result?.verdict?.reasons ?? []).map((reason) => finding(reason)));
}

// --- the images ---

function buildMaps() {
  by("maps").replaceChildren(...result.pictures.map((p) => make("button", p.title, null, { type: "button", value: p.name, "aria-pressed": String(p.name === shown), onclick: () => showMap(p.name) })));
}

async function showMap(name) {
  const { generation } = result;
  shown = name;
  markMap();
  try {
    const made = await picture(`map/${name}`, { ...scan, generation });
    if (shown === name && result?.generation === generation) drawMap(made); // another was asked for meanwhile
  } catch (error) { if (error.code !== "mismatch") complain("told", error); } // the next look loads the new products
}

function markMap() {
  for (const button of by("maps").children) button.setAttribute("aria-pressed", String(button.value === shown));
}

function drawMap(made) {
  view.show({ image: made?.image });
  showScale(by("scale"), made, result.pictures.find((p) => p.name === shown)?.colours);
}

/** Outlines of the patches and boxes drawn by hand, over the image. */
function overlay(pen, at) {
  for (const patch of labels?.open ? [] : result.patches) {
    outline(pen, () => {
      pen.beginPath();
      patch.outline_mm.forEach(([x, y], i) => pen[i ? "lineTo" : "moveTo"](...at(x, y)));
      pen.closePath();
      pen.stroke();
    }, patch.metal_reference ? "#f2b632" : "#ffffff");
    const [x0, y0, x1, y1] = patch.box_mm, [x, y] = at((x0 + x1) / 2, y1 - 0.25 * (y1 - y0));
    const words = `${patch.label} ${patchName(patch)}`, isWide = at(x1, y1)[0] - at(x0, y0)[0] > 7.5 * words.length;
    caption(pen, isWide ? words : String(patch.label), x, y); // names of neighbours would overlap on a phone
  }
  labels?.overlay(pen, at);
  if (metal) {
    const [x0, y1] = at(metal[0], metal[1]), [x1, y0] = at(metal[2], metal[3]);
    outline(pen, () => pen.strokeRect(x0, y0, x1 - x0, y1 - y0), "#f2b632");
    caption(pen, "metal", (x0 + x1) / 2, (y0 + y1) / 2);
  }
}

/** The box that is metal when the scan is processed again; a second press takes it back. */
function setMetal(box) {
  metal = box;
  drawsMetal = false;
  by("draw-metal").textContent = box ? `Metal reference: ${box.map((v) => signed(v)).join(", ")} mm` : "Metal reference: found automatically";
  drawing(labels?.open);
}

function drawing(on) {
  view.drawing = Boolean(on);
  by("view").classList.toggle("drawing", Boolean(on));
  by("draw-metal").setAttribute("aria-pressed", String(drawsMetal));
  view.draw();
}

const patchName = (p) => (p.metal_reference ? "metal reference" : p.refused ? "not judged" : called(p.name));

function showPatches() {
  by("patches").hidden = !result.patches.length;
  const layered = by("layers-patch").value;
  const options = result.patches.filter((p) => !p.metal_reference).map((p) => make("option", `${p.label} ${patchName(p)}`, null, { value: p.label }));
  by("layers-patch").replaceChildren(...options);
  if (options.some((option) => option.value === layered)) by("layers-patch").value = layered;
  by("patches-note").textContent = result.metal ? `metal reference: ${result.metal}` : "";
  fill(by("rows"), result.patches.map((p) => {
    const row = make("tr", null, null, { id: `patch-${p.label}` });
    const sure = p.confidence === null || p.confidence === undefined || p.name === "unknown" ? "" : ` ${Math.round(100 * p.confidence)} %`;
    const dominated = p.permittivity?.dominated_by ?? "", why = p.refused ? `${p.refused.what}: ${p.refused.why}` : p.why ?? "";
    const name = nest(make("td", `${patchName(p)}${p.metal_reference ? "" : sure}`), ...(p.box ? [make("div", `drawn as ${p.box}`, "soft")] : []));
    const error = nest(make("td", dominated), ...(p.permittivity?.do ? [nest(make("div", null, "soft"), ...rich(p.permittivity.do))] : []));
    row.append(make("td", String(p.label)), name, make("td", permittivity(p.permittivity)), error, make("td", String(p.pixels), "n"), nest(make("td"), ...rich(why)));
    return row;
  }));
}

async function pick(x, y) {
  if (labels?.open) return;
  const { generation } = result;
  const found = await showProbe({ ...scan, generation }, x, y, by("library").value, () => result?.generation === generation);
  for (const row of by("rows").children) row.classList.toggle("here", row.id === `patch-${found?.patch?.label}`);
}

// --- files ---

function showFiles() {
  const files = result?.files ?? [];
  by("files").hidden = !files.length;
  by("file-list").replaceChildren(...files.map((f) => nest(make("li"), make("a", f.name, null, { href: address(`file/${f.name}`, { ...scan, of: f.of }) }), make("span", ` ${bytes(f.bytes)}`, "soft"))));
  by("export").hidden = !(server.starts && files.length);
  const path = JSON.stringify(summary.folder ?? "");
  by("code").textContent = `from polysight import open_scan\n\nscan = open_scan(${path})\nscan.materials()\nscan.plot()`;
}

// --- what runs ---

/** The programs that a page started for this scan; when one ends, everything is looked at again. */
async function follow() {
  let now;
  try { now = await get("scan", scan); } catch (error) { complain("told", error); return; }
  summary = now;
  const [program] = summary.programs;
  const fits = program?.kind === "permittivity" && program.status === 0; // its result stands beside the form
  showProgram(program, !fits && (program?.running || program?.status !== 0 || running !== ""));
  const was = running;
  running = program?.running ? program.kind : "";
  if (fits && was) by("layers-told").textContent = `In the stack: ${program.log.split("in the stack").at(-1).trim()}`;
  showHead();
  if ((was && !running) || (hasProducts() && summary.generation !== result?.generation)) await load();
  if (running) by("told").textContent = "";
}

async function run(path, body, told = "told") {
  complain(told);
  try {
    by(told).textContent = "Starting…";
    await post(path, scan, body);
    complain(told);
    running = path;
    await follow();
  } catch (error) { complain(told, error); }
}

// --- notes ---

let noted; // as they were read: the server refuses to overwrite others

async function saveNotes() {
  try {
    const tags = by("tags").value.split(",").map((t) => t.trim()).filter(Boolean);
    const told = await post("notes", scan, { notes: by("notes-text").value, tags, base: noted });
    noted = { notes: told.notes, tags: told.tags };
    by("tags").value = told.tags.join(", ");
    complain("notes-told");
    by("notes-told").textContent = "Saved.";
  } catch (error) { complain("notes-told", error); }
}

// --- begin ---

const hasProducts = () => summary.processed || summary.images_only;

/** Read result and image before anything is shown: the page goes from one generation of products to the next at once. */
async function load() {
  const turn = ++loads;
  let next = null, made = null, map = shown;
  try {
    if (hasProducts()) next = await get("result", scan);
    if (next && !next.pictures.some((p) => p.name === map)) map = "h_amplitude";
    if (next) made = await picture(`map/${map}`, { ...scan, generation: next.generation });
  } catch (error) {
    if (["mismatch", INTERRUPTED].includes(error.code)) return; // replaced, or a command went first: the next look loads them
    complain("told", error);
  }
  if (turn !== loads) return;
  if (next?.generation !== result?.generation) clearProbe();
  result = next;
  shown = map;
  showHead();
  showReasons();
  showFiles();
  for (const id of ["images", "patches"]) by(id).hidden = !result;
  by("probe").hidden = !result || Boolean(labels?.open);
  by("label-open").hidden = !(result && server.control);
  if (!result) {
    if (!by("told").textContent) by("told").textContent = summary.rows ? "Not processed yet." : "";
    return;
  }
  by("use-labels").disabled = !result.labels;
  by("use-labels").checked = Boolean(result.labels);
  if (!view || String(view.extent) !== String(result.extent_mm)) {
    view = new ImageView(by("view"), { extent: result.extent_mm, label: "Image of the scan", overlay, onpick: pick, onbox: (box) => (drawsMetal ? setMetal(box) : labels.add(box)) });
  }
  labels ??= new Labels(scan, () => view.draw(), (open) => {
    by("label-open").setAttribute("aria-pressed", String(open));
    drawing(open);
  });
  labels.load(result);
  buildMaps();
  showPatches();
  drawMap(made);
}

by("resume").addEventListener("click", async () => {
  await run("resume", {});
  if (running) location.href = pageOf("watch", scanName);
});
by("label-open").addEventListener("click", () => labels.toggle());
for (const id of ["process", "layers"]) {
  by(`${id}-open`).addEventListener("click", () => {
    by(id).hidden = !by(id).hidden;
    by(`${id}-open`).setAttribute("aria-expanded", String(!by(id).hidden));
  });
}
by("process").addEventListener("submit", (event) => {
  event.preventDefault();
  by("process-open").click();
  run("process", { library: by("library").value, labels: by("use-labels").checked, metal, bands: +by("bands").value || null,
    sparse: by("sparse").checked });
});
by("layers").addEventListener("submit", (event) => {
  event.preventDefault();
  const layers = by("layers-text").value.split("\n").map((line) => line.trim()).filter(Boolean);
  run("layers", { patch: +by("layers-patch").value, layers }, "layers-told");
});
by("draw-metal").addEventListener("click", () => {
  if (metal || drawsMetal) { setMetal(null); return; }
  drawsMetal = true;
  by("draw-metal").textContent = "Draw a box on the metal";
  drawing(true);
  by("view").scrollIntoView({ block: "nearest" });
});
by("away-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  try {
    await post(event.submitter.value, scan, { name: by("away-name").value });
    location.href = "/";
  } catch (error) { complain("away-told", error); }
});
by("export").addEventListener("submit", (event) => {
  event.preventDefault();
  run("export", { formats: [...by("export").querySelectorAll("input:checked")].map((i) => i.name) });
});
by("save-notes").addEventListener("click", saveNotes);
by("copy").addEventListener("click", async () => {
  try { await navigator.clipboard.writeText(by("code").textContent); by("copied").textContent = "Copied."; } catch { by("copied").textContent = "Select it and copy."; }
});

server = await begin(scanName);
try {
  summary = await get("scan", scan);
  by("side").hidden = by("snippet").hidden = false;
  if (server.starts) {
    const { libraries, scans } = await get("scans");
    const names = new Set(scans.flatMap((s) => s.labelled.map((name) => name.replace(/#.*/, "")))); // the same word in all scans
    by("known").append(...[...names].sort().map((value) => make("option", null, null, { value })));
    by("library").append(...libraries.map((name) => make("option", name, null, { value: name })));
  }
  noted = { notes: summary.notes, tags: summary.tags };
  by("notes-text").value = summary.notes;
  by("tags").value = summary.tags.join(", ");
  by("save-notes").hidden = !server.control;
  by("notes-text").readOnly = by("tags").readOnly = !server.control;
  await load();
  await follow();
  setInterval(() => { if (!document.hidden) follow(); }, 2000);
} catch (error) { complain("told", error); }
