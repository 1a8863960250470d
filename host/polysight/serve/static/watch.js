// The live view's page: hears the newest state from the server, shows it, and asks for what a button says.
import { address, begin, by, clock, complain, confirmAbort, control, finding, get, grouped, make, nest, pageOf, post, scanName, showProgram, signed, span, tell, VERDICTS } from "./common.js";
import { plot, raster } from "./plots.js";

const SILENT_MS = 7000; // the server says something every two seconds
const SIGNS = { good: "✓", done: "✓", warn: "!", bad: "✕", wait: "…" };
const CHANNELS = [["h", "H", "s-polarised"], ["v", "V", "p-polarised"], ["p", "P = H / V", ""]];
const FEW = 4;
// Name, class, and what a press does; what may be pressed says the status.
const BUTTONS = {
  pause: ["Pause after this row", "", () => command("pause")],
  continue: ["Continue", "", () => command("continue")],
  stop: ["Stop after this row", "", () => command("stop")],
  resume: ["Resume the scan", "main", () => start("resume")],
  again: ["Try again", "main", () => start("again")],
  process: ["Process", "main", () => start("process")],
  repeat: ["Repeat this plan", "", () => { location.href = `/new?${new URLSearchParams({ from: name })}`; }],
  abort: ["Abort now", "danger", () => confirmAbort(name, (error) => complain("answer", error))],
};
const CONTROLS = ["pause", "continue", "stop", "abort"];
const CURVES = { sync: ["remaining phase error", "degrees (std)"], snr_db: ["SNR", "dB"], lost: ["lost packets", "%"] };

let state = null, motion = {}, source = null, heardAt = 0, allNotices = false, toldNotices = "", revision = -1;
let server = {}, name = scanName, summary = {}, curve = "sync";

// --- what is shown ---

