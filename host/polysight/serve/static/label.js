// Boxes drawn by hand: where they are, what lies in them, which is metal; saved beside the scan for processing and training.
import { by, complain, make, nest, post } from "./common.js";
import { caption, outline } from "./view.js";

export class Labels {
  constructor(scan, changed, opened) {
    Object.assign(this, { scan, changed, opened, open: false, boxes: [], patches: [], touched: false });
    by("from-patches").addEventListener("click", () => this.fromPatches());
    by("save-labels").addEventListener("click", () => this.save());
  }

  /** What is saved already, unless somebody is drawing. */
  load(result) {
    this.patches = result.patches;
    if (this.touched) return;
    const { boxes = {}, metal, specimens = {}, problem } = result.labels ?? {};
    this.boxes = Object.entries(boxes).map(([name, box]) => ({ name, box, metal: name === metal, specimen: specimens[name] ?? "" }));
    by("label-told").textContent = problem ?? "";
    this.show();
  }

  toggle() {
    this.open = !this.open;
    by("label").hidden = !this.open;
    by("probe").hidden = this.open;
    this.opened(this.open);
  }

  add(box, name = "", metal = false) {
    this.boxes.push({ name, box, metal, specimen: "" });
    this.touched = true;
    this.show();
    if (!name) by("boxes").lastChild.querySelector("input").focus();
  }

  fromPatches() {
    const margin = (a, b) => Math.min(9, 0.3 * (b - a)); // edges of a plate are mixed
    this.boxes = [];
    for (const p of this.patches) {
      const [x0, y0, x1, y1] = p.box_mm, mx = margin(x0, x1), my = margin(y0, y1);
      const named = p.name_source === "library" ? p.name : "";
      const box = [x0 + mx, y0 + my, x1 - mx, y1 - my].map((v) => Math.round(v * 10) / 10);
      this.boxes.push({ name: p.metal_reference ? "metal" : named, box, metal: Boolean(p.metal_reference), specimen: "" });
    }
    this.touched = true;
    this.show();
  }

  show() {
    by("boxes").replaceChildren(...this.boxes.map((b, i) => this.#row(b, i)));
    this.changed();
  }

  #row(b, i) {
    const change = (set) => (event) => { set(event.target); this.touched = true; this.changed(); };
    const name = make("input", null, null, { value: b.name, placeholder: "material", list: "known", maxLength: 80, "aria-label": `Material of box ${i + 1}`, oninput: change((f) => { b.name = f.value; }) });
    const piece = make("input", null, null, { value: b.specimen, placeholder: "piece", maxLength: 80, "aria-label": `Which piece lies in box ${i + 1}`, oninput: change((f) => { b.specimen = f.value; }) });
    const metal = make("input", null, null, { type: "radio", name: "metal", checked: b.metal, onchange: change(() => { this.boxes.forEach((o) => { o.metal = o === b; }); }) });
    const remove = make("button", "Remove", "danger", { type: "button", onclick: () => { this.boxes.splice(i, 1); this.touched = true; this.show(); } });
    const corners = make("div", `${i + 1}, mm: `, "corners");
    ["left", "lower", "right", "upper"].forEach((side, k) => corners.append(make("input", null, null, {
      type: "number", step: "0.5", value: b.box[k], "aria-label": `${side} edge of box ${i + 1}, mm`, oninput: change((f) => { if (f.value !== "") b.box[k] = +f.value; }),
    })));
    return nest(make("li"), name, piece, nest(make("label", null, "row"), metal, "metal"), remove, corners);
  }

  overlay(pen, at) {
    if (!this.open) return;
    for (const [i, b] of this.boxes.entries()) {
      const [x0, y1] = at(b.box[0], b.box[1]), [x1, y0] = at(b.box[2], b.box[3]);
      outline(pen, () => pen.strokeRect(x0, y0, x1 - x0, y1 - y0), b.metal ? "#f2b632" : "#7cc7f7");
      const isWide = x1 - x0 > 7.5 * b.name.length;
      caption(pen, b.name && isWide ? b.name : String(i + 1), (x0 + x1) / 2, (y0 + y1) / 2); // names of neighbours would overlap
    }
  }

  async save() {
    const boxes = {}, specimens = {};
    complain("label-told");
    for (const b of this.boxes) {
      const name = b.name.trim();
      if (name in boxes || !name) {
        by("label-told").textContent = name ? `Two boxes are called ${name}: call one ${name}#2, a second piece of it.` : "A box has no name yet.";
        by("label-told").classList.add("wrong");
        return;
      }
      boxes[name] = b.box;
      if (b.specimen.trim()) specimens[name] = b.specimen.trim();
    }
    try {
      const told = await post("labels", this.scan, { boxes, metal: this.boxes.find((b) => b.metal)?.name.trim() ?? null, specimens });
      this.touched = false;
      const left = Boolean(told.file);
      const done = left ? "Saved. Process again to use them here; to learn from them, choose the scans in the list and make a library." : "No box is left: the saved ones are deleted.";
      by("label-told").textContent = [done, ...told.notes.map((n) => `Note: ${n}.`)].join(" ");
      by("use-labels").disabled = !left;
      by("use-labels").checked = left;
    } catch (error) { complain("label-told", error); }
  }
}
