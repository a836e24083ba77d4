/** Number formats, the same as in the tables. */

const RAISED = { "-": "⁻", 0: "⁰", 1: "¹", 2: "²", 3: "³", 4: "⁴", 5: "⁵", 6: "⁶", 7: "⁷", 8: "⁸", 9: "⁹" };

/**
 * A number with some significant digits, a dash for none.
 * @param {number|null|undefined} value
 * @param {number} digits
 */
export function numeral(value, digits = 4) {
  if (value === null || value === undefined) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size < 1e-4 || size >= 1e6) return value.toExponential(digits - 1);
  const places = Math.max(0, digits - 1 - Math.floor(Math.log10(size)));
  return value.toFixed(places);
}

/** @param {number} exponent */
export function power(exponent) {
  return "10" + [...String(exponent)].map((letter) => RAISED[letter]).join("");
}

/** A tick of a logarithmic axis: small and large ones as powers of ten. @param {number} value */
export function logText(value) {
  if (value >= 0.009 && value < 1e4) return String(Number(value.toPrecision(3)));
  const exponent = Math.floor(Math.log10(value) + 1e-9);
  const factor = Math.round(value / 10 ** exponent);
  return factor === 1 ? power(exponent) : `${factor}·${power(exponent)}`;
}

/** Labelled multiples of a power of ten, by the decades of the axis below which they hold. */
const MULTIPLES = [
  [0.8, [1, 1.5, 2, 3, 4, 5, 7]],
  [1.5, [1, 2, 5]],
  [2.5, [1, 3]],
  [Infinity, [1]],
];

/**
 * Ticks of a logarithmic axis over [low, high].
 * @param {number} low
 * @param {number} high
 * @returns {number[]}
 */
export function logTicks(low, high) {
  if (!(low > 0) || !(high > low)) return [];
  const [, multiples] = MULTIPLES.find(([limit]) => Math.log10(high / low) < limit);
  const ticks = [];
  for (let k = Math.floor(Math.log10(low)); k <= Math.log10(high); k += 1) {
    for (const multiple of multiples) {
      const tick = multiple * 10 ** k;
      if (tick >= low && tick <= high) ticks.push(tick);
    }
  }
  return ticks;
}
