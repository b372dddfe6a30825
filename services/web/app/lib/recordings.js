// Cameras, and what they record.
import { Problem } from "./api.js";
import { known, t } from "./words.js";

// The views that record a film, by their signals. A change is a `recording` event of the window; leaving asks first.
export const recordings = new Set();
addEventListener("beforeunload", (event) => recordings.size && event.preventDefault());

export function setRecording(signal, isRecording) {
	if (isRecording) recordings.add(signal);
	else recordings.delete(signal);
	dispatchEvent(new Event("recording"));
}

const TYPES = ["video/mp4;codecs=avc1.640034", "video/mp4;codecs=avc1.42E034", "video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm"];

// The best type of video that this browser records.
export const videoType = () => TYPES.find((one) => MediaRecorder.isTypeSupported(one));

// Opens a camera that comes closest to the constraints of a video.
export async function openCamera(video) {
	try {
		return await navigator.mediaDevices.getUserMedia({ video });
	} catch ({ name }) {
		throw new Problem({ title: t("camera.failed"), detail: known(`camera.${name}`, t("camera.other", { name })) });
	}
}
