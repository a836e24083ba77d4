/** Trial page: charts of loss, inputs, bounded states, spectrum and phase plane. */

import { hoverBox } from "./hover.js";
import { nameLines } from "./legend.js";
import { drawPhase } from "./phase.js";
import { numeral } from "./numbers.js";
import { axis, ink, logRange, plot, theme } from "./plot.js";

const HEIGHT = 290;
const PAINTS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7"];
const SILENT = { y: false, drag: { x: true, y: false } };
const charts = document.getElementById("charts");

/** Charts on the page. */
const shown = new Map();

/** Draw a chart in the place of the one that was there. */
function drawn(place, ...rest) {
  shown.get(place)?.destroy();
  shown.set(place, plot(place, ...rest));
  return shown.get(place);
}

/** @param {string} id */
const part = (id) => document.getElementById(id);

/** A line without points. */
function line(colour, more = {}) {
  return { stroke: () => ink(colour), width: 1.6, points: { show: false }, ...more };
}

/** What a legend needs of a line. */
function sample(colour, dash = []) {
  return { colour, dash, line_width: 1.2 };
}

function drawLoss(found) {
  const series = [{}, line(found.legend_entry.colour), line(found.legend_entry.colour, { dash: [5, 4], width: 1.2 })];
  const names = found.is_prequential ? ["prequential loss"] : ["evaluation grid", "reachable set"];
  const range = () => logRange([...found.loss, ...found.reachable_loss].filter((one) => one !== null));
  const chart = drawn(
    part("loss"),
    {
      series,
      scales: { x: { time: false }, y: { distr: 3, log: 10, range } },
      axes: [axis("time t [steps]", false, { size: 38 }), axis(found.is_prequential ? "prequential loss" : "L² error", true, { size: 54 })],
      cursor: SILENT,
    },
    [found.t, found.loss, found.reachable_loss],
    HEIGHT,
  );
  hoverBox(part("loss"), chart, (index) => ({
    title: `t = ${found.t[index]}`,
    rows: [
      { line: sample(found.legend_entry.colour), label: names[0], value: numeral(found.loss[index]) },
      { line: sample(found.legend_entry.colour, [5, 4]), label: names[1], value: numeral(found.reachable_loss[index]) },
    ].slice(0, names.length),
  }));
}

function drawInputs(found) {
  const times = found.t.map((t) => t * found.dt);
  const series = [{}, ...found.inputs.map((_, index) => line(paint(found, found.inputs, index), { width: 1.2 }))];
  const chart = drawn(
    part("inputs"),
    {
      series,
      scales: { x: { time: false } },
      axes: [axis("time [s]", false, { size: 38 }), axis(found.inputs.map((one) => one.label).join(", "), false, { size: 54 })],
      cursor: SILENT,
    },
    [times, ...found.inputs.map((one) => one.values)],
    HEIGHT,
  );
  hoverBox(part("inputs"), chart, (index) => ({
    title: `t = ${numeral(times[index])} s`,
    rows: found.inputs.map((one, i) => ({ line: sample(paint(found, found.inputs, i)), label: one.label, value: numeral(one.values[index]) })),
  }));
  nameLines(part("inputs-legend"), named(found.inputs, found));
  const names = found.inputs.length > 1 ? `Bound of the norm` : `Bound`;
  part("inputs-note").textContent = `${names}: γ = ${numeral(found.gamma, 3)}.`;
}

/** What a legend needs of several lines. */
function named(lines, found) {
  return lines.map((one, index) => ({ ...sample(paint(found, lines, index)), label: one.label }));
}

function paint(found, lines, index) {
  return lines.length === 1 ? found.legend_entry.colour : PAINTS[index % PAINTS.length];
}

/** States that limits bound, each with dashed lines at its bounds. */
function drawStates(found) {
  const lines = found.bounded;
  const times = found.t.map((t) => (t + 1) * found.dt);
  const series = [{}];
  const data = [times];
  lines.forEach((one, index) => {
    const colour = paint(found, lines, index);
    series.push(line(colour, { width: 1.2 }));
    data.push(one.values);
    for (const bound of one.bounds.filter((value) => value !== null)) {
      series.push(line(colour, { width: 1, dash: [5, 4] }));
      data.push(times.map(() => bound));
    }
  });
  const axes = [axis("time [s]", false, { size: 38 }), axis(lines.map((one) => one.label).join(", "), false, { size: 54 })];
  const chart = drawn(part("states"), { series, scales: { x: { time: false } }, axes, cursor: SILENT }, data, HEIGHT);
  hoverBox(part("states"), chart, (index) => ({
    title: `t = ${numeral(times[index])} s`,
    rows: lines.map((one, i) => ({ line: sample(paint(found, lines, i)), label: one.label, value: numeral(one.values[index]) })),
  }));
  nameLines(part("states-legend"), named(lines, found));
}

