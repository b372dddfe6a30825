// A list, newest first, that is refreshed while something in it is in progress. Where entries have states, they can be
// searched, filtered, chosen and deleted.
import { getJson } from "./api.js";
import { button, empty, h, newest, pause, problemBox } from "./dom.js";
import { deleteLater } from "./undo.js";
import { t } from "./words.js";

const POLL = 5000; // ms between two requests
const PAGE = 50; // entries

// `kind` names a path of the API and the key of its answer. `item` makes the card of an entry, and `text` says which one
// it is. Where entries are `named`, the API searches their names; else this page searches their texts.
export async function list(main, signal, { kind, states = [], named = false, busy, fixed = () => false, none, item, text }) {
	const items = h("ul.list");
	const nothing = h("div");
	const problem = h("div.stack");
	const refused = h("div");
	const search = h("input", { type: "search", maxlength: 200, "aria-label": t("list.search"), placeholder: t("list.search") });
	const state = h("select", { "aria-label": t("list.state") }, h("option", { value: "" }, t("list.all")),
		states.map((one) => h("option", { value: one }, t(`state.${one}`))));
	const all = h("input", { type: "checkbox", "aria-label": t("list.choose.all") });
	const chosen = new Set(); // ids
	const gone = new Set(); // ids of what is deleted, or will be
	const rows = new Map(); // by id: the text of an entry and its element, which stays as long as nothing changes
	let entries = [];
	let isWhole = true; // whether the oldest entry is there
	const wanted = () => search.value.trim();

	// What follows `found`: one page of it, or every page if this page searches them.
	async function read(found) {
		do {
			const query = { limit: PAGE, state: state.value, name: named && wanted(), after: found.at(-1)?.id };
			const given = Object.entries(query).filter(([, value]) => value);
			const next = (await getJson(`v1/${kind}?${new URLSearchParams(given)}`, signal))[kind];
			found = [...found, ...next];
			isWhole = next.length < PAGE;
		} while (!isWhole && !named && wanted());
		entries = found;
		draw();
	}
	let failed; // the error of the last request, and whether that was for older entries
	const load = newest(async (isMore) => {
		try {
			await read(isMore ? entries : []);
			failed = undefined;
			problem.replaceChildren();
		} catch (error) {
			signal.throwIfAborted();
			// Otherwise a screen reader would read it again each time.
			if (failed?.error.message !== error.message) problem.replaceChildren(problemBox(error), h("p", button(t("again"), refused, () => load(failed?.isMore))));
			failed = { error, isMore };
		}
	});
	const more = button(t("older"), refused, () => load(true), "more");

	const remove = h("button.danger", {
		type: "button",
		onclick() {
			const ids = [...chosen];
			for (const id of ids) gone.add(id);
			const back = (some) => {
				for (const id of some) gone.delete(id);
				draw();
			};
			chosen.clear();
			refused.replaceChildren();
			draw();
			main.append(deleteLater(kind, ids, signal, () => back(ids), (id, error) => {
				refused.replaceChildren(problemBox(error));
				back([id]);
			}));
		},
	});
	const count = () => {
		remove.hidden = !chosen.size;
		remove.textContent = t("list.delete", { n: chosen.size });
	};
	const isFound = (one) => named || text(one).toLowerCase().includes(wanted().toLowerCase());
	const visible = () => entries.filter((one) => !gone.has(one.id) && isFound(one));
	all.onchange = () => {
		chosen.clear();
		if (all.checked) for (const one of visible()) if (!fixed(one)) chosen.add(one.id);
		draw();
	};

	function row(one) {
		const now = JSON.stringify(one);
		const known = rows.get(one.id);
		if (known?.now === now) return known.element;
		const choose = states.length > 0 && h("input", {
			type: "checkbox", "aria-label": t("list.choose", { name: text(one) }), disabled: fixed(one),
			onchange: () => (choose.checked ? chosen.add(one.id) : chosen.delete(one.id), count()),
		});
		const element = h("li", { "data-id": one.id }, choose, item(one));
		rows.set(one.id, { now, element });
		return element;
	}
	function draw() {
		const shown = visible().map(row);
		const { activeElement } = document;
		const [focused, tag] = [activeElement.closest("li")?.dataset.id, activeElement.localName];
		if (shown.length !== items.childElementCount || shown.some((one, n) => one !== items.children[n])) {
			items.replaceChildren(...shown);
			if (focused) items.querySelector(`[data-id="${focused}"] ${tag}`)?.focus();
		}
		for (const one of shown) {
			const choose = one.querySelector("[type=checkbox]");
			if (choose) choose.checked = chosen.has(one.dataset.id);
		}
		const isFiltered = Boolean(search.value || state.value);
		tools.hidden = !states.length || (!entries.length && !isFiltered);
		nothing.replaceChildren(shown.length ? "" : isFiltered ? empty(t("list.none"), t("list.other")) : none());
		more.hidden = isWhole;
		if (!chosen.size) all.checked = false;
		count();
	}
	const tools = h("div.row.tools", { role: "search", hidden: true }, h("label", all, " ", t("list.every")), search, state, remove);
	search.oninput = () => (isWhole && !named ? draw() : load().catch(() => {})); // the user left the view
	state.onchange = () => (chosen.clear(), load().catch(() => {}));
	more.hidden = true;
	main.append(tools, refused, nothing, items, problem, more);
	await load();
	watch().catch(() => {}); // the user left the view

	// Tries again what failed. Refreshes the first page only, and only while no further page is shown.
	async function watch() {
		for (;;) {
			await pause(POLL, signal);
			if (document.hidden || more.disabled) continue;
			if (failed?.error.isTemporary) await load(failed.isMore);
			else if (entries.length <= PAGE && entries.some(busy)) await load();
		}
	}
}
