// Mattes: the list, and one matte with its composite and layers.
import { getComposite, getJson, patchJson, save } from "../lib/api.js";
import { backdrop } from "../composite/backdrops/backdrops.js";
import { badge, button, empty, facts, h, pause, size, when } from "../lib/dom.js";
import { compositing } from "../composite/compositing.js";
import { layers } from "../composite/layers.js";
import { recovering } from "../composite/recovering.js";
import { list } from "../lib/list.js";
import { PLAY, deletion, fileName, matteName, qualityOf, showAgain, steps, thumbnails } from "../lib/view.js";
import { parts, t } from "../lib/words.js";
import { reportLink } from "./report.js";
import { sharing } from "./sharing.js";
import { renamable } from "../lib/rename.js";

const THUMB = 240; // pixels
const POLL = 3000; // ms between two looks for a picture
const checker = backdrop("Checker", THUMB, 180);

export function matteCards(signal) {
	const thumb = thumbnails(signal, async (id) => getComposite(id, { size: THUMB, around: "backdrop" }, "image/jpeg", await checker, signal));
	return (one) => h("a.card.pictured", { href: `#/mattes/${one.id}` }, thumb(one),
		h("span.name", matteName(one)), badge(one.state),
		h("span.about", [size(one), one.options.method, qualityOf(one)].filter(Boolean).join(" · ")), when(one.created_at));
}

export async function mattes(main, signal) {
	main.append(h("h1", t("nav.mattes")));
	await list(main, signal, {
		kind: "mattes", states: ["recovering", "ready", "failed"], named: true, text: matteName,
		busy: (one) => one.state === "recovering",
		none: () => empty(t("mattes.none"), parts("mattes.first", { captures: h("a", { href: "#/captures" }, t("nav.captures")) })),
		item: matteCards(signal),
	});
}

export async function matte(main, signal, id) {
	const found = await getJson(`v1/mattes/${id}`, signal);
	const problem = h("div");
	const { capture, job, options } = found;
	const rename = async (name) => (found.name = (await patchJson(`v1/mattes/${id}`, { name })).name);
	const isReady = found.state === "ready";
	const state = badge(found.state);
	const removal = deletion(`v1/mattes/${id}`, problem, t("matte.lost"));
	const archive = button(t("matte.download"), problem, () => save(`v1/mattes/${id}/archive`, fileName(found, "zip")));
	const page = button(t("matte.page"), problem, () => save(`v1/mattes/${id}/live.html`, fileName(found, "html")));
	archive.hidden = page.hidden = !isReady;
	main.append(
		steps(PLAY, "#/captures", capture && `#/captures/${capture}`, job && `#/jobs/${job}`),
		h("div.row.spread", renamable(matteName(found), t("matte.name"), rename), state),
	);
	const isShown = isReady || found.preview;
	const [report, others] = await Promise.all([reportLink(capture, signal), isShown && otherQualities(found, signal)]);
	const details = h("details.panel", { open: !isShown }, h("summary", h("h2", t("details"))), facts({
		[t("frame")]: found.width && t("pixels", { size: size(found) }), [t("monitor")]: found.monitor && t("pixels", { size: found.monitor.join(" × ") }),
		[t("made")]: when(found.created_at), [t("until")]: found.expires_at && when(found.expires_at),
		[t("method")]: options.method, [t("quality")]: qualityOf(found),
		[t("report")]: report,
		[t("capture")]: capture && h("a", { href: `#/captures/${capture}` }, t("job.capture")),
		[t("job")]: job && h("a", { href: `#/jobs/${job}` }, t("matte.job")),
	}));
	const more = h("div.stack");
	const complete = () => more.replaceChildren(layers(found, signal), sharing(id, signal));
	if (isShown) {
		const { section, stage } = compositing(found, others, signal);
		main.append(section, more);
		if (isReady) complete();
		else more.append(recovering(found, stage, signal, () => {
			complete();
			state.replaceWith(badge(found.state));
			archive.hidden = page.hidden = false;
		}));
	} else {
		const text = t(found.state === "failed" ? "matte.failed" : "matte.running");
		if (found.state === "recovering") awaitPicture(found, signal).catch(() => {}); // the user left the view
		main.append(h("div.empty", h("strong", t("matte.unready")), h("p", text), job && h("p", h("a", { href: `#/jobs/${job}` }, t("job.show")))));
	}
	main.append(details, h("p.row", page, archive, removal), problem);
}

// Shows the view again once there is something to see, or there will be nothing.
async function awaitPicture({ id, state }, signal) {
	for (let now = { state }; now.state === state && !now.preview; ) {
		await pause(POLL, signal);
		now = await getJson(`v1/mattes/${id}`, signal).catch((error) => (error.isTemporary ? { state } : {}));
	}
	signal.throwIfAborted();
	showAgain();
}

// The newest matte of the same capture in each other quality, by its name.
async function otherQualities({ capture, options }, signal) {
	if (!capture) return {};
	const { mattes } = await getJson(`v1/mattes?capture=${capture}&state=ready&limit=20`, signal);
	const others = mattes.filter((one) => qualityOf(one) && one.options.quality !== options.quality);
	return Object.fromEntries(others.reverse().map((one) => [qualityOf(one), one]));
}
