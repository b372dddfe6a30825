// Loads a matte for the graphics card from the service.
import { ask } from "../lib/api.js";
import { decodeLive } from "./live_form.js";

export async function fetchLive(id, signal) {
	return decodeLive(await (await ask(`v1/mattes/${id}/live`, { signal })).arrayBuffer());
}
