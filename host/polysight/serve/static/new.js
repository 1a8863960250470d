// A new scan: its plan while it is typed, the doctor's findings, and the start.
import { badge, begin, by, bytes, complain, get, make, nest, pageOf, post, rich, span } from "./common.js";

const NUMBERS = ["columns", "rows", "step_x_mm", "step_y_mm", "speed_mm_s", "pulses"];
const LEVELS = { ok: ["ok", "good"], warning: ["warning", "warn"], error: ["error", "bad"], "not checked": ["not checked", "wait"] };
let asked = 0, timer = 0, confirmed = false;

const changes = () => Object.fromEntries(NUMBERS.filter((id) => by(id).value !== "").map((id) => [id, +by(id).value]));
const pair = ([x, y], digits = 1) => [x, y].map((v) => (v === null ? "unlimited" : v.toFixed(digits))).join(" × ");

function showPlan(p) {
  by("rig").textContent = `${p.rig} · ${p.config}`;
  const { columns, rows, step_x_mm, step_y_mm } = p.begun_with;
  for (const [id, v] of Object.entries({ columns, rows, step_x_mm, step_y_mm, speed_mm_s: p.speed_mm_s, pulses: p.pulses })) by(id).placeholder = v;
  const facts = [["grid", `${p.columns} × ${p.rows} positions, steps of ${p.step_x_mm} × ${p.step_y_mm} mm`], ["raw data", bytes(p.raw_bytes)],
    ["resolution", `${pair(p.point_width_mm)} mm at half power`], ["free of ghosts", `${pair(p.alias_free_mm, 0)} mm`],
    ["noise", `a point as strong as the direct path stands ${p.image_snr_db.toFixed(0)} dB over it (${p.noise_source})`]];
  const list = make("dl");
  for (const [name, text] of facts) list.append(make("dt", name), make("dd", text));
  const warnings = make("ul");
  for (const w of p.warnings) warnings.append(nest(make("li", null, w.refused ? "refused" : ""), ...rich(`${w.refused ? "Refused: " : ""}${w.text}`)));
  by("forecast").replaceChildren(make("p", p.possible ? span(p.time_s.total) : "Not possible", "time"), list, warnings);
  by("start").disabled = !p.possible;
}

async function plan() {
  const mine = ++asked;
  try {
    const told = await post("plan", {}, changes());
    if (mine === asked) { showPlan(told); complain("told"); }
  } catch (error) {
    if (mine !== asked) return;
    by("start").disabled = true;
    by("forecast").replaceChildren(make("p", "", "wrong", { id: "plan-wrong" }));
    complain("plan-wrong", error);
  }
}

/** The doctor's lines: a verdict, a check and what was found, then why and what to do. */
function findings(log) {
  const found = [];
  for (const line of log.split("\n")) {
    const head = /^(ok|warning|error|not checked)\s+(.{16}) ?(.*)$/.exec(line), more = /^\s+(why|do): (.*)$/.exec(line);
    if (head) found.push({ verdict: head[1], check: head[2].trim(), text: head[3], more: [] });
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
  const last = program.log.split("\n").at(-1);
  by("doctor").disabled = program.running;
  by("doctor-told").textContent = program.running ? "Checking…" : program.status === null ? "Stopped." : last;
  by("rig-note").textContent = program.running ? "" : `checked ${new Date(program.started_utc).toLocaleTimeString()}`;
  if (program.running) setTimeout(showDoctor, 700);
}

async function start() {
  complain("told");
  const metal = by("metal").value.trim();
  const body = {
    plan: changes(), name: by("name").value.trim(), library: by("library").value, keep_incomplete: by("keep_incomplete").checked,
    metal: metal ? metal.split(",").map(Number) : null, notes: by("notes").value, tags: by("tags").value.split(",").map((t) => t.trim()).filter(Boolean),
  };
  by("start").disabled = confirmed = true;
  try {
    await post("start", {}, body);
    location.href = pageOf("watch", body.name);
  } catch (error) { complain("told", error); by("start").disabled = confirmed = false; }
}

for (const id of NUMBERS) by(id).addEventListener("input", () => { clearTimeout(timer); timer = setTimeout(plan, 350); });
by("doctor").addEventListener("click", async () => {
  try {
    await post("doctor");
    complain("doctor-told");
    await showDoctor();
  } catch (error) { complain("doctor-told", error); }
});
by("form").addEventListener("submit", (event) => { event.preventDefault(); if (!confirmed) start(); });

await begin("New scan");
const now = new Date(), two = (n) => String(n).padStart(2, "0");
by("name").value = `scan-${now.getFullYear()}${two(now.getMonth() + 1)}${two(now.getDate())}-${two(now.getHours())}${two(now.getMinutes())}`;
try {
  const { libraries } = await get("scans");
  by("library").append(...libraries.map((name) => make("option", name, null, { value: name })));
  await plan();
  await showDoctor();
} catch (error) { complain("told", error); }
