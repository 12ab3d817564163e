// Sessions on disk: a list with thumbnails, one session, and two side by side with their difference.

import { by, call, note } from "./main.js";
import { Picture, element, fetchPicture, pairs, unitsOf } from "./picture.js";
import { line, plotIn } from "./plots.js";

const nameOf = (folder) => folder.split("/").pop();
const address = (session, rest = "") => `session/${encodeURIComponent(session)}${rest}`;

const warned = ({ length }) => length && `${length} warning${length === 1 ? "" : "s"}`;

/** What the list shows of a session. Earlier daemons tell no warnings. */
const shownOf = ({ name, created, kind, state, warnings = [], sample, operator }) => [name,
  `${created.slice(0, 16).replace("T", " ")} UTC`, kind, state, warned(warnings), sample, operator].filter(Boolean);

let [listed, chosen, other] = [[], null, null];
/** Thumbnails by session, with the state of the session that they show. */
const thumbnails = new Map();

/** Returns what to call for each event; `watch` shows the run. */
export function startSessions({ watch }) {
  by("filter").addEventListener("input", drawList);
  document.addEventListener("shown", ({ detail }) => { if (detail === "sessions") list(); });
  return ({ event, lost }) => {
    const isNews = event === "finished" || (event === "connection" && !lost);
    if (isNews && !by("view-sessions").hidden) list();
  };

  async function list() {
    // Why the sessions' files may not be read, if so.
    const { result, error, barred } = await call("sessions");
    const notes = [error?.message, barred && `What sessions contain is not shown: ${barred}.`];
    by("sessions-notes").replaceChildren(...notes.filter(Boolean).map((why) => note("warn", why)));
    if (!result) return;
    listed = result.reverse().map((info) => ({ ...info, mayRead: !barred }));
    drawList();
  }

  function drawList() {
    const wanted = by("filter").value.toLowerCase();
    const fits = (info) => [...shownOf(info), ...info.tags, info.session].join(" ").toLowerCase().includes(wanted)
      // A viewfinder stores nothing to look at; who asks for them finds them.
      && (info.kind !== "viewfinder" || (wanted && "viewfinder".includes(wanted)));
    by("sessions").replaceChildren(...listed.filter(fits).map((info) => {
      const name = nameOf(info.session);
      const show = (one, two) => {
        [chosen, other] = [one, two];
        drawList();
        showSessions();
        // Below the list on a narrow page, where it would go unseen.
        if (matchMedia("(max-width: 760px)").matches) by("session").scrollIntoView();
      };
      return element("li", {},
        element("button", { class: "choose", type: "button", "aria-pressed": String(name === chosen), title: name,
          onclick: () => show(name, null) },
        thumbnail(info), element("span", {}, info.name || name),
        element("span", { class: "quiet" }, shownOf(info).slice(1).join(" · "))),
        element("button", { type: "button", "aria-pressed": String(name === other),
          disabled: !chosen || chosen === name,
          onclick: () => show(chosen, other === name ? null : name) }, "compare"));
    }));
    if (!listed.length) by("sessions").append(element("li", { class: "quiet" }, "No session yet."));
  }

  /** A session's small picture, loaded when it is first seen, and again only when the session has changed. */
  function thumbnail({ session, state, stored, mayRead }) {
    const shows = `${state} ${stored} ${mayRead}`;
    const known = thumbnails.get(session);
    if (known?.shows === shows) return known.image;
    const src = mayRead ? address(nameOf(session), "/thumbnail") : null;
    const image = element("img", { src, alt: "", loading: "lazy", onerror: () => {
      image.className = "none";
      // It is asked for again with the next list.
      thumbnails.delete(session);
    } });
    if (!mayRead) image.className = "none";
    thumbnails.set(session, { image, shows });
    return image;
  }

  async function showSessions() {
    const place = by("session");
    const [first, second] = [chosen, other];
    try {
      const [one, two] = await Promise.all([about(first), second && about(second)]);
      // Others were chosen meanwhile.
      if (first !== chosen || second !== other) return;
      const images = two ? one.images.filter((name) => two.images.includes(name)) : one.images;
      const menu = element("select", { "aria-label": "Picture" }, ...images.map((name) => element("option", {}, name)));
      const sides = element("div", { class: "sides" });
      const [slider, which] = [element("input", { type: "range", min: "0", value: "0" }), element("span")];
      const choice = element("label", { class: "images" }, "Image ", slider, which);
      const plot = element("div", { hidden: true });
      const link = (session, text) =>
        element("a", { href: address(session, "/report"), target: "_blank", rel: "noopener" }, text);
      place.replaceChildren(
        element("div", { class: "bar" }, element("h2", {}, two ? "Two sessions" : one.name),
          images.length ? menu : null, one.report ? link(first, two ? "report of the first" : "report") : null,
          two?.report ? link(second, "report of the second") : null,
          !two && one.can_resume ? resume(first, place) : null),
        ...[one, two].filter(Boolean).flatMap(({ session, damage, warnings }) => [...damage, ...warnings]
          .map((what) => note("warn", two ? `${nameOf(session)}: ${what}` : what))),
        two ? differences(one, two) : figures(one), choice, sides, plot);
      choice.hidden = true;
      const pixel = profile(plot, [one, two].filter(Boolean));
      const draw = pictures({ sides, menu, slider, which, choice }, [first, second], pixel);
      menu.addEventListener("change", () => {
        slider.value = 0;
        choice.hidden = true;
        draw();
      });
      slider.addEventListener("input", draw);
      if (images.length) await draw();
      else sides.replaceChildren(element("p", { class: "empty" },
        two ? "The two have no picture in common." : "This session has no pictures."));
    } catch (error) {
      place.replaceChildren(note("bad", error.message));
    }
  }

  /** A button that acquires what a session lacks. */
  function resume(session, place) {
    const button = element("button", { type: "button", class: "operator between-runs", onclick: async () => {
      button.disabled = true;
      const { error } = await call("resume", { session });
      button.disabled = false;
      if (error) place.append(note("bad", error.message));
      else watch();
    } }, "Resume");
    return button;
  }
}

