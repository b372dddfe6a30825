// A list that is newest first, looked at again while something in it is under way.
import { button, h, pause, said } from "./dom.js";

const LOOK = 5000; // ms

export async function list(main, signal, { page, busy, none, item }) {
  const items = h("ul", { class: "list" });
  const problem = h("div");
  const more = button("Older ones", problem, async () => add(await page(`&after=${last.id}`)), "more");
  let last;
  let pages = 0;
  const add = (found) => {
    items.append(...found.map((one) => h("li", {}, item(one))));
    last = found.at(-1);
    more.hidden = found.length < 50;
    pages += 1;
  };
  const first = await page("");
  if (!first.length) main.append(none());
  main.append(items, problem, more);
  add(first);
  watch(first).catch(() => {}); // the view was left

  // What was scrolled to stays as it is: only the first page is looked at again.
  async function watch(found) {
    while (found.some(busy) && pages === 1) {
      await pause(LOOK, signal);
      if (document.hidden) continue;
      try {
        found = await page("");
        problem.replaceChildren();
      } catch (error) {
        signal.throwIfAborted();
        problem.replaceChildren(said(error));
        continue;
      }
      const focused = items.contains(document.activeElement) ? document.activeElement.getAttribute("href") : undefined;
      items.replaceChildren(...found.map((one) => h("li", {}, item(one))));
      if (focused) items.querySelector(`[href="${focused}"]`)?.focus();
    }
  }
}