function drawSpectrum(found) {
  const { frequency, density, eigenfrequency } = found.spectrum;
  if (!frequency.length) {
    part("spectrum-note").textContent = "Too few inputs for a spectrum.";
    return;
  }
  const top = Math.max(...density);
  const range = () => logRange(density.filter((value) => value > top * 1e-5));
  const clipped = density.map((value) => Math.max(value, top * 1e-7) || null);
  const chart = drawn(
    part("spectrum"),
    {
      series: [{}, line(found.legend_entry.colour, { width: 1.3 })],
      scales: { x: { time: false, distr: 3, log: 10, range: () => [frequency[0], frequency.at(-1)] }, y: { distr: 3, log: 10, range } },
      axes: [axis("frequency [Hz]", true, { size: 38 }), axis("density of u [unit²/Hz]", true, { size: 54 })],
      cursor: { y: false, drag: { x: false, y: false } },
      hooks: { draw: eigenfrequency ? [(u) => mark(u, eigenfrequency)] : [] },
    },
    [frequency, clipped],
    HEIGHT,
  );
  hoverBox(part("spectrum"), chart, (index) => ({
    title: `${numeral(frequency[index])} Hz`,
    rows: [{ line: sample(found.legend_entry.colour), label: "density", value: numeral(density[index]) }],
  }));
  part("spectrum-note").textContent = eigenfrequency
    ? `Dashed: eigenfrequency f₀ = ${numeral(eigenfrequency, 3)} Hz at the stable equilibrium, and 3 f₀.`
    : "The linearised system does not oscillate: there is no eigenfrequency.";
}

/** Vertical lines at the eigenfrequency and its third harmonic. */
function mark(u, frequency) {
  const { ctx, bbox } = u;
  ctx.save();
  ctx.strokeStyle = theme("text");
  ctx.fillStyle = theme("text");
  ctx.lineWidth = devicePixelRatio;
  ctx.setLineDash([5 * devicePixelRatio, 3 * devicePixelRatio]);
  ctx.textAlign = "left";
  ctx.textBaseline = "alphabetic";
  ctx.font = `${12 * devicePixelRatio}px system-ui, sans-serif`;
  for (const [factor, text] of [[1, "f₀"], [3, "3 f₀"]]) {
    const x = u.valToPos(factor * frequency, "x", true);
    if (x < bbox.left || x > bbox.left + bbox.width) continue;
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
    ctx.fillText(text, x + 4 * devicePixelRatio, bbox.top + 11 * devicePixelRatio);
  }
  ctx.restore();
}

/** Fetch a part of the trial. @param {string} name */
async function fetched(name) {
  const answer = await fetch(`${document.body.dataset.base}/api/trials/${encodeURIComponent(charts.dataset.key)}/${name}`);
  const found = await answer.json();
  if (!answer.ok) throw new Error(found.error);
  return found;
}

/** Draw the samples of a trial that runs; without any there is no chart. */
async function loadSamples() {
  const found = await fetched("samples");
  charts.hidden = !found.t.length;
  if (charts.hidden) return;
  drawLoss(found);
  charts.dataset.drawn = String(found.t.length);
}

/** Fetch the arrays and draw all charts. */
async function load() {
  try {
    if ("running" in charts.dataset) {
      await loadSamples();
      return;
    }
    const found = await fetched("arrays");
    drawLoss(found);
    drawInputs(found);
    if (part("states")) drawStates(found);
    drawSpectrum(found);
    if (found.phase && part("phase")) {
      drawPhase(part("phase"), found.phase, found.legend_entry.colour, `Path in the plane of ${found.phase.labels.join(" and ")}`);
    }
    charts.dataset.drawn = "yes";
  } catch (error) {
    part("problem").textContent = error.message;
    part("problem").hidden = false;
  }
}

if (charts) {
  load();
  if (document.getElementById("exploration")) document.addEventListener("dopt:change", load); // it grows
  if ("running" in charts.dataset) document.addEventListener("dopt:samples", load);
}