async function read(at) {
  const answer = await fetch(at);
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}
const about = (session) => read(address(session));

function rowsOf(session) {
  return [["kind", session.kind], ["begun", `${session.created.slice(0, 19).replace("T", " ")} UTC`],
    ["state", session.state], ["stored", `${session.stored} of ${session.points}`], ["operator", session.operator],
    ["sample", session.sample], ["note", session.note], ["tags", session.tags.join(", ")], ["error", session.error],
    ...session.remarks.map(({ at, by, text }) =>
      ["remark", `${at.slice(0, 16).replace("T", " ")} UTC${by ? `, ${by}` : ""}: ${text}`]),
    ...Object.entries(session.findings)];
}

function figures(session) {
  return element("dl", { class: "figures" }, ...pairs(rowsOf(session).filter(([, value]) => value)));
}

/** A table of what differs. */
function differences(one, two) {
  const sides = [one, two].map((session) => new Map([...rowsOf(session),
    ["calibrated", session.calibration?.slice(0, 19).replace("T", " ")], ...Object.entries(session.settings)]));
  const keys = [...new Set(sides.flatMap((side) => [...side.keys()]))]
    .filter((key) => (sides[0].get(key) || "") !== (sides[1].get(key) || ""));
  const row = (kind, cells) => element("tr", {}, ...cells.map((cell) => element(kind, {}, cell || "–")));
  return element("table", { class: "differences" }, row("th", [" ", nameOf(one.session), nameOf(two.session)]),
    ...keys.map((key) => row("td", [key, ...sides.map((side) => side.get(key))])));
}

function joined(one, two) {
  const both = new Float32Array(one.length + two.length);
  both.set(one);
  both.set(two, one.length);
  return both;
}

