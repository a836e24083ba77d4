/** Hover box: the values at the cursor of a chart, positioned inside the window. */

import { swatch } from "./legend.js";

const GAP = 16;
const MARGIN = 8;

/**
 * Show a box of values while the cursor of a chart is over its data.
 * @param {HTMLElement} place the element that contains the chart
 * @param {object} chart the uPlot chart
 * @param {(index: number) => {title: string, rows: Array<{line?: object, label: string, value: string}>}} read
 */
export function hoverBox(place, chart, read) {
  const box = document.createElement("div");
  box.className = "hover";
  box.hidden = true;
  box.setAttribute("aria-hidden", "true");
  place.append(box);
  const hide = () => {
    box.hidden = true;
  };
  const update = () => {
    const { idx, left } = chart.cursor;
    if (idx === null || idx === undefined || left === undefined || left < 0) {
      hide();
      return;
    }
    fill(box, read(idx));
    box.hidden = false;
    move(box, chart);
  };
  chart.hooks.setCursor = [...(chart.hooks.setCursor ?? []), update];
  chart.hooks.destroy = [
    ...(chart.hooks.destroy ?? []),
    () => {
      removeEventListener("scroll", hide, true);
      box.remove();
    },
  ];
  addEventListener("scroll", hide, { capture: true, passive: true });
}

/** Write a title and one row for each line. */
function fill(box, { title, rows }) {
  const heading = document.createElement("strong");
  heading.textContent = title;
  box.replaceChildren(heading);
  for (const row of rows) {
    box.append(row.line ? swatch(row.line) : document.createElement("span"));
    for (const [kind, text] of [["label", row.label], ["value", row.value]]) {
      const cell = document.createElement("span");
      cell.className = kind;
      cell.textContent = text;
      box.append(cell);
    }
  }
}

/** Put the box to the right of the cursor, or to the left where the window ends. */
function move(box, chart) {
  const over = chart.over.getBoundingClientRect();
  const { width, height } = box.getBoundingClientRect();
  const x = over.left + chart.cursor.left;
  const right = x + GAP;
  const fits = right + width + MARGIN <= innerWidth;
  const left = Math.max(MARGIN, fits ? right : x - GAP - width);
  const middle = over.top + (chart.cursor.top >= 0 ? chart.cursor.top : over.height / 2);
  const top = Math.min(Math.max(MARGIN, middle - height / 2), innerHeight - height - MARGIN);
  box.style.left = `${left}px`;
  box.style.top = `${Math.max(MARGIN, top)}px`;
}
