// Plots in the page's colours, as wide as their place.

const scheme = matchMedia("(prefers-color-scheme: dark)");
const isDark = () => scheme.matches;
const axisColour = () => (isDark() ? "#9aa4b0" : "#5a6470");
const gridColour = () => (isDark() ? "#343a42" : "#e3e6ea");
const LINES = [["#0b62a8", "#6cb4f0"], ["#b35c00", "#e8b75a"], ["#2d7d46", "#7fcf9a"], ["#8b3a8b", "#d99ad9"],
  ["#a02c2c", "#f09090"]];

/** A line of a plot, in the colour of its number. */
export const line = (at, label, options = {}) =>
  ({ label, stroke: () => LINES[at % LINES.length][+isDark()], width: 1.5, points: { show: false }, ...options });

/** Plots lines over x, until its place is removed; `x` and `y` are the axes' labels, if they need any. */
export function plotIn(place, { x, y, lines, height = 220, legend = false, range = null }, data) {
  const [stroke, grid] = [axisColour, { stroke: gridColour, width: 1 }];
  const axis = (label, size) => ({ label, labelSize: 20, size, stroke, grid, ticks: { ...grid, size: 4 } });
  const watch = new ResizeObserver(() => {
    if (!place.isConnected) plot.destroy();
    else if (place.clientWidth) plot.setSize({ width: place.clientWidth, height });
  });
  const plot = new uPlot({
    width: place.clientWidth, height, legend: { show: legend },
    scales: { x: { time: false }, y: range ? { range } : {} },
    axes: [axis(x, 30), { ...axis(y, 56), space: 24 }],
    series: [{ label: x }, ...lines],
    hooks: { destroy: [() => watch.disconnect(), () => scheme.removeEventListener("change", redraw)] },
  }, data, place);
  const redraw = () => plot.redraw();
  scheme.addEventListener("change", redraw);
  watch.observe(place);
  return plot;
}
