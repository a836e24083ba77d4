/** Trial page: charts of loss, phase plane, inputs, bounded states and spectrum. */

import { draw, ink, logRange, nameLines, numeral, part, theme } from "./chart.js";

const PAINTS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7"];
const TURN = Math.PI / 2;
const charts = part("charts");

/** A line in the policy's colour; each of several lines has another colour. */
function line(found, label, values, place = 0, among = 1, more = {}) {
  const colour = among === 1 ? found.legend_entry.colour : PAINTS[place % PAINTS.length];
  return { label, values, colour, dash: [], line_width: 1, ...more };
}

function drawLoss(found) {
  const own = found.is_prequential ? "prequential loss" : found.fit && "error";
  const grid = line(found, own || "evaluation grid", found.loss);
  const reachable = line(found, "reachable set", found.reachable_loss, 0, 1, { dash: [5, 4] });
  const label = ["time t [steps]", (own || "RMS error") + (found.unit && !found.fit ? ` [${found.unit}]` : "")];
  const range = () => logRange([...found.loss, ...found.reachable_loss]);
  const lines = own ? [grid] : [grid, reachable];
  draw(part("loss"), { x: found.t, lines, label, log: [false, true], range, title: (i) => `t = ${found.t[i]}` });
}

/** Draw errors of a fit's predictions, relative to the changes of the states. */
function drawAhead(rows) {
  const x = [...new Set(rows.map((row) => row.seconds))].sort((a, b) => a - b);
  const states = [...new Set(rows.map((row) => row.state))];
  const kinds = [["rms", "model", []], ["physics", "constants alone", [5, 4]], ["linear", "linear", [2, 3]]];
  const at = (state, seconds) => rows.find((row) => row.state === state && row.seconds === seconds) ?? {};
  const share = (row, kind) => (row[kind] && row.unchanged ? row[kind] / row.unchanged : null);
  const lines = states.flatMap((state, i) =>
    kinds.map(([kind, name, dash]) => ({ label: `${state}, ${name}`, values: x.map((s) => share(at(state, s), kind)), colour: PAINTS[i % PAINTS.length], dash, line_width: 1 })),
  );
  const range = () => logRange(lines.flatMap((one) => one.values));
  draw(part("ahead"), { x, lines, label: ["time ahead [s]", "error / change"], log: [true, true], range, title: (i) => `${numeral(x[i])} s ahead` });
  nameLines(part("ahead-legend"), lines);
}

/** Draw quantities against time, bounds dashed. */
function drawTimes(name, found, items, first) {
  const x = found.t.map((t) => (t + first) * found.dt);
  const lines = items.map((one, i) => line(found, one.label, one.values, i, items.length));
  const bounds = items.flatMap((one, i) =>
    (one.bounds ?? []).filter((bound) => bound !== null).map((bound) => line(found, "", x.map(() => bound), i, items.length, { dash: [5, 4], silent: true })),
  );
  const label = ["time [s]", items.map((one) => one.label).join(", ")];
  draw(part(name), { x, lines: [...lines, ...bounds], label, title: (i) => `t = ${numeral(x[i])} s` });
  nameLines(part(`${name}-legend`), lines);
}

function drawSpectrum(found) {
  const { frequency, density, eigenfrequency } = found.spectrum;
  const note = part("spectrum-note");
  if (!frequency.length) {
    note.textContent = "Too few inputs for a spectrum.";
    return;
  }
  const top = Math.max(...density);
  draw(part("spectrum"), {
    x: frequency,
    lines: [line(found, "density", density.map((value) => Math.max(value, top * 1e-7) || null))],
    label: ["frequency [Hz]", "density of u [unit²/Hz]"],
    log: [true, true],
    range: () => logRange(density.filter((value) => value > top * 1e-5)),
    title: (i) => `${numeral(frequency[i])} Hz`,
    hooks: { draw: [(u) => eigenfrequency && mark(u, eigenfrequency)] },
  });
  note.textContent = eigenfrequency
    ? `Dashed: eigenfrequency f₀ = ${numeral(eigenfrequency, 3)} Hz at the stable equilibrium, and 3 f₀.`
    : "The linearised system does not oscillate: there is no eigenfrequency.";
}

/** Draw how many steps took how long: the plan and what was learned, or ask() and tell(). */
function drawDurations(found) {
  const { us, steps, quantiles } = found.durations;
  const note = part("durations-note");
  if (!us.length) {
    note.textContent = "No times are stored.";
    return;
  }
  const x = us.map((value) => value / 1000);
  const paths = uPlot.paths.bars({ size: [1, 100] });
  const bars = line(found, "steps", steps, 0, 1, { paths });
  draw(part("durations"), { x, lines: [bars], label: ["time [ms]", "steps"], log: [true, false], title: (i) => `${numeral(x[i], 2)} ms` });
  const [median, most, longest] = quantiles.map((value) => `${numeral(value / 1000, 2)} ms`);
  note.textContent = `Planning and learning: median ${median}, 99 % below ${most}, longest ${longest}.`;
}

