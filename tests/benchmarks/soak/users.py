"""Actions of people and machines on a service, including mistakes; each function is one action."""

import io
import time
from collections.abc import Sequence
from typing import Any

import httpx2

from tests.benchmarks.service.traffic import CHUNK, TUS, VIDEO, ZIP, User
from tests.end_to_end.captures import broken_archives as broken

OPTIONS: Sequence[dict[str, Any]] = (
    {"quality": "fast"},
    {"quality": "fast", "tile": 16},
    {},
    {"method": "nn-dgsr", "prior": "none"},
)
REFUSED = (
    broken.no_manifest,
    broken.other_format,
    broken.frame_not_there,
    broken.pattern_without_frame,
    broken.one_level,
    broken.path_outside_the_archive,
    broken.monitor_of_width_zero,
    broken.program_too_large,
)
FAILING = (broken.frame_that_is_no_image, broken.frame_that_is_a_bomb)


def film(user: User) -> None:
    """Upload a capture in one of several ways, recover its matte, and perhaps delete them."""
    random, traffic = user.random, user.traffic
    way = random.choice(("one body", "pieces", "client"))
    if way == "one body":
        key = {"Idempotency-Key": f"{random.random()}"}
        made = [
            user.ask(
                "upload in one go", "POST", "/v1/captures", content=traffic.capture_archive, headers=ZIP | key
            )
            for _ in range(random.randint(1, 2))
        ][-1].json()
    elif way == "pieces":
        body = {
            "upload": user.upload(traffic.capture_archive, filename="ball.zip"),
            "webhook": traffic.webhook,
        }
        made = user.ask("upload in pieces", "POST", "/v1/captures", json=body).json()
    else:
        file = traffic.folder / f"{random.random()}.zip"
        file.write_bytes(traffic.capture_archive)
        made = user.client.upload(file, name="by the client").answer
        file.unlink()
        traffic.done["upload by the client"] += 1
    if random.random() < 0.5:
        user.ended(made["job"])
    extra = {"webhook": traffic.webhook} if random.random() < 0.5 else {}
    body = {"capture": made["id"], "options": random.choice(OPTIONS)} | extra
    answer = user.ask(
        "recover", "POST", "/v1/jobs", json=body, headers={"Idempotency-Key": f"{random.random()}"}
    )
    if answer.status_code != 202:
        return
    job = answer.json()
    traffic.captures.append(made["id"])
    if random.random() < 0.5:
        user.followed(job["id"])
    if user.ended(job["id"]).get("state") == "succeeded":
        traffic.mattes.append(job["matte"])
    for path, chance in (
        ("captures/" + made["id"], 0.2),
        ("mattes/" + job["matte"], 0.1),
        ("jobs/" + job["id"], 0.1),
    ):
        if random.random() < chance:
            user.ask("delete", "DELETE", f"/v1/{path}")


def composite(user: User) -> None:
    """Look at a matte and composite it."""
    random, traffic = user.random, user.traffic
    matte = f"/v1/mattes/{user.pick(traffic.mattes)}"
    backdrop = random.choice(traffic.backdrops)
    kind = {"Accept": random.choice(("image/png", "image/jpeg", "image/x-exr"))}

    def still(what: str, **params: Any) -> httpx2.Response:
        return user.ask(what, "POST", f"{matte}/composite", params=params, content=backdrop, headers=kind)

    def again() -> None:
        tag = still("composite").headers.get("etag")
        if tag:
            known = kind | {"If-None-Match": tag}
            user.ask(
                "ask again for a composite",
                "POST",
                f"{matte}/composite",
                412,
                content=backdrop,
                headers=known,
            )

    def move() -> None:
        video = VIDEO | {"Idempotency-Key": f"{random.random()}"}
        answer = user.ask(
            "composite a clip", "POST", f"{matte}/composite", content=traffic.clip, headers=video
        )
        if answer.status_code == 202:
            job = answer.json()["id"]
            if user.ended(job).get("state") == "succeeded":
                user.ask("fetch a video", "GET", f"/v1/jobs/{job}/video.mp4")
                part = {"Range": "bytes=10-99"}
                user.ask("fetch a part of a video", "GET", f"/v1/jobs/{job}/video.mp4", 206, headers=part)
            if random.random() < 0.3:
                user.ask("delete", "DELETE", f"/v1/jobs/{job}")

    def carry() -> None:
        try:
            archive = user.ask("fetch an archive", "GET", f"{matte}/archive")
        except httpx2.RemoteProtocolError:  # the matte was deleted meanwhile
            return
        if archive.status_code == 200:
            key = ZIP | {"Idempotency-Key": f"{random.random()}"}
            imported = user.ask(
                "bring an archive", "POST", "/v1/mattes", content=archive.content, headers=key
            )
            traffic.mattes.append(imported.json()["id"])
            user.ask("bring an archive again", "POST", "/v1/mattes", content=archive.content, headers=key)

    def look() -> None:
        names = ("S.png", "rho.exr", "alpha.png", "confidence.png", "stmap.exr", "all.exr")
        user.ask("fetch a layer", "GET", f"{matte}/layers/{random.choice(names)}")
        user.ask("fetch for WebGL", "GET", f"{matte}/live")
        at = {"x": random.randrange(36), "y": random.randrange(24)}
        user.ask("ask for a pixel's transport", "GET", f"{matte}/transport", params=at)
        user.ask("draw a pixel's transport", "GET", f"{matte}/transport.png", params=at)

    crop = {"x": 5, "y": 4, "width": 20, "height": 10, "size": 12}
    moved = {"right": 0.2, "scale": 1.5, "angle": 30}
    random.choice(
        (
            lambda: still("composite a crop", **crop),
            lambda: still("composite moved", **moved),
            again,
            move,
            carry,
            look,
        )
    )()