/** Returns what shows the chosen image of the chosen product: of one session, or of two with their difference. */
function pictures({ sides, menu, slider, which, choice }, [first, second], onpixel) {
  // Zoom, colours and limits stay from image to image of a product.
  let [views, product] = [[], null];
  const look = async (name, k) => {
    const of = (session) => fetchPicture(address(session, `/picture/${encodeURIComponent(name)}?k=${k}`));
    const [one, two] = await Promise.all([of(first), second && of(second)]);
    const count = Math.min(one.of, two ? two.of : one.of);
    slider.max = count - 1;
    choice.hidden = count < 2;
    const at = one.about?.k?.at?.[k];
    which.textContent = `${k + 1} of ${count}${at == null ? "" : `: ${one.about.k.is.replaceAll("_", " ")} ${at}`}`;
    const shown = two ? compared(one, two, [first, second]) : [{ title: name, label: name, picture: one }];
    if (product !== name) {
      sides.replaceChildren();
      views = shown.map(({ title, label, picture, ...options }) => {
        const [box, heading] = [element("div"), element("h3")];
        box.append(heading);
        sides.append(box);
        return Object.assign(new Picture(box, { label: `${name} of ${label}`, onpixel, ...options }), { heading });
      });
      if (two && shown.length < 3) {
        sides.append(note("warn", "The pictures differ in size, so there is no difference to show."));
      }
      product = name;
    }
    for (const [at, { title, picture, range }] of shown.entries()) {
      views[at].heading.textContent = [title, unitsOf(picture)].filter(Boolean).join(" · ");
      views[at].range = range;
      views[at].show(picture);
    }
  };
  let [wanted, busy] = [false, false];
  return async () => {
    wanted = true;
    if (busy) return;
    busy = true;
    while (wanted) {
      wanted = false;
      try {
        await look(menu.value, Number(slider.value));
      } catch (error) {
        sides.replaceChildren(note("bad", error.message));
        [choice.hidden, product] = [true, null];
      }
    }
    busy = false;
  };
}

/** Two pictures, in which the same light has the same brightness, and their difference if they are of one size. */
function compared(one, two, [first, second]) {
  const range = joined(one.values, two.values);
  const sides = [[first, one], [second, two]].map(([label, picture]) => ({ title: label, label, picture, range }));
  if (one.shape.join() !== two.shape.join()) return sides;
  const values = one.values.map((value, at) => two.values[at] - value);
  // Pixels without a value in both have no difference.
  const known = values.filter(Number.isFinite);
  const rms = Math.sqrt(known.reduce((sum, value) => sum + value * value, 0) / known.length);
  const title = `second − first, RMS ${Number(rms.toPrecision(3))}`;
  const label = "the difference, second − first";
  return [...sides, { title, label, picture: { ...one, values }, colours: "difference", symmetric: true }];
}

/** Profiles over u, `{u_min, light}`, on the u that any of them has: `[u, light, ...]`, null where one has none. */
function aligned(profiles) {
  const first = Math.min(...profiles.map(({ u_min }) => u_min));
  const end = Math.max(...profiles.map(({ u_min, light }) => u_min + light.length));
  const u = Array.from({ length: end - first }, (_, at) => first + at);
  return [u, ...profiles.map(({ u_min, light }) => u.map((at) => light[at - u_min] ?? null))];
}

/** Plots the light from each projector row to the pixel under the cursor; returns what to call for a pixel. */
function profile(place, sessions) {
  const measured = sessions.filter((session) => session.has_transport);
  let [plot, latest, busy] = [null, null, false];
  const title = element("h3", {}, "Light from each projector row to the pixel under the cursor");
  const graph = element("div", { class: "plot" });
  const notes = element("div", { class: "notes" });
  place.append(title, graph, notes);
  /** A session's profile; one without light, and a note, if it cannot be read. */
  const of = async (session, row, column) => {
    try {
      return await read(address(nameOf(session.session), `/pixel/${row}/${column}`));
    } catch (error) {
      notes.append(note("warn", `${nameOf(session.session)}: ${error.message}`));
      return { u_min: 0, light: [] };
    }
  };
  const draw = async () => {
    const pixel = latest;
    latest = null;
    notes.replaceChildren();
    const data = aligned(await Promise.all(measured.map((session) => of(session, ...pixel))));
    place.hidden = false;
    graph.hidden = !data[0].length;
    if (graph.hidden) return;
    const lines = measured.map((session, at) => line(at, nameOf(session.session)));
    const [x, y] = ["u, projector rows from the pixel's own", "light, 1 = white"];
    plot ??= plotIn(graph, { x, y, lines, legend: measured.length > 1 }, data);
    plot.setData(data);
  };
  return async (row, column) => {
    latest = [row, column];
    if (busy || !measured.length) return;
    busy = true;
    try {
      while (latest) await draw();
    } finally {
      busy = false;
    }
  };
}
