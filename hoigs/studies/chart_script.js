"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const at = (id) => document.getElementById(id);
const svg = at("chart"), tip = at("tip"), hidden = new Set();
const box = { left: 70, right: 930, top: 24, bottom: 500 };
const axes = Object.fromEntries([...data.accuracy, ...data.cost].map((a) => [a.name, a]));

function add(parent, tag, attributes, text) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== undefined) element.textContent = text;
  parent.append(element);
  return element;
}

function short(v) {
  for (const [size, letter] of [[1e9, "G"], [1e6, "M"], [1e3, "k"]])
    if (Math.abs(v) >= size) return +(v / size).toPrecision(3) + letter;
  return String(+v.toPrecision(3));
}

function scale(values, from, to, log, flip) {
  const map = log ? Math.log10 : (v) => v;
  let low = map(Math.min(...values)), high = map(Math.max(...values));
  const pad = (high - low || Math.abs(high) * 0.1 || 1) * 0.1;
  low -= pad; high += pad;
  if (flip) [low, high] = [high, low];
  const place = (v) => from + ((map(v) - low) / (high - low)) * (to - from);
  place.inside = (v) => (map(v) - low) * (map(v) - high) <= 0;
  place.ticks = [];
  const a = Math.min(low, high), b = Math.max(low, high);
  if (log) {
    const every = b - a < 1.8 ? [1, 2, 5] : [1];
    for (let d = Math.floor(a); d <= b; d++)
      for (const m of every) place.ticks.push(m * 10 ** d);
  } else {
    const raw = (b - a) / 6, unit = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((m) => m * unit).find((s) => s >= raw);
    for (let t = Math.ceil(a / step); t * step <= b; t++) place.ticks.push(t * step);
  }
  place.ticks = place.ticks.filter(place.inside);
  return place;
}

const shapes = {
  o: (r) => `M${-r},0a${r},${r} 0 1,0 ${2 * r},0a${r},${r} 0 1,0 ${-2 * r},0`,
  s: (r) => `M${-r},${-r}H${r}V${r}H${-r}Z`,
  "^": (r) => `M0,${-r}L${r},${r}H${-r}Z`,
  v: (r) => `M0,${r}L${r},${-r}H${-r}Z`,
  D: (r) => `M0,${-r}L${r},0L0,${r}L${-r},0Z`,
  P: (r) => `M${-r},${-r / 3}H${-r / 3}V${-r}H${r / 3}V${-r / 3}H${r}V${r / 3}H${r / 3}V${r}H${-r / 3}V${r / 3}H${-r}Z`,
  X: (r) => `M${-r},${-r}L0,${-r / 3}L${r},${-r}L${r / 3},0L${r},${r}L0,${r / 3}L${-r},${r}L${-r / 3},0Z`,
  h: (r) => `M0,${-r}L${r},${-r / 2}V${r / 2}L0,${r}L${-r},${r / 2}V${-r / 2}Z`,
};

const noWorse = (axis, a, b) => (axis.better === "higher" ? a >= b : a <= b);
function dominates(p, q, pair) {
  const values = pair.map((a) => [a, p.values[a.name].mean, q.values[a.name].mean]);
  return values.every(([a, u, v]) => noWorse(a, u, v)) && values.some(([, u, v]) => u !== v);
}

function frame(x, y, xTitle, yTitle) {
  for (const t of x.ticks) {
    add(svg, "line", { class: "grid", x1: x(t), x2: x(t), y1: box.top, y2: box.bottom });
    add(svg, "text", { x: x(t), y: box.bottom + 20, "text-anchor": "middle" }, short(t));
  }
  for (const t of y.ticks) {
    add(svg, "line", { class: "grid", x1: box.left, x2: box.right, y1: y(t), y2: y(t) });
    add(svg, "text", { x: box.left - 8, y: y(t) + 4, "text-anchor": "end" }, short(t));
  }
  add(svg, "path", { class: "axis", fill: "none", d: `M${box.left},${box.top}V${box.bottom}H${box.right}` });
  add(svg, "text", { x: (box.left + box.right) / 2, y: 545, "text-anchor": "middle" }, xTitle);
  add(svg, "text", { x: 8, y: 14 }, yTitle);
}

