// Sessions on disk: a list with thumbnails, one session, and two side by side with their difference.

import { by, call } from "./main.js";
import { Picture, element, fetchPicture, number, paint } from "./picture.js";
import { axisColour, gridColour } from "./plots.js";

const nameOf = (folder) => folder.split("/").pop();
const address = (session, rest = "") => `session/${encodeURIComponent(session)}${rest}`;
/** Pictures that say most of a session, best first. */
const BEST = ["epipolar", "regular", "floodlit"];
const best = (images) => BEST.find((name) => images.includes(name)) ?? images[0];

let [listed, chosen, other] = [[], null, null];

export function startSessions({ open }) {
  by("filter").addEventListener("input", drawList);
  document.addEventListener("shown", ({ detail }) => { if (detail === "sessions") list(); });
  return (event) => {
    if (event.event === "finished" && !by("view-sessions").hidden) list();
    if (event.event === "open") open();
  };
}

async function list() {
  const { result } = await call("sessions");
  if (!result) return;
  listed = result.reverse();
  drawList();
}

function drawList() {
  const wanted = by("filter").value.toLowerCase();
  const fits = (info) => JSON.stringify([info.name, info.kind, info.state, info.operator, info.sample, info.tags, info.session])
    .toLowerCase().includes(wanted);
  by("sessions").replaceChildren(...listed.filter(fits).map((info) => {
    const name = nameOf(info.session);
    const thumbnail = element("canvas", { width: "44", height: "44", "aria-hidden": "true" });
    draw(thumbnail, name);
    return element("li", {},
      element("button", { class: "choose", type: "button", "aria-pressed": String(name === chosen), title: name, onclick: () => { [chosen, other] = [name, null]; drawList(); show(); } },
        thumbnail, element("span", {}, info.name || name),
        element("span", { class: "quiet" }, `${info.created.slice(0, 16).replace("T", " ")} UTC · ${info.kind} · ${info.state}`)),
      element("button", { type: "button", "aria-pressed": String(name === other), disabled: !chosen || chosen === name, onclick: () => { other = other === name ? null : name; drawList(); show(); } }, "compare"));
  }));
  if (!listed.length) by("sessions").append(element("li", { class: "quiet" }, "No session yet."));
}

const thumbnails = new Map();
async function draw(canvas, session) {
  try {
    if (!thumbnails.has(session)) {
      thumbnails.set(session, (async () => {
        const about = await (await fetch(address(session))).json();
        return about.images.length ? fetchPicture(address(session, `/picture/${encodeURIComponent(best(about.images))}`)) : null;
      })());
    }
    const picture = await thumbnails.get(session);
    if (picture) paint(canvas, picture, "grey", 0, Math.max(...sample(picture.values)) || 1);
  } catch {
    thumbnails.delete(session);
  }
}
/** Some values without the brightest half per cent. */
const sample = (values) => {
  const some = Array.from({ length: 2000 }, (_, at) => values[Math.floor((at / 2000) * values.length)]).sort((a, b) => a - b);
  return some.slice(0, 1990);
};

async function about(session) {
  const answer = await fetch(address(session));
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

async function show() {
  const place = by("session");
  try {
    const [one, two] = await Promise.all([about(chosen), other && about(other)]);
    const images = two ? one.images.filter((name) => two.images.includes(name)) : one.images;
    const menu = element("select", { "aria-label": "Picture" }, ...images.map((name) => element("option", { selected: name === best(images) }, name)));
    const sides = element("div", { class: "sides" });
    const plot = element("div", { class: "plot", hidden: true });
    const link = (session, text) => element("a", { href: address(session, "/report"), target: "_blank", rel: "noopener" }, text);
    place.replaceChildren(
      element("div", { class: "bar" }, element("h2", {}, two ? "Two sessions" : one.name), images.length ? menu : null,
        one.report ? link(chosen, two ? "report of the first" : "report") : null, two?.report ? link(other, "report of the second") : null),
      ...(two ? [] : [figures(one)]), sides, plot);
    const pixel = profile(plot, [one, two].filter(Boolean));
    menu.addEventListener("change", () => pictures(sides, menu.value, pixel));
    if (images.length) await pictures(sides, menu.value, pixel);
    else sides.replaceChildren(element("p", { class: "empty" }, two ? "The two have no picture in common." : "This session has no pictures."));
  } catch (error) {
    place.replaceChildren(element("p", { class: "note bad" }, error.message));
  }
}

function figures(session) {
  const rows = [["kind", session.kind], ["begun", `${session.created.slice(0, 19).replace("T", " ")} UTC`], ["state", session.state],
    ["stored", `${session.stored} of ${session.points}`], ["operator", session.operator], ["sample", session.sample], ["note", session.note],
    ["tags", session.tags.join(", ")], ["error", session.error], ...Object.entries(session.findings)];
  return element("dl", { class: "figures" }, ...rows.filter(([, value]) => value).flatMap(([key, value]) => [element("dt", {}, key), element("dd", {}, value)]));
}

async function pictures(sides, name, onpixel) {
  const of = (session) => fetchPicture(address(session, `/picture/${encodeURIComponent(name)}`));
  const [one, two] = await Promise.all([of(chosen), other && of(other)]);
  sides.replaceChildren();
  const side = (title, picture, options = {}) => {
    const box = element("div", {}, element("h3", {}, title));
    sides.append(box);
    const view = new Picture(box, { label: `${name} of ${title}`, onpixel, ...options });
    view.show(picture);
  };
  side(other ? chosen : name, one);
  if (!two) return;
  side(other, two);
  if (one.shape.join() !== two.shape.join()) {
    sides.append(element("p", { class: "note warn" }, "The pictures differ in size, so there is no difference to show."));
    return;
  }
  const values = one.values.map((value, at) => two.values[at] - value);
  const rms = Math.sqrt(values.reduce((sum, value) => sum + (Number.isFinite(value) ? value * value : 0), 0) / values.length);
  side(`second − first, RMS ${number(rms)}`, { ...one, values }, { colours: "difference", symmetric: true });
}

/** Plots the light from each projector row to the pixel under the cursor; returns what to call for a pixel. */
function profile(place, sessions) {
  const measured = sessions.filter((session) => session.has_transport);
  let [plot, latest, busy] = [null, null, false];
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const colours = dark ? ["#6cb4f0", "#e8b75a"] : ["#0b62a8", "#b35c00"];
  return async (row, column) => {
    latest = [row, column];
    if (busy || !measured.length) return;
    busy = true;
    while (latest) {
      const [t, s] = latest;
      latest = null;
      const answers = await Promise.all(measured.map(async (session) => (await fetch(address(nameOf(session.session), `/pixel/${t}/${s}`))).json()));
      const [{ u_min, light }] = answers;
      const data = [light.map((_, at) => u_min + at), ...answers.map((answer) => answer.light.slice(0, light.length))];
      place.hidden = false;
      if (!plot) place.append(element("h3", {}, "Light from each projector row to the pixel under the cursor"));
      plot ??= new uPlot({
        width: place.clientWidth, height: 220, scales: { x: { time: false } },
        legend: { show: measured.length > 1 },
        axes: [{ label: "u, projector rows from the pixel's own", labelSize: 20, stroke: axisColour, grid: { stroke: gridColour } },
          { label: "light, 1 = white", labelSize: 20, size: 56, stroke: axisColour, grid: { stroke: gridColour } }],
        series: [{ label: "u" }, ...measured.map((session, at) => ({ label: session.name, stroke: colours[at], width: 1.5, points: { show: false } }))],
      }, data, place);
      plot.setData(data);
    }
    busy = false;
  };
}
