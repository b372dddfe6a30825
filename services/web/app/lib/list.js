// A list, newest first, that is refreshed while something in it is in progress.
import { button, h, pause, problemBox } from "./dom.js";
import { t } from "./words.js";

const REFRESH = 5000; // ms

export async function list(main, signal, { page, busy, none, item }) {
	const items = h("ul.list");
	const problem = h("div");
	const more = button(t("older"), problem, async () => add(await page(`&after=${last.id}`)), "more");
	let last;
	let pages = 0;
	const add = (found) => {
		items.append(...found.map((one) => h("li", item(one))));
		last = found.at(-1);
		more.hidden = found.length < 50;
		pages += 1;
	};
	const start = async () => {
		const first = await page("");
		if (!first.length) items.before(none());
		add(first);
		watch(first).catch(() => {}); // the user left the view
	};
	const again = async (error) => {
		signal.throwIfAborted();
		problem.replaceChildren(problemBox(error), button(t("again"), problem, () => start().catch(again)));
	};
	more.hidden = true;
	main.append(items, problem, more);
	await start().catch(again);

	// Refreshes the first page only, and only while no further page is shown.
	async function watch(found) {
		while (found.some(busy) && pages === 1) {
			await pause(REFRESH, signal);
			if (document.hidden) continue;
			try {
				found = await page("");
				problem.replaceChildren();
			} catch (error) {
				signal.throwIfAborted();
				problem.replaceChildren(problemBox(error));
				continue;
			}
			const focused = items.contains(document.activeElement) ? document.activeElement.getAttribute("href") : undefined;
			items.replaceChildren(...found.map((one) => h("li", item(one))));
			if (focused) items.querySelector(`[href="${focused}"]`)?.focus();
		}
	}
}
