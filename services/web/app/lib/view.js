// What several views have in common: steps, deletion, names, qualities, thumbnails.
import { RETRY, remove } from "./api.js";
import { button, confirmed, h, newest, pause, problemBox, show } from "./dom.js";
import { t } from "./words.js";

const STEPS = ["film", "check", "recover", "play"];
export const [FILM, CHECK, RECOVER, PLAY] = STEPS.keys();

// Where one is on the way from a film to a composite; `links` lead to the steps before.
export const steps = (at, ...links) =>
	h("ol.steps", { "aria-label": t("steps") }, STEPS.map((name, n) =>
		h("li", { "aria-current": n === at && "step" }, n < at && links[n] ? h("a", { href: links[n] }, t(`step.${name}`)) : t(`step.${name}`))));

// Says later whether the user is still in the view that is shown now: who has left it is not led elsewhere.
export function staying() {
	const view = () => location.hash.split("?")[0];
	const now = view();
	return () => view() === now;
}

// Shows the view that is open once more: what it shows has changed.
export const showAgain = () => dispatchEvent(new HashChangeEvent("hashchange"));

// Does what needs the service, and does it again after an outage. An error is shown in `where`.
export async function persist(work, where, signal) {
	while (!signal.aborted) {
		try {
			await work();
			return where.replaceChildren();
		} catch (error) {
			const box = problemBox(error);
			// Otherwise a screen reader would read it again each time.
			if (box.textContent !== where.textContent) where.replaceChildren(box);
			if (!error.isTemporary) return;
			await pause(RETRY, signal).catch(() => {}); // the user left the view
		}
	}
}

// A button that deletes what a path such as `v1/captures/ID` names; then its list is shown.
export function deletion(path, where, lost) {
	const [, list] = path.split("/");
	return button(t("delete"), where, async () => {
		if (!(await confirmed(t(`delete.${list}?`), lost, t(`delete.${list}`)))) return;
		const isHere = staying();
		await remove(path);
		if (isHere()) location.replace(`#/${list}`);
	}, "quiet");
}

export const QUALITIES = ["fast", "fine"];
export const qualityOf = ({ options: { quality } }) => QUALITIES.includes(quality) && t(`quality.${quality}`);

export const matteName = ({ id, name }) => name || t("matte.unnamed", { id: id.slice(0, 8) });

// The name of a file of a matte.
export const fileName = (matte, kind) => `${matteName(matte).replace(/[^\p{L}\p{N}._-]+/gu, "_")}.${kind}`;

const thumbs = new Map(); // by id: what is ready never changes

// A function that makes thumbnails. Pictures are requested one after the other, and only of what is in view.
export function thumbnails(signal, request) {
	const queue = [];
	const draw = newest(async () => {
		while (queue.length && !signal.aborted) {
			const frame = queue.shift();
			const { id } = frame.dataset;
			try {
				if (!thumbs.has(id)) thumbs.set(id, await request(id));
				await show(frame.firstChild, thumbs.get(id));
			} catch (error) { // the place stays empty
				if (!error.isTemporary) continue;
				queue.push(frame);
				await pause(RETRY, signal).catch(() => {}); // the user left the view
			}
		}
	});
	const seen = new IntersectionObserver((entries) => {
		for (const { isIntersecting, target } of entries) {
			if (!isIntersecting) continue;
			seen.unobserve(target);
			queue.push(target);
		}
		draw();
	});
	signal.addEventListener("abort", () => seen.disconnect());
	return ({ id, state }) => {
		const frame = h("span.thumb", { "data-id": id }, h("img", { alt: "", width: 96, height: 72, hidden: true }));
		if (state === "ready") seen.observe(frame);
		return frame;
	};
}
