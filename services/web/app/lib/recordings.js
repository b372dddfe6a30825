// The views in which a film is being recorded, by their signals. A change is announced as a `recording` event of the
// window, and leaving the page asks first.
export const recordings = new Set();
addEventListener("beforeunload", (event) => recordings.size && event.preventDefault());

export function setRecording(signal, isRecording) {
	if (isRecording) recordings.add(signal);
	else recordings.delete(signal);
	dispatchEvent(new Event("recording"));
}
