/** Curves page: chart and legend of loss curves, updated by the form and by the database. */

import { errorBars } from "./bars.js";
import { hoverBox } from "./hover.js";
import { fillLegend, nameLines, readLegend } from "./legend.js";
import { numeral } from "./numbers.js";
import { axis, describe, ink, logRange, plot, veil } from "./plot.js";

const HEIGHT = 430;
const DEFAULTS = { column: "loss", x: "steps", style: "band", range: "main", diverged: "exclude" };
const ASKED = ["env", "width", "column", "x", "diverged", "where"];

/** @param {string} id */
const part = (id) => document.getElementById(id);
const form = /** @type {HTMLFormElement|null} */ (part("controls"));
const place = part("chart");
const LEAD = part("lead").textContent;
const PREQUENTIAL = "Prequential loss against time: the error of each predicted acceleration before it is learned, not an error over a grid.";
const hidden = new Set(
  (new URLSearchParams(location.search).get("hide") ?? "").split(",").filter(Boolean),
);
let answer = null;
let chart = null;
let asking = null;

/** The values of the form that differ from the defaults. */
function chosen() {
  const found = new URLSearchParams();
  for (const [name, value] of new FormData(form)) {
    if (value !== "" && DEFAULTS[name] !== value) found.set(name, String(value));
  }
  return found;
}

/** Fill the menu of widths for the chosen environment. @param {string|null} wanted */
function offerWidths(wanted) {
  const environments = JSON.parse(form.dataset.environments);
  const env = new FormData(form).get("env");
  const widths = environments.find((one) => one.env === env)?.widths ?? [];
  const select = form.elements.namedItem("width");
  const options = [new Option("default", "")];
  for (const width of widths) options.push(new Option(String(width), String(width)));
  select.replaceChildren(...options);
  select.value = widths.map(String).includes(wanted ?? "") ? wanted : "";
}

/** Fetch the curves and draw them. */
async function load() {
  asking?.abort();
  const mine = (asking = new AbortController());
  const query = new URLSearchParams([...chosen()].filter(([name]) => ASKED.includes(name)));
  place.setAttribute("aria-busy", "true");
  try {
    const found = await fetch(`${document.body.dataset.base}/api/curves?${query}`, { signal: mine.signal });
    const content = await found.json();
    if (!found.ok) throw new Error(content.error);
    answer = content;
    complain("");
    draw();
  } catch (error) {
    if (error.name !== "AbortError") complain(error.message);
  } finally {
    if (asking === mine) place.removeAttribute("aria-busy");
  }
  part("csv").href = `${document.body.dataset.base}/api/curves.csv?${query}`;
}

