// The samples that come with the app: glass that was traced, filmed and recovered by `workflows/simulation/samples.py`.
import { Problem, received } from "../lib/api.js";
import { decodeLive } from "../composite/live/live_form.js";
import { known, t } from "../lib/words.js";

const FOLDER = "web/samples/";
const REMOVED = "envmatte-samples-removed"; // in this browser's storage

export const areRemoved = () => localStorage.getItem(REMOVED) !== null;
export const removeSamples = () => localStorage.setItem(REMOVED, "");
export const restoreSamples = () => localStorage.removeItem(REMOVED);

export const titleOf = ({ name, title }) => known(`sample.${name}`, title);
export const aboutOf = ({ name, about }) => known(`sample.${name}.about`, about);
export const pictureOf = ({ name }) => `${FOLDER}${name}.webp`;

// Fetches a file of the app itself, which needs no key.
async function fetchFile(name, signal) {
	const answer = await received(fetch(FOLDER + name, { signal }), signal);
	if (!answer.ok) throw new Problem({ title: t("sample.missing"), detail: t("sample.file", { name }), status: answer.status });
	return answer;
}

export const fetchSamples = async (signal) => (await fetchFile("samples.json", signal)).json();

export async function fetchSample({ name }, signal) {
	const { body } = await fetchFile(`${name}.live`, signal);
	return decodeLive(await received(new Response(body.pipeThrough(new DecompressionStream("gzip"))).arrayBuffer(), signal));
}

export async function fetchCapture(signal) {
	return new File([await received((await fetchFile("capture.zip", signal)).blob(), signal)], "sample-tumbler.zip", { type: "application/zip" });
}
