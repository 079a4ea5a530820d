"use strict";
// Requests the present state every two seconds and draws it. Everything from a machine is inserted as text.
const POLL_MS = 2000, MOST_ACTIONS = 10, DAY_S = 86400, SIGNS = {good: "✓", warn: "⚠", bad: "✗"};
const TONES = {ok: "good", starting: "warn", degraded: "warn", hold: "bad", fault: "bad"};
const $ = (id) => document.getElementById(id);
let past = {prefix: null, history: null}, drawn = "", lastAnswer = null, effects = [], current = null;

const make = (tag, attributes = {}, ...children) => {
  const svg = ["svg", "path", "line", "text", "rect", "g"].includes(tag);
  const element = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
};
const setText = (element, text) => { if (element.textContent !== text) element.textContent = text; };
const known = (value) => typeof value === "number" && isFinite(value);
const signed = (value, digits = 2) => known(value) ? (value < 0 ? "−" : "+") + Math.abs(value).toFixed(digits) : "–";
const plain = (value, digits = 2) => known(value) ? (value < 0 ? "−" : "") + Math.abs(value).toFixed(digits) : "–";
const clock = (t_s, seconds = false) => new Date(1000 * t_s).toLocaleTimeString("en-GB",
  seconds ? {} : {hour: "2-digit", minute: "2-digit"});
const zone = (t_s) => {
  const date = new Date(1000 * t_s), ahead = -date.getTimezoneOffset(), two = (n) => String(n).padStart(2, "0");
  return ahead ? `UTC${ahead < 0 ? "−" : "+"}${two(Math.floor(Math.abs(ahead) / 60))}:${two(Math.abs(ahead) % 60)}` : "UTC";
};
const day = (t_s) => new Date(1000 * t_s).toLocaleDateString("en-CA");
const stamp = (t_s) => `${day(t_s)} ${clock(t_s, true)}`;
const age = (s) => !known(s) ? "–" : s < 120 ? `${Math.max(s, 0).toFixed(0)} s` : s < 3600 ? `${Math.floor(s / 60)} min`
  : s < 172800 ? `${Math.floor(s / 3600)} h ${Math.floor(s % 3600 / 60)} min` : `${(s / 86400).toFixed(1)} d`;
const wordLink = (code) => make("a", {href: `#word=${$(`word=${code}`) ? code : code.split(":")[0]}`}, code);
const alive = (machine) => ({true: "alive", false: "gone", null: "unknown"})[String(machine.alive)];

// ---------------------------------------------------------------- requests

function selected(machines) {
  if (location.hash.startsWith("#m=")) current = decodeURIComponent(location.hash.slice(3));
  else if (!location.hash.startsWith("#word=")) current = null;
  return current ?? (machines.length === 1 ? machines[0].prefix : null);
}

async function ask(path) {
  const answer = await fetch(path, {cache: "no-store"});
  if (!answer.ok) throw new Error(`${path}: ${answer.status}`);
  return answer.json();
}

async function update() {
  try {
    const shop = await ask("shop.json");
    const prefix = selected(shop.machines);
    lastAnswer = new Date();
    if (prefix === null || !shop.machines.some((one) => one.prefix === prefix)) showShop(shop, prefix);
    else await showOne(prefix, shop.machines.length);
    connection(shop.status);
  } catch (error) {
    const since = lastAnswer ? lastAnswer.toLocaleTimeString("en-GB") : "the page was opened";
    verdict("bad", "No answer", `compensator watch has not answered since ${since}; the values below are out of date. Restart compensator watch --page.`);
  }
}

function connection(status) {
  const text = status.connected ? `Connected to ${status.where}.` : `No connection to ${status.where}; retrying. The values below are out of date.`;
  setText($("note"), text + (status.ignored ? ` ${status.ignored} message(s) with unknown keys or of further machines ignored.` : ""));
  const now_s = Date.now() / 1000, place = Intl.DateTimeFormat().resolvedOptions().timeZone;
  setText($("zone"), `Times of day are in this computer's time zone, ${place === "UTC" ? "" : `${place}, `}${zone(now_s)}.`);
  $("note").className = status.connected ? "note" : "note tone is-bad";
}

function verdict(tone, word, text) {
  const element = $("verdict"), words = `${SIGNS[tone]} ${word}`;
  if (element.textContent === words + text) return;
  element.className = `verdict ${tone}`;
  element.replaceChildren(make("b", {}, words), text);
}

