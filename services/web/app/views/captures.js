// The captures there are, and the way for another one.
import { getJson } from "../lib/api.js";
import { badge, bytes, empty, h, size, when } from "../lib/dom.js";
import { list } from "../lib/list.js";
import { dropZone } from "../upload/upload.js";

export async function captures(main, signal) {
  main.append(
    h("h1", {}, "Captures"),
    h("p", { class: "lead" }, "A glass, filmed before a monitor that shows patterns. Add one, and see how it turned out."),
    dropZone(),
  );
  await list(main, signal, {
    page: (after) => getJson(`v1/captures?limit=50${after}`, signal).then((answer) => answer.captures),
    busy: (one) => one.state === "ingesting",
    none: () => empty("No captures yet", "The first one appears here as soon as it is uploaded."),
    item: (one) =>
      h("a", { class: "card", href: `#/captures/${one.id}` },
        h("span", { class: "name" }, one.name || `Capture ${one.id.slice(0, 8)}`), badge(one.state),
        h("span", { class: "about" }, [size(one), `${one.frames} frames`, bytes(one.bytes)].filter(Boolean).join(" · ")),
        when(one.created_at)),
  });
}
