// The view of the run: state, figures, question, VSYNC, plan and live pictures.

import { by, call, note } from "./main.js";
import { marksOf, showFinder, startFinder } from "./finder.js";
import { startDelays } from "./delays.js";
import { line, plotIn } from "./plots.js";
import { Picture, element, fetchPicture, number, pairs, unitsOf } from "./picture.js";

const UNDER_WAY = ["preparing", "armed", "running", "paused", "draining"];

/** Nobody ends a viewfinder whose tab was closed: it ends by itself, with its light, after an hour. */
const FINDER = "kind = \"viewfinder\"\n[viewfinder]\nseconds = 3600\n";
const ALIGN = `${FINDER}picture = "align"\nsubject = "board"\n`;

/** What `raysweep calibrate` runs. */
const CALIBRATION = "kind = \"calibration\"\n";

const clock = (seconds) => {
  if (!Number.isFinite(seconds)) return "unknown";
  const whole = Math.round(seconds);
  const two = (part) => String(part).padStart(2, "0");
  return `${two(Math.floor(whole / 3600))}:${two(Math.floor(whole / 60) % 60)}:${two(whole % 60)}`;
};
const words = (name) => name.replaceAll("_", " ");
const nameOf = (folder) => folder?.split("/").pop();

let status = {};
/** What was last asked; at the end of a run nothing waits for it. */
let asked = null;
/** What the last run found. */
let found = [];
/** Says of what the live picture is; it depends on the run, too. */
let tellAbout = () => {};
/** Why the last order was refused, until the next one. */
let complaint = null;
/** Jitter since the page was opened: seconds, standard deviation, 99th percentile. */
const jitter = [[], [], []];
let jitterPlot = null;
const opened = performance.now();

export function startRun() {
  const buttons = [["pause", "pause"], ["continue", "continue"], ["answer", "continue"], ["cancel", "cancel"]];
  for (const [id, method] of buttons) {
    by(id).addEventListener("click", () => {
      by(id).disabled = true;
      order(method);
    });
  }
  by("plan-file").addEventListener("change", async (event) => {
    const [file] = event.target.files;
    if (file) by("plan").value = await file.text();
  });
  by("check").addEventListener("click", check);
  by("start").addEventListener("click", () => start(by("plan").value));
  by("find").addEventListener("click", () => start(FINDER));
  by("align").addEventListener("click", () => start(ALIGN));
  by("calibrate").addEventListener("click", () => start(CALIBRATION));
  watchPictures(startFinder(order));
  setInterval(() => { if (!document.hidden) refresh(); }, 2000);
  return hear;
}

function hear(event) {
  switch (event.event) {
    case "connection":
      by("lost").hidden = !event.lost;
      by("lost").textContent = event.lost ? `${event.lost}. The page goes on when the daemon is back.` : "";
      if (event.lost) { status = {}; draw(); } else refresh();
      break;
    case "progress": status.progress = event; draw(); break;
    case "vsync": addJitter(event); break;
    case "viewfinder": showFinder(event); break;
    case "state":
      status.state = event.state;
      if (["preparing", "running"].includes(event.state)) [asked, found] = [null, []];
      draw();
      refresh();
      break;
    case "ask":
      // What is left to do once the run is over.
      if (!event.wants_answer) asked = event.text;
      refresh();
      break;
    case "finished":
      found = event.found ?? [];
      refresh();
      break;
  }
}

async function refresh() {
  const { result } = await call("status");
  if (!result) return;
  status = result;
  if (result.vsync) tellVsync(result.vsync);
  const finder = UNDER_WAY.includes(result.state) ? result.viewfinder : null;
  // Nobody looks at edges during a viewfinder, so these are those of the run before.
  by("vsync-card").hidden = !result.vsync || Boolean(finder);
  showFinder(finder);
  draw();
}

/** Calls a method that changes the run, and says why if it is refused. */
async function order(method, params) {
  const { error } = await call(method, params);
  complaint = error?.message ?? null;
  draw();
  refresh();
}

