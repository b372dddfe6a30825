// Which view is shown: the part of the URL after `#` says it, so that a reload and the back button keep it.
import { h, said } from "./lib/dom.js";
import { taking } from "./film/recorder.js";
import { captures } from "./views/captures.js";
import { capture } from "./views/capture.js";
import { filming, program } from "./film/program.js";
import { job, jobs } from "./views/jobs.js";
import { matte, mattes } from "./views/mattes.js";

const VIEWS = { film: [filming, program], captures: [captures, capture], jobs: [jobs, job], mattes: [mattes, matte] };
const main = document.getElementById("main");
const note = document.getElementById("taking");
const views = new Map(); // by their part of the URL: the one that is shown, and those in which a film is being taken
let shown;

// Whoever leaves a view in which a film is being taken does not end the film: the view goes on, to be shown again.
function tidy() {
  for (const [hash, view] of views) {
    if (view === shown || taking.has(view.signal)) continue;
    view.stop.abort();
    views.delete(hash);
  }
  const [away] = [...views].find(([, view]) => view !== shown) ?? [];
  note.hidden = !away;
  if (away) note.hash = away;
}
addEventListener("taking", tidy);

function opened(hash) {
  const stop = new AbortController();
  const view = { stop, signal: stop.signal, element: h("div", { class: "view" }) };
  views.get(hash)?.stop.abort();
  views.set(hash, view);
  return view;
}

async function route(moved) {
  const [hash, name, id] = /^#\/(\w+)(?:\/([\w-]+))?$/.exec(location.hash) ?? [];
  if (!VIEWS[name]) return location.replace("#/captures");
  const before = views.get(hash);
  const view = (shown = taking.has(before?.signal) ? before : opened(hash));
  tidy();
  for (const link of document.querySelectorAll("nav a")) {
    if (link.hash === `#/${name}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  main.replaceChildren(view.element);
  main.ariaBusy = "true";
  try {
    if (view === before) view.again();
    else view.again = await VIEWS[name][id ? 1 : 0](view.element, view.signal, id);
  } catch (error) {
    if (!view.signal.aborted) view.element.append(said(error));
  }
  if (view !== shown) return;
  main.ariaBusy = "false";
  const title = main.querySelector("h1");
  document.title = `${title?.textContent ?? "envmatte"} · envmatte`;
  if (moved) {
    scrollTo(0, 0);
    main.focus({ preventScroll: true });
  }
}

// Not by its link, which would take the place of the view in the URL.
document.querySelector(".skip").onclick = (event) => {
  event.preventDefault();
  main.focus();
};
// A file that misses where it is wanted would take the place of the page.
for (const type of ["dragover", "drop"]) {
  addEventListener(type, (event) => {
    if (event.defaultPrevented || !event.dataTransfer.types.includes("Files")) return;
    event.preventDefault();
    event.dataTransfer.dropEffect = "none";
  });
}
addEventListener("hashchange", () => route(true));
route(false);