def change_mind(user: User) -> None:
    """Cancel jobs that are ingesting, queued or running."""
    random, traffic = user.random, user.traffic

    def ingest() -> None:
        made = user.ask(
            "upload in one go", "POST", "/v1/captures", content=traffic.capture_archive, headers=ZIP
        ).json()
        user.ask("cancel an ingest", "POST", f"/v1/jobs/{made['job']}/cancel")
        user.ask("delete", "DELETE", f"/v1/captures/{made['id']}")

    def queued() -> None:
        jobs = [recover() for _ in range(4)]
        for job in jobs[::-1]:
            user.ask("cancel in the queue", "POST", f"/v1/jobs/{job}/cancel")
        user.ask("retry what was cancelled", "POST", f"/v1/jobs/{jobs[0]}/retry")

    def running() -> None:
        job = recover({"method": "nn-dgsr"})
        while user.ask("poll", "GET", f"/v1/jobs/{job}").json().get("state") == "queued":
            time.sleep(0.1)
        user.ask("cancel while it runs", "POST", f"/v1/jobs/{job}/cancel")

    def recover(options: dict[str, Any] | None = None) -> str:
        body = {"capture": user.pick(traffic.captures), "options": options or {}, "webhook": traffic.webhook}
        return str(user.ask("recover", "POST", "/v1/jobs", json=body).json().get("id", "none"))

    if traffic.gentle:  # a cancelled task that keeps running ends its worker
        user.ended(recover())
    else:
        random.choice((ingest, queued, running))()


