// A picture with axes in millimetres: zoom, pan, a place to point at, boxes to draw; by mouse, finger and keyboard.
import { make, signed } from "./common.js";
import { ticks } from "./plots.js";

const LEFT = 46, BOTTOM = 38, TOP = 8, RIGHT = 16;
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/**
 * options: { extent: [left, right, low, high] in mm, label, onpick(x, y), onbox([x0, y0, x1, y1]), onview(view), overlay(pen, at) }
 * `show({ image, second, swipe })` draws; `drawing` true makes a drag a box.
 */
export class ImageView {
  constructor(place, options) {
    this.extent = options.extent;
    this.options = options;
    this.view = [...this.extent];
    this.shown = {};
    this.cursor = null;
    this.drawing = false;
    this.box = null;
    this.pointers = new Map();
    const keys = "Arrow keys move the cross, Enter looks at its place, plus and minus zoom, 0 shows all.";
    this.canvas = make("canvas", null, "imageview", { tabIndex: 0, role: "application", "aria-label": `${options.label}. ${keys}` });
    this.said = make("p", null, "soft said", { "aria-live": "polite" });
    place.replaceChildren(this.canvas, this.#buttons(), this.said);
    for (const kind of ["pointerdown", "pointermove", "pointerup", "pointercancel", "pointerleave"]) {
      this.canvas.addEventListener(kind, (event) => this.#pointer(kind.slice(7), event));
    }
    this.canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && document.activeElement !== this.canvas) return; // the page scrolls otherwise
      event.preventDefault();
      this.zoom(event.deltaY < 0 ? 1.25 : 0.8, ...this.#place(event));
    }, { passive: false });
    this.canvas.addEventListener("keydown", (event) => this.#key(event));
    this.canvas.addEventListener("focus", () => this.draw());
    this.canvas.addEventListener("blur", () => this.draw());
    new ResizeObserver(() => this.draw()).observe(place);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  #buttons() {
    const bar = make("div", null, "zoom row");
    for (const [text, title, onclick] of [["+", "Zoom in", () => this.zoom(1.6)], ["−", "Zoom out", () => this.zoom(1 / 1.6)], ["All", "Show all", () => this.look(this.extent)]]) {
      bar.append(make("button", text, null, { type: "button", title, onclick }));
    }
    return bar;
  }

  show(what) { this.shown = { ...this.shown, ...what }; this.draw(); }

  /** Another part of the plane, [left, right, low, high] mm, kept within the image. */
  look(view, told = true) {
    const [l, r, b, t] = this.extent;
    const wide = Math.min(view[1] - view[0], r - l), high = Math.min(view[3] - view[2], t - b);
    const x = Math.min(Math.max(view[0], l), r - wide), y = Math.min(Math.max(view[2], b), t - high);
    this.view = [x, x + wide, y, y + high];
    this.draw();
    if (told) this.options.onview?.(this.view);
  }

  zoom(factor, x, y) {
    const [l, r, b, t] = this.view;
    const cx = x ?? this.cursor?.[0] ?? (l + r) / 2, cy = y ?? this.cursor?.[1] ?? (b + t) / 2;
    if (factor > 1 && (r - l) / factor < 10) return;
    this.look([cx - (cx - l) / factor, cx + (r - cx) / factor, cy - (cy - b) / factor, cy + (t - cy) / factor]);
  }

  get #area() {
    const wide = this.canvas.clientWidth - LEFT - RIGHT;
    return { wide, high: wide * (this.extent[3] - this.extent[2]) / (this.extent[1] - this.extent[0]) };
  }

