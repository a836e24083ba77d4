/** Phase-plane path of a trial as SVG. */

import { ink } from "./plot.js";

const SPACE = "http://www.w3.org/2000/svg";
const WIDTH = 520;
const HEIGHT = 330;
const FRAME = { left: 62, right: 508, top: 10, bottom: 278 };
const TURN = Math.PI / 2;

/** @param {string} name @param {Object<string, string|number>} attributes */
function shape(name, attributes, text = "") {
  const made = document.createElementNS(SPACE, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, String(value));
  made.textContent = text;
  return made;
}

/** Limits of one axis: the path and the box, with a margin. */
function extent(values, side) {
  const known = values.filter((value) => value !== null);
  const low = Math.min(...known, side[0]);
  const high = Math.max(...known, side[1]);
  const margin = 0.04 * (high - low || 1);
  return [low - margin, high + margin];
}

/** Round ticks over a range; multiples of π/2 for an angle. */
function ticks([low, high], angle) {
  let step = angle ? TURN : 10 ** Math.floor(Math.log10((high - low) / 4));
  if (!angle) step *= [1, 2, 5, 10].find((factor) => (high - low) / (factor * step) <= 6) ?? 10;
  while (angle && (high - low) / step > 7) step *= 2;
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high; k += 1) found.push(k * step);
  return found;
}

function tickText(value, angle) {
  if (!angle) return String(Number(value.toPrecision(6))).replace("-", "−");
  const count = Math.round(value / TURN);
  if (count === 0) return "0";
  const size = Math.abs(count);
  const names = { 1: "π/2", 2: "π", 3: "3π/2", 4: "2π" };
  return `${count < 0 ? "−" : ""}${names[size] ?? `${size / 2}π`}`;
}

/**
 * Draw a path.
 * @param {HTMLElement} place
 * @param {object} phase as the server gives it: x, y, start, labels, angles, box
 * @param {string} colour
 * @param {string} description for screen readers
 */
export function drawPhase(place, phase, colour, description) {
  const ranges = [extent(phase.x, phase.box[0]), extent(phase.y, phase.box[1])];
  const across = scale(ranges[0], FRAME.left, FRAME.right);
  const up = scale(ranges[1], FRAME.bottom, FRAME.top);
  const svg = shape("svg", { class: "phase", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": description });
  const [[left, right], [bottom, top]] = phase.box;
  svg.append(
    shape("rect", { class: "box", x: across(left), y: up(top), width: across(right) - across(left), height: up(bottom) - up(top) }),
  );
  axes(svg, phase, ranges, across, up);
  svg.append(shape("path", { class: "path", d: path(phase, across, up), stroke: ink(colour) }));
  if (phase.start) {
    svg.append(shape("circle", { class: "start", cx: across(phase.start[0]), cy: up(phase.start[1]), r: 4.5 }));
  }
  place.replaceChildren(svg);
}

function scale([low, high], from, to) {
  return (value) => Number((from + ((value - low) / (high - low)) * (to - from)).toFixed(2));
}

function axes(svg, phase, ranges, across, up) {
  const { left, right, top, bottom } = FRAME;
  for (const tick of ticks(ranges[0], phase.angles[0])) {
    svg.append(shape("line", { class: "tick", x1: across(tick), x2: across(tick), y1: top, y2: bottom }));
    svg.append(shape("text", { x: across(tick), y: bottom + 17, "text-anchor": "middle" }, tickText(tick, phase.angles[0])));
  }
  for (const tick of ticks(ranges[1], phase.angles[1])) {
    svg.append(shape("line", { class: "tick", x1: left, x2: right, y1: up(tick), y2: up(tick) }));
    svg.append(shape("text", { x: left - 7, y: up(tick) + 4, "text-anchor": "end" }, tickText(tick, phase.angles[1])));
  }
  svg.append(shape("rect", { class: "frame", x: left, y: top, width: right - left, height: bottom - top }));
  const middle = (top + bottom) / 2;
  svg.append(shape("text", { class: "label", x: (left + right) / 2, y: HEIGHT - 12, "text-anchor": "middle" }, phase.labels[0]));
  svg.append(shape("text", { class: "label", transform: `translate(15 ${middle}) rotate(-90)`, "text-anchor": "middle" }, phase.labels[1]));
}

/** SVG path data, interrupted where the server inserted a break. */
function path(phase, across, up) {
  let pen = "M";
  const pieces = [];
  phase.x.forEach((x, index) => {
    if (x === null || phase.y[index] === null) {
      pen = "M";
      return;
    }
    pieces.push(`${pen}${across(x)} ${up(phase.y[index])}`);
    pen = "L";
  });
  return pieces.join("");
}
