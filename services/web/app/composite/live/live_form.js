// Decodes a matte for the graphics card. `workflows/composite/live/encode.py` encodes it and describes the format.

const PLANES = 8; // of a lookup
const SPARED = 0.01; // share of the light: the finest levels of the backdrop are left out if they hold no more than this

export function decodeLive(buffer) {
	const start = 4 + new DataView(buffer).getUint32(0, true);
	const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, start - 4)));
	const { width, height } = header;
	const pixels = width * height;
	const light = new Float64Array(16); // what is looked up in each level
	const plane = (k) => new Uint8Array(buffer, start + k * pixels, pixels);
	const lookups = Array.from({ length: header.lookups }, (_, k) => {
		const [xHigh, xLow, yHigh, yLow, level, red, green, blue] = Array.from({ length: PLANES }, (_, n) => plane(PLANES * k + n));
		const layer = new Uint16Array(4 * pixels);
		let [x, y] = [0, 0];
		for (let i = 0; i < pixels; i++) {
			if (i % width === 0) x = y = 0;
			x = (x + 256 * xHigh[i] + xLow[i]) & 0xffff;
			y = (y + 256 * yHigh[i] + yLow[i]) & 0xffff;
			layer[4 * i] = x;
			layer[4 * i + 1] = y;
			layer[4 * i + 2] = 256 * level[i] + red[i];
			layer[4 * i + 3] = 256 * green[i] + blue[i];
			light[level[i] >> 4] += red[i] + green[i] + blue[i];
		}
		return layer;
	});
	const all = light.reduce((sum, one) => sum + one, 0);
	let finest = 0;
	for (let spared = light[0]; spared <= SPARED * all && finest < header.levels.length - 1; spared += light[finest]) finest++;
	const first = PLANES * header.lookups;
	const together = (...planes) => {
		const frame = new Uint8Array(4 * pixels);
		planes.forEach((values, c) => values.forEach((value, i) => (frame[4 * i + c] = value)));
		return frame;
	};
	return {
		...header, lookups, finest, isMasked: plane(first + 6).some((alpha) => alpha < 255),
		offset: together(plane(first), plane(first + 1), plane(first + 2), plane(first + 6)),
		absorption: together(plane(first + 3), plane(first + 4), plane(first + 5)),
	};
}
