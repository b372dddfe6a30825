// Makes a ZIP of uncompressed files (APPNOTE, sect. 4.3) without reading them into memory.
const PIECE = 4 << 20; // bytes summed at a time
const FULL = 2 ** 32 - 1; // stands for a number that is in the ZIP64 extension
const SHORT = 20; // version needed to read an entry, in tenths
const LONG = 45; // version needed to read a ZIP64 entry
const SIGNATURES = { local: 0x04034b50, central: 0x02014b50, end: 0x06054b50, end64: 0x06064b50, locator: 0x07064b50 };
const FIRST_DAY = 0x21; // 1 January 1980: the same files make the same bytes

const TABLE = Uint32Array.from({ length: 256 }, (_, n) => {
	for (let bit = 0; bit < 8; bit++) n = n & 1 ? 0xedb88320 ^ (n >>> 1) : n >>> 1;
	return n;
});

export async function crc32(blob, signal) {
	let sum = -1;
	for (let at = 0; at < blob.size; at += PIECE) {
		signal?.throwIfAborted();
		for (const byte of new Uint8Array(await blob.slice(at, at + PIECE).arrayBuffer())) sum = TABLE[(sum ^ byte) & 255] ^ (sum >>> 8);
	}
	return ~sum >>> 0;
}

function record(signature, ...fields) {
	const view = new DataView(new ArrayBuffer(4 + sum(fields)));
	view.setUint32(0, signature, true);
	write(view, 4, fields);
	return view.buffer;
}

const sum = (fields) => fields.reduce((all, [bytes]) => all + bytes, 0);

function write(view, at, fields) {
	for (const [bytes, value] of fields) {
		if (bytes === 2) view.setUint16(at, value, true);
		else if (bytes === 4) view.setUint32(at, Math.min(value, FULL), true);
		else view.setBigUint64(at, BigInt(value), true);
		at += bytes;
	}
}

// The ZIP64 extension with the numbers that need more than 32 bits (APPNOTE, sect. 4.5.3).
function extension(...values) {
	const long = values.filter((value) => value >= FULL).map((value) => [8, value]);
	const fields = [[2, 1], [2, sum(long)], ...long];
	const view = new DataView(new ArrayBuffer(long.length ? sum(fields) : 0));
	if (long.length) write(view, 0, fields);
	return view.buffer;
}

// The headers before each file, and the directory after the last. Files have `name` (ASCII), `size`, `crc`.
export function framed(files) {
	const heads = [];
	const directory = [];
	let at = 0;
	for (const { name, size, crc } of files) {
		const [local, central] = [extension(size, size), extension(size, size, at)];
		const version = (more) => [2, more.byteLength ? LONG : SHORT];
		const about = (more) => [version(more), [2, 0], [2, 0], [2, 0], [2, FIRST_DAY], [4, crc], [4, size], [4, size], [2, name.length], [2, more.byteLength]];
		const head = new Blob([record(SIGNATURES.local, ...about(local)), name, local]);
		directory.push(record(SIGNATURES.central, version(central), ...about(central), [2, 0], [2, 0], [2, 0], [4, 0], [4, at]), name, central);
		heads.push(head);
		at += head.size + size;
	}
	const { size } = new Blob(directory);
	const count = files.length;
	if (at >= FULL) {
		directory.push(record(SIGNATURES.end64, [8, 44], [2, LONG], [2, LONG], [4, 0], [4, 0], [8, count], [8, count], [8, size], [8, at]));
		directory.push(record(SIGNATURES.locator, [4, 0], [8, at + size], [4, 1]));
	}
	const end = record(SIGNATURES.end, [2, 0], [2, 0], [2, count], [2, count], [4, size], [4, at], [2, 0]);
	return { heads, end: new Blob([...directory, end]) };
}

export async function zip(files, signal) {
	const entries = [];
	for (const [name, blob] of files) entries.push({ name, size: blob.size, crc: await crc32(blob, signal) });
	const { heads, end } = framed(entries);
	return new Blob([...files.flatMap(([, blob], n) => [heads[n], blob]), end], { type: "application/zip" });
}
