// A new scan: its plan while it is typed, the doctor's findings, and the start.
import { badge, begin, by, bytes, complain, get, make, nest, pageOf, post, rich, span } from "./common.js";
import "./stage.js";

const NUMBERS = ["columns", "rows", "step_x_mm", "step_y_mm", "speed_mm_s", "pulses"];
const LEVELS = { ok: ["ok", "good"], warning: ["warning", "warn"], error: ["error", "bad"], "not checked": ["not checked", "wait"] };
const FRESH_MIN = 10; // a rig that was checked longer ago may have changed
let asked = 0, timer = 0, confirmed = false, rigFile = "", possible = false;

const changes = () => Object.fromEntries(NUMBERS.filter((id) => by(id).value !== "").map((id) => [id, +by(id).value]));
const pair = ([x, y], digits, infinite) => [x, y].map((v) => (v === null ? infinite : v.toFixed(digits))).join(" × ");

function showPlan(p) {
  by("rig").textContent = `${p.rig} · ${p.config}`;
  const { columns, rows, step_x_mm, step_y_mm } = p.begun_with;
  for (const [id, v] of Object.entries({ columns, rows, step_x_mm, step_y_mm, speed_mm_s: p.speed_mm_s, pulses: p.pulses })) by(id).placeholder = v;
  const facts = [["grid", `${p.columns} × ${p.rows} positions, steps of ${p.step_x_mm} × ${p.step_y_mm} mm`], ["raw data", bytes(p.raw_bytes)],
    ["resolution", `${pair(p.point_width_mm, 1, "none")} mm at half power`], ["free of ghosts", `${pair(p.alias_free_mm, 0, "unlimited")} mm`],
    ["noise", `a point as strong as the direct path stands ${p.image_snr_db.toFixed(0)} dB over it (${p.noise_source})`]];
  const list = make("dl");
  for (const [name, text] of facts) list.append(make("dt", name), make("dd", text));
  const warnings = make("ul");
  for (const w of p.warnings) warnings.append(nest(make("li", null, w.refused ? "refused" : ""), ...rich(`${w.refused ? "Refused: " : ""}${w.text}`)));
  by("forecast").replaceChildren(make("p", p.possible ? span(p.time_s.total) : "Not possible", "time"), list, warnings);
  rigFile = p.config;
  possible = p.possible;
  allowStart();
}

function allowStart() {
  for (const id of ["start", "enqueue"]) by(id).disabled = !possible || confirmed;
}

async function plan() {
  const mine = ++asked;
  try {
    const told = await post("plan", {}, changes());
    if (mine === asked) { showPlan(told); complain("told"); }
  } catch (error) {
    if (mine !== asked) return;
    possible = false;
    allowStart();
    by("forecast").replaceChildren(make("p", "", "wrong", { id: "plan-wrong" }));
    complain("plan-wrong", inWords(error));
  }
}

/** The same error with fields called as the page calls them, not as the rig file does. */
function inWords(error) {
  const ofField = /^(the request|.*, changed): /; // which field, and what it must be, is all that helps here
  if (ofField.test(error.what)) Object.assign(error, { what: error.what.replace(ofField, ""), why: "", do: "" });
  for (const id of NUMBERS) {
    const label = by(id).parentNode.firstChild.textContent.trim();
    const isMeant = new RegExp(`\\b${id}\\b`).test(error.what ?? "");
    by(id).setAttribute("aria-invalid", String(isMeant));
    for (const part of ["what", "why", "do"]) error[part] = error[part]?.replace(new RegExp(`(plan\\.|grid\\.)?\\b${id}\\b( =)?`, "g"), label);
  }
  error.what = error.what?.replace(/ \([^()]*\bstage\.[^()]*\)$/, ""); // the keys of the rig file
  return error;
}

/** The doctor's lines: a verdict, a check, two spaces or more and what was found; then why and what to do. */
function findings(log) {
  const found = [];
  for (const line of log.split("\n")) {
    const head = /^(ok|warning|error|not checked)\s+(.+?)(?: {2,}(.*))?$/.exec(line), more = /^\s+(why|do): (.*)$/.exec(line);
    if (head) found.push({ verdict: head[1], check: head[2], text: head[3] ?? "", more: [] });
    else if (more && found.length) found.at(-1).more.push(more[2]);
  }
  return found;
}