/** Show an error message in place of the chart, or hide it. @param {string} sentence */
function complain(sentence) {
  part("problem").textContent = sentence;
  part("problem").hidden = sentence === "";
  if (!sentence) return;
  chart?.destroy();
  chart = null;
  answer = null;
  part("legend").tBodies[0].replaceChildren();
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

/** Draw the curves: three series for each policy, centre, low and high. */
function draw() {
  const choice = new FormData(form);
  const range = chart && chart.zoomed ? { ...chart.scales.x } : null;
  chart?.destroy();
  part("heading").textContent = form.querySelector("[name=env]:checked + b").textContent + answer.widths;
  fillLegend(part("legend"), answer.curves, hidden, toggle);
  warn();
  const style = choice.get("style");
  const unit = choice.get("x") === "seconds" ? "s" : "steps";
  chart = plot(place, options(style, unit, choice.get("column")), data(), HEIGHT);
  hoverBox(place, chart, values);
  if (range) chart.setScale("x", { min: range.min, max: range.max });
  part("band").textContent = style === "none" ? "" : `Interval: ${answer.band}.`;
  part("lead").textContent = answer.is_prequential ? PREQUENTIAL : LEAD;
  if (answer.is_prequential) part("band").textContent = `Points: each step. Lines: ${answer.statistic}.`;
  for (const name of ["column", "style"]) form.querySelector(`[name=${name}]`).closest("fieldset").hidden = answer.is_prequential;
  part("legend").tHead.rows[0].cells[0].textContent = "policy";
  read(null);
  shown();
}

/** Columns of uPlot; the lower end of an interval is at least a quarter of its centre (log axis). */
function data() {
  const columns = [answer.x];
  for (const curve of answer.curves) {
    const low = curve.points ?? curve.low.map((value, at) => (value === null ? null : Math.max(value, curve.centre[at] / 4)));
    columns.push(curve.centre, low, curve.high);
  }
  return columns;
}

function options(style, unit, column) {
  const series = [{}];
  const bands = [];
  answer.curves.forEach((curve, index) => {
    const show = !hidden.has(curve.policy);
    const dash = curve.dash.map((piece) => piece * curve.line_width);
    const first = 1 + 3 * index;
    series.push(
      { label: curve.policy, show, stroke: () => ink(curve.colour), width: 1.25 * curve.line_width, dash, points: { show: false } },
      { label: "low", show, stroke: "transparent", width: 0, points: faint(curve) },
      { label: "high", show, stroke: "transparent", width: 0, points: { show: false } },
    );
    bands.push({ series: [first + 2, first + 1], fill: () => veil(curve.colour, 0.17) });
  });
  const what = column === "loss" ? "L² error, evaluation grid" : "L² error, reachable set";
  const name = column === "loss" && answer.is_prequential ? "prequential loss" : what;
  return {
    series,
    bands: style === "band" && !answer.is_prequential ? bands : [],
    scales: { x: { time: false }, y: { distr: 3, log: 10, range: limits } },
    axes: [
      axis(`time t [${unit}]`, false, { size: 38, space: 70 }),
      axis(name, true, { size: 54 }),
    ],
    cursor: { y: false, points: { size: 7, one: false, fill: (u, i) => pointFill(i), stroke: "transparent", width: 0 }, drag: { x: true, y: false } },
    hooks: {
      setCursor: [(u) => read(u.cursor.idx ?? null)],
      setSelect: [(u) => { u.zoomed = true; }],
      drawSeries: [],
      draw: style === "errorbar" ? [errorBars(barred)] : [],
    },
  };
}

/** The points of a prequential loss, of which a line would be noise. */
function faint(curve) {
  const fill = () => veil(curve.colour, 0.3);
  return curve.points ? { show: true, size: 3, width: 0, stroke: "transparent", fill } : { show: false };
}

/** Limits of the loss axis: the visible curves, without those far below the others. */
function limits(_, low, high) {
  const [bottom, top] = logRange([low, high]);
  const all = !answer.main || new FormData(form).get("range") === "all";
  const floor = all ? 0 : answer.main[0];
  const visible = answer.curves.filter((curve) => !hidden.has(curve.policy));
  const below = visible.filter((curve) => Math.min(...curve.centre.filter((value) => value > 0)) < floor);
  const cut = below.length > 0 && below.length < visible.length;
  const names = below.map((curve) => curve.label).join(", ");
  part("below").textContent = cut ? `Below this part of the axis: ${names}. ` : "";
  return cut ? [Math.max(bottom, floor), top] : [bottom, top];
}

/** Colour of the cursor's point: only centres have one. */
function pointFill(series) {
  return series % 3 === 1 ? ink(answer.curves[(series - 1) / 3].colour) : "transparent";
}

/** The curves with their visibility, for the error bars. */
function barred() {
  return answer.curves.map((curve) => ({ ...curve, shown: !hidden.has(curve.policy) }));
}

/** Write the values at the cursor, or at the last step, into the legend. @param {number|null} index */
function read(index) {
  if (!answer) return;
  const last = answer.x.length - 1;
  const at = index ?? last;
  const unit = new FormData(form).get("x") === "seconds" ? " s" : "";
  part("at").textContent =
    index === null ? `${answer.statistic} at the last step` : `${answer.statistic} at t = ${Number(answer.x[at].toPrecision(6))}${unit}`;
  readLegend(part("legend"), answer.curves, at);
}

/** The values of the visible curves at one step, for the box at the cursor. @param {number} index */
function values(index) {
  const unit = new FormData(form).get("x") === "seconds" ? " s" : "";
  const rows = answer.curves
    .filter((curve) => !hidden.has(curve.policy))
    .map((curve) => {
      const [centre, low, high] = [curve.centre, curve.low, curve.high].map((column) => column[index]);
      const known = low !== null && low !== undefined;
      const interval = known ? ` [${numeral(low, 3)}, ${numeral(high, 3)}]` : "";
      return { line: curve, label: curve.label, value: `${numeral(centre, 3)}${interval}` };
    });
  return { title: `t = ${Number(answer.x[index].toPrecision(6))}${unit}`, rows };
}

/** @param {string} policy @param {boolean} on */
function toggle(policy, on) {
  if (on) hidden.delete(policy);
  else hidden.add(policy);
  const first = 1 + 3 * answer.curves.findIndex((curve) => curve.policy === policy);
  chart.batch(() => {
    for (let i = first; i < first + 3; i += 1) chart.setSeries(i, { show: on });
  });
  remember();
  shown();
}

/** Describe the chart for screen readers. */
function shown() {
  const curves = answer.curves.filter((curve) => !hidden.has(curve.policy));
  nameLines(part("key"), curves);
  place.dataset.shown = curves.map((curve) => curve.policy).join(" ");
  place.dataset.steps = String(answer.x.length);
  describe(place, `Loss against time in the ${answer.env}: ${curves.map((curve) => curve.label).join(", ")}. The table below has the values.`);
}

/** List missing trials and configurations that are not shown. */
function warn() {
  const notes = answer.notes.map((text) => note("note", `${text}.`));
  const gaps = answer.missing.map((gap) => `${gap.policy}: ${gap.states} (seeds ${gap.seeds})`);
  if (gaps.length) notes.unshift(note("warning", `Not all trials have ended: ${gaps.join("; ")}.`));
  part("missing").replaceChildren(...notes);
}

function note(kind, text) {
  const made = document.createElement("p");
  made.className = kind;
  made.textContent = text;
  return made;
}

/** Move the cursor with the arrow keys. @param {KeyboardEvent} event */
function steer(event) {
  const move = { ArrowLeft: -1, ArrowRight: 1, PageUp: -25, PageDown: 25 }[event.key];
  if (!chart || !move) return;
  event.preventDefault();
  const now = chart.cursor.idx ?? answer.x.length - 1;
  const at = Math.min(Math.max(now + move, 0), answer.x.length - 1);
  chart.setCursor({ left: chart.valToPos(answer.x[at], "x"), top: 10 });
}

if (form) {
  offerWidths(new URLSearchParams(location.search).get("width"));
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("change", (event) => {
    if (event.target.name === "env") offerWidths(form.elements.namedItem("width").value);
    remember();
    if (["style", "range"].includes(event.target.name) && answer) draw();
    else load();
  });
  place.addEventListener("keydown", steer);
  document.addEventListener("dopt:change", load);
  load();
} else {
  document.addEventListener("dopt:change", () => location.reload());
}
