// A film as a capture: which program it shows is asked for, and both go into one ZIP.
import { getJson } from "../lib/api.js";
import { h, size, when } from "../lib/dom.js";
import { zip } from "./zip.js";

const ENDS = /\.(mp4|m4v|mov|mkv|webm|avi|3gp)$/i;
export const isFilm = (file) => file.type.startsWith("video/") || ENDS.test(file.name);

export const named = (program) => `${program.patterns} patterns${program.display ? ` on a screen of ${size(program.display)}` : ""}`;

// capture.json for a film of a program that its page has shown, or a player its video.
export function recordOf(program, rate) {
  const border = program.showing?.border ?? program.display;
  const video = { patterns_per_second: rate, ...(border && { border }) };
  return { format: "envmatte-capture/1", program: program.program, video };
}

// The ZIP of a film and its record.
export async function bundle(film, record, signal) {
  const file = `film${ENDS.exec(film.name)?.[0].toLowerCase() ?? ".mp4"}`;
  const name = record.name || film.name.replace(/\.\w+$/, "").slice(0, 200);
  const text = JSON.stringify({ ...record, name, video: { ...record.video, file } });
  return zip([["capture.json", new Blob([text])], [file, film]], signal);
}

// Asks in `where` which program a film shows; resolves with its record.
export async function askFor(where, signal) {
  const { programs } = await getJson("v1/programs?limit=100", signal);
  return new Promise((resolve, reject) => {
    signal.addEventListener("abort", () => reject(signal.reason), { once: true });
    const problem = h("p", { class: "hint", role: "status" });
    const which = h("select", { "aria-label": "Program" }, programs.map((one, n) => h("option", { value: n }, `${named(one)}, of ${when(one.created_at).textContent}`)));
    const rate = h("input", { type: "number", min: 0.01, max: 120, step: "any", required: true });
    const suggest = () => (rate.value = programs[which.value]?.showing?.patterns_per_second ?? 2);
    which.onchange = suggest;
    suggest();
    const own = h("input", { type: "file", accept: ".json,application/json" });
    own.onchange = async () => {
      try {
        const found = JSON.parse(await own.files[0].text());
        if (!found.video?.patterns_per_second) throw new Error("it tells of no video");
        resolve(found);
      } catch (error) {
        problem.textContent = `This is no capture.json of a film: ${error.message}. Choose the one that came with the program.`;
        own.value = "";
      }
    };
    const form = h("form", { class: "stack" },
      h("p", {}, h("strong", {}, "Which program does this film show?")),
      programs.length
        ? [h("label", {}, "Program", which), h("label", {}, "Patterns a second", rate), h("p", { class: "row" }, h("button", { class: "primary" }, "Upload"))]
        : h("p", {}, "This service has shown none. ", h("a", { href: "#/film" }, "Show one and film it"), "."),
      h("label", {}, "Or the capture.json that came with the program", own), problem);
    form.onsubmit = (event) => {
      event.preventDefault();
      resolve(recordOf(programs[which.value], Number(rate.value)));
    };
    where.replaceChildren(form);
    (programs.length ? which : own).focus();
  }).finally(() => where.replaceChildren());
}