// ---------------------------------------------------------------- a shop

function showShop(shop, missing) {
  $("shop").hidden = false; $("machine").hidden = true; $("all").hidden = missing === null;
  setText($("title"), "quill-compensator, live"); document.title = "Machines, live";
  const tones = shop.machines.map((one) => one.tone);
  const tone = !tones.length || tones.includes("bad") ? "bad" : tones.includes("warn") ? "warn" : "good";
  if (missing !== null) verdict("bad", "Silent", `No messages from ${missing}.`);
  else verdict(tone, {good: "All ok", warn: "Caution", bad: "Attention"}[tone], shop.headline);
  const severe = shop.machines.filter((one) => one.tone !== "good");
  const lines = severe.slice(0, MOST_ACTIONS).map((one) => [make("b", {}, `${SIGNS[one.tone]} ${one.prefix} ${one.shown}: ${one.headline.word}. `), one.headline.text]);
  if (severe.length > MOST_ACTIONS) lines.push([`… and ${severe.length - MOST_ACTIONS} more.`]);
  list("actions", lines, "warning");
  const body = $("machines").tBodies[0], focused = document.activeElement && document.activeElement.id;
  const rows = new Map([...body.rows].map((row) => [row.dataset.prefix, row]));
  shop.machines.forEach((machine, i) => {
    let row = rows.get(machine.prefix);
    if (!row) {
      row = make("tr", {"data-prefix": machine.prefix});
      const link = make("a", {href: `#m=${encodeURIComponent(machine.prefix)}`, id: `to-${machine.prefix}`}, machine.prefix);
      row.append(make("th", {scope: "row"}, link), ...Array.from({length: 10}, () => make("td")));
    }
    rows.delete(machine.prefix);
    if (body.rows[i] !== row) body.insertBefore(row, body.rows[i] || null);
    fillRow(row, machine);
  });
  rows.forEach((row) => row.remove());
  if (focused && $(focused) && document.activeElement.id !== focused) $(focused).focus();
}

function fillRow(row, machine) {
  const why = machine.shown === "silent" ? [machine.means] : machine.reasons.map((reason) => reason.means);
  const cells = [`${SIGNS[machine.tone]} ${machine.shown}`, signed(machine.y_offset_um), signed(machine.y_offset_rate_um_per_min),
    plain(machine.y_offset_std_um), signed(machine.residual_um), plain(machine.t_q_degc), plain(machine.at_degc),
    age(machine.age_s), alive(machine), [...why, ...machine.warnings].join(" ")];
  cells.forEach((text, i) => setText(row.cells[i + 1], text));
  row.cells[1].className = `tone is-${machine.tone}`;
  row.cells[2].className = machine.shown === "silent" ? "old" : "";
}

// ---------------------------------------------------------------- one machine

async function showOne(prefix, count) {
  if (past.prefix !== prefix) { past = {prefix, history: null}; drawn = ""; }
  const times = past.history ? past.history.t_s : [];
  // The newest points are requested again: their values come in several messages.
  const since = times.length ? Math.max(times[times.length - 1] - 300, 0) : 0;
  const found = await ask(`machine.json?prefix=${encodeURIComponent(prefix)}&since_s=${since}`);
  const machine = found.machine;
  effects = found.effects;
  past.history = joined(past.history, found.history, found.now_s);
  $("shop").hidden = true; $("machine").hidden = false; $("all").hidden = count < 2;
  setText($("title"), machine.machine === prefix ? prefix : `${machine.machine} (${prefix})`);
  document.title = `${SIGNS[machine.tone]} ${machine.machine} ${machine.shown}`;
  verdict(machine.tone, machine.headline.word, machine.headline.text);
  setText($("state"), `${machine.shown}: ${sentence(machine)}`);
  pictures(machine, past.history, found.now_s);
  list("reasons", machine.reasons.map((reason) => [wordLink(reason.code), `: ${reason.means} `, make("b", {}, "Action: "), reason.do]), "warning");
  list("warnings", machine.warnings.map((text, i) => [text, " ", wordLink(machine.warning_codes[i])]), "warning");
  faulty(machine); now(machine); probe(machine.probe); loop(machine.loop); events(machine.events); intervals(found.intervals); channels(machine); points(past.history);
}

