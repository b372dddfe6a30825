// Reads the number and size of an archive's frames, so that the service can refuse them before they are sent.
const END = 0x06054b50; // signatures of APPNOTE, sect. 4.3
const ENTRY = 0x02014b50;
const TAIL = 22 + 65535; // bytes in which the end of the directory begins
const FULL = 2 ** 32 - 1; // stands for a 64-bit number that is stored elsewhere
const MANIFEST = "capture.json";
const MOST = 8 << 20; // bytes of that file
const HEAD = 1 << 16; // bytes of an image that contain its size
const PNG = 0x89504e47; // first bytes of images
const JPEG = 0xffd8;

const view = async (blob) => new DataView(await blob.arrayBuffer());

// The entries of a ZIP by name; none of a ZIP64 archive.
async function entries(file) {
	const tail = await view(file.slice(-TAIL));
	let at = tail.byteLength - 22;
	while (tail.getUint32(at, true) !== END) at -= 1;
	const start = tail.getUint32(at + 16, true);
	if (start === FULL) return {};
	const directory = await view(file.slice(start, start + tail.getUint32(at + 12, true)));
	const found = {};
	for (let n = 0; n < directory.byteLength && directory.getUint32(n, true) === ENTRY; ) {
		const [name, extra, comment] = [28, 30, 32].map((field) => directory.getUint16(n + field, true));
		const text = new TextDecoder().decode(new Uint8Array(directory.buffer, n + 46, name));
		found[text] = { method: directory.getUint16(n + 10, true), size: directory.getUint32(n + 20, true), at: directory.getUint32(n + 42, true) };
		n += 46 + name + extra + comment;
	}
	return found;
}

async function read(file, { method, size, at }) {
	const head = await view(file.slice(at, at + 30));
	const start = at + 30 + head.getUint16(26, true) + head.getUint16(28, true);
	const packed = file.slice(start, start + size);
	return method ? new Response(packed.stream().pipeThrough(new DecompressionStream("deflate-raw"))).blob() : packed;
}

const patterns = ({ levels, colours, files, count }) => (levels ?? colours ?? files)?.length ?? count;
export const countPatterns = ({ parts }) => parts.reduce((sum, part) => sum + patterns(part), 0);

// The size of a PNG or JPEG (ITU-T T.81, table B.1) from its first bytes.
function sizeOf(head) {
	if (head.getUint32(0) === PNG) return { width: head.getUint32(16), height: head.getUint32(20) };
	if (head.getUint16(0) !== JPEG) return {};
	let at = 2;
	while ((head.getUint8(at + 1) & 0xf0) !== 0xc0 || [0xc4, 0xc8, 0xcc].includes(head.getUint8(at + 1))) at += 2 + head.getUint16(at + 2);
	return { width: head.getUint16(at + 7), height: head.getUint16(at + 5) };
}

// `frames`, and `width` and `height` of the first if it is PNG or JPEG. What cannot be read is left out.
export async function readArchiveInfo(file) {
	const info = {};
	try {
		const found = await entries(file);
		if (found[MANIFEST].size > MOST) return info;
		const manifest = JSON.parse(await (await read(file, found[MANIFEST])).text());
		info.frames = manifest.frames?.length || countPatterns(manifest.program);
		if (manifest.frames?.length) {
			const image = await read(file, found[manifest.frames[0].file]);
			Object.assign(info, sizeOf(await view(image.slice(0, HEAD))));
		}
	} catch {}
	return info;
}
