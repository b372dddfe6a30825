// A film that the service could not read: its first frame, and what is left to do.
import { saveBlob } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { t } from "../lib/words.js";
import { filmOf } from "../upload/kept_films.js";

export async function failedFilm(capture, signal) {
	const film = await filmOf(capture);
	const again = h("a.primary", { href: film?.again ?? "#/film" }, t("film.again"));
	if (!film) return h("p.row", again);
	const url = URL.createObjectURL(film.file);
	signal.addEventListener("abort", () => URL.revokeObjectURL(url));
	const first = h("video", { src: url, muted: true, playsinline: true, controls: true, preload: "auto", "aria-label": t("film.first") });
	const frame = h("div.picture", first);
	first.onloadedmetadata = () => (frame.style.aspectRatio = `${first.videoWidth} / ${first.videoHeight}`);
	first.onerror = () => (frame.hidden = true); // only the service reads it
	const save = h("button", { type: "button", onclick: () => saveBlob(film.file, film.file.name) }, t("film.save"));
	return h("section.panel", { "aria-label": t("film.title") }, h("h2", t("film.first")), frame, h("p.row", again, save));
}
