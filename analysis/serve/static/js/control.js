/** Control page: charts of success rate and relative cost against explored steps. */

import { hoverBox } from "./hover.js";
import { numeral } from "./numbers.js";
import { axis, describe, ink, logRange, plot, theme, veil } from "./plot.js";

const HEIGHT = 270;
const TRUTH = { colour: "#000000", dash: [5, 2], line_width: 1, label: "true model" };
let charts = [];

/** The columns of one quantity in the answer: centre, low and high. */
const columns = (name) => [name, `${name}_low`, `${name}_high`];

/** Values of a curve at all steps of a chart, null where it has none. */
function aligned(curve, name, steps) {
  const at = new Map(curve.t.map((t, index) => [t, curve[name][index]]));
  return steps.map((t) => at.get(t) ?? null);
}

/** Draw one quantity of one environment. */
function draw(place, environment, name, label, scale) {
  const { curves, steps, truth } = environment;
  const ideal = name === "success" ? truth.success : 1;
  const data = [steps, steps.map(() => ideal)];
  const series = [{}, { stroke: () => theme("text"), width: TRUTH.line_width, dash: TRUTH.dash, points: { show: false } }];
  const bands = [];
  for (const curve of curves) {
    const first = series.length;
    const dash = curve.dash.map((piece) => piece * curve.line_width);
    const stroke = () => ink(curve.colour);
    series.push(
      { stroke, width: 1.25 * curve.line_width, dash, points: { show: true, size: 6, fill: stroke } },
      { stroke: "transparent", width: 0, points: { show: false } },
      { stroke: "transparent", width: 0, points: { show: false } },
    );
    bands.push({ series: [first + 2, first + 1], fill: () => veil(curve.colour, 0.12) });
    for (const column of columns(name)) data.push(aligned(curve, column, steps));
  }
  const options = {
    series,
    bands,
    scales: { x: { time: false }, y: scale(data.slice(1).flat().filter((value) => value !== null)) },
    axes: [axis("explored steps", false, { size: 38 }), axis(label, name === "cost", { size: 54 })],
    cursor: { y: false, points: { show: false }, drag: { x: false, y: false } },
  };
  const chart = plot(place, options, data, HEIGHT);
  hoverBox(place, chart, (index) => values(environment, name, ideal, index));
  describe(place, `${label} in the ${environment.env}: ${curves.map((curve) => curve.label).join(", ")}. The table below has the values.`);
  return chart;
}

/** The values of all policies after one number of steps. */
function values({ curves, steps }, name, ideal, index) {
  const rows = curves.map((curve) => {
    const [centre, low, high] = columns(name).map((column) => aligned(curve, column, steps)[index]);
    const interval = low === null ? "" : ` [${numeral(low, 3)}, ${numeral(high, 3)}]`;
    return { line: curve, label: curve.label, value: `${numeral(centre, 3)}${interval}` };
  });
  return { title: `after ${steps[index]} steps`, rows: [{ line: TRUTH, label: TRUTH.label, value: numeral(ideal, 3) }, ...rows] };
}

/** Fetch the results and draw the charts of every environment. */
async function load() {
  const answer = await fetch(`${document.body.dataset.base}/api/control${location.search}`);
  if (!answer.ok) return;
  const found = await answer.json();
  for (const chart of charts) chart.destroy();
  charts = [];
  for (const environment of found.environments) {
    const section = document.getElementById(`control-${environment.env}`);
    if (!section) continue;
    const [success, cost] = section.querySelectorAll(".chart");
    charts.push(
      draw(success, environment, "success", "success rate", () => ({ range: [-0.04, 1.04] })),
      draw(cost, environment, "cost", "cost / cost with the true model", (all) => ({ distr: 3, log: 10, range: () => logRange(all) })),
    );
    section.dataset.drawn = "yes";
  }
}

document.addEventListener("dopt:change", load);
load();
