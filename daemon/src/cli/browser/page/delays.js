// The plot of a pixel's light over the delays of the sweep in progress.

import { by } from "./main.js";
import { line, plotIn } from "./plots.js";

/** Least time between two readings, in ms: each reads a part of every image that is stored. */
const PACE = 500;

/** Returns what to call for the pixel under the cursor, with the session whose pixel it is. */
export function startDelays() {
  let [plot, drawn, latest, busy] = [null, "", null, false];
  const draw = ({ delay_us, exposures }) => {
    const data = [delay_us, ...exposures.map((exposure) => exposure.light_dn)];
    const kind = exposures.map((exposure) => exposure.exposure_us).join();
    if (kind === drawn) {
      plot.setData(data);
      return;
    }
    plot?.destroy();
    drawn = kind;
    const lines = exposures.map(({ exposure_us }, at) =>
      line(at, `${Number(exposure_us.toPrecision(6))} µs`, { points: { show: true, size: 4 } }));
    plot = plotIn(by("delays"), { x: "delay, µs", y: "light of a frame, counts", lines, legend: true }, data);
  };
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