function draw() {
  const { state, progress, session, question, role, operators } = status;
  const isUnderWay = UNDER_WAY.includes(state);
  by("daemon").textContent = status.rig ? `${status.rig} rig` : "";
  by("state").textContent = state ? words(state) : "not connected";
  by("state").dataset.state = state ?? "lost";
  const done = isUnderWay && progress ? `${progress.points_stored}/${progress.points_planned} – ` : "";
  document.title = question ? "waits for you – raysweep" : `${done}raysweep`;
  document.body.classList.toggle("observes", role === "observer");
  document.body.classList.toggle("under-way", isUnderWay);
  by("observer-text").textContent = operators
    ? `To operate it, have root add you to the group ${operators}: usermod -aG ${operators} USER. Then log in again.`
    : "Only root and the daemon's own user operate it.";
  by("question").hidden = !question;
  document.body.classList.toggle("asks", Boolean(question));
  by("question-text").textContent = question?.text ?? "";
  by("answer").disabled = !question?.wants_answer;
  by("run-name").textContent = session ? nameOf(session) : "No run yet";
  by("pause").disabled = !["armed", "running"].includes(state);
  by("continue").disabled = state !== "paused" || Boolean(question?.wants_answer);
  by("cancel").disabled = !isUnderWay;
  for (const id of ["start", "check", "find", "align", "calibrate"]) by(id).disabled = isUnderWay || !state;
  for (const id of ["align", "calibrate"]) by(id).hidden = status.rig !== "plane";
  // A viewfinder stores nothing.
  const stores = Boolean(progress?.points_planned);
  by("progress").hidden = !stores;
  by("progress").max = progress?.points_planned || 1;
  const point = progress?.under_way;
  by("progress").value = (progress?.points_stored ?? 0) + (point ? point.frames / point.of : 0);
  const rows = [];
  if (progress) {
    const lost = Object.entries(progress.counts.lost).map(([cause, frames]) => `${frames} ${words(cause)}`);
    // As at the terminal: dark and regular images too, which are no points of a session.
    rows.push(["measurements", `${progress.points_stored} of ${progress.points_planned}`]);
    if (isUnderWay && point) rows.push(["this point", `frame ${point.frames} of ${point.of}`]);
    if (isUnderWay) rows.push(["time left", clock(progress.left_s ?? NaN)]);
    rows.push(["elapsed", clock(progress.elapsed_s)], ["rate", `${number(progress.frames_per_s)} frames/s`],
      ["frames used", `${progress.counts.averaged} of ${progress.counts.expected}`],
      ["lost", lost.join(", ") || "none"]);
  }
  if (status.mirror) {
    const { parked, laser } = status.mirror;
    rows.push(["mirror", `${parked ? "parked" : "not parked"}, laser ${laser ? "on" : "off"}`]);
  }
  by("figures").replaceChildren(...pairs(rows));
  const notes = complaint ? [note("bad", complaint)] : [];
  if (status.ended) notes.push(note(status.ended === "complete" ? "good" : "warn", `The run is ${status.ended}.`));
  if (status.error) notes.push(note("bad", status.error));
  if (status.ended && asked) notes.push(note("warn", asked));
  notes.push(...(status.warnings ?? []).map((warning) => note("warn", warning)));
  if (status.ended) notes.push(...found.map((what) => note("", what)));
  if (status.ended === "complete" && session && stores) {
    const href = `session/${encodeURIComponent(nameOf(session))}/report`;
    notes.push(element("p", {}, element("a", { href, target: "_blank", rel: "noopener" }, "Open the report")));
  } else if (status.ended && session && stores) {
    notes.push(note("warn", "What it has stored is among the sessions, with a button that resumes it if it can be."));
  }
  by("notes").replaceChildren(...notes);
  tellAbout();
}

function tellVsync(vsync) {
  by("vsync-text").textContent = `period ${vsync.period_us.toFixed(2)} µs, jitter ${number(vsync.jitter_us)} µs; `
    + `${vsync.edges} edges, ${vsync.missed} missed, ${vsync.false_edges} false`;
}

function addJitter(vsync) {
  by("vsync-card").hidden = false;
  tellVsync(vsync);
  const row = [(performance.now() - opened) / 1000, vsync.jitter_us, vsync.jitter_p99_us];
  row.forEach((value, axis) => jitter[axis].push(value));
  if (jitter[0].length > 3600) jitter.forEach((values) => values.shift());
  const lines = [line(0, "standard deviation", { points: { show: true, size: 4 } }), line(1, "99 %", { dash: [4, 3] })];
  jitterPlot ??= plotIn(by("vsync"), { x: "time since the page was opened, s", y: "µs", lines, height: 150, legend: true }, jitter);
  jitterPlot.setData(jitter);
}

async function check() {
  tellChecked(element("p", { class: "quiet" }, "checking …"));
  const { error, checked } = await call("check", { plan: by("plan").value });
  if (error) tellChecked(...mistakes(error));
  else if (!checked) tellChecked(note("bad", "The daemon has another version: start `raysweep view` again."));
  else tellChecked(element("dl", { class: "figures" }, ...pairs(checked.rows)), ...checked.tables.flatMap(([what, table]) =>
    [element("h3", {}, what), element("pre", {}, table)]));
}

function tellChecked(...parts) {
  by("checked").hidden = !parts.length;
  by("checked").replaceChildren(...parts);
}

const mistakes = (error) => (error.data?.mistakes ?? [error]).map(({ message }) => note("bad", message));