/** A terminal's advice on a scan that could not start: there is nothing to resume, and the button reads the rig file
again. */ function beforeTryingAgain(advice) {
  const here = advice.replace(/ \([^()]*`polysight resume [^()]*\)/g, "").replace(", and add --config instrument.toml", "")
    .replace(/`polysight resume [^`]*`/g, "Try again");
  const mend = `${here}${here.includes("`") ? " (commands: in a shell)" : ""}`;
  return mend.includes("Try again") ? mend : [mend, "Try again"].filter(Boolean).join("; then ");
}

function showStatus() {
  const { status, scan } = state;
  by("status").dataset.level = status.level;
  by("sign").textContent = SIGNS[status.level];
  by("headline").textContent = status.headline;
  tell("detail", status.detail.replace("{since}", span(Math.max(0, (motion.now_s ?? status.since_s) - status.since_s))));
  tell("why", status.why && `Likely: ${status.why[0].toLowerCase()}${status.why.slice(1)}.`);
  tell("do", status.press.includes("again") && server.starts ? beforeTryingAgain(status.do) : status.do);
  by("progress").hidden = !scan;
  let left = "", ends = "";
  if (scan) {
    by("done").style.width = `${100 * scan.committed / scan.rows}%`;
    by("count").textContent = `${scan.committed} of ${scan.rows} rows`;
    const open = scan.committed < scan.rows;
    if (open && Number.isFinite(motion.left_s)) {
      left = motion.left_s ? `${span(motion.left_s)} left` : "nearly done";
      ends = state.paused ? "once it continues" : `ends about ${clock(motion.now_s + motion.left_s)}`;
      if (motion.left_from !== "measured") ends += motion.left_from === "plan" ? ", by the plan" : ", a first guess";
    } else if (open && state.running) {
      ends = "time left: known after the first row";
    }
  }
  by("left").textContent = left;
  by("ends").textContent = ends;
  const short = scan ? ` ${scan.committed}/${scan.rows}` : "";
  document.title = `${SIGNS[status.level]}${short}${left ? ` · ${left}` : ""} · polysight`;
}

function showResult() {
  const told = state.verdict;
  by("result").hidden = !told;
  if (!told) return;
  by("result").dataset.level = told.level;
  by("result-level").textContent = VERDICTS[told.level][0];
  by("reasons").replaceChildren(...told.reasons.map((reason) => finding(reason)));
}

function showButtons() {
  const allowed = (key) => (CONTROLS.includes(key) ? state.control : server.starts);
  const keys = Object.keys(BUTTONS).filter((key) => state.status.press.includes(key) && allowed(key));
  if (keys.join() === [...by("buttons").children].map((b) => b.id).join()) return; // a button that has the focus stays
  by("buttons").replaceChildren(...keys.map((key) => {
    const [text, className, press] = BUTTONS[key];
    return make("button", text, className, { id: key, type: "button", onclick: press });
  }));
}

function buildChannels() {
  const { width_mm: wide, height_mm: high } = state.pictures;
  by("channels").replaceChildren(...CHANNELS.map(([key, name, note]) => {
    const head = nest(make("h3", `${name} `), make("span", note, null, { id: `${key}_note` }));
    return nest(make("div", undefined, "channel"), head, ...["amplitude", "phase"].map((kind) => {
      const view = make("div", undefined, kind === "phase" || key === "p" ? "view fades" : "view");
      view.style.aspectRatio = `${wide} / ${high}`;
      view.append(make("span", "after the first row"), make("img", null, null, { id: `${key}_${kind}`, alt: `${kind} of ${name}`, hidden: true }));
      const bar = make("img", null, null, { src: address(`bar/${kind}`), alt: "" });
      return nest(make("figure"), view, nest(make("figcaption"), make("span", kind), bar, make("span", "")));
    }));
  }));
}

function showImages() {
  const p = state.pictures;
  if (!by("h_amplitude")) buildChannels();
  const waiting = p.waiting ? `, ${p.waiting} more on their way` : "";
  const early = p.rows && p.rows < state.scan.rows / 3 ? "; sharp when more rows are in" : "";
  by("images-note").textContent = `${p.rows} ${p.rows === 1 ? "row" : "rows"} in${waiting}; ${p.width_mm} × ${p.height_mm} mm${early}`;
  const notes = { finished: "not referenced to metal: not processed", unprocessed: "not referenced to metal: not processed" };
  by("p_note").textContent = state.verdict ? "as received; relative to metal under Result"
    : notes[state.status.key] ?? "not referenced to metal yet";
  if (p.revision === revision) return;
  revision = p.revision;
  for (const [key, [low, high, unit]] of Object.entries(p.scales)) {
    const picture = by(key), caption = picture.closest("figure").querySelector("figcaption");
    picture.src = address(`picture/${key}`, { scan: name, revision });
    picture.hidden = false;
    picture.parentNode.classList.add("filled");
    caption.lastChild.textContent = `${signed(low)} to ${signed(high)}${unit === "°" ? "°" : ` ${unit}`}`;
  }
}

function showStage() {
  const { stage, row, point } = motion, notes = [];
  if (row >= 0) notes.push(`row ${row}, point ${point}`);
  if (stage) notes.push(`x ${signed(stage[0])}, y ${signed(stage[1])} mm`);
  by("stage-note").textContent = notes.join(" · ");
  raster(by("raster"), state, motion);
}

function showNotices() {
  const told = JSON.stringify([state.notices, state.status.level, allNotices]);
  if (told === toldNotices) return; // so that what is unfolded stays so
  toldNotices = told;
  const notices = state.notices, serious = notices.filter((n) => n.level !== "note");
  by("faults").classList.toggle("news", serious.length > 0 && ["warn", "bad"].includes(state.status.level));
  by("faults-note").textContent = notices.length ? `${notices.length}, the newest first` : "";
  const shown = allNotices ? notices : notices.slice(0, FEW);
  const items = shown.map((n) => {
    const item = finding({ ...n, why: n.why && `${n.why}.` }, ". ");
    item.dataset.level = { warning: "warn", error: "bad" }[n.level] ?? n.level;
    if (n.facts.utc) item.prepend(make("time", `${clock(Date.parse(n.facts.utc) / 1000)} `));
    if (n.facts.detail) item.append(nest(make("details"), make("summary", "in full"), make("span", n.facts.detail)));
    return item;
  });
  const isWell = ["good", "done"].includes(state.status.level);
  by("faults").hidden = !items.length && !isWell;
  if (!items.length) items.push(make("li", "No faults.", "none"));
  by("notices").replaceChildren(...items);
  by("more").hidden = notices.length <= FEW;
  by("more").textContent = allNotices ? "Fewer" : `All ${notices.length}`;
}

function showBoards() {
  const table = make("table"), head = table.createTHead().insertRow(), body = table.createTBody();
  head.append(make("td"), ...state.boards.map((b) => make("th", b.name, null, { scope: "col" })));
  const line = (name, cell) => {
    const row = body.insertRow();
    row.append(make("th", name, null, { scope: "row" }), ...state.boards.map((b) => {
      const [text, level] = cell(b);
      return make("td", text, level);
    }));
  };
  const bad = (n) => [grouped(n), n ? "warn" : ""];
  const lost = (b) => b.frames_expected - b.frames_received;
  line("data", (b) => (lost(b) ? ["gaps", "warn"] : b.frames_expected ? ["✓ whole", "good"] : ["–", ""]));
  line("frames lost", (b) => bad(lost(b)));
  line("frames in all", (b) => [grouped(b.frames_expected), ""]);
  if (state.boards.some((b) => "packets" in b.counts)) {
    line("packets", (b) => [grouped(b.counts.packets ?? 0), ""]);
    line("late or twice", (b) => [grouped((b.counts.late ?? 0) + (b.counts.duplicates ?? 0)), ""]);
    line("dropped by this machine", (b) => bad(b.counts.kernel_drops ?? 0));
  }
  line("takes rejected", (b) => bad(b.retaken));
  line("pulses missed", (b) => bad(b.counts.pulses_missed ?? 0));
  line("positions masked", (b) => bad(b.masked));
  by("board-table").replaceChildren(table);
  const t = state.trigger;
  by("trigger").textContent = t
    ? `Triggers: ${grouped(state.scan.pulses)} pulses; the longest ${(t.width_max_ns / 1e3).toFixed(1)} µs of ${state.scan.pulse_limit_us} allowed, `
      + `the latest ${(t.jitter_max_ns / 1e3).toFixed(1)} µs late.`
    : "Triggers: no data yet.";
}

function showPlots() {
  const names = state.scan.receivers, p = state.profile;
  if (p) {
    const levels = Object.values(p.boards).flat();
    by("range-note").textContent = `row ${p.row}, dB below the direct path`;
    plot(by("profile"), {
      x: [p.excess_m[0], p.excess_m.at(-1)], y: [Math.max(-70, Math.floor(Math.min(...levels) / 10) * 10), 10],
      xLabel: "path longer than the direct one, m", yLabel: "dB",
      lines: names.filter((n) => p.boards[n]).map((n) => ({ x: p.excess_m, y: p.boards[n], name: n, style: `receiver${names.indexOf(n)}` })),
      upright: [{ x: 0, name: "direct path" }], scene: p.scene_m, sceneName: "scene",
    });
  } else by("profile").replaceChildren(make("p", "After the first row.", "empty"));
  by("curves").replaceChildren(...Object.entries(CURVES).map(([key, [text]]) => make("button", text, null, {
    type: "button", "aria-pressed": String(key === curve), onclick: () => { curve = key; showPlots(); },
  })));
  const figures = state[curve], [, unit] = CURVES[curve];
  const lines = names.filter((n) => figures[n]).map((n) => (
    { x: Object.keys(figures[n]).map(Number), y: Object.values(figures[n]), name: n, style: `receiver${names.indexOf(n)}` }));
  const values = lines.flatMap((l) => l.y).filter((v) => v !== null);
  if (!values.length) { by("sync").replaceChildren(make("p", "After the first row.", "empty")); return; }
  const paper = curve === "sync" ? [{ y: state.paper_deg, name: "the paper's" }] : [];
  const top = Math.max(curve === "lost" ? 1 : 0, ...paper.map((l) => 2 * l.y), 1.15 * Math.max(...values));
  plot(by("sync"), { x: [0, Math.max(1, state.scan.rows - 1)], y: [0, top], xLabel: "row", yLabel: unit, lines, level: paper });
}

function showAll() {
  showStatus();
  showResult();
  showButtons();
  showNotices();
  const there = Boolean(state.scan);
  for (const id of ["images", "stage", "boards", "range", "residual"]) by(id).hidden = !there;
  if (!there) return;
  by("scan").textContent = `${state.scan.folder} · ${state.scan.rig}`;
  by("simulated").hidden = !state.scan.simulated;
  showImages();
  showStage();
  showBoards();
  showPlots();
}

// --- the server ---

function connect() {
  source?.close();
  heardAt = Date.now();
  source = new EventSource(address("events", { scan: name }));
  const heard = (take) => (event) => {
    heardAt = Date.now();
    document.body.classList.remove("lost");
    take(JSON.parse(event.data));
  };
  source.addEventListener("alive", heard(() => {}));
  source.addEventListener("state", heard((told) => {
    if (told.status.key !== state?.status.key) look(); // the program's output is that of this state
    state = told;
    showAll();
  }));
  source.addEventListener("motion", heard((told) => {
    motion = told;
    if (state) showStatus();
    if (state?.scan) showStage();
  }));
  source.onerror = sayWhyLost;
}

/** The server ends a stream that it refuses as it ends one that breaks: only another question tells which. */
async function sayWhyLost() {
  try { await get("scan", { scan: name }); } catch (error) {
    if (error.code === "file-missing") {
      lost({ level: "bad", headline: "No scan of this name", detail: error.what, why: error.why, do: error.do });
      return;
    }
  }
  lost(server.states.offline);
}

/** The page is alone: its own words, from the same table as the server's. */
function lost(words) {
  const fill = (text) => text.replaceAll("{folder}", state?.scan?.folder ?? name);
  document.body.classList.add("lost");
  by("status").dataset.level = words.level;
  by("sign").textContent = "?";
  by("headline").textContent = words.headline;
  tell("detail", fill(words.detail));
  tell("why", `Likely: ${fill(words.why)}.`);
  tell("do", fill(words.do));
  by("buttons").replaceChildren();
  document.title = "? · polysight";
}

setInterval(() => {
  if (!source || Date.now() - heardAt < SILENT_MS) return;
  const isClosed = source.readyState !== EventSource.OPEN;
  connect();
  lost(isClosed ? server.states.offline : server.states.server_frozen);
}, 1000);

/** Say that something is asked, until it is answered. */
async function ask(words, work) {
  by("answer").textContent = words;
  try {
    await work();
    complain("answer");
  } catch (error) { complain("answer", error); }
}

const command = (word) => ask("Asking…", () => control(word, name));
const start = (path) => ask("Starting…", () => post(path, { scan: name }));

/** What the scan's program printed, while that says more than the status, and the way to the result. */
async function look() {
  try { summary = await get("scan", { scan: name }); } catch { return; } // not there yet, or gone for a moment
  by("to-result").hidden = !(summary.processed || summary.images_only);
  by("to-result").href = pageOf("scan", name);
  const [program] = summary.programs.filter((p) => ["scan", "process"].includes(p.kind));
  const isNews = ["starting", "start_failed", "resuming", "failed", "unprocessed", "processing"].includes(state?.status.key);
  showProgram(program, isNews);
}

by("more").addEventListener("click", () => { allNotices = !allNotices; showNotices(); });
new ResizeObserver(() => { if (state?.scan) { showStage(); showPlots(); } }).observe(document.body);
server = await begin();
name = scanName || server.only || "";
connect();
look();
setInterval(look, 3000);
