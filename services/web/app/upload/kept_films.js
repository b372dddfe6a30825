// Films of this page by the captures that they became, and those that were recorded here also in IndexedDB until their
// captures are ready, so that a reload does not lose them.

const STORE = "films";
const DAY = 86_400_000; // ms that an uploaded film stays, in case that it cannot be read and has to be saved
const here = new Map();
let opened;

const settled = (request) => new Promise((resolve, reject) => {
	request.onsuccess = () => resolve(request.result);
	request.onerror = () => reject(request.error);
});

function open() {
	const request = indexedDB.open("envmatte", 1);
	request.onupgradeneeded = () => request.result.createObjectStore(STORE, { keyPath: "id" });
	return settled(request);
}

async function store(mode, work) {
	opened ??= open();
	return settled(work((await opened).transaction(STORE, mode).objectStore(STORE)));
}

// Holds a film for as long as this page is open; false if another page holds it, and asks what to do with it.
const hold = ({ id }) => new Promise((resolve) => {
	navigator.locks.request(`envmatte-film-${id}`, { ifAvailable: true }, (lock) => {
		resolve(Boolean(lock));
		return lock && new Promise(() => {});
	});
});

// Keeps a film `{id, at, file, record, again, warning}`: when it was recorded, its capture.json, the view where it was
// filmed, and what is wrong with it. Resolves with whether this browser keeps it.
export const keepFilm = (film) => Promise.all([store("readwrite", (films) => films.put(film)), hold(film)])
	.then(() => true, () => false); // there is no room, or nothing may be stored

export const forgetFilm = (id) => store("readwrite", (films) => films.delete(id)).catch(() => {});

export const allFilms = () => store("readonly", (films) => films.getAll()).catch(() => []);

// The films that are not uploaded yet, and that no other page holds.
export async function waitingFilms() {
	if (!navigator.locks) return []; // pages that may not record either
	const waiting = [];
	for (const film of await allFilms()) {
		if (film.capture) {
			if (Date.now() - film.at > DAY) forgetFilm(film.id);
		} else if (await hold(film)) waiting.push(film);
	}
	return waiting;
}

// Notes which capture a film has become.
export async function noteCapture(film, capture) {
	here.set(capture, film);
	if (film.id) await store("readwrite", (films) => films.put({ ...film, capture })).catch(() => {});
}

// The film that a capture was made of, if this browser has it.
export const filmOf = async (capture) => here.get(capture) ?? (await allFilms()).find((film) => film.capture === capture);

export async function forgetFilmOf(capture) {
	const film = await filmOf(capture);
	here.delete(capture);
	if (film?.id) await forgetFilm(film.id);
}
