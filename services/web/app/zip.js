// A ZIP of files that are stored as they are (APPNOTE, sect. 4.3), put together without being read into memory.
import { Problem } from "./api.js";

const PIECE = 4 << 20; // bytes that are summed at once
const MOST = 2 ** 32 - 2 ** 16; // bytes of a file: more takes the 64-bit extension
const SIGNATURES = { local: 0x04034b50, central: 0x02014b50, end: 0x06054b50 };
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
  const view = new DataView(new ArrayBuffer(4 + fields.reduce((sum, [bytes]) => sum + bytes, 0)));
  let at = 4;
  view.setUint32(0, signature, true);
  for (const [bytes, value] of fields) {
    if (bytes === 2) view.setUint16(at, value, true);
    else view.setUint32(at, value, true);
    at += bytes;
  }
  return view.buffer;
}

// `files` are pairs of a name, of ASCII, and a Blob.
export async function zip(files, signal) {
  const parts = [];
  const directory = [];
  let at = 0;
  for (const [name, blob] of files) {
    if (at + blob.size > MOST) {
      throw new Problem({ status: 413, title: "Too large", detail: "The film has more than 4 GB: make it smaller, or put it into a ZIP with its capture.json by another tool." });
    }
    const about = [[2, 0], [2, 0], [2, 0], [2, FIRST_DAY], [4, await crc32(blob, signal)], [4, blob.size], [4, blob.size], [2, name.length], [2, 0]];
    const head = record(SIGNATURES.local, [2, 20], ...about);
    parts.push(head, name, blob);
    directory.push(record(SIGNATURES.central, [2, 20], [2, 20], ...about, [2, 0], [2, 0], [2, 0], [4, 0], [4, at]), name);
    at += head.byteLength + name.length + blob.size;
  }
  const size = new Blob(directory).size;
  const end = record(SIGNATURES.end, [2, 0], [2, 0], [2, files.length], [2, files.length], [4, size], [4, at], [2, 0]);
  return new Blob([...parts, ...directory, end], { type: "application/zip" });
}
