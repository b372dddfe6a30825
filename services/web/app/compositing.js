// The glass before a backdrop that is chosen, moved, scaled and turned; what is drawn is the service's composite.
import { ask, saveBlob } from "./api.js";
import { NAMES, brought, builtIn } from "./backdrops.js";
import { button, h, newest, said, show } from "./dom.js";
import { onDrop } from "./upload.js";

const STILL = 300; // ms after which a hand has stopped
const QUICK = 480; // pixels of the longer side while it moves
const CONTROLS = [
  // name, label, default, minimum, maximum, step of the slider and of the keys
  ["right", "Move right", 0, -2, 2, 0.01],
  ["down", "Move down", 0, -2, 2, 0.01],
  ["scale", "Size", 1, 0.1, 10, 0.01],
  ["angle", "Turn", 0, -180, 180, 1],
];
const KEYS = {
  ArrowLeft: ["right", -2], ArrowRight: ["right", 2], ArrowUp: ["down", -2], ArrowDown: ["down", 2],
  "+": ["scale", 5], "-": ["scale", -5], "[": ["angle", -2], "]": ["angle", 2],
};

export async function compositing(matte, signal) {
  const longer = Math.max(matte.width, matte.height);
  const at = Object.fromEntries(CONTROLS.map(([name, , value]) => [name, value]));
  let source;
  let timer;
  let changes = 0;

  const image = h("img", { alt: "The glass before the backdrop", width: matte.width, height: matte.height, draggable: "false" });
  const stage = h("div", {
    class: "picture stage", tabindex: 0, role: "group",
    "aria-label": "Composite. Drag to move the backdrop; arrow keys move, plus and minus scale, square brackets turn it.",
  }, image);
  stage.style.aspectRatio = `${matte.width} / ${matte.height}`;
  const status = h("p", { class: "hint", role: "status" }, "Loading");
  const problem = h("div");

  const composite = (body, wanted, accept) => {
    const query = new URLSearchParams({ ...at, ...wanted });
    return ask(`v1/mattes/${matte.id}/composite?${query}`, { method: "POST", headers: { Accept: accept }, body, signal });
  };
  const draw = newest(async (exact) => {
    const drawn = changes;
    try {
      const wanted = exact ? { quality: 95 } : { quality: 80, size: Math.min(QUICK, longer) };
      const answer = await composite(exact ? source.exact : source.quick, wanted, "image/jpeg");
      await show(image, await answer.blob());
      if (exact && drawn === changes) status.textContent = `${source.name}: exact, ${matte.width} × ${matte.height} pixels`;
      problem.replaceChildren();
    } catch (error) {
      if (!signal.aborted) problem.replaceChildren(said(error));
    }
  });
  const stop = () => clearTimeout(timer);
  signal.addEventListener("abort", stop);
  const moved = () => {
    stop();
    changes += 1;
    status.textContent = `${source.name}: preview`;
    timer = setTimeout(draw, STILL, true);
    draw(false);
  };

  // What is set by hand, by sliders and by keys is the same four figures.
  const sliders = Object.fromEntries(CONTROLS.map(([name, , value, min, max, step]) => {
    const scale = name === "scale"; // by its logarithm: as far from 1 to 10 as from 1 to a tenth
    const [low, high, fine] = scale ? [Math.log10(min), Math.log10(max), 0.01] : [min, max, step];
    const input = h("input", { type: "range", id: `place-${name}`, min: low, max: high, step: fine });
    input.oninput = () => set({ [name]: scale ? 10 ** input.value : Number(input.value) });
    return [name, { input, told: h("output", { for: `place-${name}` }) }];
  }));
  function set(wanted, quiet = false) {
    for (const [name, , , min, max] of CONTROLS) {
      let value = wanted[name] ?? at[name];
      if (name === "angle") value = ((((value + 180) % 360) + 360) % 360) - 180;
      at[name] = Number(Math.min(max, Math.max(min, value)).toFixed(4));
      const { input, told } = sliders[name];
      input.value = name === "scale" ? Math.log10(at.scale) : at[name];
      input.ariaValueText = told.textContent = name === "angle" ? `${Math.round(at.angle)}°` : `${Math.round(100 * at[name])} %`;
    }
    if (!quiet) moved();
  }
  const step = (name, by) => {
    const [, , , , , fine] = CONTROLS.find(([one]) => one === name);
    set({ [name]: name === "scale" ? at.scale * 1.02 ** by : at[name] + by * fine });
  };
  const reset = h("button", { type: "button", onclick: () => set(Object.fromEntries(CONTROLS.map(([name, , value]) => [name, value]))) }, "Back to the start");

  stage.onkeydown = (event) => {
    const [name, by] = KEYS[event.key] ?? [];
    if (!name || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    step(name, event.shiftKey && event.key.startsWith("Arrow") ? 5 * by : by);
  };
  stage.addEventListener("wheel", (event) => {
    if (document.activeElement !== stage && !event.ctrlKey) return; // who only passes by scrolls the page
    event.preventDefault();
    set({ scale: at.scale * Math.exp(-event.deltaY * (event.deltaMode ? 0.03 : 0.001)) });
  }, { passive: false });
  handle(stage, () => at, set);

  async function use(making) {
    try {
      source = await making;
      moved();
    } catch (error) {
      problem.replaceChildren(said(error));
    }
  }
  const bring = (files) => {
    for (const choice of choices.querySelectorAll("input")) choice.checked = false;
    use(brought(files[0]));
  };
  const choices = h("fieldset", { class: "row" }, h("legend", {}, "Backdrop"), NAMES.map((name, i) =>
    h("label", { class: "choice" }, h("input", { type: "radio", name: "backdrop", checked: i === 0, onchange: () => use(builtIn(name, matte.monitor)) }), name)));
  const file = h("input", { type: "file", id: "backdrop", accept: "image/*,.exr,.tif,.tiff" });
  file.onchange = () => {
    if (file.files.length) bring(file.files);
    file.value = "";
  };
  onDrop(stage, bring);
  addEventListener("paste", ({ clipboardData }) => clipboardData?.files.length && bring(clipboardData.files), { signal });

  const download = (kind, accept) => button(kind, problem, async () =>
    saveBlob(await (await composite(source.exact, {}, accept)).blob(), `composite.${kind.toLowerCase()}`));
  set({}, true);
  use(builtIn(NAMES[0], matte.monitor));
  return [
    h("section", { class: "panel composite", "aria-label": "Compositing" },
      h("div", {}, stage, h("p", { class: "hint" }, "Drag the picture to move the backdrop; then scroll, or pinch, to scale it."), status, problem),
      h("div", { class: "stack" }, choices,
        h("div", { class: "drop small" }, h("label", { for: "backdrop" }, h("strong", {}, "Your own picture"), " drop, paste or choose it",
          h("span", { class: "hint" }, "PNG, JPEG, TIFF or EXR")), file),
        h("div", { class: "sliders" }, CONTROLS.map(([name, label]) =>
          [h("label", { for: `place-${name}` }, label), sliders[name].input, sliders[name].told])),
        h("p", { class: "row" }, reset),
        h("div", { class: "row" }, h("span", {}, "Download it as"), download("PNG", "image/png"), download("EXR", "image/x-exr")))),
  ];
}

// One finger or the mouse moves; two fingers scale and turn as well.
function handle(stage, place, set) {
  const fingers = new Map();
  const state = () => {
    const [a, b = a] = [...fingers.values()];
    const [dx, dy] = [b.x - a.x, b.y - a.y];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, apart: Math.hypot(dx, dy), angle: (Math.atan2(dy, dx) * 180) / Math.PI };
  };
  stage.onpointerdown = (event) => {
    if (event.button) return;
    stage.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  };
  stage.onpointermove = (event) => {
    if (!fingers.has(event.pointerId)) return;
    const before = state();
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const now = state();
    const { width, height } = stage.getBoundingClientRect();
    const { right, down, scale, angle } = place();
    const wanted = { right: right + (now.x - before.x) / width, down: down + (now.y - before.y) / height };
    if (fingers.size === 2 && before.apart > 10) {
      wanted.scale = (scale * now.apart) / before.apart;
      wanted.angle = angle + now.angle - before.angle;
    }
    set(wanted);
  };
  stage.onpointerup = stage.onpointercancel = (event) => fingers.delete(event.pointerId);
}
