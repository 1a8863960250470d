// Two scans: one under the other with an edge to move, side by side, or their difference in standard deviations.
import { ImageView } from "./view.js";
import { begin, by, called, complain, fill, get, make, nest, permittivity, picture, query, showScale, signed } from "./common.js";

const MAPS = { h_amplitude: "|H|", v_amplitude: "|V|", p_amplitude: "|P|", p_phase: "phase of P", permittivity: "permittivity, real part", loss: "permittivity, loss" };
const DIFFERENCES = { sigmas: "difference of P, in standard deviations", p: "|difference of P|", permittivity: "difference of the permittivity, real part", loss: "difference of the loss" };
const COLOURS = { p_phase: "twilight" };
let how = "swipe", told = null, views = null, asked = 0;

const names = () => ({ a: by("a").value, b: by("b").value });

function options() {
  const maps = how === "difference" ? DIFFERENCES : MAPS, now = by("map").value;
  by("map").replaceChildren(...Object.entries(maps).map(([value, text]) => make("option", text, null, { value })));
  by("map").value = now in maps ? now : Object.keys(maps)[0];
  for (const button of document.querySelectorAll("#head button")) button.setAttribute("aria-pressed", String(button.value === how));
  by("swipe-label").hidden = how !== "swipe";
  by("second").hidden = how !== "pair";
  by("pair").classList.toggle("pair", how === "pair");
}

function build() {
  const view = (place, other) => new ImageView(by(place), { extent: told.extent_mm, label: "Comparison", onview: (v) => other()?.look(v, false) });
  views = {};
  views.a = view("view-a", () => (how === "pair" ? views.b : null));
  views.b = view("view-b", () => views.a);
}

async function showMap() {
  if (!told) return;
  const mine = ++asked, map = by("map").value, { a, b } = names();
  try {
    if (how === "difference") {
      const made = await picture(`compare/${map}`, { a, b });
      if (mine !== asked) return;
      views.a.show({ image: made.image, second: null });
      showScale(by("scale"), made, ["sigmas", "p"].includes(map) ? "cividis" : "RdBu");
    } else {
      const first = await picture(`map/${map}`, { scan: a });
      const second = await picture(`map/${map}`, { scan: b, low: first.low, high: first.high });
      if (mine !== asked) return;
      views.a.show({ image: first.image, second: how === "swipe" ? second.image : null, swipe: by("swipe").value / 100 });
      views.b.show({ image: second.image });
      showScale(by("scale"), first, COLOURS[map] ?? "cividis");
    }
    by("name-a").textContent = how === "pair" ? a : "";
    by("name-b").textContent = b;
  } catch (error) { complain("told", error); }
}

function showTable() {
  by("compared").hidden = false;
  const rows = told.patches.map((p) => {
    const d = p.difference, sure = p.sigmas === null ? "–" : `${p.sigmas.toFixed(1)}${p.sigmas > told.significant_sigmas ? " differs" : ""}`;
    const row = make("tr");
    row.append(make("td", p.place_mm.join(", ").replaceAll("-", "−")));
    [0, 1].forEach((k) => row.append(nest(make("td", called(p.names[k])), make("div", permittivity(p.permittivity[k]), "soft"))));
    const std = (s) => (s ? ` ± ${s.toPrecision(2)}` : "");
    row.append(make("td", d ? `${signed(d.real, 2)}${std(d.real_std)}, loss ${signed(-d.imag, 2)}${std(d.imag_std)}` : "–"), make("td", sure, "n"));
    return row;
  });
  fill(by("rows"), rows);
  by("share").textContent = told.significant_share === null ? "Errors are unknown: significance cannot be judged."
    : `${(100 * told.significant_share).toFixed(1)} % of ${told.compared} pixels differ by more than ${told.significant_sigmas} standard deviations.`;
  by("warnings").replaceChildren(...told.notes.map((n) => make("li", n)));
}

async function compare() {
  const { a, b } = names();
  by("viewer").hidden = by("compared").hidden = true;
  told = null;
  if (!a || !b) return;
  try {
    told = await get("compare", { a, b });
    complain("told");
    history.replaceState(null, "", `/compare?${new URLSearchParams({ a, b })}`);
    by("viewer").hidden = false;
    options();
    build();
    showTable();
    await showMap();
  } catch (error) { complain("told", error); }
}

await begin();
try {
  const { scans } = await get("scans");
  const good = scans.filter((s) => s.processed || s.images_only).map((s) => s.name);
  for (const id of ["a", "b"]) {
    by(id).append(make("option", "–", null, { value: "" }), ...good.map((name) => make("option", name, null, { value: name })));
    by(id).value = good.includes(query.get(id)) ? query.get(id) : "";
    by(id).addEventListener("change", compare);
  }
  by("map").addEventListener("change", showMap);
  by("swipe").addEventListener("input", () => views?.a.show({ swipe: by("swipe").value / 100 }));
  for (const button of document.querySelectorAll("#head button")) {
    button.addEventListener("click", () => { how = button.value; options(); showMap(); });
  }
  options();
  await compare();
} catch (error) { complain("told", error); }