function label(text, px, py, color, taken) {
  const element = add(svg, "text", { class: "name", x: px, y: py, style: `fill:${color}` }, text);
  const size = element.getBBox();
  let best = null;
  for (const reach of [10, 18, 30, 46])
    for (let k = 0; k < 12; k++) {
      const dx = Math.cos(k * Math.PI / 6), dy = Math.sin(k * Math.PI / 6);
      const left = px + reach * dx - size.width * (0.5 - 0.5 * Math.sign(Math.round(dx)));
      const top = py + reach * dy - size.height * (0.5 - 0.5 * Math.sign(Math.round(dy)));
      const b = [left, top, left + size.width, top + size.height];
      const cover = taken.reduce((sum, t) => sum + Math.max(0, Math.min(b[2], t[2]) - Math.max(b[0], t[0])) *
        Math.max(0, Math.min(b[3], t[3]) - Math.max(b[1], t[1])), 0);
      const out = b[0] < box.left || b[2] > 958 || b[1] < box.top || b[3] > box.bottom ? 5000 : 0;
      const cost = 6 * cover + out + 2 * reach;
      if (best === null || cost < best.cost) best = { cost, b };
    }
  element.setAttribute("x", best.b[0]);
  element.setAttribute("y", best.b[1] + size.height * 0.78);
  taken.push(best.b);
}

function hover(element, p) {
  const show = (event) => {
    tip.replaceChildren();
    const line = (tag, text) => { const e = document.createElement(tag); e.textContent = text; tip.append(e); };
    line("b", p.spec);
    line("p", `${p.definition} · rasterizer:${p.rasterizer} · ${p.steps} steps`);
    line("p", `clip ${p.clip} · ${p.seeds.length} seed${p.seeds.length > 1 ? "s" : ""} (${p.seeds.join(", ")})`);
    for (const [name, v] of Object.entries(p.values))
      line("p", `${axes[name].title}: ${short(v.mean)}${v.std === null ? "" : " ± " + short(v.std)}`);
    for (const why of p.missing) line("p", `missing: ${why}`);
    line("p", p.machine);
    line("p", p.protocol.join(" "));
    tip.hidden = false;
    const x = Math.min(event.pageX + 14, document.documentElement.clientWidth - tip.offsetWidth - 10);
    tip.style.left = `${Math.max(4, x)}px`;
    tip.style.top = `${event.pageY + 14}px`;
  };
  element.addEventListener("pointermove", show);
  element.addEventListener("pointerleave", () => { tip.hidden = true; });
}

function drawPoints(points, across, up) {
  const pair = [across, up];
  const shown = points.filter((p) => pair.every((a) => a.name in p.values));
  if (!shown.length) return "no point has both of these";
  const log = at("log").checked && shown.every((p) => p.values[across.name].mean > 0);
  const ends = (p, a) => { const v = p.values[a.name]; const s = v.std ?? 0; return [Math.max(v.mean - s, log && a === across ? v.mean / 10 : -Infinity), v.mean + s]; };
  const x = scale(shown.flatMap((p) => ends(p, across)), box.left, box.right, log, false);
  const y = scale(shown.flatMap((p) => ends(p, up)), box.bottom, box.top, false, up.better === "lower");
  frame(x, y, across.title, up.title + (up.better === "lower" ? ", axis turned round" : ""));
  const spot = (p) => [x(p.values[across.name].mean), y(p.values[up.name].mean)];
  const front = shown.filter((p) => !shown.some((q) => q !== p && dominates(q, p, pair)));
  const stairs = front.map(spot).sort((a, b) => a[0] - b[0]);
  if (stairs.length > 1)
    add(svg, "path", { class: "front", d: stairs.map(([u, v], i) => (i ? `H${u}V${v}` : `M${u},${v}`)).join("") });
  const steps = [...new Set(shown.map((p) => p.steps))].sort((a, b) => a - b);
  const groups = Map.groupBy ? Map.groupBy(shown, kin) : group(shown, kin);
  const taken = shown.map((p) => { const [u, v] = spot(p); return [u - 8, v - 8, u + 8, v + 8]; });
  for (const own of groups.values()) {
    own.sort((a, b) => a.steps - b.steps);
    add(svg, "path", { d: "M" + own.map((p) => spot(p).join(",")).join("L"), stroke: own[0].color, "stroke-opacity": 0.45, fill: "none" });
    for (const p of own) {
      const [u, v] = spot(p), [xa, xb] = ends(p, across).map(x), [ya, yb] = ends(p, up).map(y);
      add(svg, "path", { d: `M${xa},${v}H${xb}M${u},${ya}V${yb}`, stroke: p.color });
      const r = 4.5 + 3 * (steps.indexOf(p.steps) + 1) / steps.length;
      const mark = add(svg, "path", { class: "mark", d: (shapes[p.marker] || shapes.o)(r), transform: `translate(${u},${v})`, fill: front.includes(p) ? p.color : "#fff", stroke: p.color, "stroke-width": 2 });
      hover(mark, p);
    }
  }
  const several = new Set(shown.map((p) => p.marker)).size > 1;
  for (const own of groups.values()) {
    const p = own[own.length - 1];
    label(several ? `${p.spec} · ${p.rasterizer}` : p.spec, ...spot(p), p.ink, taken);
  }
  return "";
}

