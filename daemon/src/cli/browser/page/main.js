// The page: two views, and one stream of events from the daemon.

import { element } from "./picture.js";
import { startRun } from "./run.js";
import { startSessions } from "./sessions.js";

export const by = (id) => document.getElementById(id);

/** Calls a method of the daemon; {result}, with what `raysweep view` adds to it, or {error}. */
export async function call(method, params = {}) {
  try {
    const answer = await fetch("call", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ method, params }),
    });
    return answer.ok ? await answer.json() : { error: { message: await answer.text() } };
  } catch {
    return { error: { message: "`raysweep view` has ended; start it again and open its new address" } };
  }
}

/** A note below the run's figures or elsewhere: "bad", "warn" or "good". */
export const note = (kind, ...children) => element("p", { class: `note ${kind}` }, ...children);

const views = ["run", "sessions"];
function choose(name) {
  for (const view of views) {
    by(`view-${view}`).hidden = view !== name;
    by(`tab-${view}`).setAttribute("aria-selected", String(view === name));
    by(`tab-${view}`).tabIndex = view === name ? 0 : -1;
  }
  document.dispatchEvent(new CustomEvent("shown", { detail: name }));
}
views.forEach((view, index) => {
  by(`tab-${view}`).addEventListener("click", () => choose(view));
  by(`tab-${view}`).addEventListener("keydown", (event) => {
    if (event.key !== "ArrowRight" && event.key !== "ArrowLeft") return;
    const other = views[(index + 1) % views.length];
    choose(other);
    by(`tab-${other}`).focus();
  });
});

/** Hears the daemon's events while the page can be seen: browsers allow an address six connections, over all tabs. */
function follow(listeners) {
  let events = null;
  const tell = (event) => { for (const listener of listeners) listener(event); };
  const open = () => {
    events = new EventSource("events");
    events.onmessage = (message) => { if (message.data) tell(JSON.parse(message.data)); };
    events.onerror = () => tell({ event: "connection", lost: "`raysweep view` does not answer" });
  };
  const look = () => {
    events?.close();
    if (!document.hidden) open();
  };
  document.addEventListener("visibilitychange", look);
  look();
}

follow([startRun(), startSessions({ watch: () => choose("run") })]);
choose("run");
