// Deletes after some seconds in which it can be undone, or at once when the user leaves.
import { remove } from "./api.js";
import { h } from "./dom.js";
import { t } from "./words.js";

const DELAY = 8000; // ms
let act = () => {}; // deletes what waits

addEventListener("pagehide", () => act());

// The bar that offers to undo. `undone` is called if nothing is deleted, `failed` with each id that cannot be deleted.
export function deleteLater(kind, ids, signal, undone, failed) {
	act();
	const timer = setTimeout(() => act(), DELAY);
	const end = () => {
		clearTimeout(timer);
		signal.removeEventListener("abort", mine);
		if (act === mine) act = () => {};
		bar.remove();
	};
	const mine = (act = () => {
		end();
		for (const id of ids) remove(`v1/${kind}/${id}`, { keepalive: true }).catch((error) => failed(id, error));
	});
	signal.addEventListener("abort", mine);
	const undo = h("button", { type: "button", onclick: () => (end(), undone()) }, t("undo"));
	const bar = h("div.undo", { role: "status" }, t(`deleted.${kind}`, { n: ids.length }), undo);
	return bar;
}
