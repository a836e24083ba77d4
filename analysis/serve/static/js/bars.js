/** Error bars: the interval of each curve at a few steps, shifted so that policies do not overlap. */

import { ink } from "./plot.js";

const COUNT = 16;
const CAP = 3;

/**
 * A hook of uPlot that draws bars for each visible curve.
 * @param {() => Array<{colour: string, shown: boolean, low: number[], high: number[]}>} curves
 */
export function errorBars(curves) {
  return (chart) => {
    const given = curves();
    const { ctx, bbox } = chart;
    const x = chart.data[0];
    const ratio = window.devicePixelRatio;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.lineWidth = 1.4 * ratio;
    given.forEach((curve, place) => {
      if (!curve.shown) return;
      ctx.strokeStyle = ink(curve.colour);
      for (const at of steps(x, chart.scales.x, place / given.length)) {
        bar(chart, x[at], curve.low[at], curve.high[at], CAP * ratio);
      }
    });
    ctx.restore();
  };
}

/** Indices of the bars of one curve among the visible steps, shifted by a share of their spacing. */
function* steps(x, scale, share) {
  const inside = x.map((_, index) => index).filter((i) => x[i] >= scale.min && x[i] <= scale.max);
  const spacing = inside.length / COUNT;
  for (let k = 0; k < COUNT; k += 1) {
    const at = Math.floor((k + share) * spacing);
    if (at < inside.length && (spacing >= 1 || k < inside.length)) yield inside[at];
  }
}

function bar(chart, x, low, high, cap) {
  if (low === null || high === null || high < chart.scales.y.min) return;
  const across = chart.valToPos(x, "x", true);
  const bottom = chart.valToPos(Math.max(low, chart.scales.y.min), "y", true);
  const top = chart.valToPos(high, "y", true);
  const { ctx } = chart;
  ctx.beginPath();
  ctx.moveTo(across, bottom);
  ctx.lineTo(across, top);
  for (const end of [bottom, top]) {
    ctx.moveTo(across - cap, end);
    ctx.lineTo(across + cap, end);
  }
  ctx.stroke();
}
