// The list of scans: what there is, how it stands; search, order, and what several scans are chosen for.
import { address, badge, begin, by, bytes, called, complain, day, get, make, nest, pageOf, post, rich, STATES, VERDICTS } from "./common.js";

const LOOK_MS = 4000, REST_MS = 100; // between two looks at the list, and before the rest of one that was too long
const FIRST_CARDS = 40, MORE_CARDS = 400; // the first ones of a long list are seen before the rest is made
const ORDER = { good: 0, care: 1, "": 2, none: 3, damaged: 4 };
const cards = new Map(), chosen = new Set();
let server = {}, told = { scans: [] }, rest = null;

const words = (s) => [s.name, s.scan_id, s.rig, s.state, s.notes, s.started_utc, ...s.tags, ...s.materials, ...s.labelled].join(" ").toLowerCase();

function card(s) {
  const item = make("li"), [state, level] = STATES[s.state] ?? [s.state, "warn"];
  const box = make("input", null, null, { type: "checkbox", checked: chosen.has(s.name), onchange: () => choosing(s.name), "aria-label": `Choose ${s.name}` });
  const choose = nest(make("label", null, "choose"), box);
  const live = ["running", "paused", "lost", "frozen", "begun"].includes(s.state) || !(s.processed || s.images_only);
  const link = make("a", s.name, "name", { href: pageOf(live ? "watch" : "scan", s.name) });
  const picture = s.processed || s.images_only
    ? make("img", null, "thumb", { loading: "lazy", decoding: "async", alt: "", src: address("thumbnail", { scan: s.name, at: s.generation }) })
    : make("div", s.state === "running" ? "being scanned" : "not processed", "thumb none");
  picture.addEventListener("error", () => picture.replaceWith(make("div", "no picture", "thumb none")));
  const badges = make("div", null, "badges");
  badges.append(badge([state, level]));
  if (s.verdict) badges.append(badge(VERDICTS[s.verdict] ?? [s.verdict, "warn"]));
  if (s.simulated) badges.append(make("span", "simulated", "stamp"));
  const rows = s.rows ? `${s.committed} of ${s.rows} rows · ` : "";
  const facts = make("div", `${s.seconds ? day(s.seconds) : ""} · ${rows}${bytes(s.bytes)}${s.rig ? ` · ${s.rig}` : ""}`, "facts");
  const found = s.materials.length ? make("div", s.materials.map(called).join(", "), "facts") : "";
  const labelled = s.labelled.length ? make("div", `labelled: ${s.labelled.join(", ")}`, "facts") : "";
  const reason = s.state === "failed" && s.reason ? make("div", s.reason, "facts") : "";
  item.append(picture, link, choose, badges, facts, reason, found, labelled, s.notes ? make("div", s.notes, "words") : "");
  if (s.tags.length) item.append(nest(make("div", null, "badges"), ...s.tags.map((t) => make("span", t, "tag"))));
  item.classList.toggle("chosen", chosen.has(s.name));
  return item;
}

function choosing(name) {
  if (!chosen.delete(name)) chosen.add(name);
  cards.get(name)?.node.classList.toggle("chosen", chosen.has(name));
  showChoice();
}

function showChoice() {
  const names = [...chosen];
  by("compare").hidden = names.length !== 2;
  if (names.length === 2) by("compare").href = `/compare?${new URLSearchParams({ a: names[0], b: names[1] })}`;
  by("train-open").hidden = !(server.starts && names.length);
  if (!names.length) by("train").hidden = true;
}

function wanted() {
  const text = by("find").value.trim().toLowerCase(), state = by("state").value, tag = by("tag").value;
  const found = told.scans.filter((s) => (!state || s.state === state) && (!tag || s.tags.includes(tag)) && text.split(/\s+/).every((w) => words(s).includes(w)));
  const by_ = {
    new: (a, b) => b.seconds - a.seconds, old: (a, b) => a.seconds - b.seconds, bytes: (a, b) => (b.bytes ?? 0) - (a.bytes ?? 0),
    verdict: (a, b) => (ORDER[a.verdict] ?? 5) - (ORDER[b.verdict] ?? 5),
  };
  return found.sort((a, b) => by_[by("sort").value]?.(a, b) || a.name.localeCompare(b.name));
}

