// Resumable uploads by tus 1.0 (https://tus.io/protocols/resumable-upload).
import { Problem, ask, authorization, post } from "./api.js";
import { bytes, duration, h, pause, said } from "./dom.js";

const PART = 8 << 20; // bytes of a request: the service takes 10,000 of them
const LONGEST = 30_000; // ms between two attempts
const TUS = { "Tus-Resumable": "1.0.0" };
// The service has more than was thought, is full of requests, or is away: what helps is to look how far it is.
const PASSING = [0, 409, 429, 502, 503, 504];

// A request with the bytes that went out told meanwhile, which `fetch` can't.
function patch(path, offset, blob, progress, signal) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    const stop = () => request.abort();
    request.open("PATCH", path);
    const type = { "Content-Type": "application/offset+octet-stream", "Upload-Offset": offset };
    for (const [name, value] of Object.entries({ ...TUS, ...type, ...authorization() })) request.setRequestHeader(name, value);
    request.upload.onprogress = (event) => progress(offset + event.loaded);
    request.onload = () => {
      if (request.status === 204) return resolve(Number(request.getResponseHeader("Upload-Offset")));
      const about = { title: "Refused", detail: `The service answered with ${request.status}.`, status: request.status };
      try {
        Object.assign(about, JSON.parse(request.responseText));
      } catch {} // of something between that is no part of the service
      reject(new Problem(about));
    };
    request.onerror = () => reject(new Problem({ status: 0, title: "The connection broke" }));
    request.onabort = () => reject(signal.reason);
    request.onloadend = () => signal.removeEventListener("abort", stop);
    signal.addEventListener("abort", stop);
    request.send(blob);
  });
}

async function offsetOf(id, signal) {
  const answer = await ask(`v1/uploads/${id}`, { method: "HEAD", headers: TUS, signal });
  return Number(answer.headers.get("Upload-Offset"));
}

// Sends a file, going on where an upload of it stood; returns the upload's id.
async function send(file, remembered, { signal, progress, waiting }) {
  let id = localStorage.getItem(remembered);
  let offset = 0;
  let wait = 1000;
  let lost = Boolean(id);
  for (;;) {
    try {
      if (lost) offset = await offsetOf(id, signal);
      if (!id) {
        const answer = await ask("v1/uploads", { method: "POST", headers: { ...TUS, "Upload-Length": file.size }, signal });
        id = answer.headers.get("Location").split("/").at(-1);
        localStorage.setItem(remembered, id);
      }
      lost = false;
      waiting(false);
      while (offset < file.size) {
        offset = await patch(`v1/uploads/${id}`, offset, file.slice(offset, offset + PART), progress, signal);
        progress(offset);
        wait = 1000;
      }
      return id;
    } catch (error) {
      signal.throwIfAborted();
      lost = Boolean(id);
      if (id && [404, 410].includes(error.status)) {
        id = null; // expired: from the start
        offset = 0;
        lost = false;
        continue;
      }
      if (error.status === 401) continue; // `ask` will ask for a key
      if (!PASSING.includes(error.status)) throw error;
      waiting(true, wait);
      await pause(wait, signal);
      wait = Math.min(2 * wait, LONGEST);
    }
  }
}

// Uploads live longer than the view that shows them: who looks at something else meanwhile finds them again.
const running = h("div", { class: "uploads" });
let number = 0;
addEventListener("beforeunload", (event) => number && event.preventDefault());

function begin(file) {
  const stop = new AbortController();
  const bar = h("progress", { max: 1, value: 0, "aria-label": `Upload of ${file.name}` });
  const status = h("span", { role: "status" }, "Starting");
  const problem = h("div");
  const again = h("button", { type: "button", hidden: true, onclick: () => work() }, "Go on");
  const cancel = h("button", { type: "button", onclick: () => (stop.abort(), row.remove()) }, "Give up");
  const row = h("section", { class: "panel", "aria-label": file.name },
    h("p", { class: "row spread" }, h("strong", { class: "name" }, file.name), h("span", { class: "row" }, again, cancel)), bar, status, problem);
  running.append(row);
  const remembered = `envmatte-upload ${file.name} ${file.size} ${file.lastModified}`;

  async function work() {
    const start = performance.now();
    let first;
    again.hidden = true;
    problem.replaceChildren();
    number += 1;
    try {
      if (file.type.startsWith("video/")) {
        const detail = "Put it into one ZIP with its capture.json, which says what the monitor showed, and drop that here.";
        throw new Problem({ status: 422, title: "A film alone is no capture", detail });
      }
      const upload = await send(file, remembered, {
        signal: stop.signal,
        progress(done) {
          first ??= done;
          const left = (file.size - done) / ((done - first) / (performance.now() - start) || Infinity) / 1000;
          bar.value = file.size ? done / file.size : 1;
          status.textContent = `${bytes(done)} of ${bytes(file.size)}${left > 2 ? `, ${duration(left)} left` : ""}`;
        },
        waiting: (away, ms) => away && (status.textContent = `The service does not answer; trying again in ${duration(ms / 1000)}`),
      });
      status.textContent = "Looking into the ZIP";
      const made = await post("v1/captures", { upload }, `capture-of-${upload}`);
      localStorage.removeItem(remembered);
      row.remove();
      if (location.hash === "#/captures") location.hash = `#/captures/${made.id}`;
    } catch (error) {
      if (stop.signal.aborted) return;
      const hopeless = error.status >= 400 && error.status < 500;
      if (hopeless) localStorage.removeItem(remembered);
      status.textContent = hopeless ? "Refused" : "Stopped; what has come is kept";
      cancel.textContent = hopeless ? "Dismiss" : "Give up";
      again.hidden = hopeless;
      problem.replaceChildren(said(error));
    } finally {
      number -= 1;
    }
  }
  work();
}

// Where a ZIP is dropped or chosen.
export function dropZone() {
  const take = (files) => [...files].forEach(begin);
  const input = h("input", { type: "file", accept: ".zip,application/zip", id: "zip", multiple: true });
  input.onchange = () => {
    take(input.files);
    input.value = "";
  };
  const zone = h("div", { class: "drop" },
    h("label", { for: "zip" }, h("strong", {}, "Choose a capture’s ZIP"), " or drop it here",
      h("span", { class: "hint" }, "capture.json, and the frames or the film of which it tells. An upload that breaks off goes on where it stood.")),
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
