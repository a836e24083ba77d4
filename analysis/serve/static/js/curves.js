/** Curves page: chart and legend of loss curves, updated by the form and by the database. */

import { draw, element, logRange, nameLines, numeral, part, swatch } from "./chart.js";

const DEFAULTS = { column: "loss", x: "steps", style: "band", range: "main" };
const ASKED = ["env", "width", "column", "x", "where"];
const PREQUENTIAL = "Prequential loss against time: the error of each predicted acceleration before it is learned, not an error over a grid.";

const form = /** @type {HTMLFormElement|null} */ (part("controls"));
const [place, table] = [part("chart"), part("legend")];
const LEAD = part("lead").textContent;
const hidden = new Set((new URLSearchParams(location.search).get("hide") ?? "").split(",").filter(Boolean));
let answer = null;
let chart = null;
let asking = null;

/** The values of the form that differ from the defaults. */
const chosen = () => new URLSearchParams([...new FormData(form)].filter(([name, value]) => value !== "" && DEFAULTS[name] !== value));

/** @param {string} name of a field */
const value = (name) => new FormData(form).get(name);

/** Fill the menu of widths for the chosen environment. @param {string|null} wanted */
function offerWidths(wanted) {
  const widths = (JSON.parse(form.dataset.environments)[value("env")] ?? []).map(String);
  const select = form.elements.namedItem("width");
  select.replaceChildren(new Option("default", ""), ...widths.map((width) => new Option(width, width)));
  select.value = widths.includes(wanted ?? "") ? wanted : "";
}

/** Fetch the curves and draw them. */
async function load() {
  asking?.abort();
  const mine = (asking = new AbortController());
  const query = new URLSearchParams([...chosen()].filter(([name]) => ASKED.includes(name)));
  part("csv").href = `/api/curves.csv?${query}`;
  place.setAttribute("aria-busy", "true");
  try {
    const found = await fetch(`/api/curves?${query}`, { signal: mine.signal });
    const content = await found.json();
    if (!found.ok) throw new Error(content.error);
    answer = content;
    complain("");
    show();
  } catch (error) {
    if (error.name !== "AbortError") complain(error.message);
  } finally {
    if (asking === mine) place.removeAttribute("aria-busy");
  }
}

/** Show an error message in place of the chart, or hide it. @param {string} sentence */
function complain(sentence) {
  part("problem").textContent = sentence;
  part("problem").hidden = sentence === "";
  if (!sentence) return;
  chart?.destroy();
  chart = answer = null;
  table.tBodies[0].replaceChildren();
  part("missing").replaceChildren();
  place.dataset.shown = "";
}

/** Write the settings into the URL, so that it can be shared. */
function remember() {
  const query = chosen();
  if (hidden.size) query.set("hide", [...hidden].join(","));
  const text = query.toString().replaceAll("%2C", ",");
  history.replaceState(null, "", text ? `?${text}` : location.pathname);
}

/** Draw the curves, with the part of the time axis that was shown before. */
function show() {
  const { is_prequential: prequential, curves } = answer;
  const zoomed = chart?.zoomed ? { ...chart.scales.x } : null;
  const banded = value("style") === "band" && !prequential;
  const where = value("column") === "loss" ? "RMS error, evaluation grid" : "RMS error, reachable set";
  const lines = curves.map((curve) => ({ ...curve, hidden: hidden.has(curve.policy), ...(banded ? {} : { low: null, high: null }) }));
  chart = draw(place, {
    x: answer.x,
    lines,
    log: [false, true],
    label: [`time t [${value("x") === "seconds" ? "s" : "steps"}]`, `${prequential ? "prequential error" : where} [${answer.unit}]`],
    range: limits,
    height: 430,
    title: (index) => `t = ${time(index)}`,
    hooks: { setCursor: [(u) => read(u.cursor.idx ?? null)], setSelect: [(u) => { u.zoomed = true; }] },
  });
  chart.zoomed = zoomed !== null;
  if (zoomed) chart.setScale("x", { min: zoomed.min, max: zoomed.max });
  const shown = lines.filter((line) => !line.hidden);
  nameLines(part("key"), shown);
  place.dataset.shown = shown.map((line) => line.policy).join(" ");
  place.dataset.steps = String(answer.x.length);
  place.setAttribute("aria-label", `Loss against time in the ${answer.env}: ${shown.map((line) => line.label).join(", ")}. The table below has the values.`);
  part("heading").textContent = form.elements.namedItem("env").selectedOptions[0].text + answer.widths;
  part("lead").textContent = prequential ? PREQUENTIAL : LEAD;
  part("band").textContent = prequential ? `Points: each step. Lines: ${answer.statistic}.` : banded ? `Interval: ${answer.band}.` : "";
  for (const name of ["column", "style"]) form.elements.namedItem(name).closest("label").hidden = prequential;
  const gaps = answer.missing.map((gap) => `${gap.policy}: ${gap.states} (seed${/^\d+$/.test(gap.seeds) ? "" : "s"} ${gap.seeds})`);
  const missing = gaps.length ? [element("p", "warning", `Not all trials have ended: ${gaps.join("; ")}.`)] : [];
  part("missing").replaceChildren(...missing, ...answer.notes.map((text) => element("p", "note", `${text}.`)));
  fill(lines);
  read(null);
}