function joined(before, news, now_s) {
  if (!before || !news.t_s.length) return before && !news.t_s.length ? before : news;
  const cut = before.t_s.findIndex((t) => t >= news.t_s[0] - 60), keep = cut < 0 ? before.t_s.length : cut;
  const oldest = now_s - DAY_S, first = before.t_s.findIndex((t) => t >= oldest);
  const from = first < 0 ? keep : Math.min(first, keep);
  return Object.fromEntries(Object.keys(news).map((name) => [name, [...(before[name] ?? before.t_s.map(() => null)).slice(from, keep), ...news[name]]]));
}

function sentence(machine) {
  const offset = `${signed(machine.y_offset_um)} µm`;
  if (machine.shown === "silent") return `for ${age(machine.age_s)}; the last offset was ${offset}. ${machine.means} ${machine.do}`;
  if (machine.shown === "unknown") return `${machine.means} ${machine.do}`;
  return `${known(machine.y_offset_um) ? `offset ${offset}` : "no offset"}. ${machine.means}`;
}

function list(id, lines, kind) {
  const section = $(id), key = JSON.stringify(lines.map((line) => line.map((part) => part.textContent ?? part)));
  section.hidden = !lines.length;
  if (section.dataset.key === key) return;
  section.dataset.key = key;
  const items = make("ul", {}, ...lines.map((line) => make("li", {}, ...line)));
  section.lastElementChild.replaceChildren(make("div", {class: `words ${kind}`}, items));
}

function fill(table, rows) {
  const body = table.tBodies[0], key = JSON.stringify(rows);
  if (table.dataset.key === key) return;
  table.dataset.key = key;
  body.replaceChildren(...rows.map((cells) => make("tr", {}, ...cells.map((cell, i) => make(i ? "td" : "th", i ? {} : {scope: "row"}, cell)))));
}

function faulty(machine) {
  const channels = Object.entries(machine.channels).filter(([, one]) => one.quality !== "good").map(([name, one]) =>
    [`${name}: `, wordLink(one.quality), `: ${one.means} `, make("b", {}, "Action: "), one.do]);
  const devices = Object.entries(machine.devices ?? {}).filter(([, error]) => error !== "ok").map(([name, error]) => [error.startsWith(`${name}: `) ? error : `${name}: ${error}`]);
  list("faulty", [...channels, ...devices], "warning");
}

function now(machine) {
  tiles($("now"), [
    [machine.shown === "silent" ? "last offset, µm" : "offset, µm", signed(machine.y_offset_um)], ["age of the offset", age(machine.age_s)], ["valid for", age(machine.valid_for_s)],
    ["rate, µm/min", signed(machine.y_offset_rate_um_per_min)], ["standard deviation, µm", plain(machine.y_offset_std_um)],
    ["measured Y, µm", signed(machine.y_um)], ["predicted Y, µm", signed(machine.y_pred_um)],
    ["residual, µm", signed(machine.residual_um)],
    ...machine.shares.map((share) => [`share ${share.name}, µm`, signed(share.y_um)]),
    ["heat, W", plain(machine.heat_w, 1)], ["T_Q, °C", plain(machine.t_q_degc)], ["AT, °C", plain(machine.at_degc)],
    ["alive", alive(machine)], ["messages received", String(machine.received)], ["messages missed", String(machine.missed)],
    ["malformed messages", String(machine.malformed)],
    ["model", `${machine.model ?? "–"} ${(machine.model_sha256 ?? "").slice(0, 12)}`], ["recording", machine.recording || "–"],
  ]);
}

function probe(found) {
  const element = $("probe");
  element.hidden = !found;
  if (!found) return;
  const saves = "Probing before a tight feature only when a probe is wanted saves about half of the probes; timing alone saves nothing at equal mean error.";
  const figures = `standard deviation ${plain(found.std_um)} µm${known(found.tolerance_um) ? `, tolerance ${plain(found.tolerance_um)} µm` : ""}`;
  const when = found.by_ns === null ? "No probe wanted" : `No probe wanted before ${clock(found.by_ns / 1e9)}`;
  setText(element, found.wanted ? `Probe wanted (${figures}): ${found.means} ${found.do}` : `${when} (${figures}). ${saves}`);
  element.className = found.wanted ? "note tone is-warn" : "note";
}

function loop(found) {
  $("loop").hidden = !found;
  if (!found) return;
  setText($("loop-line"), found.line);
  $("loop-line").className = found.phase === "proposed" ? "note tone is-warn" : "note";
  $("loop-commands").hidden = found.phase !== "proposed";
  setText($("loop-commands"), found.commands.join("\n"));
  $("loop-picture").hidden = found.phase === "idle";
}

