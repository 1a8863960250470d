// What all pages share: the token, asking the server, and making elements. No text from the server is ever taken as HTML.
const KEY = "polysight-token";
const ANSWER_MS = 40000; // a read may take 30 s on a network drive
const CONTROL_MS = 8000; // a scan takes a command within 5 s, or it is withdrawn
const RUNNING_MS = 1200; // a killed scan is red within 2 s: the server looks every 0.5 s
export const INTERRUPTED = "interrupted";
// What advice for a terminal is called on a page.
const ON_PAGE = [
  [/\(--metal(-box)? [A-Z0-9,]+\)/g, "(Process again, metal reference)"],
  [/\(polysight label; process --labels[^)]*\)/g, "(Label, then Process again with the boxes)"],
  [/`polysight process --bands (\d+)`/g, "Process again with $1 sub-bands"],
  [/`polysight process SCAN --sparse --out DIR`/g, "Process again, which can fill in positions that were not recorded,"],
  [/`?polysight permittivity --layer( NAME,\?,\?)?`?/g, "Fit layers"],
  [/polysight label (SCAN )?--specimen NAME=WHICH/g, "Label, piece"],
  [/polysight label \/.*; then train again/g, "label it on its page, then train again"],
  [/polysight label SCAN --list shows them/g, "see Label"],
  [/;? to move a box: --remove .*/g, "; or correct the box that has this name"],
  [/--box .*=x0,y0,x1,y1 with/g, "give"],
  [/name its box, --metal NAME \(in Python metal=NAME\): /g, "mark the metal, one of "],
  [/with --bands (\d+)/g, "with $1 sub-bands"],
  [/: --value water=0/g, " in it, such as water (0%)"],
  [/\(--value NAME=PERCENT gives it\)/g, ""],
];

export const by = (id) => document.getElementById(id);
export const query = new URLSearchParams(location.search);
export const scanName = query.get("scan") ?? "";

/** The token of the printed address, kept for this address alone and taken out of what a screenshot shows. */
function readToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    localStorage.setItem(KEY, given);
    history.replaceState(null, "", location.pathname + location.search);
  }
  return localStorage.getItem(KEY) ?? "";
}

export let token = readToken();

export class Refused extends Error {
  constructor(told, status) {
    super([told.what, told.why, told.do].filter(Boolean).join(". "));
    Object.assign(this, { what: told.what, why: told.why, do: told.do, code: told.code, status });
  }
}

export const address = (path, given = {}) => {
  const words = new URLSearchParams(Object.entries(given).filter(([, v]) => v !== undefined && v !== null && v !== ""));
  const text = words.toString();
  return `/api/${path}${text ? `?${text}` : ""}`;
};

const reads = new Set(); // what ends the reads that are under way

/** The server's answer; its refusal, or its silence, is thrown as `Refused`. */
export async function reach(path, given, options, limit = ANSWER_MS) {
  const cut = new AbortController();
  let reply;
  setTimeout(() => cut.abort("late"), limit);
  if (!options) reads.add(cut);
  try {
    const headers = { ...options?.headers, "X-Polysight-Token": token };
    reply = await fetch(address(path, given), { ...options, headers, signal: cut.signal });
  } catch (error) {
    const shell = "in a shell on the host `polysight ask SCAN abort` stops a scan; the emergency stop stops the stage";
    const late = error === "late";
    if (error === INTERRUPTED) throw new Refused({ what: "A command went first", code: INTERRUPTED }, 0);
    throw new Refused({
      what: late ? `No answer within ${limit / 1000} s` : "The server is not responding",
      why: late ? "the server or its machine is very busy, or it hangs" : "`polysight serve` was ended, or the network is interrupted",
      do: shell,
    }, 0);
  } finally { reads.delete(cut); }
  if (!reply.ok) {
    const told = await reply.json().catch(() => ({ what: `The server answered ${reply.status}` }));
    if (told.code === "token-wrong") askForToken();
    throw new Refused(told, reply.status);
  }
  return reply;
}

