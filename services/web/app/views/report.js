// What the report of a capture comes to, in words.
import { getJson } from "../lib/api.js";
import { badge, h } from "../lib/dom.js";
import { t } from "../lib/words.js";

const GRADES = [[40, "excellent"], [30, "good"], [22, "fair"], [-Infinity, "poor"]]; // from so many dB on

export function verdictOf({ level, quality }) {
	// Random grids without offsets suit frosted glass, all others clear glass.
	const clear = quality && (quality.blocks == null ? quality.high : quality.low);
	const [, grade] = quality ? GRADES.find(([least]) => clear >= least) : [];
	return t(`verdict.${level}`) + (grade ? t(`verdict.${level === "good" ? "expect" : "best"}`, { grade: t(`grade.${grade}`) }) : "");
}

// Leads to the report of a capture and says what it comes to; null if there is none.
export async function reportLink(capture, signal) {
	const report = capture && (await getJson(`v1/captures/${capture}/report`, signal).catch(() => null));
	return report && h("a", { href: `#/captures/${capture}` }, verdictOf(report), report.level !== "good" && [" ", badge(report.level)]);
}