function shadow(frame, machine, history) {
  if (!machine.loop || !history.candidate_um) return [];
  const name = machine.loop.phase === "watching" ? "model before" : "candidate";
  const other = history.residual_um.map((r, i) => [r, history.y_pred_um[i], history.candidate_um[i]].every(known) ? r + history.y_pred_um[i] - history.candidate_um[i] : null);
  return [chart(frame, "Residual of both models", "µm", [{name: "present model", y: history.residual_um}, {name, y: other}])];
}

function tiles(element, pairs) {
  const key = JSON.stringify(pairs);
  if (element.dataset.key === key) return;
  element.dataset.key = key;
  element.replaceChildren(...pairs.map(([name, value]) => make("div", {}, make("dt", {}, name), make("dd", {}, value))));
}

function events(found) {
  const key = JSON.stringify(found);
  if ($("events").dataset.key === key) return;
  $("events").dataset.key = key;
  const lines = found.slice(0, 20).map((event) => make("li", {}, make("b", {}, `${stamp(event.time_utc_ns / 1e9)} ${event.kind}: `),
    event.text, ...(event.do ? [" ", make("b", {}, "Action: "), event.do] : [])));
  $("events").replaceChildren(lines.length ? make("ul", {}, ...lines) : make("p", {}, "None."));
}

function intervals(found) {
  const when = (t) => `${day(t) === day(Date.now() / 1000) ? "" : `${day(t).slice(5)} `}${clock(t)}`;
  fill($("intervals"), found.map((one) =>
    [when(one.begin_s), `${SIGNS[TONES[one.state] ?? "bad"]} ${one.state}`, age(one.end_s - one.begin_s), one.reasons]));
}

function channels(machine) {
  const rows = Object.entries(machine.channels).map(([name, one]) => [name, plain(one.mean, 3), one.quality,
    Object.entries(one.errors).map(([code, count]) => `${count} × ${code}`).join(", ")]);
  const devices = Object.entries(machine.devices ?? {}).map(([name, error]) => [name, "", error === "ok" ? "ok" : "error", error === "ok" ? "" : error]);
  fill($("channels"), [...rows, ...devices]);
}

function points(history) {
  const rows = history.t_s.map((t, i) => [clock(t), history.state[i] ?? "–", signed(history.y_offset_um[i]), plain(history.y_offset_std_um[i]),
    signed(history.y_dtf_um[i]), signed(history.y_tdtf_um[i]), signed(history.residual_um[i]), plain(history.t_q_degc[i]), plain(history.at_degc[i])]);
  fill($("points"), rows.slice(-60).reverse());
}

// ---------------------------------------------------------------- pictures

const gap = () => Math.max(150, current_valid);
let current_valid = 150;