export const get = async (path, given) => (await reach(path, given)).json();
export const post = async (path, given, body = {}, limit = ANSWER_MS) =>
  (await reach(path, given, { method: "POST", body: JSON.stringify(body), headers: { "Content-Type": "application/json" } }, limit)).json();

/** Send a command to a scan. A browser has six connections: what is being read waits, or all may hang on a drive that is gone. */
export async function control(command, scan) {
  for (const cut of reads) cut.abort(INTERRUPTED);
  const waiting = [...document.images].filter((image) => !image.complete).map((image) => [image, image.src]);
  for (const [image] of waiting) image.removeAttribute("src");
  try { return await post(`control/${command}`, { scan }, {}, CONTROL_MS); } finally {
    for (const [image, source] of waiting) image.src = source;
  }
}

/** A picture, and what the ends of its colours mean. */
export async function picture(path, given) {
  const reply = await reach(path, given);
  const unit = { deg: "°" }[reply.headers.get("X-Unit")] ?? reply.headers.get("X-Unit") ?? "";
  return { image: await createImageBitmap(await reply.blob()), low: +reply.headers.get("X-Low"), high: +reply.headers.get("X-High"), unit };
}

/** The colours of a picture with the values at their ends; nothing without a picture. */
export function showScale(node, made, colours) {
  if (!made) { node.replaceChildren(); return; }
  const digits = made.unit ? 1 : 3, bar = make("img", null, null, { src: address(`bar/${colours}`), alt: "" });
  node.replaceChildren(make("span", signed(made.low, digits)), bar, make("span", signed(made.high, digits)), make("span", made.unit, "soft"));
}

export function make(name, text, className, more = {}) {
  const node = document.createElement(name);
  if (text !== undefined && text !== null) node.textContent = text;
  if (className) node.className = className;
  for (const [key, value] of Object.entries(more)) {
    if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else if (key in node && key !== "list") node[key] = value;
    else node.setAttribute(key, value);
  }
  return node;
}

export const nest = (node, ...children) => { node.append(...children); return node; };

/** Fill a table; each cell has the name of its column, which a phone shows beside it. */
export function fill(body, rows) {
  const names = [...body.closest("table").querySelectorAll("thead th")].map((head) => head.textContent);
  for (const row of rows) [...row.children].forEach((cell, i) => { cell.dataset.name = names[i]; });
  body.replaceChildren(...rows);
}

/** Text with `commands` in it, as nodes. */
export const rich = (text) =>
  ON_PAGE.reduce((words, [option, name]) => words.replace(option, name), String(text)).split("`").map((part, i) => (i % 2 ? make("code", part) : document.createTextNode(part)));

export function tell(id, text) {
  const node = by(id);
  if (node.textContent === text.replaceAll("`", "") && node.hidden === !text) return; // screen readers read changes
  node.replaceChildren(...rich(text));
  node.hidden = !text;
}

/** What was found, why, and what to do, as an item of a list. */
export function finding({ what, why, do: remedy }, separator = ": ") {
  const item = nest(make("li"), nest(make("b"), ...rich(what)));
  if (why) item.append(nest(make("span", separator, "why"), ...rich(why)));
  if (remedy) item.append(nest(make("span", "→ ", "do"), ...rich(remedy)));
  return item;
}

/** A started program, and what it printed. */
export function showProgram(program, isShown) {
  by("program").hidden = !program || !isShown;
  if (!program) return;
  by("program-title").textContent = `polysight ${program.kind} ${ending(program)}`;
  if (by("program-log").textContent !== program.log) by("program-log").textContent = program.log || "No output yet.";
}

