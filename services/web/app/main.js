// Which view is shown: the part of the URL after `#` says it, so that a reload and the back button keep it.
import { said } from "./dom.js";
import { captures } from "./captures.js";
import { capture } from "./capture.js";
import { filming, program } from "./filming.js";
import { job, jobs } from "./jobs.js";
import { matte, mattes } from "./mattes.js";

const VIEWS = { film: [filming, program], captures: [captures, capture], jobs: [jobs, job], mattes: [mattes, matte] };
const main = document.getElementById("main");
let leaving = new AbortController();

async function route(moved) {
  const [, name, id] = /^#\/(\w+)(?:\/([\w-]+))?$/.exec(location.hash) ?? [];
  if (!VIEWS[name]) return location.replace("#/captures");
  leaving.abort();
  leaving = new AbortController();
  const { signal } = leaving;
  for (const link of document.querySelectorAll("nav a")) {
    if (link.hash === `#/${name}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  main.replaceChildren();
  main.ariaBusy = "true";
  try {
    await VIEWS[name][id ? 1 : 0](main, signal, id);
  } catch (error) {
    if (!signal.aborted) main.append(said(error));
  }
  if (signal.aborted) return;
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