  #place(event) {
    const box = this.canvas.getBoundingClientRect(), { wide, high } = this.#area, [l, r, b, t] = this.view;
    return [l + ((event.clientX - box.left - LEFT) / wide) * (r - l), t - ((event.clientY - box.top - TOP) / high) * (t - b)];
  }

  #inside([x, y]) { const [l, r, b, t] = this.view; return x >= l && x <= r && y >= b && y <= t; }

  #clip([x, y]) {
    const [l, r, b, t] = this.extent;
    return [Math.min(Math.max(x, l), r), Math.min(Math.max(y, b), t)];
  }

  #pointer(kind, event) {
    const at = this.#place(event);
    if (kind === "down" && this.#inside(at)) {
      this.canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, { from: at, at, x: event.clientX, y: event.clientY, moved: false });
    }
    const own = this.pointers.get(event.pointerId);
    if (kind === "move" && own) {
      own.moved ||= Math.hypot(event.clientX - own.x, event.clientY - own.y) > 5;
      if (this.pointers.size === 2) this.#pinch(event, own);
      else if (this.drawing && own.moved) { this.box = [...own.from, ...this.#clip(at)]; this.draw(); }
      else if (own.moved) this.look([this.view[0] + own.from[0] - at[0], this.view[1] + own.from[0] - at[0], this.view[2] + own.from[1] - at[1], this.view[3] + own.from[1] - at[1]]);
    } else if (kind === "move") {
      this.said.textContent = this.#inside(at) ? placeText(at) : "";
    }
    if ((kind === "up" || kind === "cancel") && own) {
      this.pointers.delete(event.pointerId);
      if (kind === "up" && this.box) this.#endBox();
      else if (kind === "up" && !own.moved) this.pick(at);
    }
  }

  #pinch(event, own) {
    const [one, other] = [...this.pointers.values()];
    const before = Math.hypot(one.x - other.x, one.y - other.y);
    own.x = event.clientX;
    own.y = event.clientY;
    const after = Math.hypot(one.x - other.x, one.y - other.y);
    if (before > 0 && after > 0) this.zoom(after / before, (one.from[0] + other.from[0]) / 2, (one.from[1] + other.from[1]) / 2);
  }

  #endBox() {
    const [x0, y0, x1, y1] = this.box;
    this.box = null;
    const made = [Math.min(x0, x1), Math.min(y0, y1), Math.max(x0, x1), Math.max(y0, y1)];
    if (made[2] - made[0] > 1 && made[3] - made[1] > 1) this.options.onbox?.(made.map((v) => Math.round(v * 10) / 10));
    this.draw();
  }

  /** Point at a place, and say so. */
  pick(at) {
    this.cursor = this.#clip(at);
    this.said.textContent = placeText(this.cursor);
    this.draw();
    this.options.onpick?.(...this.cursor);
  }

  #key(event) {
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (steps) {
      const step = (event.shiftKey ? 10 : 2), [l, r, b, t] = this.view;
      const from = this.cursor ?? [(l + r) / 2, (b + t) / 2];
      this.cursor = this.#clip([from[0] + step * steps[0], from[1] + step * steps[1]]);
      if (!this.#inside(this.cursor)) this.look([l + step * steps[0], r + step * steps[0], b + step * steps[1], t + step * steps[1]]);
      this.said.textContent = placeText(this.cursor);
      this.draw();
    } else if (event.key === "Enter" || event.key === " ") this.#enter();
    else if (event.key === "+" || event.key === "=") this.zoom(1.6);
    else if (event.key === "-") this.zoom(1 / 1.6);
    else if (event.key === "0") this.look(this.extent);
    else if (event.key === "Escape") { this.corner = null; this.box = null; this.draw(); }
    else return;
    event.preventDefault();
  }

  #enter() {
    if (!this.cursor) return;
    if (!this.drawing) return this.pick(this.cursor);
    if (!this.corner) { this.corner = this.cursor; this.said.textContent = "First corner set; move, and press Enter for the other."; return; }
    this.box = [...this.corner, ...this.cursor];
    this.corner = null;
    this.#endBox();
  }

  draw() {
    const { wide, high } = this.#area, canvas = this.canvas;
    if (wide <= 0) return;
    const ratio = window.devicePixelRatio || 1;
    canvas.style.height = `${high + TOP + BOTTOM}px`;
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round((high + TOP + BOTTOM) * ratio);
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    const [l, r, b, t] = this.view;
    const at = (x, y) => [LEFT + ((x - l) / (r - l)) * wide, TOP + ((t - y) / (t - b)) * high];
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, TOP, wide, high);
    pen.clip();
    pen.fillStyle = colour("--well");
    pen.fillRect(LEFT, TOP, wide, high);
    this.#images(pen, at, wide);
    this.options.overlay?.(pen, at);
    this.#marks(pen, at);
    pen.restore();
    this.#axes(pen, at, wide, high);
  }

  #images(pen, at, wide) {
    const { image, second, swipe } = this.shown, [l, r, b, t] = this.extent;
    const [x0, y0] = at(l, t), [x1, y1] = at(r, b);
    pen.imageSmoothingEnabled = false;
    if (image) pen.drawImage(image, x0, y0, x1 - x0, y1 - y0);
    if (!second) return;
    const edge = LEFT + wide * swipe;
    pen.save();
    pen.beginPath();
    pen.rect(edge, 0, wide, 1e4);
    pen.clip();
    pen.fillStyle = colour("--well");
    pen.fillRect(edge, 0, wide, 1e4);
    pen.drawImage(second, x0, y0, x1 - x0, y1 - y0);
    pen.restore();
    outline(pen, () => { pen.beginPath(); pen.moveTo(edge, 0); pen.lineTo(edge, 1e4); pen.stroke(); }, "#ffffff");
  }

  #marks(pen, at) {
    const corners = this.box ?? (this.corner && this.cursor ? [...this.corner, ...this.cursor] : null);
    if (corners) {
      const [x0, y0] = at(corners[0], corners[1]), [x1, y1] = at(corners[2], corners[3]);
      outline(pen, () => pen.strokeRect(x0, y0, x1 - x0, y1 - y0), "#ffffff");
    }
    if (!this.cursor) return;
    const [x, y] = at(...this.cursor);
    outline(pen, () => {
      pen.beginPath();
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) { pen.moveTo(x + 4 * dx, y + 4 * dy); pen.lineTo(x + 14 * dx, y + 14 * dy); }
      pen.stroke();
    }, "#ffffff");
  }

  #axes(pen, at, wide, high) {
    const [l, r, b, t] = this.view;
    pen.strokeStyle = colour("--edge");
    pen.lineWidth = 1;
    pen.strokeRect(LEFT + 0.5, TOP + 0.5, wide - 1, high - 1);
    pen.fillStyle = colour("--soft");
    pen.font = "12px system-ui, sans-serif";
    pen.textAlign = "center";
    for (const v of ticks(l, r, Math.min(8, wide / 60))) {
      const [x] = at(v, 0);
      pen.fillRect(x, TOP + high, 1, 4);
      pen.fillText(String(v).replace("-", "−"), x, TOP + high + 17);
    }
    pen.fillText("x, mm", LEFT + wide / 2, TOP + high + 32);
    pen.textAlign = "right";
    for (const v of ticks(b, t, Math.min(8, high / 40))) {
      const [, y] = at(0, v);
      pen.fillRect(LEFT - 4, y, 4, 1);
      pen.fillText(String(v).replace("-", "−"), LEFT - 7, y + 4);
    }
    pen.save();
    pen.translate(11, TOP + high / 2);
    pen.rotate(-Math.PI / 2);
    pen.textAlign = "center";
    pen.fillText("y, mm", 0, 0);
    pen.restore();
  }
}

const placeText = ([x, y]) => `x ${signed(x, 1)}, y ${signed(y, 1)} mm`;

/** A line that is seen on light and on dark. */
export function outline(pen, draw, ink) {
  pen.strokeStyle = "#000000";
  pen.lineWidth = 4;
  draw();
  pen.strokeStyle = ink;
  pen.lineWidth = 2;
  draw();
}

/** Text that is seen on light and on dark. */
export function caption(pen, text, x, y) {
  pen.font = "600 13px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.lineWidth = 4;
  pen.strokeStyle = "#000000";
  pen.strokeText(text, x, y);
  pen.fillStyle = "#ffffff";
  pen.fillText(text, x, y);
}