function pictures(machine, history, end) {
  current_valid = machine.valid_for_s ?? 150;
  const width = $("pictures").clientWidth;
  const key = `${machine.prefix} ${width} ${JSON.stringify([history.t_s.length, ...["t_s", "y_offset_um", "residual_um", "t_q_degc", "y_dtf_um"].map((n) => history[n][history[n].length - 1])])} ${Math.floor(end / 60)}`;
  if (key === drawn) return;
  drawn = key;
  const from = Math.max(end - DAY_S, Math.min(history.t_s[0] ?? end, end - 600));
  const frame = {from, end, width, t: history.t_s};
  const line = (name, y, band) => ({name, y, band});
  const count = Math.max(0, ...history.effects.map((one) => one.length));
  const several = count > (machine.probe ? 2 : 3)
    ? [line("effects together", history.effects.map((one) => one.length ? one.reduce((a, b) => a + (b ?? NaN), 0) : null))]
    : Array.from({length: count}, (_, i) => line(effects[i] ?? `effect ${i + 1}`, history.effects.map((one) => one[i] ?? null)));
  const probes = machine.probe ? [line("probes", history.y_pred_um.map((y, i) => [y, history.y_base_um[i], history.y_dtf_um[i], history.y_tdtf_um[i], ...history.effects[i]].every(known)
    ? y + history.y_base_um[i] - history.y_dtf_um[i] - history.y_tdtf_um[i] - history.effects[i].reduce((a, b) => a + b, 0) : null))] : [];
  $("loop-picture").replaceChildren(...shadow(frame, machine, history));
  $("pictures").replaceChildren(
    chart(frame, "Offset, added to the commanded Y, with its standard deviation", "µm", [line("offset", history.y_offset_um, history.y_offset_std_um)], history.state),
    chart(frame, "Predicted deformation by path", "µm", [line("DTF (heat)", history.y_dtf_um), line("TDTF (air)", history.y_tdtf_um), ...several, ...probes]),
    chart(frame, "Residual: measured − predicted deformation", "µm", [line("residual", history.residual_um)]),
    chart(frame, "Temperatures", "°C", [line("T_Q", history.t_q_degc), line("AT", history.at_degc)]));
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
  const {from, end, width, t} = frame;
  const left = 52, right = 8, top = 6, strip = states ? 26 : 0, tall = width < 500 ? 170 : 210, height = tall + strip + 40;
  const caption = make("figcaption", {}, title), keys = make("ul", {class: "keys"});
  const values = series.flatMap((one) => one.y.flatMap((v, i) => known(v) ? (one.band && known(one.band[i]) ? [v - one.band[i], v + one.band[i]] : [v]) : []));
  const ranges = series.map((one) => { const seen = one.y.filter(known); return seen.length ? `${one.name} last ${plain(seen[seen.length - 1])} ${unit}, from ${plain(Math.min(...seen))} to ${plain(Math.max(...seen))}` : `${one.name}: no values`; });
  const svg = make("svg", {viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${title}. ${ranges.join("; ")}; in the last ${((end - from) / 3600).toFixed(1)} h.`});
  const figure = make("figure", {}, caption, keys, svg);
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
    if (one.band) svg.append(make("path", {d: bands(t, one, from, x, y), class: `band c${i}`}));
    svg.append(make("path", {d: curve(t, one.y, from, x, y), class: `curve c${i}`}));
  });
  if (states) strips(svg, t, states, from, x, tall + 4);
  return figure;
}

function curve(t, values, from, x, y) {
  let path = "", before = null;
  t.forEach((s, i) => {
    if (!known(values[i]) || s < from) { before = s < from ? before : null; return; }
    const joins = before !== null && s - before < gap();
    // An isolated point is drawn as a dot.
    path += joins ? `L${x(s).toFixed(1)} ${y(values[i]).toFixed(1)}` : `M${x(s).toFixed(1)} ${y(values[i]).toFixed(1)}h.1`;
    before = s;
  });
  return path;
}

function bands(t, one, from, x, y) {
  let path = "", run = [];
  const close = () => {
    if (run.length > 1) path += "M" + run.map(([s, v, d]) => `${x(s).toFixed(1)} ${y(v + d).toFixed(1)}`).join("L") + "L"
      + run.reverse().map(([s, v, d]) => `${x(s).toFixed(1)} ${y(v - d).toFixed(1)}`).join("L") + "Z";
    run = [];
  };
  t.forEach((s, i) => {
    if (s < from || !known(one.y[i]) || !known(one.band[i])) return close();
    if (run.length && s - run[run.length - 1][0] > gap()) close();
    run.push([s, one.y[i], one.band[i]]);
  });
  close();
  return path;
}

function strips(svg, t, states, from, x, top) {
  // Higher is worse, so that the strip is readable without colour; intervals without messages are blank.
  const tall = {good: 5, warn: 12, bad: 20};
  let i = 0;
  while (i < t.length) {
    let j = i;
    while (j + 1 < t.length && states[j + 1] === states[i] && t[j + 1] - t[j] < gap()) j++;
    if (t[j] >= from && states[i]) {
      const tone = TONES[states[i]] ?? "bad", h = tall[tone];
      const first = Math.max(t[i] - 60, from), bar = make("rect", {x: x(first), y: top + 20 - h, width: Math.max(x(t[j]) - x(first), 1.5), height: h, class: `s-${tone}`});
      svg.append(bar);
    }
    i = j + 1;
  }
  svg.append(make("text", {x: 46, y: top + 18, "text-anchor": "end"}, "state"));
}

// ---------------------------------------------------------------- always

function openCodes() {
  if (!location.hash.startsWith("#word=")) return;
  $("words").open = true;
  const target = $(decodeURIComponent(location.hash.slice(1)));
  if (target) target.scrollIntoView();
}
addEventListener("hashchange", () => { openCodes(); update(); });
addEventListener("resize", () => { if (past.history && !$("machine").hidden) update(); });
(async () => { openCodes(); for (;;) { await update(); await new Promise((resolve) => setTimeout(resolve, POLL_MS)); } })();
