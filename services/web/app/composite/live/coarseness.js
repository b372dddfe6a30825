// How many fewer pixels to draw so that the picture keeps up with the hand.

const SLOW = 45; // ms between pictures above which fewer pixels are drawn
const SHORTEST = 240; // pixels of the shorter side that are drawn at least

export class Coarseness {
	level = 0; // one pixel of 4 ** level is drawn
	#intervals = []; // ms between the last pictures of a movement
	#paintedAt;
	#rested = true; // whether the movement before has ended
	#coarsest;

	// `shorter` is the shorter side of the picture, in pixels.
	constructor(shorter) {
		this.#coarsest = Math.max(0, Math.floor(Math.log2(shorter / SHORTEST)));
	}

	// Notes that a picture is painted at a time; returns the level to paint it with.
	next(now) {
		if (!this.#rested) this.#intervals = [...this.#intervals.slice(-3), now - this.#paintedAt];
		else if (this.level) [this.level, this.#intervals] = [this.level - 1, []]; // the device may have been busy only then
		[this.#paintedAt, this.#rested] = [now, false];
		if (this.#intervals.length === 4 && Math.min(...this.#intervals) > SLOW && this.level < this.#coarsest) {
			this.level += 1;
			this.#intervals = [];
		}
		return this.level;
	}
	rest() {
		this.#rested = true;
	}
}
