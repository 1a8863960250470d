// What a scan says of one place: numbers, nearest materials, and the range profile through it.
import { by, called, complain, get, make, permittivity, rich, signed } from "./common.js";
import { plot } from "./plots.js";

const number = (v, digits = 3) => (v === null || v === undefined ? "not known" : v.toPrecision(digits).replace("-", "−"));
const db = (v) => (v === null ? "nothing" : `${signed(v, 1)} dB`);

function complex({ real, imag }) {
  return `${number(real)} ${imag < 0 ? "−" : "+"} j ${number(Math.abs(imag))}`;
}

/** Forget the place: it was of products that are gone. */
export function clearProbe() {
  by("probe-facts").replaceChildren();
  by("profile-why").replaceChildren();
  by("profile").hidden = true;
}

/** Ask for a place and show it while it `isCurrent`; returns what was told. */
export async function showProbe(scan, x, y, library, isCurrent) {
  let told;
  try {
    told = await get("probe", { ...scan, x: x.toFixed(2), y: y.toFixed(2), library });
    if (!isCurrent()) return null;
    complain("probe-hint");
  } catch (error) { complain("probe-hint", error); return null; }
  by("probe-hint").textContent = told.lit ? "" : "The scan does not illuminate this position.";
  const facts = [["place", `x ${signed(told.place_mm[0], 1)}, y ${signed(told.place_mm[1], 1)} mm`],
    ["|H|, |V|", `${db(told.h_db)}, ${db(told.v_db)}${told.referenced ? " relative to metal" : ""}`],
    ["P", told.p.real === null ? "nothing" : `${complex(told.p)}${told.p_sigma === null ? "" : ` ± ${number(told.p_sigma, 2)}`}`]];
  if (told.permittivity) {
    const error = { real_std: told.permittivity_real_std, imag_std: told.permittivity_loss_std };
    facts.push(["permittivity", `${permittivity({ ...told.permittivity, ...error })}, as a half space`]);
  } else facts.push(["permittivity", told.why]);
  if (told.patch) {
    const p = told.patch;
    facts.push(["in patch", `${p.label}, ${p.metal_reference ? "the metal reference" : called(p.name)}`]);
    if (p.permittivity) facts.push(["the patch's", permittivity(p.permittivity)]);
    const likely = Object.entries(p.probabilities ?? {}).map(([name, share]) => `${name === "unknown" ? "none of these" : name} ${Math.round(100 * share)} %`);
    if (likely.length) facts.push(["likeliest", likely.slice(0, 4).join(", ")]);
    if (p.bands?.length) facts.push(["sub-bands, P", p.bands.map((b) => (b.ratio ? complex(b.ratio) : "–")).join("; ")]);
  }
  if (told.nearest.length) facts.push(["nearest by P", told.nearest.map((n) => `${n.name} (${n.sigmas} σ)`).join(", ")]);
  by("probe-facts").replaceChildren(...facts.flatMap(([name, text]) => [make("dt", name), make("dd", text)]));
  by("profile").hidden = !told.profile;
  by("profile-why").replaceChildren(...rich(told.profile_why && `No range profile: ${told.profile_why}.`));
  if (told.profile) {
    const { path_m: path, boards } = told.profile;
    plot(by("profile"), {
      x: [path[0] * 1e3, path.at(-1) * 1e3], y: [-50, 5], xLabel: "path longer than to this place, mm", yLabel: "dB",
      lines: Object.entries(boards).map(([name, levels], i) => ({ x: path.map((m) => m * 1e3), y: levels, name, style: `receiver${i}` })),
      upright: [{ x: 0, name: "here" }],
    });
  }
  return told;
}
