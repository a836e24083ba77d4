/** Charts: formats of numbers, colours, one function that draws, and the values at the cursor. */

const dark = matchMedia("(prefers-color-scheme: dark)");
const FONT = '12px system-ui, "Noto Sans", "DejaVu Sans", sans-serif';
const RAISED = { "-": "⁻", 0: "⁰", 1: "¹", 2: "²", 3: "³", 4: "⁴", 5: "⁵", 6: "⁶", 7: "⁷", 8: "⁸", 9: "⁹" };
const NARROW = [8, 16]; // margin in the window, gap to the cursor
const charts = new Map();

/** @param {string} id */
export const part = (id) => document.getElementById(id);

/** A colour of the style sheet. @param {string} name */
export const theme = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

/** The colour of a line: black becomes the text colour, which is visible on a dark background. */
export const ink = (colour) => (colour === "#000000" ? theme("text") : colour);

/** A number with some significant digits, a dash for none. @param {number|null|undefined} value */
export function numeral(value, digits = 4) {
  if (value === null || value === undefined) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size < 1e-4 || size >= 1e6) return value.toExponential(digits - 1);
  return value.toFixed(Math.max(0, digits - 1 - Math.floor(Math.log10(size))));
}

/** A tick of a logarithmic axis: small and large ones as powers of ten. @param {number} value */
function logText(value) {
  if (value >= 0.009 && value < 1e4) return String(Number(value.toPrecision(3)));
  const exponent = Math.floor(Math.log10(value) + 1e-9);
  const factor = Math.round(value / 10 ** exponent);
  const power = "10" + [...String(exponent)].map((letter) => RAISED[letter]).join("");
  return factor === 1 ? power : `${factor}·${power}`;
}

/** Ticks of a logarithmic axis over [low, high]: fewer multiples of ten where it has more decades. */
function logTicks(low, high) {
  if (!(low > 0) || !(high > low)) return [];
  const decades = Math.log10(high / low);
  const multiples = decades < 0.8 ? [1, 1.5, 2, 3, 4, 5, 7] : decades < 1.5 ? [1, 2, 5] : decades < 2.5 ? [1, 3] : [1];
  const ticks = [];
  for (let k = Math.floor(Math.log10(low)); k <= Math.log10(high); k += 1) {
    ticks.push(...multiples.map((one) => one * 10 ** k).filter((tick) => tick >= low && tick <= high));
  }
  return ticks;
}

/** Limits of a logarithmic axis around the positive ones of some values. */
export function logRange(values) {
  const known = values.filter((value) => value > 0);
  return known.length ? [Math.min(...known) / 1.15, Math.max(...known) * 1.15] : [0.1, 1];
}

/** @param {string} label @param {boolean} logarithmic @param {object} more options of uPlot */
function axis(label, logarithmic, more) {
  const grid = { stroke: () => theme("grid"), width: 1 };
  const common = { label, labelSize: 22, labelFont: FONT, font: FONT, stroke: () => theme("muted"), grid, ticks: { ...grid, size: 4 } };
  const spaced = logarithmic
    ? { splits: (_, __, low, high) => logTicks(low, high), filter: (_, ticks) => ticks, values: (_, ticks) => ticks.map((tick) => (tick === null ? "" : logText(tick))) }
    : { values: (_, ticks) => ticks.map((tick) => String(Number(tick.toPrecision(6))).replace("-", "−")) };
  return { ...common, ...spaced, ...more };
}

/** A sample of a line. @param {{colour: string, dash: number[], line_width: number}} entry */
export function swatch(entry) {
  const made = document.createElement("template");
  const dash = entry.dash.map((piece) => piece * entry.line_width * 1.3).join(" ");
  made.innerHTML = '<svg class="swatch" viewBox="0 0 34 12" aria-hidden="true"><line x1="1" x2="33" y1="6" y2="6"/></svg>';
  const line = made.content.querySelector("line");
  line.setAttribute("stroke-width", String(1.5 * entry.line_width));
  if (entry.colour === "#000000") line.setAttribute("class", "ink");
  else line.setAttribute("stroke", entry.colour);
  if (dash) line.setAttribute("stroke-dasharray", dash);
  return made.content.firstChild;
}

/** An element with a class and a text. */
export function element(name, kind, text = "") {
  const made = document.createElement(name);
  made.className = kind;
  made.textContent = text;
  return made;
}

/** Write the legend of several lines above their chart. @param {HTMLElement} place */
export function nameLines(place, lines) {
  const items = lines.map((line) => {
    const item = document.createElement("li");
    item.append(swatch(line), line.label);
    return item;
  });
  place.replaceChildren(...items);
  place.hidden = items.length < 2;
}

