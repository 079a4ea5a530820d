"use strict";
// The plots of the live page: the last day of a machine, zoomed on the time axis together.
const KEYS = "Arrow keys move the cursor, + and − zoom, 0 shows all.";
// The part of the day that all plots show, s since 1970; null for all of it.
let shown = null, dragging = false;

const gap = () => Math.max(150, current_valid);
let current_valid = 150;

function pictures(machine, history, end) {
  current_valid = machine.valid_for_s ?? 150;
  const width = $("pictures").clientWidth;
  if (dragging) return;
  const key = `${shown} ${machine.prefix} ${width} ${JSON.stringify([history.t_s.length, ...["t_s", "y_offset_um", "residual_um", "t_q_degc", "y_dtf_um"].map((n) => history[n][history[n].length - 1])])} ${Math.floor(end / 60)}`;
  if (key === drawn) return;
  drawn = key;
  const whole = [Math.max(end - DAY_S, Math.min(history.t_s[0] ?? end, end - 600)), end];
  const [from, to] = shown ?? whole;
  const frame = {from, end: to, whole, width, t: history.t_s, show: (part) => { shown = part; pictures(machine, past.history, end); }};
  const line = (name, y, band) => ({name, y, band});
  const count = Math.max(0, ...history.effects.map((one) => one.length));
  const several = count > (machine.probe ? 2 : 3)
    ? [line("effects together", history.effects.map((one) => one.length ? one.reduce((a, b) => a + (b ?? NaN), 0) : null))]
    : Array.from({length: count}, (_, i) => line(effects[i] ?? `effect ${i + 1}`, history.effects.map((one) => one[i] ?? null)));
  const probes = machine.probe ? [line("probes", history.y_pred_um.map((y, i) => [y, history.y_base_um[i], history.y_dtf_um[i], history.y_tdtf_um[i], ...history.effects[i]].every(known)
    ? y + history.y_base_um[i] - history.y_dtf_um[i] - history.y_tdtf_um[i] - history.effects[i].reduce((a, b) => a + b, 0) : null))] : [];
  const plots = () => [...document.querySelectorAll("#machine figure > svg")], focused = plots().indexOf(document.activeElement);
  $("loop-picture").replaceChildren(...shadow(frame, machine, history));
  $("pictures").replaceChildren(
    chart(frame, "Offset, added to the commanded Y, with its standard deviation", "µm", [line("offset", history.y_offset_um, history.y_offset_std_um)], history.state),
    chart(frame, "Predicted deformation by path", "µm", [line("DTF (heat)", history.y_dtf_um), line("TDTF (air)", history.y_tdtf_um), ...several, ...probes]),
    chart(frame, "Residual: measured − predicted deformation", "µm", [line("residual", history.residual_um)]),
    chart(frame, "Temperatures", "°C", [line("T_Q", history.t_q_degc), line("AT", history.at_degc)]));
  plots()[focused]?.focus({preventScroll: true});
}

function ticks(low, high, count) {
  const rough = (high - low) / count, ten = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((m) => m * ten).find((s) => s >= rough);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
  return {found, digits: Math.max(0, -Math.floor(Math.log10(step)))};
}

function hours(from, end, count) {
  const steps = [60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 14400, 21600];
  const step = steps.find((s) => (end - from) / s <= count) ?? 43200;
  const shift = new Date(1000 * end).getTimezoneOffset() * 60, found = [];
  for (let t = Math.ceil((from - shift) / step) * step + shift; t <= end; t += step) found.push(t);
  return found;
}