def disconnect(user: User) -> None:
    """Break connections, and leave uploads unfinished."""
    random, traffic = user.random, user.traffic
    half = traffic.capture_archive[: len(traffic.capture_archive) // 2]
    size = {"Content-Length": str(len(traffic.capture_archive))}

    def piece() -> None:
        create = TUS | {"Upload-Length": str(len(traffic.capture_archive))}
        where = user.ask("create an upload", "POST", "/v1/uploads", headers=create).headers["location"]
        user.disconnect(
            "disconnect during a piece", "PATCH", where, CHUNK | size | {"Upload-Offset": "0"}, half
        )
        if random.random() < 0.3:
            user.ask("delete an upload", "DELETE", where, headers=TUS)

    def whole() -> None:
        user.disconnect("disconnect during an upload", "POST", "/v1/captures", ZIP | size, half)

    def archive() -> None:
        user.disconnect("disconnect during an archive", "POST", "/v1/mattes", ZIP | size, half)

    def video() -> None:
        path = f"/v1/mattes/{user.pick(traffic.mattes)}/composite"
        user.disconnect(
            "disconnect during a clip", "POST", path, VIDEO | {"Content-Length": "99999"}, traffic.clip[:900]
        )

    def head() -> None:
        user.disconnect("disconnect during a head", "GET", "/v1/jobs", {"X-Half": "a"}, b"X-")

    def download() -> None:
        path = f"/v1/mattes/{user.pick(traffic.mattes)}/archive"
        user.disconnect("disconnect during a download", "GET", path, {}, b"")

    random.choice((piece, piece, whole, archive, video, head, download))()


def mistake(user: User) -> None:
    """Send invalid data."""
    random, traffic = user.random, user.traffic

    def capture() -> None:
        data = broken.changed_archive(io.BytesIO(traffic.capture_archive), random.choice(REFUSED))
        user.ask("send a wrong capture", "POST", "/v1/captures", 422, content=data, headers=ZIP)

    def frame() -> None:
        data = broken.changed_archive(io.BytesIO(traffic.capture_archive), random.choice(FAILING))
        made = user.ask("send a wrong frame", "POST", "/v1/captures", content=data, headers=ZIP).json()
        user.ended(made["job"])

    def cut() -> None:
        data = traffic.capture_archive[: random.randrange(len(traffic.capture_archive))]
        if random.random() < 0.5:
            body = {"upload": user.upload(data)}
            user.ask("upload half a capture in pieces", "POST", "/v1/captures", 422, json=body)
        else:
            user.ask("send half a capture", "POST", "/v1/captures", 422, content=data, headers=ZIP)

    def checksum() -> None:
        create = TUS | {"Upload-Length": "10"}
        where = user.ask("create an upload", "POST", "/v1/uploads", headers=create).headers["location"]
        piece = CHUNK | {"Upload-Offset": "0", "Upload-Checksum": "sha1 AAAA"}
        user.ask("send a wrong piece", "PATCH", where, 460, headers=piece, content=b"12345")

    def options() -> None:
        body = {"capture": user.pick(traffic.captures), "options": {"speed": 11}}
        user.ask("ask for a wrong option", "POST", "/v1/jobs", 422, json=body)

    def backdrop() -> None:
        path = f"/v1/mattes/{user.pick(traffic.mattes)}/composite"
        user.ask("send a wrong backdrop", "POST", path, 422, content=b"no image at all")

    def video() -> None:
        path = f"/v1/mattes/{user.pick(traffic.mattes)}/composite"
        answer = user.ask("send a wrong clip", "POST", path, content=b"no clip" * 99, headers=VIDEO)
        if answer.status_code == 202:
            user.ended(answer.json()["id"])

    def others() -> None:
        user.ask("send a wrong archive", "POST", "/v1/mattes", 422, content=b"no archive", headers=ZIP)
        user.ask(
            "send another type", "POST", "/v1/captures", 415, content=b"x", headers={"Content-Type": "a/b"}
        )
        user.ask("ask for nothing there", "GET", "/v1/mattes/none")
        user.ask("send no JSON", "POST", "/v1/jobs", 422, content=b"{")
        user.ask("speak another tus", "POST", "/v1/uploads", 412, headers={"Upload-Length": "1"})

    random.choice((capture, frame, cut, checksum, options, backdrop, video, others))()


def watch(user: User) -> None:
    """Requests of a dashboard, a browser and Prometheus."""
    random, traffic = user.random, user.traffic

    def pages() -> None:
        for path in ("captures", "jobs", "mattes", "programs", "limits", "cluster", "options", "network"):
            user.ask("look around", "GET", f"/v1/{path}")
        for path in ("/metrics", "/healthz", "/", "/web/app/main.js", "/openapi.json"):
            user.ask("look around", "GET", path)
        user.ask("look around", "GET", "/readyz", 200, 503)  # while a killed worker is replaced

    def capture() -> None:
        at = f"/v1/captures/{user.pick(traffic.captures)}"
        for path in ("report", "contact-sheet.png", f"frames/{random.randrange(20)}.png"):
            user.ask("look at a capture", "GET", f"{at}/{path}")

    def events() -> None:
        for job in user.ask("look around", "GET", "/v1/jobs?limit=3").json()["jobs"]:
            user.followed(job["id"], limit=random.randrange(4))
            user.ask("read a log", "GET", f"/v1/jobs/{job['id']}/log")

    def program() -> None:
        monitor = {"width": random.randrange(200, 400), "height": random.randrange(150, 300)}
        body = {"preset": "sketch", "monitor": monitor}
        made = user.ask("make a program", "POST", "/v1/programs", json=body).json()["id"]
        at = f"/v1/programs/{made}"
        shown = {"phase": "shown", "patterns_per_second": 2}
        user.ask("show a program", "PUT", f"{at}/showing", json=shown)
        user.ask("fetch a pattern", "GET", f"{at}/patterns/{random.randrange(32)}.png")
        with user.http.stream("GET", f"{at}/events") as answer:
            user.note("follow a program", answer)
            next(answer.iter_lines())
        user.ask("delete", "DELETE", at)

    random.choice((pages, capture, events, program))()


ALL = (film, film, composite, composite, change_mind, disconnect, mistake, watch)
"""All actions."""