/** An error where it belongs, or nothing. */
export function complain(id, error) {
  if (error?.code === INTERRUPTED) return; // the next look reads it
  const node = by(id);
  node.classList.toggle("wrong", Boolean(error));
  if (!error) { node.replaceChildren(); return; }
  if (!(error instanceof Refused)) throw error;
  node.replaceChildren(...rich([error.what, error.why].filter(Boolean).join(": ")), ...rich(error.do ? `. To do: ${error.do}.` : "."));
}

export function span(seconds) {
  if (seconds < 100) return `${Math.round(seconds)} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 60 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${String(minutes % 60).padStart(2, "0")} min`;
}

export const clock = (seconds) => new Date(seconds * 1000).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" });
export const day = (seconds) => new Date(seconds * 1000).toLocaleString([], { year: "numeric", month: "short", day: "numeric", hour: "2-digit", minute: "2-digit" });
/** A number with so many digits and a true minus; a rounded zero has no sign. */
export const signed = (n, digits = 0) => n.toFixed(digits).replace(/^-(?=[0.]*$)/, "").replace("-", "−");
export const grouped = (n) => n.toLocaleString("en").replaceAll(",", "\u202f");
export const bytes = (n) => (n === null || n === undefined ? "…" : n < 1e6 ? `${(n / 1e3).toFixed(0)} kB` : n < 1e9 ? `${(n / 1e6).toFixed(0)} MB` : `${(n / 1e9).toFixed(1)} GB`);
export const pageOf = (page, scan) => `/${page}?${new URLSearchParams({ scan })}`;

/** eps' − j eps″ with errors, as tables show it. */
export function permittivity(p) {
  if (!p || p.real === null || p.real === undefined) return "–";
  const error = (std) => (std ? ` ± ${std.toPrecision(2)}` : "");
  return `${p.real.toFixed(2)}${error(p.real_std)} − j (${signed(-p.imag, 2)}${error(p.imag_std)})`;
}

/** A material's name as people read it. */
export const called = (name) => (name === "unknown" ? "not in the library" : name ?? "not named");

/** Words and colours of states in lists: the server's table. */
export const STATES = {};
export const VERDICTS = { good: ["good", "good"], care: ["usable with care", "warn"], none: ["no result", "bad"], damaged: ["products damaged", "bad"] };

/** How a program of `polysight` stands: 7 is the exit status of a scan that supports no result. */
export function ending({ running, status, log }) {
  if (running) return "runs";
  if (/^end: stopped on request/m.test(log)) return "was stopped on request";
  if (status === 0) return "has ended";
  if (status === 7) return "has ended without a result";
  return `has failed${status === null ? ": it was killed" : ` (exit status ${status})`}`;
}

export function badge([text, level]) {
  return make("span", text, "badge", { "data-level": level });
}

/** The bar at the top, with the running scan and its abort, and what the server allows. */
export async function begin(title) {
  const bar = make("header", null, "bar"), nav = make("nav", null, null, { "aria-label": "Pages" });
  bar.append(make("a", "polysight", "brand", { href: "/" }), nav, make("div", null, "running", { id: "running" }));
  document.body.prepend(make("a", "Skip to the content", "skip", { href: "#main" }), bar);
  const told = await get("page");
  Object.assign(STATES, told.badges);
  if (!told.only) {
    for (const [text, href] of [["Scans", "/"], ["New scan", "/new"], ["Compare", "/compare"], ["Check plate", "/check"]]) {
      if (href === "/new" && !told.starts) continue;
      nav.append(make("a", text, null, { href, ...(location.pathname === href ? { "aria-current": "page" } : {}) }));
    }
  }
  if (title) document.title = `${title} · polysight`;
  if (token) openSession(told);
  else if (!told.known) askForToken();
  if (told.known) watchRunning(told);
  return told;
}

// --- the running scan, on every page ---

let runs = null;

