/** Legend table of the curves: names, check boxes, and the values at one step. */

import { numeral } from "./numbers.js";

const SPACE = "http://www.w3.org/2000/svg";

/** A sample of a line. @param {{colour: string, dash: number[], line_width: number}} entry */
export function swatch(entry) {
  const svg = document.createElementNS(SPACE, "svg");
  const line = document.createElementNS(SPACE, "line");
  svg.setAttribute("class", "swatch");
  svg.setAttribute("viewBox", "0 0 34 12");
  svg.setAttribute("aria-hidden", "true");
  const given = { x1: 1, x2: 33, y1: 6, y2: 6, "stroke-width": 1.5 * entry.line_width };
  for (const [name, value] of Object.entries(given)) line.setAttribute(name, String(value));
  if (entry.colour === "#000000") line.setAttribute("class", "ink");
  else line.setAttribute("stroke", entry.colour);
  const dash = entry.dash.map((part) => part * entry.line_width * 1.3).join(" ");
  if (dash) line.setAttribute("stroke-dasharray", dash);
  svg.append(line);
  return svg;
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
 * Fill the table with a row for each curve.
 * @param {HTMLTableElement} table
 * @param {object[]} curves as the server gives them
 * @param {Set<string>} hidden policies that are switched off
 * @param {(policy: string, shown: boolean) => void} onToggle
 */
export function fillLegend(table, curves, hidden, onToggle) {
  const rows = curves.map((curve) => {
    const row = document.createElement("tr");
    const box = document.createElement("input");
    box.type = "checkbox";
    box.checked = !hidden.has(curve.policy);
    box.value = curve.policy;
    const label = document.createElement("label");
    label.className = "policy";
    label.append(box, swatch(curve), curve.label);
    const name = document.createElement("td");
    name.append(label);
    row.append(name, cell("value"), cell("95 % interval"), cell("trials", curve.count));
    row.classList.toggle("off", !box.checked);
    box.addEventListener("change", () => {
      row.classList.toggle("off", !box.checked);
      onToggle(curve.policy, box.checked);
    });
    return row;
  });
  const focused = document.activeElement instanceof HTMLInputElement && document.activeElement.value;
  const kept = focused && table.contains(document.activeElement);
  table.tBodies[0].replaceChildren(...rows);
  if (kept) table.querySelector(`input[value="${CSS.escape(focused)}"]`)?.focus();
}

/** A cell with the heading that a phone shows in it. */
function cell(heading, text = "") {
  const made = document.createElement("td");
  made.className = "number";
  made.dataset.label = heading;
  made.textContent = text;
  return made;
}

/** Write the values of one step into the table. @param {HTMLTableElement} table */
export function readLegend(table, curves, at) {
  curves.forEach((curve, index) => {
    const cells = table.tBodies[0].rows[index].cells;
    cells[1].textContent = numeral(curve.centre[at]);
    const known = curve.low[at] !== null && curve.low[at] !== undefined;
    cells[2].textContent = known ? `${numeral(curve.low[at])} – ${numeral(curve.high[at])}` : "–";
  });
}
