// The views that record a film, by their signals. A change is a `recording` event of the window; leaving asks first.
export const recordings = new Set();
addEventListener("beforeunload", (event) => recordings.size && event.preventDefault());

export function setRecording(signal, isRecording) {
	if (isRecording) recordings.add(signal);
	else recordings.delete(signal);
	dispatchEvent(new Event("recording"));
}
