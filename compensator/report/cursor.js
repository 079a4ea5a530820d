"use strict";
// Zoom on the time axis and values at a cursor. Without this script, and in print, each plot shows all of its data.

const SVG = "http://www.w3.org/2000/svg";
const HINT = "Drag to zoom, double-click to show all. Values at the cursor appear here.";
// A finger that is moved over a wide plot scrolls it.
const TAP = "Tap the plot: its values there appear here. Two fingers enlarge it.";
const KEYS = "Arrow keys move the cursor, + and − zoom, 0 shows all; after a click, the wheel zooms, too.";
const MONTHS = ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"];
// Steps of a time of day, min.
const CLOCK_MIN = [1, 2, 5, 10, 15, 30, 60, 120, 180, 360, 720, 1440, 2880, 7200, 14400, 43200];
const MINUTES = 1440;

const two = (number) => String(number).padStart(2, "0");
const signed = (text) => text.replace("-", "−");

function made(name, attributes, parent) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (parent) parent.append(node);
  return node;
}

class Plot {
  constructor(svg) {
    this.svg = svg;
    Object.assign(this, JSON.parse(svg.dataset.plot));
    const [first, last] = [this.panels[0], this.panels[this.panels.length - 1]];
    [this.left, this.top, this.right] = first.box;
    this.bottom = last.box[3];
    this.width = this.right - this.left;
    [this.from, this.to] = this.x;
    this.at = null;
    this.axes = this.panels.map((panel) => document.getElementById(panel.id));
    this.readout = document.createElement("output");
    this.readout.className = "readout";
    this.box = svg.closest(".scroll");
    this.readout.textContent = this.hint;
    (this.box ?? svg).after(this.readout);
    svg.setAttribute("tabindex", "0");
    svg.setAttribute("aria-description", KEYS);
    this.listen();
  }

  // Whether the plot is wider than its box, so that a finger scrolls it.
  get scrolls() { return this.box?.dataset.scrolls === "true"; }

  get hint() { return this.scrolls && matchMedia("(pointer: coarse)").matches ? TAP : HINT; }

  get zoomed() { return this.to - this.from < (this.x[1] - this.x[0]) * 0.9999; }

  // Where a point of the whole plot is in the present stretch; both in units of the picture.
  moved(x) {
    const all = this.x[1] - this.x[0];
    return this.left + (x - this.left - (this.from - this.x[0]) / all * this.width) * all / (this.to - this.from);
  }

  value(x) { return this.from + (x - this.left) / this.width * (this.to - this.from); }

  place(value) { return this.left + (value - this.from) / (this.to - this.from) * this.width; }

  // ---------------------------------------------------------------- the shapes that move

  get shapes() {
    if (this.known) return this.known;
    this.known = [];
    const outline = (path) => {
      const whole = path.getAttribute("d");
      this.known.push({path, whole, parts: whole.trim().split(/\s+/)});
    };
    for (const axes of this.axes) for (const child of axes.children) {
      if (/axis_|legend|text/.test(child.id)) continue;
      const uses = [...child.querySelectorAll("[clip-path] > use")];
      child.querySelectorAll("path[clip-path]").forEach(outline);
      // A filled area is drawn once at 0, a marker at each of its points.
      if (uses.some((use) => Number(use.getAttribute("x")) === 0)) child.querySelectorAll("defs path").forEach(outline);
      else for (const use of uses) this.known.push({use, whole: use.getAttribute("x")});
    }
    return this.known;
  }

  show(from, to) {
    const [low, high] = this.x, least = (high - low) / 2000;
    const span = Math.min(Math.max(to - from, least), high - low);
    this.from = Math.min(Math.max((from + to - span) / 2, low), high - span);
    this.to = this.from + span;
    for (const shape of this.shapes) {
      if (!this.zoomed) { (shape.use ?? shape.path).setAttribute(shape.use ? "x" : "d", shape.whole); continue; }
      if (shape.use) { shape.use.setAttribute("x", this.moved(Number(shape.whole)).toFixed(3)); continue; }
      let isX = true;
      shape.path.setAttribute("d", shape.parts.map((part) => {
        if (/[a-z]/i.test(part)) { isX = true; return part; }
        const number = isX ? this.moved(Number(part)).toFixed(3) : part;
        isX = !isX;
        return number;
      }).join(" "));
    }
    this.ticks();
    this.point(this.at);
  }

  // ---------------------------------------------------------------- the time axis

  // Offset of the zone at a time, in the unit of the axis.
  offset(value) {
    return this.zone.reduce((found, [from, offset]) => from <= value ? offset : found, this.zone[0][1]);
  }

