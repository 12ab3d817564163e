// The plot of a pixel's light over the delays of the sweep in progress.

import { by } from "./main.js";
import { axisColour, gridColour } from "./plots.js";

const COLOURS = [["#0b62a8", "#6cb4f0"], ["#b35c00", "#e8b75a"], ["#2d7d46", "#7fcf9a"], ["#8b3a8b", "#d99ad9"], ["#a02c2c", "#f09090"]];
/** Least time between two readings, in ms: each reads a part of every image that is stored. */
const PACE = 500;

/** Returns what to call for the pixel under the cursor, with the session whose pixel it is. */
export function startDelays() {
  let [plot, drawn, latest, busy] = [null, "", null, false];
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const draw = ({ delay_us, exposures }) => {
    const data = [delay_us, ...exposures.map((exposure) => exposure.light_dn)];
    const kind = exposures.map((exposure) => exposure.exposure_us).join();
    if (kind !== drawn) {
      plot?.destroy();
      drawn = kind;
      plot = new uPlot({
        width: by("delays").clientWidth, height: 220, scales: { x: { time: false } }, legend: { show: true },
        axes: [{ label: "delay, µs", labelSize: 20, stroke: axisColour, grid: { stroke: gridColour } },
          { label: "light of a frame, counts", labelSize: 20, size: 56, stroke: axisColour, grid: { stroke: gridColour } }],
        series: [{ label: "delay" }, ...exposures.map(({ exposure_us }, at) => ({
          label: `${Number(exposure_us.toPrecision(6))} µs`, stroke: COLOURS[at % COLOURS.length][dark ? 1 : 0], width: 1.5, points: { show: true, size: 4 } }))],
      }, data, by("delays"));
    } else plot.setData(data);
  };
  window.addEventListener("resize", () => plot?.setSize({ width: by("delays").clientWidth, height: 220 }));
  return async (session, row, column) => {
    latest = [session, row, column];
    if (busy) return;
    busy = true;
    while (latest) {
      const [name, t, s] = latest;
      latest = null;
      try {
        const answer = name && await fetch(`session/${encodeURIComponent(name)}/delays/${t}/${s}`);
        const found = answer?.ok ? await answer.json() : { delay_us: [] };
        by("delays-card").hidden = !found.delay_us.length;
        if (found.delay_us.length) {
          by("delays-text").textContent = `row ${t}, column ${s}`;
          draw(found);
        }
      } catch {
        by("delays-card").hidden = true;
      }
      await new Promise((done) => { setTimeout(done, PACE); });
    }
    busy = false;
  };
}