async function start(plan) {
  for (const id of ["start", "find", "align", "calibrate"]) by(id).disabled = true;
  const { error } = await call("run", { plan });
  tellChecked(...(error ? mistakes(error) : []));
  complaint = null;
  refresh();
}

const isSeen = () => !document.hidden && !by("view-run").hidden;
const CHANGES = ["visibilitychange", "shown"];

/** Waits until the live picture can be seen. */
const seen = () => new Promise((done) => {
  const look = () => {
    if (!isSeen()) return;
    for (const change of CHANGES) document.removeEventListener(change, look);
    done();
  };
  for (const change of CHANGES) document.addEventListener(change, look);
  look();
});

/** Whether the first points of a sweep tell nothing of a picture: they may not see what it shows. */
const isBlank = ({ about, values }) => about.points != null && !about.last && !values.some((value) => value > 0);

/** Shows the newest live picture of the chosen name, as soon as it comes. */
async function watchPictures({ onregion, onmarks }) {
  let [names, chosen, sequence, shown] = [{}, null, 0, null];
  // A request that waits for a picture takes one of the browser's few connections.
  let waiting = new AbortController();
  for (const change of CHANGES) {
    document.addEventListener(change, () => {
      if (isSeen()) return;
      waiting.abort();
      waiting = new AbortController();
    });
  }
  const delays = startDelays();
  // A viewfinder has no delays.
  const onpixel = (row, column) =>
    delays(shown?.name === "viewfinder" ? null : nameOf(shown?.about.session), row, column);
  const picture = new Picture(by("live-picture"), {
    label: "Live picture",
    onpixel,
    onregion: (region) => { if (shown?.name === "viewfinder") onregion(region, shown); },
  });
  picture.element.hidden = true;
  onmarks(() => { if (shown) picture.mark(marksOf(shown)); });
  const wait = (seconds) => new Promise((done) => { setTimeout(done, 1000 * seconds); });
  const choose = (name) => {
    [chosen, sequence] = [name, 0];
    for (const button of by("live-names").children) {
      button.setAttribute("aria-pressed", String(button.textContent === name));
    }
  };
  /** What is shown, and whether it is of an earlier run: the file keeps the newest picture of each name. */
  tellAbout = () => {
    if (!shown) return;
    const session = nameOf(shown.about.session);
    // Of a daemon that is lost nobody knows.
    const isOld = Boolean(status.state) && session !== nameOf(status.session);
    picture.element.classList.toggle("old", isOld);
    by("live-about").textContent = (isOld ? "of an earlier run: " : "") + describe(shown);
  };
  /** Says in place of a picture why there is none. */
  const tellNone = (why) => {
    const none = shown ? "Nothing is estimated yet of what this picture shows: no point so far sees it."
      : "No live picture yet. A run publishes its first after some points.";
    picture.element.hidden = !shown || isBlank(shown);
    by("live-none").textContent = why ?? none;
    by("live-none").hidden = why === null && !picture.element.hidden;
  };
  const look = async () => {
    const answer = await fetch("live");
    const found = answer.ok ? await answer.json() : {};
    // A daemon that was started again counts from 1.
    if ((found[chosen] ?? 0) < sequence) sequence = 0;
    tellAbout();
    tellNone(answer.ok ? null : await answer.text());
    if (Object.keys(found).join() === Object.keys(names).join()) return;
    names = found;
    by("live-names").replaceChildren(...Object.keys(names).map((name) =>
      element("button", { type: "button", "aria-pressed": "false", onclick: () => choose(name) }, name)));
    if (!(chosen in names)) choose(Object.keys(names)[0] ?? null);
    else choose(chosen);
  };
  for (;;) {
    try {
      await seen();
      await look();
      const address = `live/${encodeURIComponent(chosen)}?after=${sequence}`;
      const newest = chosen && await fetchPicture(address, waiting.signal);
      if (newest && newest.name === chosen) {
        [sequence, shown] = [newest.sequence, newest];
        tellNone(null);
        picture.selects = newest.name === "viewfinder" && status.role === "operator";
        picture.marks = marksOf(newest);
        picture.show(newest);
        // What the run has stored since belongs to the plot too.
        if (picture.at) onpixel(...picture.at);
        tellAbout();
      } else if (!newest) {
        await wait(chosen ? 0.05 : 1);
      }
    } catch {
      await wait(1);
    }
  }
}

function describe(picture) {
  const { about, shape } = picture;
  const parts = [`${shape[1]} × ${shape[0]} px`];
  if (about.points != null) parts.push(`from ${about.points} points`);
  if (about.cycle != null) parts.push(`cycle ${about.cycle}`);
  if (about.batch != null) parts.push(`batch ${about.batch}`);
  if (about.units) parts.push(unitsOf(picture));
  if (about.session) parts.push(nameOf(about.session));
  return parts.join(" · ");
}