async function showDoctor() {
  const program = await get("program/doctor");
  if (!program) return;
  by("findings").replaceChildren(...findings(program.log).map((f) => {
    const item = nest(make("li"), nest(make("span"), badge(LEVELS[f.verdict])), nest(make("span"), make("b", `${f.check}: `), ...rich(f.text)));
    for (const text of f.more) item.append(nest(make("span", null, "more"), ...rich(text)));
    return item;
  }));
  const last = program.log.split("\n").at(-1), minutes = Math.round((Date.now() - Date.parse(program.started_utc)) / 60000);
  const isOther = !program.words.includes(rigFile), isOld = minutes >= FRESH_MIN || isOther;
  const errors = findings(program.log).filter((f) => f.verdict === "error").length;
  by("checks").hidden = false;
  by("checks").open = program.running || (errors > 0 && !isOld);
  by("findings").classList.toggle("old", isOld && !program.running);
  by("doctor").disabled = program.running;
  by("doctor-told").textContent = program.running ? "Checking…" : program.status === null ? "Stopped." : last;
  by("rig-note").textContent = program.running ? "" : isOther ? `another rig was checked ${minutes} min ago: check this one` : `checked ${minutes} min ago${isOld ? ": check it again" : ""}`;
  const isWarned = errors > 0 && !isOld && !program.running;
  by("start").className = isWarned ? "danger" : "main";
  by("start").textContent = isWarned ? `Start in spite of ${errors} error${errors > 1 ? "s" : ""}` : "Start the scan";
  if (program.running) setTimeout(showDoctor, 700);
}

function readForm() {
  const metal = by("metal").value.trim();
  return {
    plan: changes(), name: by("name").value.trim(), library: by("library").value, keep_incomplete: by("keep_incomplete").checked,
    metal: metal ? metal.split(",").map(Number) : null, notes: by("notes").value, tags: by("tags").value.split(",").map((t) => t.trim()).filter(Boolean),
  };
}

/** The form as a scan was started, under a name of its own. */
async function fillFrom(scan) {
  const r = await get("request", { scan });
  for (const id of NUMBERS) by(id).value = r.plan[id] ?? "";
  by("library").value = r.library;
  by("metal").value = r.metal?.join(", ") ?? "";
  by("keep_incomplete").checked = r.keep_incomplete;
  by("notes").value = r.notes;
  by("tags").value = r.tags.join(", ");
  by("name").value = `${scan.replace(/-\d{8}-\d{4}$/, "")}-${stamp()}`;
}

const stamp = () => {
  const now = new Date(), two = (n) => String(n).padStart(2, "0");
  return `${now.getFullYear()}${two(now.getMonth() + 1)}${two(now.getDate())}-${two(now.getHours())}${two(now.getMinutes())}`;
};

async function start() {
  complain("told");
  const body = readForm();
  confirmed = true;
  allowStart();
  try {
    await post("start", {}, body);
    location.href = pageOf("watch", body.name);
  } catch (error) { complain("told", error); confirmed = false; allowStart(); }
}

async function enqueue() {
  complain("told");
  if (!by("form").reportValidity()) return;
  try {
    await post("queue", {}, readForm());
    by("told").textContent = "It waits in the queue.";
    by("name").value = `scan-${stamp()}-${Math.floor(Math.random() * 90 + 10)}`;
    await showQueue();
  } catch (error) { complain("told", error); }
}

async function showQueue() {
  const { names, held } = await get("queue");
  by("queue").hidden = !names.length;
  by("held").textContent = held ? `It waits for you: ${held}` : "";
  by("release").hidden = !held;
  by("waiting").replaceChildren(...names.map((name) => nest(make("li", `${name} `), make("button", "Take out", null, {
    type: "button", "aria-label": `Take ${name} out of the queue`, onclick: () => change("unqueue", { name }) }))));
}

async function change(path, body) {
  try { await post(path, {}, body); await showQueue(); } catch (error) { complain("told", error); }
}

for (const id of NUMBERS) by(id).addEventListener("input", () => { clearTimeout(timer); timer = setTimeout(plan, 350); });
by("doctor").addEventListener("click", async () => {
  try {
    await post("doctor");
    complain("doctor-told");
    await showDoctor();
  } catch (error) { complain("doctor-told", error); }
});
by("enqueue").addEventListener("click", enqueue);
by("release").addEventListener("click", () => change("release", {}));
by("form").addEventListener("submit", (event) => { event.preventDefault(); if (!confirmed) start(); });

await begin();
by("name").value = `scan-${stamp()}`;
by("materials").open = innerWidth > 640;
try {
  const { libraries } = await get("scans");
  by("library").append(...libraries.map((name) => make("option", name, null, { value: name })));
  const from = new URLSearchParams(location.search).get("from");
  if (from) await fillFrom(from);
  await plan();
  await showDoctor();
  await showQueue();
  setInterval(() => { if (!document.hidden) showQueue().catch(() => {}); }, 5000);
} catch (error) { complain("told", error); }
