// The viewfinder's figures, and what it shows.

import { by, call, note } from "./main.js";
import { element, number } from "./picture.js";

const PICTURES = ["white", "black", "grid", "rows", "cross", "align"];
const percent = (share) => `${(100 * share).toFixed(share < 0.001 ? 3 : 1)} %`;

export function startFinder({ complain, refresh }) {
  const change = async (params) => {
    complain(await call("viewfinder", params));
    refresh();
  };
  by("finder-pictures").append(...PICTURES.map((picture) =>
    element("button", { type: "button", "aria-pressed": "false", onclick: () => change({ picture }) }, picture)));
  by("finder-exposure").addEventListener("change", (event) => change({ exposure_us: Number(event.target.value) }));
}

/** The event `viewfinder`; none comes when the viewfinder has ended. */
export const hearFinder = (event) => showFinder(event);

/** Shows the values of a viewfinder, or hides them. */
export function showFinder(values) {
  by("finder").hidden = !values;
  if (!values) return;
  const { focus, alignment, dot } = values;
  const rows = [];
  if (focus) rows.push(["focus", `${focus.score.toPrecision(4)}, ${percent(focus.score / focus.best)} of the best, ${focus.trend}`]);
  rows.push(["saturated", percent(values.saturated)], ["nearly dark", percent(values.underexposed)],
    ["mean", `${number(values.mean_dn)} of ${values.full_dn} counts`], ["brightest", `${values.brightest_dn} counts`]);
  if (alignment) {
    rows.push(["shift", `${alignment.shift_rows.toFixed(2)} rows`], ["rotation", `${alignment.rotation_deg.toFixed(3)}°`],
      ["magnification", alignment.magnification.toFixed(4)], ["farthest off", `${alignment.worst_rows.toFixed(2)} rows`]);
  }
  if (dot) rows.push(["dot", `row ${dot.row.toFixed(1)}, column ${dot.column.toFixed(1)}; ${dot.fwhm_px.toFixed(1)} px wide, ${number(dot.peak_dn)} counts`]);
  by("finder-figures").replaceChildren(...rows.flatMap(([key, value]) => [element("dt", {}, key), element("dd", {}, value)]));
  const advice = [...(alignment?.advice ?? []).map((text) => note("warn", text)), ...(values.problem ? [note("bad", values.problem)] : [])];
  by("finder-advice").replaceChildren(...advice);
  for (const button of by("finder-pictures").children) button.setAttribute("aria-pressed", String(button.textContent === values.picture));
  if (document.activeElement !== by("finder-exposure")) by("finder-exposure").value = number(values.exposure_us);
  by("histogram-text").textContent = `0 to ${values.full_dn} counts; the line is saturation`;
  drawHistogram(by("histogram"), values);
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
