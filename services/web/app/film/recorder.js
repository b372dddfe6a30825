// The camera of this device, and a film by it.
import { h, pause, said } from "../lib/dom.js";

const TYPES = ["video/mp4;codecs=avc1.640034", "video/mp4;codecs=avc1.42E034", "video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm"];
const BITS = 40e6; // a second: a codec that saves takes decibels off the matte
const LOCKED = { exposureMode: "exposure", whiteBalanceMode: "white balance", focusMode: "focus" };
const AFTER = 1000; // ms that the film goes on after the program

// Why there is none, in words; null where there is one.
export function noCamera() {
  if (!isSecureContext) return "Browsers give their camera to pages by https, or of this very device, alone: film with the camera’s own app, and choose the film here.";
  if (!navigator.mediaDevices?.getUserMedia || !window.MediaRecorder) return "This browser records no films: use the camera’s own app, and choose the film here.";
  return null;
}

// The views, by their signals, in which a film is being taken; what changes here is told as an event of the window.
export const taking = new Set();
addEventListener("beforeunload", (event) => taking.size && event.preventDefault());

// A panel to film with; `filmed(file, whole)` is called with every film, `again` when the panel is back in the page.
export function camera(signal, filmed) {
  const picture = h("video", { muted: true, playsinline: true, "aria-label": "What the camera sees" });
  const frame = h("div", { class: "picture", hidden: true }, picture);
  const told = h("p", { class: "hint", role: "status" });
  const problem = h("div");
  const which = h("select", { "aria-label": "Camera", hidden: true });
  const open = h("button", { type: "button", onclick: () => use() }, "Use a camera of this device");
  const shoot = h("button", { type: "button", class: "primary", hidden: true, onclick: () => (recorder ? stop() : start()) }, "Start filming");
  let stream;
  let recorder;
  let whole; // whether it was stopped, and did not break off

  async function use(deviceId) {
    problem.replaceChildren();
    open.disabled = true;
    try {
      close();
      const wanted = { width: { ideal: 1920 }, height: { ideal: 1080 }, frameRate: { ideal: 30 } };
      stream = await navigator.mediaDevices.getUserMedia({ audio: false, video: deviceId ? { ...wanted, deviceId: { exact: deviceId } } : { ...wanted, facingMode: "environment" } });
      if (signal.aborted) return close();
      picture.srcObject = stream;
      frame.hidden = which.hidden = shoot.hidden = false;
      open.hidden = true;
      const { width, height, deviceId: used } = stream.getVideoTracks()[0].getSettings();
      picture.style.aspectRatio = `${width} / ${height}`;
      const cameras = (await navigator.mediaDevices.enumerateDevices()).filter(({ kind }) => kind === "videoinput");
      which.replaceChildren(...cameras.map(({ deviceId: id, label }, n) => h("option", { value: id, selected: id === used }, label || `Camera ${n + 1}`)));
      told.textContent = `${width} × ${height} pixels. It starts and stops by itself with the program.`;
      await picture.play();
    } catch (error) {
      const detail = error.name === "NotAllowedError" ? "Allow it in the browser’s bar, and try again." : error.message;
      if (!signal.aborted) problem.replaceChildren(said({ title: "The camera can’t be used", detail }));
    } finally {
      open.disabled = false;
    }
  }
  which.onchange = () => use(which.value);

  // What the camera has set by itself so far stays: what it changes meanwhile would be taken for light.
  async function lock(track) {
    const can = track.getCapabilities?.() ?? {};
    const free = [];
    for (const [mode, name] of Object.entries(LOCKED)) {
      if (!can[mode]?.includes("manual")) free.push(name);
      else await track.applyConstraints({ advanced: [{ [mode]: "manual" }] }).catch(() => free.push(name));
    }
    return free;
  }

  const tell = (change) => {
    taking[change](signal);
    dispatchEvent(new Event("taking"));
  };

  async function start() {
    if (!stream || recorder) return;
    const type = TYPES.find((one) => MediaRecorder.isTypeSupported(one));
    const parts = [];
    const mine = (recorder = new MediaRecorder(stream, { mimeType: type, videoBitsPerSecond: BITS }));
    mine.ondataavailable = ({ data }) => parts.push(data);
    mine.onstop = () => {
      recorder = undefined;
      shoot.textContent = "Start filming";
      which.disabled = false;
      told.textContent = "Filmed.";
      const [kind] = mine.mimeType.split(";");
      filmed(new File(parts, `film.${kind.endsWith("mp4") ? "mp4" : "webm"}`, { type: kind }), whole);
      tell("delete");
    };
    whole = false;
    mine.start(1000);
    tell("add");
    shoot.textContent = "Stop filming";
    which.disabled = true;
    const free = await lock(stream.getVideoTracks()[0]);
    told.textContent = free.length ? `Filming. The browser can’t lock ${free.join(", ")} of this camera: see that nothing changes.` : "Filming.";
  }

  async function stop(ended = true) {
    if (recorder?.state !== "recording") return;
    await pause(AFTER, signal).catch(() => {});
    if (recorder?.state !== "recording") return;
    whole = ended;
    recorder.stop();
  }

  function close() {
    stream?.getTracks().forEach((track) => track.stop());
    stream = undefined;
  }
  signal.addEventListener("abort", close, { once: true });
  const panel = h("div", { class: "stack" }, h("div", { class: "row" }, open, which, shoot), frame, told, problem);
  const again = () => picture.play().catch(() => {}); // it stands still out of the page, unlike the film
  return { panel, start, stop, again };
}