function options(id, values, name = (v) => v) {
  const select = by(id), now = select.value;
  select.replaceChildren(select.options[0], ...values.map((v) => make("option", name(v), null, { value: v })));
  select.value = values.includes(now) ? now : "";
}

function show() {
  const found = wanted();
  const most = cards.size ? MORE_CARDS : FIRST_CARDS;
  let waiting = 0;
  for (const s of found) {
    const old = cards.get(s.name);
    if (old?.of === s || ++waiting > most) continue;
    const node = card(s);
    old?.node.replaceWith(node);
    cards.set(s.name, { of: s, node });
  }
  if (waiting > most) requestAnimationFrame(() => setTimeout(show)); // these are painted first
  const nodes = found.filter((s) => cards.has(s.name)).map((s) => cards.get(s.name).node), now = [...by("list").children];
  if (nodes.length !== now.length || nodes.some((node, i) => node !== now[i])) by("list").replaceChildren(...nodes);
  const all = told.scans.length;
  by("count").textContent = `${found.length === all ? "" : `${found.length} of `}${all} scan${all === 1 ? "" : "s"}`
    + (told.unread ? ` · reading ${told.unread} more` : "")
    + (told.left_out?.length ? ` · not shown (links, odd names): ${told.left_out.slice(0, 3).join(", ")}${told.left_out.length > 3 ? ", …" : ""}` : "")
    + (told.free_bytes ? ` · ${bytes(told.free_bytes)} free` : "");
  if (!all) by("told").textContent = server.starts ? "No scans yet: start one with New scan." : "No scans yet.";
  else if (!by("told").classList.contains("wrong")) by("told").textContent = found.length ? "" : "No scan matches.";
}

async function look(answer = get("scans", { since: told.stamp })) {
  try {
    const now = await answer, held = new Map(now.whole ? [] : told.scans.map((s) => [s.name, s]));
    complain("told");
    for (const name of now.gone) held.delete(name);
    for (const s of now.scans) held.set(s.name, s);
    const differs = now.whole || now.scans.length || now.gone.length;
    now.scans = [...held.values()];
    told = now;
    if (differs) {
      options("state", [...new Set(now.scans.map((s) => s.state))], (v) => STATES[v]?.[0] ?? v);
      options("tag", [...new Set(now.scans.flatMap((s) => s.tags))].sort());
    }
    show();
    clearTimeout(rest);
    if (told.unread) rest = setTimeout(look, REST_MS);
  } catch (error) { complain("told", error); }
}

/** Follow `train` or `concentration` to its end. */
async function showTraining(kind = "train") {
  const program = await get(`program/${kind}`);
  by("train-log").hidden = !program;
  if (!program) return;
  by("train-log").replaceChildren(...rich(program.log));
  const [, scan, all] = /^.*\[(\d+)\/(\d+)\]/s.exec(program.log) ?? [];
  const progress = all ? `Reading scan ${scan} of ${all}.` : "Starting.";
  const done = kind === "train" ? "The library is saved: choose it under Process again, or for a new scan." : "Done.";
  by("train-told").textContent = program.running ? progress : program.status === 0 ? done : "It has failed:";
  by("concentration").hidden = program.running || program.status !== 0;
  if (program.running) setTimeout(showTraining, 1000, kind);
}

async function train(kind, body) {
  try {
    await post(kind, {}, body);
    complain("train-told");
    await showTraining(kind);
  } catch (error) { complain("train-told", error); }
}

by("train-open").addEventListener("click", () => { by("train").hidden = false; by("train-name").focus(); });
by("train").addEventListener("submit", (event) => {
  event.preventDefault();
  train("train", { name: by("train-name").value, scans: [...chosen] });
});
by("concentration").addEventListener("click", () => train("concentration", { library: by("train-name").value }));
by("tools").addEventListener("submit", (event) => event.preventDefault());
for (const id of ["find", "state", "tag", "sort"]) by(id).addEventListener("input", show);

const list = get("scans"); // a long one takes its time: asked for before the page knows what it may show
list.catch(() => {}); // `look` says what is wrong
server = await begin();
await look(list);
if ((await get("program/train"))?.running) {
  by("train").hidden = false;
  showTraining();
}
setInterval(() => { if (!document.hidden) look(); }, LOOK_MS);