/**
 * Draw lines in the place of the chart that was there; it follows its width and the theme.
 * @param {HTMLElement} place
 * @param {object} spec
 *   x: positions; title: (index) => text of the cursor; label: [x, y]; log: [x, y];
 *   lines: label, colour, dash, line_width, values; low, high (a band); points (faint); paths (filled); hidden; silent;
 *   range: limits of y; height; axes: options of uPlot for x and y; zoom; hooks: of uPlot
 */
export function draw(place, spec) {
  charts.get(place)?.destroy();
  place.replaceChildren();
  const [series, bands, data] = [[{}], [], [spec.x]];
  const add = (values, show, more) => {
    series.push({ show, stroke: "transparent", width: 0, points: { show: false }, ...more });
    data.push(values);
  };
  for (const line of spec.lines) {
    const [show, stroke, width] = [!line.hidden, () => ink(line.colour), 1.25 * line.line_width];
    const bars = line.paths ? { paths: line.paths, fill: stroke } : {};
    add(line.values, show, { stroke, width, dash: line.dash.map((piece) => piece * line.line_width), ...bars });
    if (line.points) add(line.points, show, { points: { show: true, size: 3, width: 0, stroke: "transparent", fill: () => `${ink(line.colour)}4d` } });
    if (!line.low) continue;
    bands.push({ series: [series.length + 1, series.length], fill: () => `${ink(line.colour)}2b` });
    add(line.low.map((value, at) => (value === null ? null : Math.max(value, line.values[at] / 4))), show); // on a log axis
    add(line.high, show);
  }
  const scale = (log) => (log ? { distr: 3, log: 10 } : {});
  const [xlog, ylog] = spec.log ?? [false, false];
  const y = { ...scale(ylog), ...(spec.range ? { range: spec.range } : {}) };
  const size = () => ({ width: Math.max(place.clientWidth, 120), height: spec.height ?? 290 });
  const options = {
    ...size(),
    series,
    bands,
    legend: { show: false },
    padding: [10, 14, 0, 0],
    scales: { x: { time: false, ...scale(xlog), ...(xlog ? { range: () => [spec.x[0], spec.x.at(-1)] } : {}) }, y },
    axes: [axis(spec.label[0], xlog, { size: 38, space: 70, ...spec.axes?.[0] }), axis(spec.label[1], ylog, { size: 54, ...spec.axes?.[1] })],
    cursor: { y: false, points: { show: false }, drag: { x: spec.zoom ?? !xlog, y: false } },
    hooks: spec.hooks ?? {},
  };
  const chart = new window.uPlot(options, data, place);
  const watch = new ResizeObserver(() => chart.width !== size().width && chart.setSize(size()));
  const repaint = () => chart.redraw(false, true);
  watch.observe(place);
  dark.addEventListener("change", repaint);
  const forget = spec.title ? hoverBox(place, chart, spec) : () => {};
  chart.hooks.destroy = [() => { watch.disconnect(); dark.removeEventListener("change", repaint); forget(); }];
  charts.set(place, chart);
  return chart;
}

/** Show the values of the visible lines at the cursor, inside the window; return how to end it. */
function hoverBox(place, chart, spec) {
  const box = element("div", "hover");
  const hide = () => { box.hidden = true; };
  hide();
  box.setAttribute("aria-hidden", "true");
  place.append(box);
  const update = () => {
    const { idx, left } = chart.cursor;
    if (idx === null || idx === undefined || !(left >= 0)) return hide();
    box.replaceChildren(element("strong", "", spec.title(idx)));
    for (const line of spec.lines.filter((one) => !one.hidden && !one.silent)) {
      const known = line.low?.[idx] !== null && line.low?.[idx] !== undefined;
      const interval = known ? ` [${numeral(line.low[idx], 3)}, ${numeral(line.high[idx], 3)}]` : "";
      box.append(swatch(line), element("span", "label", line.label), element("span", "value", `${numeral(line.values[idx], line.low ? 3 : 4)}${interval}`));
    }
    box.hidden = false;
    move(box, chart);
  };
  chart.hooks.setCursor = [...(chart.hooks.setCursor ?? []), update];
  addEventListener("scroll", hide, { capture: true, passive: true });
  return () => removeEventListener("scroll", hide, true);
}

/** Put the box to the right of the cursor, or to the left where the window ends. */
function move(box, chart) {
  const [margin, gap] = NARROW;
  const over = chart.over.getBoundingClientRect();
  const { width, height } = box.getBoundingClientRect();
  const x = over.left + chart.cursor.left;
  const left = x + gap + width + margin <= innerWidth ? x + gap : x - gap - width;
  const middle = over.top + (chart.cursor.top >= 0 ? chart.cursor.top : over.height / 2);
  const top = Math.min(middle - height / 2, innerHeight - height - margin);
  box.style.left = `${Math.max(margin, left)}px`;
  box.style.top = `${Math.max(margin, top)}px`;
}