  steps() {
    const rough = (this.to - this.from) / 8;
    if (this.clock) {
      const step = (CLOCK_MIN.find((one) => one / MINUTES >= rough) ?? CLOCK_MIN[CLOCK_MIN.length - 1]) / MINUTES;
      const shift = this.offset(this.from);
      return {step, first: Math.ceil((this.from + shift) / step - 1e-9) * step - shift};
    }
    const ten = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((factor) => factor * ten).find((one) => one >= rough * 0.9999);
    return {step, first: Math.ceil(this.from / step - 1e-9) * step};
  }

  label(value, step) {
    if (!this.clock) return signed(value.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9))));
    const time = this.time(value), clock = `${two(time.getUTCHours())}:${two(time.getUTCMinutes())}`;
    return step === 0 ? `${this.date(value)} ${clock}` : clock === "00:00" ? this.date(value).slice(5) : clock;
  }

  // The time of day in the zone of the plot, as if it were UTC.
  time(value) { return new Date(Math.round((value + this.offset(value)) * MINUTES) * 60_000); }

  date(value) {
    const time = this.time(value);
    return `${time.getUTCFullYear()}-${MONTHS[time.getUTCMonth()]}-${two(time.getUTCDate())}`;
  }

  ticks() {
    const marks = this.axes.flatMap((axes) => [...axes.querySelectorAll('[id*="-xtick_"]')]);
    // The date in the corner is that of the whole plot.
    const corners = this.clock ? this.axes.flatMap((axes) => [...axes.querySelectorAll('[id*="axis_"] > g > text')])
      .filter((one) => /^\s*\d{4}/.test(one.textContent)) : [];
    [...marks, ...corners].forEach((mark) => { mark.style.display = this.zoomed ? "none" : ""; });
    if (this.own) this.own.remove();
    this.own = null;
    if (!this.zoomed) return;
    this.own = made("g", {class: "own-ticks"});
    const text = marks.map((mark) => mark.querySelector("text")).filter(Boolean).pop();
    const {step, first} = this.steps();
    for (let k = 0; first + k * step <= this.to + 1e-9 * step; k++) {
      const x = this.place(first + k * step);
      for (const {box} of this.panels) made("line", {x1: x, x2: x, y1: box[1], y2: box[3]}, this.own);
      if (!text) continue;
      const label = made("text", {x, y: text.getAttribute("y"), style: text.getAttribute("style")}, this.own);
      label.style.textAnchor = "middle";
      label.textContent = this.label(first + k * step, step);
    }
    if (this.clock && text) {
      const y = corners.length ? corners[0].getAttribute("y") : Number(text.getAttribute("y")) + 14;
      const corner = made("text", {x: this.right, y, style: text.getAttribute("style"), class: "date"}, this.own);
      corner.style.textAnchor = "end";
      corner.textContent = this.date(this.to);
    }
    // Behind the curves.
    this.axes[0].before(this.own);
  }

  // ---------------------------------------------------------------- values

  // Points of a curve on the whole plot: its pieces, each a row of x and y.
  pieces(id) {
    this.curves ??= new Map();
    if (!this.curves.has(id)) {
      const shape = this.shapes.find((one) => one.path?.parentNode.id === id), found = [];
      for (let i = 0; shape && i + 2 < shape.parts.length; i += 3) {
        if (shape.parts[i] === "M") found.push([]);
        found[found.length - 1].push([Number(shape.parts[i + 1]), Number(shape.parts[i + 2])]);
      }
      this.curves.set(id, found);
    }
    return this.curves.get(id);
  }

  // Height of a curve at an x of the whole plot; undefined in a gap.
  height(id, x) {
    for (const piece of this.pieces(id)) {
      const after = piece.findIndex(([one]) => one >= x - 1e-6);
      if (after < 0) continue;
      const [x1, y1] = piece[after], [x0, y0] = piece[Math.max(after - 1, 0)];
      if (x0 <= x + 1e-6) return x1 > x0 ? y0 + (y1 - y0) * (x - x0) / (x1 - x0) : y1;
    }
    return undefined;
  }

  read(panel, id, x) {
    const height = this.height(id, x), [, top, , bottom] = panel.box, [low, high] = panel.y;
    if (height === undefined) return "–";
    const share = (bottom - height) / (bottom - top);
    if (panel.log) return (low * (high / low) ** share).toPrecision(3);
    return signed((low + share * (high - low)).toFixed(Math.max(0, Math.ceil(-Math.log10((high - low) / 1000)))));
  }

  point(value, spoken = false) {
    this.cursor?.remove();
    this.cursor = null;
    if (value === null || value < this.from || value > this.to) { this.readout.textContent = this.hint; return; }
    this.at = value;
    const x = this.place(value), all = this.left + (value - this.x[0]) / (this.x[1] - this.x[0]) * this.width;
    this.cursor = made("line", {class: "cursor", x1: x, x2: x, y1: this.top, y2: this.bottom}, this.svg);
    const values = this.panels.flatMap((panel) => panel.lines.map(({id, name}) => `${name} ${this.read(panel, id, all)} ${panel.unit}`));
    const digits = Math.max(0, Math.ceil(-Math.log10((this.to - this.from) / 1000)));
    const when = this.clock ? this.label(value, 0) : `${signed(value.toFixed(digits))} ${this.unit}`;
    this.readout.setAttribute("aria-live", spoken ? "polite" : "off");
    this.readout.textContent = [when, ...values].join(" · ");
  }

  // ---------------------------------------------------------------- mouse, finger, keys

  listen() {
    const {svg} = this;
    const at = (event) => {
      const to = svg.getScreenCTM();
      return Math.min(Math.max((event.clientX - to.e) / to.a, this.left), this.right);
    };
    let start = null, box = null;
    const end = () => { box?.remove(); start = box = null; };
    svg.addEventListener("pointerdown", (event) => {
      if (event.button === 0 && !(event.pointerType === "touch" && this.scrolls)) start = at(event);
    });
    svg.addEventListener("pointermove", (event) => {
      const x = at(event);
      this.point(this.value(x));
      if (start === null || Math.abs(x - start) < 4) { box?.remove(); box = null; return; }
      if (!box) { box = made("rect", {class: "stretch", y: this.top, height: this.bottom - this.top}, svg); svg.setPointerCapture(event.pointerId); }
      box.setAttribute("x", Math.min(x, start));
      box.setAttribute("width", Math.abs(x - start));
    });
    svg.addEventListener("pointerup", (event) => {
      const [one, other] = [start, at(event)];
      const zooms = box !== null;
      end();
      if (zooms) this.show(this.value(Math.min(one, other)), this.value(Math.max(one, other)));
      // A finger has no cursor: what it tapped stays.
      else if (event.pointerType === "touch") this.point(this.value(other));
    });
    svg.addEventListener("pointercancel", end);
    svg.addEventListener("pointerleave", (event) => { if (start === null && event.pointerType !== "touch" && document.activeElement !== svg) this.point(null); });
    svg.addEventListener("dblclick", () => this.show(...this.x));
    svg.addEventListener("wheel", (event) => {
      // A page scrolls past its plots until one is clicked.
      if (document.activeElement !== svg || event.deltaY === 0) return;
      event.preventDefault();
      this.zoom(event.deltaY < 0 ? 0.8 : 1.25, this.value(at(event)));
    }, {passive: false});
    svg.addEventListener("keydown", (event) => this.key(event));
    addEventListener("beforeprint", () => { this.at = null; if (this.zoomed) this.show(...this.x); else this.point(null); });
  }

  zoom(factor, about) {
    this.show(about - (about - this.from) * factor, about + (this.to - about) * factor);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const middle = (this.from + this.to) / 2, step = (this.to - this.from) / 100;
    const move = (by) => {
      const value = Math.min(Math.max((this.at ?? middle) + by, this.x[0]), this.x[1]);
      const beyond = value < this.from ? value - this.from : Math.max(0, value - this.to);
      if (beyond) this.show(this.from + beyond, this.to + beyond);
      this.point(value, true);
    };
    const done = {
      ArrowLeft: () => move(-step), ArrowRight: () => move(step),
      "+": () => this.zoom(0.5, this.at ?? middle), "=": () => this.zoom(0.5, this.at ?? middle), "-": () => this.zoom(2, this.at ?? middle),
      0: () => this.show(...this.x), Escape: () => this.show(...this.x),
    }[event.key];
    if (!done) return;
    event.preventDefault();
    done();
  }
}

// Only a table or plot that is wider than its box says that it scrolls.
function fits() {
  for (const box of document.querySelectorAll('.scroll[role="region"]')) box.dataset.scrolls = box.scrollWidth > box.clientWidth + 1;
}
fits();
addEventListener("resize", fits);
for (const details of document.querySelectorAll("details")) details.addEventListener("toggle", fits);
for (const svg of document.querySelectorAll("svg[data-plot]")) new Plot(svg);
