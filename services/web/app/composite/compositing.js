// The glass before a backdrop that is chosen, moved, scaled and turned. While it moves, WebGL2 draws it in this browser,
// or the service a small picture where it can't; when the hand has stopped, the service's composite is shown.
import { ask, saveBlob } from "../lib/api.js";
import { NAMES, brought, builtIn } from "./backdrops.js";
import { clips } from "./clip_job.js";
import { button, h, newest, said, show } from "../lib/dom.js";
import { glass, lightOf } from "./webgl.js";
import { fetchLive } from "./live.js";
import { camera, clip } from "./video_backdrops.js";
import { onDrop } from "../upload/upload.js";

const STILL = 300; // ms after which a hand has stopped
const QUICK = 480; // pixels of the longer side while it moves
const SLOW = 45; // ms between pictures, from which fewer pixels are drawn
const COARSEST = 2;
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
  let painter;
  let timer;
  let frame = 0;
  let changes = 0;
  let coarser = 0; // as this device needs it for the glass to follow the hand
  let paces = []; // ms between the last pictures of a movement
  let painted;
  let rested = true; // whether the hand has stopped since

  const image = h("img", { alt: "The glass before the backdrop", width: matte.width, height: matte.height, draggable: "false" });
  const canvas = h("canvas", { role: "img", "aria-label": "The glass before the backdrop", width: matte.width, height: matte.height, hidden: true });
  const stage = h("div", {
    class: "picture stage", tabindex: 0, role: "group",
    "aria-label": "Composite. Drag to move the backdrop; arrow keys move, plus and minus scale, square brackets turn it.",
  }, image, canvas);
  stage.style.aspectRatio = `${matte.width} / ${matte.height}`;
  const status = h("p", { class: "hint", role: "status" }, "Loading");
  const drawer = h("p", { class: "hint" }, "Until all of the glass is here, the service draws it while you move.");
  const problem = h("div");
  const fail = (error) => signal.aborted || problem.replaceChildren(said(error));
  const tell = (how) => {
    const text = `${source.name}: ${how}`;
    if (status.textContent !== text) status.textContent = text;
  };
  const front = (one) => {
    image.hidden = one !== image;
    canvas.hidden = one !== canvas;
  };

  const composite = (body, wanted, accept) => {
    const query = new URLSearchParams({ ...at, ...wanted });
    return ask(`v1/mattes/${matte.id}/composite?${query}`, { method: "POST", headers: { Accept: accept }, body, signal });
  };
  const playing = () => source.moving && !source.moving.paused;
  const drawn = () => painter && source.picture;
  const draw = newest(async (exact) => {
    const [was, now] = [source, changes];
    try {
      const wanted = exact ? { quality: 95 } : { quality: 80, size: Math.min(QUICK, longer) };
      const answer = await (await composite(await (exact ? was.exact() : was.quick()), wanted, "image/jpeg")).blob();
      if (was !== source || (drawn() && now !== changes)) return; // what is drawn here is newer
      await show(image, answer);
      front(image);
      if (exact && now === changes) tell(`exact, ${matte.width} × ${matte.height} pixels`);
      problem.replaceChildren();
    } catch (error) {
      fail(error);
    }
    if (!exact && playing() && !drawn() && !signal.aborted) draw(false); // the next frame
  });
  function paint(now) {
    frame = 0;
    if (!drawn()) return;
    if (!rested) paces = [...paces.slice(-3), now - painted];
    else if (coarser) [coarser, paces] = [coarser - 1, []]; // another movement: it may have been busy only then
    [painted, rested] = [now, false];
    if (paces.length === 4 && Math.min(...paces) > SLOW && coarser < COARSEST) {
      coarser += 1;
      paces = [];
    }
    if (playing()) painter.take(source.picture);
    painter.draw(at, coarser);
    front(canvas);
    if (playing()) redraw();
  }
  function redraw() {
    frame ||= requestAnimationFrame(paint);
  }
  const stop = () => {
    clearTimeout(timer);
    cancelAnimationFrame(frame);
    frame = 0;
  };
  const stopped = () => {
    rested = true;
    draw(true);
  };
  const moved = () => {
    if (!source) return;
    clearTimeout(timer);
    changes += 1;
    tell(drawn() ? "live" : "preview");
    if (!playing()) timer = setTimeout(stopped, STILL);
    if (drawn()) redraw();
    else draw(false);
  };
  signal.addEventListener("abort", () => {
    stop();
    painter?.close();
    source?.close?.();
  });

  // Draws in this browser as soon as the matte is here, if it can.
  async function prepare() {
    const gl = lightOf(canvas);
    if (!gl) return (drawer.textContent = "This browser can’t draw the glass itself, for it has no WebGL2: the service draws it while you move.");
    const lost = () => {
      painter = undefined;
      drawer.textContent = "The graphics card has let go of the glass: the service draws it while you move, until this page is loaded anew.";
      moved();
    };
    canvas.addEventListener("webglcontextlost", lost, { signal });
    signal.addEventListener("abort", () => gl.getExtension("WEBGL_lose_context")?.loseContext());
    try {
      const found = await fetchLive(matte.id, signal);
      if (Math.max(found.width, found.height, ...found.texture) > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
        return (drawer.textContent = "This matte is larger than what the graphics card draws: the service draws it while you move.");
      }
      painter = glass(gl, found, matte.monitor);
      if (source?.picture) painter.take(source.picture);
      const some = found.step > 1 ? `, one pixel in ${found.step ** 2} of it` : "";
      drawer.textContent = `This browser draws the glass while you move${some}; when you stop, the service does.`;
      if (source && playing()) moved();
    } catch (error) {
      fail(error);
    }
  }

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

  // The backdrop that was asked for last; what is slower to come is let go of.
  let choice = 0;
  async function use(making) {
    const mine = (choice += 1);
    try {
      const made = await making;
      if (mine !== choice || signal.aborted) return made.close?.();
      source?.close?.();
      source = made;
      video.choose(made.clip);
      play.hidden = !made.moving;
      play.textContent = "Hold it";
      problem.replaceChildren();
      if (drawn()) painter.take(made.picture);
      moved();
    } catch (error) {
      if (mine === choice) fail(error);
    }
  }
  const play = h("button", {
    type: "button", hidden: true,
    onclick: async () => {
      if (playing()) source.moving.pause();
      else await source.moving.play().catch(fail);
      play.textContent = playing() ? "Hold it" : "Let it go on";
      if (drawn()) painter.take(source.picture);
      moved();
    },
  }, "Hold it");
  const bring = ([one]) => {
    for (const choice of choices.querySelectorAll("input")) choice.checked = false;
    use(/^video\/|\.(mp4|mov|mkv|webm|avi)$/i.test(one.type || one.name) ? clip(one) : brought(one));
  };
  const live = h("label", { class: "choice" }, h("input", { type: "radio", name: "backdrop", onchange: () => use(camera()) }), "Camera");
  const choices = h("fieldset", { class: "row" }, h("legend", {}, "Backdrop"), NAMES.map((name, i) =>
    h("label", { class: "choice" }, h("input", { type: "radio", name: "backdrop", checked: i === 0, onchange: () => use(builtIn(name, matte.monitor)) }), name)), live);
  const file = h("input", { type: "file", id: "backdrop", accept: "image/*,.exr,.tif,.tiff,video/*" });
  file.onchange = () => {
    if (file.files.length) bring(file.files);
    file.value = "";
  };
  onDrop(stage, bring);
  addEventListener("paste", ({ clipboardData }) => clipboardData?.files.length && bring(clipboardData.files), { signal });

  const download = (kind, accept) => button(kind, problem, async () =>
    saveBlob(await (await composite(await source.exact(), accept === "image/jpeg" ? { quality: 95 } : {}, accept)).blob(), `composite.${kind.toLowerCase()}`));
  const video = clips(matte, () => at, signal);
  set({}, true);
  prepare();
  use(builtIn(NAMES[0], matte.monitor));
  return [
    h("section", { class: "panel composite", "aria-label": "Compositing" },
      h("div", {}, stage, h("p", { class: "hint" }, "Drag the picture to move the backdrop; then scroll, or pinch, to scale it."), status, drawer, problem),
      h("div", { class: "stack" }, choices,
        h("div", { class: "drop small" }, h("label", { for: "backdrop" }, h("strong", {}, "Your own picture or clip"), " drop, paste or choose it",
          h("span", { class: "hint" }, "PNG, JPEG, TIFF, EXR or a video")), file),
        h("div", { class: "sliders" }, CONTROLS.map(([name, label]) =>
          [h("label", { for: `place-${name}` }, label), sliders[name].input, sliders[name].told])),
        h("p", { class: "row" }, reset, play),
        h("div", { class: "row" }, h("span", {}, "Download it as"), download("PNG", "image/png"), download("JPEG", "image/jpeg"), download("EXR", "image/x-exr")),
        video.element)),
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