async function watchRunning(told) {
  try {
    const now = await get("running");
    for (const scan of runs ?? []) if (!now.some((s) => s.name === scan.name)) tellEnd(scan.name);
    for (const scan of now) if (scan.state !== "running" && runs?.some((s) => s.name === scan.name && s.state === "running")) tellEnd(scan.name);
    if (JSON.stringify(now) !== JSON.stringify(runs)) showRunning(now, told);
    const asks = by("confirm")?.dataset.scan;
    if (asks && runs?.some((s) => s.name === asks) && !now.some((s) => s.name === asks && s.doing === "rows")) by("confirm").close("ended");
    runs = now;
  } catch (error) { if (!(error instanceof Refused)) throw error; }
  setTimeout(() => watchRunning(told), RUNNING_MS);
}

function showRunning(now, told) {
  by("running").replaceChildren(...now.flatMap((scan) => {
    const name = make("a", scan.name, "running-name", { href: pageOf("watch", scan.name) });
    if (scan.state === "lost") return [badge(STATES.lost), name];
    const nodes = [badge(scan.doing === "rows" ? STATES[scan.state] : ["computes materials", "wait"]), name];
    if (told.control && scan.doing === "rows" && scan.asked !== "abort") {
      nodes.push(make("button", "Abort", "danger", { type: "button", onclick: () => confirmAbort(scan.name) }));
    }
    if ("Notification" in window && Notification.permission === "default") {
      nodes.push(make("button", "Notify me", null, { type: "button", title: "when it ends", onclick: askToNotify }));
    }
    return nodes;
  }));
}

async function askToNotify(event) {
  const button = event.target;
  await Notification.requestPermission();
  button.remove();
}

/** A browser's notification when a scan has ended, whatever page is open. */
async function tellEnd(name) {
  if (!("Notification" in window) || Notification.permission !== "granted") return;
  let words = "ended";
  try {
    const scan = await get("scan", { scan: name });
    words = [STATES[scan.state]?.[0] ?? scan.state, scan.reason].filter(Boolean).join(": ");
  } catch { /* its folder is gone: it has ended */ }
  new Notification(name, { body: words, tag: name });
}

/** Ask, then stop the stage; `told` shows the answer. */
export function confirmAbort(scan, told = alertError) {
  by("confirm")?.remove();
  const dialog = make("dialog", null, null, { id: "confirm", "aria-label": "Abort" });
  dialog.dataset.scan = scan;
  const form = make("form", null, null, { method: "dialog" });
  form.append(make("button", "Keep scanning", null, { value: "no" }), make("button", "Abort now", "danger", { value: "yes" }));
  dialog.append(nest(make("p"), make("strong", "Stop the stage now?")),
    nest(make("p"), ...rich(`The running row of ${scan} is lost; all others are safe, and it can be resumed later.`)), form);
  dialog.addEventListener("close", async () => {
    if (dialog.returnValue !== "yes") return;
    try { await control("abort", scan); told(null); } catch (error) { told(error); }
  });
  document.body.append(dialog);
  dialog.showModal();
}

function alertError(error) {
  if (!by("header-told")) document.querySelector(".bar").after(make("p", "", "header-told", { id: "header-told", role: "alert" }));
  complain("header-told", error);
}

async function openSession(told) {
  try {
    await post("session");
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    if (told.known && error.status === 403 && !told.control) return; // nothing here needs a token
  }
}

/** Where the token can be typed: another tab, another phone. */
export function askForToken() {
  if (by("token-bar")) return;
  const field = make("input", null, null, { id: "token-field", type: "password", autocomplete: "off", required: true });
  const form = make("form", null, "token-bar", { id: "token-bar" });
  form.append(make("label", "Enter the token: the text after #token= in the address that the server printed.", null, { htmlFor: "token-field" }),
    field, make("button", "Apply"));
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const given = field.value.trim().replace(/^.*#token=/, "");
    token = given;
    try {
      await post("session");
      localStorage.setItem(KEY, given);
      location.reload();
    } catch { field.setAttribute("aria-invalid", "true"); }
  });
  document.querySelector(".bar").after(form);
}
