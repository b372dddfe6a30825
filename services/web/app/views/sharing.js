// Links by which people without a key see a matte: made, copied, deleted.
import { elsewhere, getJson, post, remove } from "../lib/api.js";
import { button, h, problemBox, prose, when } from "../lib/dom.js";
import { parts, said, t } from "../lib/words.js";

const DAYS = [7, 30, 365];
const USUAL = 30;

// Folded; the links are requested once it is opened.
export function sharing(id, signal) {
	const path = `v1/mattes/${id}/links`;
	const days = h("select", { id: "days" }, DAYS.map((n) => h("option", { value: n, selected: n === USUAL }, t("share.days", { n }))));
	const problem = h("div");
	const made = h("div.stack");
	const links = h("ul.list");

	const row = ({ id: link, created_at: created, expires_at: expires }) => {
		const end = button(t("share.delete"), problem, async () => {
			await remove(`${path}/${link}`);
			if (made.dataset.link === link) made.replaceChildren();
			item.remove();
		}, "quiet");
		const item = h("li", { "data-id": link }, h("span", parts("share.until", { from: when(created), to: when(expires) })), end);
		return item;
	};
	const create = button(t("share.make"), problem, async () => {
		const { url, problem: here } = await elsewhere(signal); // before: what is made is shown only once
		const link = await post(path, { days: Number(days.value) });
		made.dataset.link = link.id;
		const to = (where) => new URL(where.slice(1), url ? `${url}/` : location.href.split("#")[0]).href;
		made.replaceChildren(...[field(t("share.link"), to(link.path), problem),
			field(t("share.embed"), h("iframe", { src: to(link.embed), width: 640, height: 560 }).outerHTML, problem),
			here && h("p", prose(said(here)), "."), h("p.hint", t("share.once"))].filter(Boolean));
		links.prepend(row(link));
	}, "primary");
	const panel = h("details.panel", h("summary", h("h2", t("share"))),
		h("div.stack", h("p", t("share.about")), h("div.row", h("label", { for: "days" }, t("share.expires")), days, create), problem, made, links));
	let isRead = false;
	panel.addEventListener("toggle", async () => {
		if (!panel.open || isRead) return;
		isRead = true;
		try {
			const found = (await getJson(path, signal)).links;
			links.append(...found.filter((one) => !links.querySelector(`[data-id="${one.id}"]`)).map(row)); // one may be made meanwhile
			problem.replaceChildren();
		} catch (error) {
			isRead = false;
			if (!signal.aborted) problem.replaceChildren(problemBox(error));
		}
	});
	return panel;
}

// A text to copy.
function field(label, text, problem) {
	const input = h("input", { type: "text", readonly: true, value: text, onfocus: () => input.select() });
	const copy = button(t("share.copy"), problem, async () => {
		input.select(); // for browsers that let no page of http write into the clipboard
		await navigator.clipboard?.writeText(text);
		if (navigator.clipboard) copy.textContent = t("share.copied");
	});
	return h("div.row.copied", h("label", label, input), copy);
}