function kin(p) { return `${p.spec}\n${p.rasterizer}\n${p.machine}`; }
function group(items, key) {
  const found = new Map();
  for (const item of items) found.set(key(item), [...(found.get(key(item)) || []), item]);
  return found;
}

function drawCurves(points, byTime) {
  const shown = points.filter((p) => p.curve.length > 1);
  if (!shown.length) return "no run of this clip has previews";
  const which = byTime ? 1 : 0, all = shown.flatMap((p) => p.curve);
  const log = at("log").checked && all.every((c) => c[which] > 0);
  const x = scale(all.map((c) => c[which]), box.left, box.right - 90, log, false);
  const y = scale(all.map((c) => c[2]), box.bottom, box.top, false, false);
  frame(x, y, byTime ? "seconds of training" : "steps", "PSNR of a few test frames, full frame (dB), mean over seeds");
  const taken = [];
  for (const p of shown) {
    const line = p.curve.map((c) => `${x(c[which])},${y(c[2])}`);
    const path = add(svg, "path", { class: "mark", d: "M" + line.join("L"), stroke: p.color, "stroke-width": 2.5, fill: "none" });
    hover(path, p);
  }
  for (const p of shown) {
    const last = p.curve[p.curve.length - 1];
    label(`${p.spec} (${p.steps})`, x(last[which]), y(last[2]), p.ink, taken);
  }
  return "";
}

function draw() {
  svg.replaceChildren();
  const sheet = data.sheets[at("clip").value], refused = sheet.refused;
  const points = sheet.points.filter((p) => !hidden.has(p.spec));
  const across = axes[at("x").value], up = axes[at("y").value];
  const machines = new Set(points.map((p) => p.machine));
  const warn = machines.size > 1 ? `Points of ${machines.size} machines, a marker each; times and joules cannot be compared between them. ` : "";
  const curves = at("kind").value === "curves";
  let why = "";
  if (curves) why = drawCurves(points, !("training (s)" in refused));
  else why = refused[up.title] ? `${up.title}: ${refused[up.title]}` : refused[across.title] ? `${across.title}: ${refused[across.title]}` : drawPoints(points, across, up);
  at("x").disabled = at("y").disabled = curves;
  at("said").textContent = warn + why;
  at("legend").replaceChildren(...[...new Map(sheet.points.map((p) => [p.spec, p.ink]))].map(([spec, ink]) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = spec;
    button.style.color = ink;
    button.setAttribute("aria-pressed", String(!hidden.has(spec)));
    button.onclick = () => { hidden.has(spec) ? hidden.delete(spec) : hidden.add(spec); draw(); };
    return button;
  }));
}

function fill(id, entries) {
  at(id).replaceChildren(...entries.map(([value, text]) => new Option(text, value)));
  at(id).addEventListener("change", draw);
}
fill("clip", Object.keys(data.sheets).map((name) => [name, name]));
fill("y", data.accuracy.map((a) => [a.name, a.title]));
fill("x", data.cost.map((a) => [a.name, a.title]));
for (const id of ["kind", "log"]) at(id).addEventListener("change", draw);
if (Object.keys(data.sheets).length) draw();
else at("said").textContent = "No run is done.";