/** Limits of the loss axis: the visible curves, without those far below the others. */
function limits(_, low, high) {
  const [bottom, top] = logRange([low, high]);
  const floor = answer.main && value("range") === "main" ? answer.main[0] : 0;
  const visible = answer.curves.filter((curve) => !hidden.has(curve.policy));
  const below = visible.filter((curve) => Math.min(...curve.values.filter((one) => one > 0)) < floor);
  const cut = below.length > 0 && below.length < visible.length;
  part("below").textContent = cut ? `Below this part of the axis: ${below.map((curve) => curve.label).join(", ")}. ` : "";
  return [cut ? Math.max(bottom, floor) : bottom, top];
}

/** Fill the legend with a row for each curve. */
function fill(lines) {
  const focused = table.contains(document.activeElement) && document.activeElement.value;
  const rows = lines.map((line) => {
    const [row, name, label, box] = ["tr", "td", "label", "input"].map((kind) => document.createElement(kind));
    Object.assign(box, { type: "checkbox", checked: !line.hidden, value: line.policy });
    box.addEventListener("change", () => {
      if (box.checked) hidden.delete(line.policy);
      else hidden.add(line.policy);
      remember();
      show();
    });
    label.className = "policy";
    label.append(box, swatch(line), line.label);
    name.append(label);
    row.classList.toggle("off", line.hidden);
    row.append(name, element("td", "number"), element("td", "number"), element("td", "number", line.count));
    return row;
  });
  table.tBodies[0].replaceChildren(...rows);
  if (focused) table.querySelector(`input[value="${CSS.escape(focused)}"]`)?.focus();
}

/** Time on the axis at a step. @param {number} index */
const time = (index) => `${Number(answer.x[index].toPrecision(6))}${value("x") === "seconds" ? " s" : ""}`;

/** Write the values at the cursor, or at the last step, into the legend. @param {number|null} index */
function read(index) {
  if (!answer) return;
  const at = index ?? answer.x.length - 1;
  part("at").textContent = index === null ? `${answer.statistic} at the last step` : `${answer.statistic} at t = ${time(at)}`;
  answer.curves.forEach((curve, row) => {
    const [, centre, interval] = table.tBodies[0].rows[row].cells;
    const known = curve.low?.[at] !== null && curve.low?.[at] !== undefined;
    centre.textContent = numeral(curve.values[at]);
    interval.textContent = known ? `${numeral(curve.low[at])} – ${numeral(curve.high[at])}` : "–";
  });
}

/** Move the cursor with the arrow keys. @param {KeyboardEvent} event */
function steer(event) {
  const move = { ArrowLeft: -1, ArrowRight: 1, PageUp: -25, PageDown: 25 }[event.key];
  if (!chart || !move) return;
  event.preventDefault();
  const last = answer.x.length - 1;
  const at = Math.min(Math.max((chart.cursor.idx ?? last) + move, 0), last);
  chart.setCursor({ left: chart.valToPos(answer.x[at], "x"), top: 10 });
}

if (form) {
  offerWidths(new URLSearchParams(location.search).get("width"));
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("change", ({ target }) => {
    if (target.name === "env") offerWidths(value("width"));
    remember();
    if (["style", "range"].includes(target.name) && answer) show();
    else load();
  });
  place.addEventListener("keydown", steer);
  document.addEventListener("dopt:change", load);
  load();
} else {
  document.addEventListener("dopt:change", () => location.reload());
}
