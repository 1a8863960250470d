// The control chart: the check plate of every processed scan beside its known permittivity and the limits.
import { badge, begin, by, complain, day, fill, get, make, nest, pageOf, query } from "./common.js";
import { control } from "./plots.js";

const LOOK_MS = 10000;
const LEVELS = { good: ["good", "good"], warning: ["warning", "warn"], action: ["action", "bad"], missing: ["missing", "bad"] };
let told = { scans: [], unreadable: [] }, seen = "";

const both = ([real, loss], [realStd, lossStd]) => `${real.toFixed(2)} ± ${realStd.toFixed(2)}, loss ${loss.toFixed(3)} ± ${lossStd.toFixed(3)}`;

/** What the charts take: one point a scan, in the order of their start. */
function points(scans, part) {
  return scans.map(({ name, seconds, check }) => ({
    value: check.measured?.[part] ?? null,
    bar: check.measured ? told.warning_sigmas * check.measured_std[part] : 0,
    known: check.expected[part],
    band: told.warning_sigmas * check.expected_std[part],
    level: LEVELS[check.level][1],
    href: pageOf("scan", name),
    name: `${name}${seconds ? `, ${day(seconds)}` : ""}: ${check.level}`,
  }));
}

function row({ name, seconds, check }) {
  const node = make("tr");
  node.append(
    nest(make("td"), make("a", name, null, { href: pageOf("scan", name) })),
    nest(make("td"), badge(LEVELS[check.level])),
    make("td", check.sigmas === null ? "–" : check.sigmas.toFixed(1), "n"),
    make("td", check.measured ? both(check.measured, check.measured_std) : check.why),
    make("td", both(check.expected, check.expected_std)),
    make("td", seconds ? day(seconds) : "–"),
  );
  return node;
}

function show() {
  const scans = told.scans.filter((s) => s.check.name === by("plate").value);
  for (const node of document.querySelectorAll(".chart")) node.hidden = !scans.length;
  by("stamp").replaceChildren(...(scans.some((s) => s.simulated !== false) ? [make("span", "simulated", "stamp")] : []));
  const unreadable = told.unreadable.length ? ` Products cannot be read: ${told.unreadable.slice(0, 3).join(", ")}${told.unreadable.length > 3 ? ", …" : ""}.` : "";
  if (!scans.length) {
    by("told").textContent = `No processed scan has a check plate: name it in the rig file ([check], docs/how-to/check-plate.md).${unreadable}`;
    by("limits").textContent = "";
    return;
  }
  const count = (level) => scans.filter((s) => s.check.level === level).length;
  const last = scans.at(-1);
  by("told").textContent = `Latest scan ${last.name}: ${last.check.level}. Of ${scans.length} scan${scans.length === 1 ? "" : "s"}: ${count("good")} good, ${count("warning")} warning, ${count("action")} action, ${count("missing")} missing.${unreadable}`;
  by("limits").textContent = `Warning above ${told.warning_sigmas} standard deviations (5 % of good scans), action above ${told.action_sigmas} (0.3 %). Bars and band: ± ${told.warning_sigmas} standard deviations of each part.`;
  control(by("real"), points(scans, 0), "real part");
  control(by("loss"), points(scans, 1), "loss");
  fill(by("rows"), [...scans].reverse().map(row));
}

async function look() {
  try {
    const now = await get("check"), text = JSON.stringify(now);
    if (by("told").classList.contains("wrong")) {
      complain("told");
      seen = "";
    }
    if (text === seen) return;
    [told, seen] = [now, text];
    const plates = [...new Set(now.scans.map((s) => s.check.name))], chosen = by("plate").value || query.get("plate");
    by("plate").replaceChildren(...plates.map((name) => make("option", name, null, { value: name })));
    by("plate").value = plates.includes(chosen) ? chosen : now.scans.at(-1)?.check.name ?? "";
    show();
  } catch (error) { complain("told", error); }
}

await begin();
by("plate").addEventListener("change", show);
addEventListener("resize", show);
await look();
setInterval(() => { if (!document.hidden) look(); }, LOOK_MS);
