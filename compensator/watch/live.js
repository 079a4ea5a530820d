// Requests the present state every two seconds and draws it. Everything from a machine is inserted as text.
const POLL_MS = 2000, MOST_ACTIONS = 10, DAY_S = 86400, SIGNS = {good: "✓", warn: "⚠", bad: "✗"};
const TONES = {ok: "good", starting: "warn", degraded: "warn", hold: "bad", fault: "bad"};
const $ = (id) => document.getElementById(id);
let past = {prefix: null, history: null, now_s: Infinity}, drawn = "", lastAnswer = null, effects = [], current = null;

const make = (tag, attributes = {}, ...children) => {
  const svg = ["svg", "path", "line", "text", "rect", "g"].includes(tag);
  const element = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
};
// A command between backticks is shown as the code that it is.
const prose = (text) => text.split("`").map((part, i) => i % 2 ? make("code", {}, part) : part);
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
// A typed address may have a percent sign that encodes nothing.
const unescaped = (text) => { try { return decodeURIComponent(text); } catch { return text; } };
const alive = (machine) => ({true: "alive", false: "gone", null: "unknown"})[String(machine.alive)];

// ---------------------------------------------------------------- requests

function selected(machines) {
  if (location.hash.startsWith("#m=")) current = unescaped(location.hash.slice(3));
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
    connection({...shop.status, machines: shop.machines.length});
    for (const box of document.querySelectorAll('.scroll[role="region"]')) box.dataset.scrolls = box.scrollWidth > box.clientWidth + 1;
  } catch (error) {
    const since = lastAnswer ? lastAnswer.toLocaleTimeString("en-GB") : "the page was opened";
    verdict("bad", "No answer", `compensator watch has not answered since ${since}; the values below are out of date. Restart compensator watch --page.`);
  }
}

function connection(status) {
  const text = status.connected ? `Connected to ${status.where}.` : `No connection to ${status.where}; retrying.${status.machines ? " The values below are out of date." : ""}`;
  setText($("note"), text + (status.ignored ? ` ${status.ignored} message(s) with unknown keys or of further machines ignored.` : ""));
  const now_s = Date.now() / 1000, place = Intl.DateTimeFormat().resolvedOptions().timeZone;
  setText($("zone"), `Times of day are in this computer's time zone, ${place === "UTC" ? "" : `${place}, `}${zone(now_s)}.`);
  $("note").className = status.connected ? "note" : "note tone is-bad";
}

function verdict(tone, word, text) {
  const element = $("verdict"), words = `${SIGNS[tone]} ${word}`;
  if (element.textContent === words + text.replaceAll("`", "")) return;
  element.className = `verdict ${tone}`;
  element.replaceChildren(make("b", {}, words), ...prose(text));
}

// ---------------------------------------------------------------- a shop

function showShop(shop, missing) {
  $("shop").hidden = false; $("machine").hidden = true; $("all").hidden = missing === null;
  setText($("title"), "quill-compensator, live"); document.title = "Machines, live";
  $("machines").closest("section > .scroll").hidden = $("heard").hidden = !shop.machines.length;
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
  if (past.prefix !== prefix) { past = {prefix, history: null, now_s: Infinity}; drawn = ""; shown = null; }
  const times = past.history ? past.history.t_s : [];
  // The newest points are requested again: their values come in several messages. A point ahead of the watch's clock,
  // which may have been set back, keeps no later one out.
  const since = times.length ? Math.max(Math.min(times[times.length - 1], past.now_s) - 300, 0) : 0;
  const found = await ask(`machine.json?prefix=${encodeURIComponent(prefix)}&since_s=${since}`);
  const machine = found.machine;
  effects = found.effects;
  past.history = joined(past.history, found.history, found.now_s);
  past.now_s = found.now_s;
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
  // One point per minute: what was not sent again of a minute before stays, however few seconds before.
  const cut = before.t_s.findIndex((t) => Math.floor(t / 60) >= Math.floor(news.t_s[0] / 60)), keep = cut < 0 ? before.t_s.length : cut;
  const oldest = now_s - DAY_S, first = before.t_s.findIndex((t) => t >= oldest);
  const from = first < 0 ? keep : Math.min(first, keep);
  return Object.fromEntries(Object.keys(news).map((name) => [name, [...(before[name] ?? before.t_s.map(() => null)).slice(from, keep), ...news[name]]]));
}

function sentence(machine) {
  const offset = `${signed(machine.y_offset_um)} µm`;
  if (machine.shown === "silent") return `for ${age(machine.age_s)}; the last offset was ${offset}.`;
  if (machine.shown === "unknown") return machine.means;
  return `${known(machine.y_offset_um) ? `offset ${offset}` : "no offset"}. ${machine.means}`;
}

function list(id, lines, kind) {
  const section = $(id), key = JSON.stringify(lines.map((line) => line.map((part) => part.textContent ?? part)));
  section.hidden = !lines.length;
  if (section.dataset.key === key) return;
  section.dataset.key = key;
  const items = make("ul", {}, ...lines.map((line) => make("li", {}, ...line.flatMap((part) => typeof part === "string" ? prose(part) : part))));
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
    ...(machine.axes ?? []).flatMap((one) => [[`${one.label} offset, ${one.unit}`, `${signed(one.offset)} (${one.state ?? "not received"})`],
      ...("slope_um_per_m" in one ? [[`${one.label} slope, µm/m`, signed(one.slope_um_per_m)]] : [])]),
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
    ...prose(event.text), ...(event.do ? [" ", make("b", {}, "Action: "), ...prose(event.do)] : [])));
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

// ---------------------------------------------------------------- always

function openCodes() {
  if (!location.hash.startsWith("#word=")) return;
  $("words").open = true;
  const target = $(unescaped(location.hash.slice(1)));
  if (target) target.scrollIntoView();
}
addEventListener("hashchange", () => { openCodes(); update(); });
addEventListener("resize", () => { if (past.history && !$("machine").hidden) update(); });
(async () => { openCodes(); for (;;) { await update(); await new Promise((resolve) => setTimeout(resolve, POLL_MS)); } })();
