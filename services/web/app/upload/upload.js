// Uploads: rows that show how far each is, and where files are dropped or chosen.
import { Problem, post, saveBlob } from "../lib/api.js";
import { taking } from "../film/recorder.js";
import { bytes, duration, h, said, sure } from "../lib/dom.js";
import { askFor, bundle, isFilm } from "./film_bundle.js";
import { send } from "./tus.js";
import { crc32 } from "./zip.js";

const HEAD = 1 << 20; // bytes of an archive in which its record lies

// Uploads live longer than the view that shows them: who looks at something else meanwhile finds them again.
export const running = h("div", { class: "uploads" });
const rows = new Set(); // of each, whether it is `busy`, and `only`: of a film that is nowhere but in this page
addEventListener("beforeunload", (event) => [...rows].some(({ busy, only }) => busy || only) && event.preventDefault());

// Uploads a capture's ZIP, or a film: with its record, or whoever dropped it is asked for what it shows. One that was
// `taken` here can be saved, and is let go of by nobody who was not asked; one that `lacks` something waits for a word.
export function begin(file, record, { taken = false, lacks = "" } = {}) {
  const state = { busy: false, only: taken };
  const stop = new AbortController();
  const bar = h("progress", { max: 1, value: 0, "aria-label": `Upload of ${file.name}` });
  const status = h("span", { role: "status" }, "Starting");
  const problem = h("div");
  const asked = h("div");
  const again = h("button", { type: "button", hidden: true, onclick: () => work() }, "Go on");
  const save = h("button", { type: "button", hidden: !taken, onclick: () => (saveBlob(file, file.name), (state.only = false)) }, "Save the film");
  const end = () => (rows.delete(state), row.remove());
  const drop = async () => {
    if (state.only && !(await sure("Delete this film?", "It is nowhere but in this page: upload it, or save it first.", "Delete it"))) return;
    stop.abort();
    end();
  };
  const cancel = h("button", { type: "button", onclick: drop }, taken ? "Delete the film" : "Give up");
  const row = h("section", { class: "panel", "aria-label": file.name },
    h("p", { class: "row spread" }, h("strong", { class: "name" }, file.name), h("span", { class: "row" }, again, save, cancel)), bar, status, asked, problem);
  running.append(row);
  rows.add(state);
  let archive = isFilm(file) ? null : file;
  let remembered;

  async function work() {
    const start = performance.now();
    let first;
    again.hidden = true;
    problem.replaceChildren();
    state.busy = true;
    try {
      if (!archive) {
        status.textContent = "A film";
        record ??= await askFor(asked, stop.signal);
        status.textContent = "Putting it into a ZIP";
        archive = await bundle(file, record, stop.signal);
      } else if (!(await startsAsZip(archive))) {
        const detail = `${file.name} is neither a ZIP nor a film: drop the ZIP that holds capture.json and the frames, or the video that the camera took.`;
        throw new Problem({ status: 422, title: "This is no capture", detail });
      }
      // Of a film, the same with another record would be another archive.
      remembered ??= `envmatte-upload ${file.name} ${archive.size} ${file.lastModified} ${record ? await crc32(archive.slice(0, HEAD)) : ""}`;
      const upload = await send(archive, remembered, {
        signal: stop.signal,
        progress(done) {
          first ??= done;
          const left = (archive.size - done) / ((done - first) / (performance.now() - start) || Infinity) / 1000;
          bar.value = archive.size ? done / archive.size : 1;
          status.textContent = `${bytes(done)} of ${bytes(archive.size)}${left > 2 ? `, ${duration(left)} left` : ""}`;
        },
        waiting: (away, ms) => away && (status.textContent = `The service does not answer; trying again in ${duration(ms / 1000)}`),
      });
      status.textContent = "Looking into the ZIP";
      const made = await post("v1/captures", { upload }, `capture-of-${upload}`);
      localStorage.removeItem(remembered);
      end();
      if (running.isConnected && !taking.size) location.hash = `#/captures/${made.id}`;
    } catch (error) {
      if (stop.signal.aborted) return;
      const hopeless = error.status >= 400 && error.status < 500 && error.status !== 401; // another key may be typed
      if (hopeless) localStorage.removeItem(remembered);
      status.textContent = hopeless ? "Refused" : "Stopped; what has come is kept";
      if (!taken) cancel.textContent = hopeless ? "Dismiss" : "Give up";
      again.textContent = "Go on";
      again.hidden = hopeless;
      problem.replaceChildren(said(/^Not(Found|Readable)Error$/.test(error.name) ? unreadable(file) : error));
    } finally {
      state.busy = false;
    }
  }
  if (!lacks) return work();
  status.textContent = lacks;
  again.textContent = "Upload it all the same";
  again.hidden = false;
}

const unreadable = ({ name }) => ({
  title: "The file can’t be read",
  detail: `${name} was changed, moved or taken out since it was chosen, or is a folder: put it back and go on, or choose it anew.`,
});

const startsAsZip = async (file) => /^PK[\x03\x05]/.test(await file.slice(0, 4).text());

// Where a ZIP or a film is dropped or chosen.
export function dropZone() {
  const take = (files) => [...files].forEach((file) => begin(file));
  const input = h("input", { type: "file", accept: ".zip,application/zip,video/*,.mkv", id: "zip", multiple: true });
  input.onchange = () => {
    take(input.files);
    input.value = "";
  };
  const zone = h("div", { class: "drop" },
    h("label", { for: "zip" }, h("strong", {}, "Choose a capture’s ZIP or a film"), " or drop it here",
      h("span", { class: "hint" }, "A ZIP of capture.json and its frames, or the film of a program. An upload that breaks off goes on where it stood.")),
    input);
  onDrop(zone, take);
  return h("div", {}, zone, running);
}

export function onDrop(zone, take) {
  let depth = 0;
  const over = (by) => zone.classList.toggle("over", (depth = Math.max(0, depth + by)) > 0);
  zone.addEventListener("dragenter", (event) => (event.preventDefault(), over(1)));
  zone.addEventListener("dragleave", () => over(-1));
  zone.addEventListener("dragover", (event) => event.preventDefault());
  zone.addEventListener("drop", (event) => {
    event.preventDefault();
    depth = 0;
    over(0);
    if (event.dataTransfer.files.length) take(event.dataTransfer.files);
  });
}
