// The viewfinder's figures, what it shows, and the region that they are of.

import { by, note } from "./main.js";
import { element, number, pairs } from "./picture.js";
import { line, plotIn } from "./plots.js";

const PICTURES = ["white", "black", "grid", "rows", "cross", "align"];
/** With its sign, unless it is shown as zero. */
const signed = (value, digits) => {
  const shown = value.toFixed(digits);
  return Number(shown) === 0 ? (0).toFixed(digits) : `${value > 0 ? "+" : ""}${shown}`;
};
const percent = (share) => `${(100 * share).toFixed(share < 0.001 ? 3 : 1)} %`;

/** Plots of the counts along a row and a column. */
const cuts = {};
/** Rows and columns of the newest picture. */
let size = null;

/** Returns what the live picture calls: for a region that is chosen in it, and for when its marks change. */
export function startFinder(order) {
  const change = (params) => order("viewfinder", params);
  by("finder-pictures").append(...PICTURES.map((picture) =>
    element("button", { type: "button", "aria-pressed": "false", onclick: () => change({ picture }) }, picture)));
  by("finder-exposure").addEventListener("change", (event) => change({ exposure_us: Number(event.target.value) }));
  by("finder-whole").addEventListener("click", () => { if (size) change({ region: [0, size[0], 0, size[1]] }); });
  return {
    onregion: ([top, bottom, left, right], { about }) => {
      const [rows, columns] = about.size;
      const side = about.reduced_by ?? 1;
      change({ region: [top * side, Math.min(bottom * side, rows), left * side, Math.min(right * side, columns)] });
    },
    onmarks: (marked) => by("finder-cross").addEventListener("change", marked),
  };
}

/** What is marked in a picture of the viewfinder, in its pixels: the region, and the lines through its middle. */
export function marksOf({ name, about }) {
  if (name !== "viewfinder") return {};
  size = about.size;
  const side = about.reduced_by ?? 1;
  const [top, bottom, left, right] = about.region;
  const middle = (first, end) => (Math.floor((first + end) / 2) + 0.5) / side;
  const isWhole = about.region.join() === [0, size[0], 0, size[1]].join();
  return {
    frame: isWhole ? null : about.region.map((at) => at / side),
    cross: by("finder-cross").checked ? [middle(top, bottom), middle(left, right)] : null,
  };
}

/** Shows the values of a viewfinder, or hides them. */
export function showFinder(values) {
  by("finder").hidden = !values;
  if (!values || by("view-run").hidden) return;
  const { focus, alignment, dot } = values;
  const rows = [];
  if (focus) {
    const share = focus.best > 0 ? `, ${percent(focus.score / focus.best)} of the best, ${focus.trend}` : "";
    rows.push(["focus", `${focus.score.toPrecision(4)}${share}`]);
  }
  rows.push(["saturated", percent(values.saturated)], ["nearly dark", percent(values.underexposed)],
    ["mean", `${number(values.mean_dn)} of ${values.full_dn} counts`], ["brightest", `${values.brightest_dn} counts`]);
  if (alignment) {
    rows.push(["shift", `${signed(alignment.shift_rows, 2)} rows`],
      ["rotation", `${signed(alignment.rotation_deg, 3)}°`],
      ["magnification", alignment.magnification.toFixed(4)],
      ["farthest off", `${alignment.worst_rows.toFixed(2)} rows`]);
  }
  if (dot) {
    rows.push(["dot", `row ${dot.row.toFixed(1)}, column ${dot.column.toFixed(1)}; ${dot.fwhm_px.toFixed(1)} px wide, `
      + `${number(dot.peak_dn)} counts`]);
  }
  const [top, bottom, left, right] = values.region;
  rows.push(["region", `rows ${top} to ${bottom - 1}, columns ${left} to ${right - 1}`]);
  by("finder-figures").replaceChildren(...pairs(rows));
  const advice = (alignment?.advice ?? []).map((text) => note("warn", text));
  by("finder-advice").replaceChildren(...advice, ...(values.problem ? [note("bad", values.problem)] : []));
  for (const button of by("finder-pictures").children) {
    button.setAttribute("aria-pressed", String(button.textContent === values.picture));
  }
  if (document.activeElement !== by("finder-exposure")) by("finder-exposure").value = number(values.exposure_us);
  by("histogram-text").textContent = `0 to ${values.full_dn} counts; the line is saturation`;
  drawHistogram(by("histogram"), values);
  drawCut("row-cut", values.row_cut, [left, right], `Counts along row ${Math.floor((top + bottom) / 2)}`);
  drawCut("column-cut", values.column_cut, [top, bottom], `Counts along column ${Math.floor((left + right) / 2)}`);
}

/** Plots counts along a line from `first` to before `end`; each is the mean of as many neighbours. */
function drawCut(id, counts, [first, end], title) {
  if (!counts.length) return;
  by(`${id}-text`).textContent = title;
  const step = Math.ceil((end - first) / counts.length);
  const data = [counts.map((_, at) => first + at * step + (step - 1) / 2), counts];
  const range = (_, least, most) => [0, Math.max(most, 1) * 1.05];
  cuts[id] ??= plotIn(by(id), { lines: [line(0, "counts")], height: 110, range }, data);
  cuts[id].setData(data);
}

function drawHistogram(canvas, { histogram, saturation_dn: saturation, full_dn: full }) {
  const context = canvas.getContext("2d");
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const [width, most] = [canvas.width / histogram.length, Math.max(...histogram) || 1];
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.fillStyle = dark ? "#6cb4f0" : "#0b62a8";
  histogram.forEach((pixels, at) => {
    // The square root shows few pixels beside many.
    const height = Math.sqrt(pixels / most) * canvas.height;
    context.fillRect(at * width, canvas.height - height, Math.ceil(width) - 1, height);
  });
  context.fillStyle = dark ? "#f28b82" : "#b3261e";
  context.fillRect(Math.min(saturation / full, 1) * (canvas.width - 1), 0, 1, canvas.height);
}