function chart(frame, title, unit, series, states) {
  const {from, end, width, t} = frame, inside = (i) => t[i] >= from && t[i] <= end;
  const left = 52, right = 8, top = 6, strip = states ? 26 : 0, tall = width < 500 ? 170 : 210, height = tall + strip + 40;
  const caption = make("figcaption", {}, title), keys = make("ul", {class: "keys"});
  const values = series.flatMap((one) => one.y.flatMap((v, i) => known(v) && inside(i) ? (one.band && known(one.band[i]) ? [v - one.band[i], v + one.band[i]] : [v]) : []));
  const ranges = series.map((one) => { const seen = one.y.filter((v, i) => known(v) && inside(i)); return seen.length ? `${one.name} last ${plain(seen[seen.length - 1])} ${unit}, from ${plain(Math.min(...seen))} to ${plain(Math.max(...seen))}` : `${one.name}: no values`; });
  const svg = make("svg", {viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${title}. ${ranges.join("; ")}; ${frame.whole[1] === end ? `in the last ${((end - from) / 3600).toFixed(1)} h` : `from ${clock(from)} to ${clock(end)}`}.`, tabindex: 0, "aria-description": KEYS});
  const readout = make("output", {class: "readout"}), figure = make("figure", {}, caption, keys, svg, readout);
  series.forEach((one, i) => keys.append(make("li", {}, make("svg", {viewBox: "0 0 32 12", "aria-hidden": "true"}, make("path", {d: "M0 6H32", class: `curve c${i}`})), one.name)));
  if (!values.length) { keys.replaceChildren(make("li", {}, "no values yet")); }
  let low = values.length ? Math.min(...values) : 0, high = values.length ? Math.max(...values) : 1;
  if (high - low < 0.2) { const middle = (high + low) / 2; low = middle - 0.1; high = middle + 0.1; }
  const margin = 0.06 * (high - low); low -= margin; high += margin;
  const x = (s) => left + (s - from) / (end - from) * (width - left - right), y = (v) => top + (high - v) / (high - low) * (tall - top);
  const rungs = ticks(low, high, 6);
  for (const v of rungs.found) svg.append(make("line", {x1: left, x2: width - right, y1: y(v), y2: y(v), class: "axis"}),
    make("text", {x: left - 6, y: y(v) + 4, "text-anchor": "end"}, plain(v, rungs.digits)));
  for (const s of hours(from, end, width / 75)) svg.append(make("line", {x1: x(s), x2: x(s), y1: top, y2: tall + strip, class: "axis"}),
    make("text", {x: Math.min(Math.max(x(s), left), width - 20), y: tall + strip + 16, "text-anchor": "middle"}, clock(s)));
  svg.append(make("text", {x: width - right, y: height - 6, "text-anchor": "end"}, `time of day, ${zone(end)}`), make("text", {x: 2, y: height - 6}, `${title.split(/[:,]/)[0].toLowerCase().replace("predicted deformation by path", "share")}, ${unit}`));
  series.forEach((one, i) => {
    if (one.band) svg.append(make("path", {d: bands(t, one, from, end, x, y), class: `band c${i}`}));
    svg.append(make("path", {d: curve(t, one.y, from, end, x, y), class: `curve c${i}`}));
  });
  if (states) strips(svg, t, states, from, end, x, tall + 4);
  const read = (s) => [clock(s, true), ...series.map((one) => `${one.name} ${signed(at(t, one.y, s))} ${unit}`)].join(" · ");
  reader(frame, svg, readout, {left, right: width - right, top, bottom: tall + strip, x, read});
  return figure;
}

// The value at a time, that of the nearest point; none in a gap.
function at(t, values, s) {
  let best = -1;
  t.forEach((one, i) => { if (best < 0 || Math.abs(one - s) < Math.abs(t[best] - s)) best = i; });
  return best >= 0 && Math.abs(t[best] - s) < gap() ? values[best] : null;
}

// Zoom on the time axis and values at a cursor, as on the pages of reports.
function reader(frame, svg, readout, plot) {
  const {from, end, whole} = frame, value = (x) => from + (Math.min(Math.max(x, plot.left), plot.right) - plot.left) / (plot.right - plot.left) * (end - from);
  const where = (event) => { const to = svg.getScreenCTM(); return (event.clientX - to.e) / to.a; };
  const show = (a, b) => {
    const span = Math.min(Math.max(b - a, 120), whole[1] - whole[0]), begin = Math.min(Math.max((a + b - span) / 2, whole[0]), whole[1] - span);
    frame.show(span > 0.999 * (whole[1] - whole[0]) ? null : [begin, begin + span]);
  };
  let start = null, box = null, cursor = null, now = null;
  const point = (s, spoken = false) => {
    cursor?.remove();
    cursor = null; now = s;
    readout.setAttribute("aria-live", spoken ? "polite" : "off");
    readout.textContent = s === null ? "" : plot.read(s);
    if (s !== null) svg.append(cursor = make("line", {class: "cursor", x1: plot.x(s), x2: plot.x(s), y1: plot.top, y2: plot.bottom}));
  };
  svg.addEventListener("pointerdown", (event) => { if (event.button === 0) { start = value(where(event)); dragging = true; } });
  svg.addEventListener("pointermove", (event) => {
    const s = value(where(event));
    point(s);
    if (start === null || Math.abs(plot.x(s) - plot.x(start)) < 4) { box?.remove(); box = null; return; }
    if (!box) { svg.append(box = make("rect", {class: "stretch", y: plot.top, height: plot.bottom - plot.top})); svg.setPointerCapture(event.pointerId); }
    box.setAttribute("x", Math.min(plot.x(s), plot.x(start)));
    box.setAttribute("width", Math.abs(plot.x(s) - plot.x(start)));
  });
  const done = (event) => {
    const [one, zooms] = [start, box !== null];
    box?.remove();
    start = box = null; dragging = false;
    if (zooms && event.type === "pointerup") show(...[one, value(where(event))].sort((a, b) => a - b));
  };
  svg.addEventListener("pointerup", done);
  svg.addEventListener("pointercancel", done);
  svg.addEventListener("pointerleave", () => { if (start === null && document.activeElement !== svg) point(null); });
  svg.addEventListener("dblclick", () => show(...whole));
  svg.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const middle = now ?? (from + end) / 2, step = (end - from) / 100;
    const zoom = (factor) => show(middle - (middle - from) * factor, middle + (end - middle) * factor);
    const move = (by) => point(Math.min(Math.max(middle + by, from), end), true);
    const key = {ArrowLeft: () => move(-step), ArrowRight: () => move(step), "+": () => zoom(0.5), "=": () => zoom(0.5), "-": () => zoom(2), 0: () => show(...whole), Escape: () => show(...whole)}[event.key];
    if (key) { event.preventDefault(); key(); }
  });
}

function curve(t, values, from, end, x, y) {
  let path = "", before = null;
  t.forEach((s, i) => {
    if (s > end) return;
    if (!known(values[i]) || s < from) { before = s < from ? before : null; return; }
    const joins = before !== null && s - before < gap();
    // An isolated point is drawn as a dot.
    path += joins ? `L${x(s).toFixed(1)} ${y(values[i]).toFixed(1)}` : `M${x(s).toFixed(1)} ${y(values[i]).toFixed(1)}h.1`;
    before = s;
  });
  return path;
}

function bands(t, one, from, end, x, y) {
  let path = "", run = [];
  const close = () => {
    if (run.length > 1) path += "M" + run.map(([s, v, d]) => `${x(s).toFixed(1)} ${y(v + d).toFixed(1)}`).join("L") + "L"
      + run.reverse().map(([s, v, d]) => `${x(s).toFixed(1)} ${y(v - d).toFixed(1)}`).join("L") + "Z";
    run = [];
  };
  t.forEach((s, i) => {
    if (s < from || s > end || !known(one.y[i]) || !known(one.band[i])) return close();
    if (run.length && s - run[run.length - 1][0] > gap()) close();
    run.push([s, one.y[i], one.band[i]]);
  });
  close();
  return path;
}

function strips(svg, t, states, from, end, x, top) {
  // Higher is worse, so that the strip is readable without colour; intervals without messages are blank.
  const tall = {good: 5, warn: 12, bad: 20};
  let i = 0;
  while (i < t.length) {
    let j = i;
    while (j + 1 < t.length && states[j + 1] === states[i] && t[j + 1] - t[j] < gap()) j++;
    if (t[j] >= from && t[i] <= end && states[i]) {
      const tone = TONES[states[i]] ?? "bad", h = tall[tone];
      const first = Math.max(t[i] - 60, from), last = Math.min(t[j], end), bar = make("rect", {x: x(first), y: top + 20 - h, width: Math.max(x(last) - x(first), 1.5), height: h, class: `s-${tone}`});
      svg.append(bar);
    }
    i = j + 1;
  }
  svg.append(make("text", {x: 46, y: top + 18, "text-anchor": "end"}, "state"));
}