/** Vertical lines at the eigenfrequency and its third harmonic. */
function mark({ ctx, bbox, valToPos }, frequency) {
  ctx.save();
  Object.assign(ctx, { strokeStyle: theme("text"), fillStyle: theme("text"), lineWidth: devicePixelRatio, textAlign: "left", font: `${12 * devicePixelRatio}px sans-serif` });
  ctx.setLineDash([5 * devicePixelRatio, 3 * devicePixelRatio]);
  for (const [factor, text] of [[1, "f₀"], [3, "3 f₀"]]) {
    const x = valToPos(factor * frequency, "x", true);
    if (x < bbox.left || x > bbox.left + bbox.width) continue;
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
    ctx.fillText(text, x + 4 * devicePixelRatio, bbox.top + 11 * devicePixelRatio);
  }
  ctx.restore();
}

/** Draw the path in the phase plane: uPlot has the axes, the path is drawn on its canvas. */
function drawPhase(found) {
  const { x, y, box, start, labels, angles } = found.phase;
  const [across, up] = [extent(x, box[0]), extent(y, box[1])];
  const axes = angles.map((angle) => (angle ? { incrs: [TURN, 2 * TURN, 4 * TURN], values: (_, ticks) => ticks.map(angleText) } : {}));
  const paint = ({ ctx, valToPos }) => {
    const at = (i) => [valToPos(x[i], "x", true), valToPos(y[i], "y", true)];
    const [left, top, right, bottom] = [valToPos(box[0][0], "x", true), valToPos(box[1][1], "y", true), valToPos(box[0][1], "x", true), valToPos(box[1][0], "y", true)];
    ctx.save();
    Object.assign(ctx, { fillStyle: `${theme("muted")}22`, strokeStyle: ink(found.legend_entry.colour), lineWidth: 1.4 * devicePixelRatio });
    ctx.fillRect(left, top, right - left, bottom - top);
    ctx.beginPath();
    x.forEach((value, i) => value !== null && ctx[i && x[i - 1] !== null ? "lineTo" : "moveTo"](...at(i)));
    ctx.stroke();
    Object.assign(ctx, { fillStyle: theme("surface"), strokeStyle: theme("text") });
    ctx.beginPath();
    if (start) ctx.arc(valToPos(start[0], "x", true), valToPos(start[1], "y", true), 4.5 * devicePixelRatio, 0, 7);
    ctx.fill();
    ctx.stroke();
    ctx.restore();
  };
  draw(part("phase"), { x: across, lines: [{ ...line(found, "", up), line_width: 0 }], label: labels, range: () => up, axes, zoom: false, hooks: { draw: [paint] } });
}

/** Limits of one axis: the path and the box, with a margin. */
function extent(values, side) {
  const known = [...values.filter((value) => value !== null), ...side];
  const [low, high] = [Math.min(...known), Math.max(...known)];
  const margin = 0.04 * (high - low || 1);
  return [low - margin, high + margin];
}

function angleText(value) {
  const count = Math.round(value / TURN);
  if (!count) return "0";
  const size = Math.abs(count);
  return `${count < 0 ? "−" : ""}${{ 1: "π/2", 2: "π", 3: "3π/2", 4: "2π" }[size] ?? `${size / 2}π`}`;
}

/** Fetch the arrays and draw all charts. */
async function load() {
  try {
    const answer = await fetch(`/api/trials/${encodeURIComponent(charts.dataset.key)}/arrays`);
    const found = await answer.json();
    if (!answer.ok) throw new Error(found.error);
    drawLoss(found);
    if (found.fit) drawAhead(found.fit.errors);
    drawTimes("inputs", found, found.inputs, 0);
    const names = found.inputs.length > 1 ? "Bound of the norm" : "Bound";
    part("inputs-note").textContent = `${names}: γ = ${numeral(found.gamma, 3)}.`;
    if (part("states")) drawTimes("states", found, found.bounded, 1);
    drawSpectrum(found);
    drawDurations(found);
    if (found.phase) drawPhase(found);
    charts.dataset.drawn = String(found.t.length);
  } catch (error) {
    part("problem").textContent = error.message;
    part("problem").hidden = false;
  }
}

load();
if (part("exploration")) document.addEventListener("dopt:change", load); // it grows
