/** Shared parts of all charts: theme colours, axes, and a redraw after a change of size or theme. */

import { logText, logTicks, numeral } from "./numbers.js";

const dark = matchMedia("(prefers-color-scheme: dark)");

/** A colour of the style sheet. @param {string} name */
export function theme(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** The colour of a line: black becomes the text colour, which is visible on a dark background. */
export function ink(colour) {
  return colour === "#000000" ? theme("text") : colour;
}

/** The same colour, translucent. @param {string} colour @param {number} alpha */
export function veil(colour, alpha) {
  const hex = ink(colour).replace("#", "");
  const [red, green, blue] = [0, 2, 4].map((at) => parseInt(hex.slice(at, at + 2), 16));
  return `rgba(${red}, ${green}, ${blue}, ${alpha})`;
}

const FONT = '12px system-ui, "Noto Sans", "DejaVu Sans", sans-serif';

/**
 * @param {string} label
 * @param {boolean} logarithmic
 * @param {object} more further options of the axis
 */
export function axis(label, logarithmic = false, more = {}) {
  const grid = { stroke: () => theme("grid"), width: 1 };
  const common = {
    label,
    labelSize: 22,
    labelFont: FONT,
    font: FONT,
    stroke: () => theme("muted"),
    grid,
    ticks: { ...grid, size: 4 },
    ...more,
  };
  if (!logarithmic) return { values: (_, ticks) => ticks.map((tick) => number(tick, ticks)), ...common };
  return {
    ...common,
    splits: (_, __, low, high) => logTicks(low, high),
    filter: (_, ticks) => ticks,
    values: (_, ticks) => ticks.map((tick) => (tick === null ? "" : logText(tick))),
  };
}

/** Text of a tick of a linear axis, with the decimals that the spacing needs. */
function number(tick, ticks) {
  const step = ticks.length > 1 ? Math.abs(ticks[1] - ticks[0]) : 1;
  let places = 0;
  while (places < 8 && Math.abs(step * 10 ** places - Math.round(step * 10 ** places)) > 1e-6) places += 1;
  return tick.toFixed(places).replace("-", "−");
}

/** Limits of a logarithmic axis around the positive ones of some values. @param {number[]} values */
export function logRange(values) {
  let low = Infinity;
  let high = -Infinity;
  for (const value of values) {
    if (value > 0 && value < low) low = value;
    if (value > 0 && value > high) high = value;
  }
  return low > high ? [0.1, 1] : [low / 1.15, high * 1.15];
}

/**
 * Make a chart that fills its place and follows its width and the theme.
 * @param {HTMLElement} place
 * @param {object} options of uPlot, without size
 * @param {Array<Array<number|null>>} data
 * @param {number} height
 */
export function plot(place, options, data, height) {
  place.replaceChildren();
  const size = () => ({ width: Math.max(place.clientWidth, 120), height });
  const chart = new window.uPlot(
    { ...size(), legend: { show: false }, padding: [10, 14, 0, 0], ...options },
    data,
    place,
  );
  const watch = new ResizeObserver(() => {
    if (chart.width !== size().width) chart.setSize(size());
  });
  const repaint = () => chart.redraw(false, true);
  watch.observe(place);
  dark.addEventListener("change", repaint);
  chart.hooks.destroy = [
    ...(chart.hooks.destroy ?? []),
    () => {
      watch.disconnect();
      dark.removeEventListener("change", repaint);
    },
  ];
  return chart;
}

/** Set the description of a chart for screen readers. */
export function describe(place, text) {
  place.setAttribute("aria-label", text);
}

export { numeral };
