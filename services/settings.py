"""The settings of the service: one object, built where a process starts and passed on.

Every setting is an environment variable ``ENVMATTE_…`` and a line in the file ``.env``; an option of the command line
wins. What only some settings need is imported where they are checked, so that `envmatte serve --help` is quick.
"""

import logging
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from services.runtime.addresses import is_loopback
from services.runtime.environment import DATA, PREFIX, database_url, read_environment, unknown_variables
from services.runtime.webhook_signature import signing_key
from storage.errors import InvalidInput
from workflows.untrusted.limits import MAX_FRAMES, Limits

if TYPE_CHECKING:
    from distributed.security import Security

logger = logging.getLogger(__name__)


def _setting(default: Any, description: str, *, unset: str = "", **constraints: Any) -> Any:
    """A field of a settings model.

    Parameters
    ----------
    default : object or callable
        The default, or what makes it of the fields before this one.
    unset : str
        What the default comes to, in words, where the value doesn't say it.
    **constraints
        As `pydantic.Field` takes them.
    """
    made = {"default_factory": default} if callable(default) else {"default": default}
    return Field(**made, description=description, json_schema_extra={"unset": unset}, **constraints)


LEAST_MEMORY = 300_000_000
"""Bytes that a worker needs: one that is idle has 150 MB and more, and was ended and started again without end."""


def _memory_per_worker(settings: dict[str, Any]) -> int:
    from distributed.system import MEMORY_LIMIT

    return max(int(MEMORY_LIMIT // settings["workers"]), LEAST_MEMORY)


class DataSettings(BaseModel):
    """The folder that every process of an installation starts from."""

    model_config = ConfigDict(frozen=True, defer_build=True)

    def __init__(self, **given: Any) -> None:
        super().__init__(**read_environment(type(self).model_fields) | given)

    data: Path = _setting(DATA, "Folder of the database and of everything stored.")


class SchedulerSettings(DataSettings):
    """The settings of `envmatte scheduler`."""

    certs: Path | None = _setting(
        None,
        "Folder of the cluster's certificates, made by `envmatte certs`.",
        unset="`certs` in the data folder, if it exists",
    )
    log: Literal["text", "json"] = _setting(
        "text", "Format of the logs on stderr: text, or json (one object per line)."
    )
    log_level: Literal["DEBUG", "INFO", "WARNING", "ERROR"] = _setting(
        "INFO", "Lowest level that is logged. DEBUG logs every tile."
    )

    @property
    def certificates(self) -> Path | None:
        """The folder of the certificates, or None if there is none."""
        default = self.data / "certs"
        return self.certs or (default if default.is_dir() else None)


class ClusterSettings(SchedulerSettings):
    """The settings of `envmatte worker`."""

    cluster: str | None = _setting(
        None,
        "Address of a dask scheduler: tls://HOST:PORT, or tcp://127.0.0.1:PORT on one machine.",
        unset="none: the service starts a cluster of its own",
    )
    workers: int = _setting(
        lambda: os.cpu_count() or 1,
        "Worker processes on this machine, one thread each.",
        unset="one per core",
        ge=1,
    )
    worker_memory: int = _setting(
        _memory_per_worker,
        "Bytes of memory a worker process may use before it is ended and started again, 300 MB at least; 0 sets no "
        "limit.",
        unset="the machine's memory divided by the workers",
        ge=0,
    )

    @field_validator("worker_memory")
    @classmethod
    def _check_worker_memory(cls, value: int) -> int:
        if 0 < value < LEAST_MEMORY:
            raise ValueError(
                f"must be {LEAST_MEMORY} bytes or more, or 0 for no limit: an idle worker has half of it"
            )
        return value

    @model_validator(mode="after")
    def _check_trusted(self) -> "ClusterSettings":
        """Allow TCP only on loopback, and TLS only with usable certificates."""
        if self.cluster is None:
            return self
        url = urlsplit(self.cluster)
        if url.scheme not in ("tcp", "tls") or not url.hostname or not _has_port(url.netloc):
            raise ValueError(f"cluster {self.cluster!r}: give it as tls://HOST:PORT, or tcp://127.0.0.1:PORT")
        if url.scheme == "tcp" and not is_loopback(url.hostname):
            raise ValueError(
                f"cluster {self.cluster}: plain TCP is allowed on loopback only, because anyone who reaches the "
                "scheduler can run arbitrary code on the cluster. Make certificates with `envmatte certs DIR`, give "
                f"every process of the cluster a copy with --certs, and use tls://{url.netloc}"
            )
        if url.scheme == "tls":
            try:
                self.security()
            except InvalidInput as error:
                raise ValueError(error.detail) from error
        return self

    def security(self) -> "Security | None":
        """The TLS configuration with which dask connects to the cluster; None for a cluster without TLS.

        Raises
        ------
        InvalidInput
            If the certificates can't be used.
        """
        if self.cluster is None or not self.cluster.startswith("tls://"):
            return None
        if self.certificates is None:
            raise InvalidInput(
                f"cluster {self.cluster} uses TLS, and there are no certificates: name the folder that "
                "`envmatte certs` made for it with --certs"
            )
        from services.runtime.certificates import security_of

        return security_of(self.certificates)


class CoordinatorSettings(ClusterSettings):
    """The settings of `envmatte coordinator`."""

    database: str | None = _setting(
        None,
        "URL of the database: postgresql://USER:PASSWORD@HOST/NAME or sqlite:////FILE.",
        unset="a SQLite file in the data folder",
    )
    store: str | None = _setting(
        None,
        "URL of the object store: s3://BUCKET/PREFIX or file:///FOLDER.",
        unset="a folder in the data folder",
    )
    attempts: int = _setting(3, "How often a tile is tried before its job fails.", ge=1)
    ingest_memory: int = _setting(
        512 << 20,
        "Bytes of frames a worker may hold while it ingests, for captures of any length. A single frame may take a "
        "quarter of it. Compression needs about 50 MB more.",
        ge=1 << 20,
    )
    unpacked_bytes: int = _setting(64 << 30, "Bytes that a capture archive may unpack to.", ge=1)
    capture_frames: int = _setting(
        MAX_FRAMES, "Frames, or patterns, of a capture, at most.", ge=1, le=MAX_FRAMES
    )
    capture_pixels: int = _setting(100_000_000, "Pixels of a frame, at most.", ge=1)
    job_seconds: int | None = _setting(
        None,
        "How long an ended job is kept, in seconds, with its log and, for a composite, its video. The job of a "
        "capture or a matte is kept at least as long as these.",
        unset="until it is deleted",
        ge=1,
    )
    webhook_secret: str | None = _setting(
        None,
        "Signs webhooks: whsec_ and a key in Base64, or any text of 16 characters or more.",
        unset="none: requests with a webhook are refused",
        min_length=16,
    )
    webhook_private: bool = _setting(
        False, "Whether webhooks may go to addresses that are not public, and without TLS."
    )

    @field_validator("webhook_secret")
    @classmethod
    def _check_webhook_secret(cls, value: str | None) -> str | None:
        if value is not None:
            signing_key(value)
        return value

    @field_validator("database")
    @classmethod
    def _check_database(cls, value: str | None) -> str | None:
        if value is not None:
            from storage.database.dialects import parse_url

            parse_url(value)
        return value

    @field_validator("store")
    @classmethod
    def _check_store(cls, value: str | None) -> str | None:
        url = urlsplit(value or "file:///")
        folder = url.scheme == "file" and not url.netloc and url.path
        bucket = url.scheme == "s3" and url.netloc
        if not folder and not bucket:
            raise ValueError(f"{value!r}: give it as s3://BUCKET/PREFIX or file:///FOLDER")
        return value

    @model_validator(mode="after")
    def _check_store_is_shared(self) -> "CoordinatorSettings":
        if self.cluster and self.store is None and not is_loopback(str(urlsplit(self.cluster).hostname)):
            raise ValueError(
                f"the workers of {self.cluster} can't reach a folder of this machine: name a store that they share "
                "with it, s3://BUCKET/PREFIX or file:///FOLDER, with --store"
            )
        return self

    @property
    def database_url(self) -> str:
        """Where the database is, as SQLAlchemy takes it."""
        return database_url(self.data, self.database)

    @property
    def store_url(self) -> str:
        """Where captures and mattes are, as `storage.objects.store.Objects` takes it."""
        return self.store or (self.data.resolve() / "store").as_uri()

    @property
    def alone(self) -> bool:
        """Whether the data folder holds all of the service, so that no other service may use it."""
        return self.cluster is None and self.database is None and self.store is None

    @property
    def limits(self) -> Limits:
        """Limits of a capture archive."""
        return Limits(
            unpacked=self.unpacked_bytes,
            memory=self.ingest_memory,
            frames=self.capture_frames,
            pixels=self.capture_pixels,
        )


class Settings(CoordinatorSettings):
    """The settings of `envmatte serve`: all of them."""

    coordinate: bool = _setting(True, "Whether this process also runs jobs, or only the API.")
    host: str = _setting("127.0.0.1", "Address to listen on. Any other than loopback requires API keys.")
    port: int = _setting(8000, "Port to listen on; 0 takes a free one.", ge=0, le=65535)
    keys: tuple[str, ...] = _setting(
        (),
        "API keys, separated by commas, in addition to those of `envmatte keys`. They have scope admin and owner "
        "`default`. Without any key the service is open to all, on loopback only.",
        unset="none",
    )
    upload_bytes: int = _setting(8 << 30, "Largest capture archive or clip, in bytes.", ge=1)
    upload_seconds: int = _setting(
        86_400, "How long an unfinished upload is kept after its last byte arrived, in seconds.", ge=1
    )
    capture_seconds: int | None = _setting(
        None,
        "How long a capture is kept after it was created, in seconds.",
        unset="until it is deleted",
        ge=1,
    )
    matte_seconds: int | None = _setting(
        None,
        "How long a matte is kept after it was requested, in seconds.",
        unset="until it is deleted",
        ge=1,
    )
    owner_captures: int | None = _setting(
        None, "Captures of one owner, at most, including uploads under way.", unset="no limit", ge=1
    )
    owner_jobs: int | None = _setting(
        None,
        "Jobs of one owner that may be queued or running at once, including ingests.",
        unset="no limit",
        ge=1,
    )
    owner_bytes: int | None = _setting(None, "Bytes stored for one owner, at most.", unset="no limit", ge=1)
    store_bytes: int | None = _setting(
        None, "Bytes stored for all owners together, at most.", unset="what the disk has room for", ge=1
    )
    backdrop_bytes: int = _setting(128 << 20, "Largest backdrop, in bytes, both as a file and decoded.", ge=1)
    matte_memory: int = _setting(1 << 30, "Bytes of mattes kept in memory for further composites.", ge=0)
    request_memory: int = _setting(
        512 << 20,
        "Bytes that requests for frames, pixels, layers and composites, and archives that are checked, may take "
        "together; further ones wait. Those of one owner may take half of it.",
        ge=64 << 20,
    )
    request_seconds: int = _setting(
        300,
        "How long a request may wait for its turn, and then compute a composite, a layer or a picture, or import a GiB "
        "of a matte, in seconds.",
        ge=1,
    )

    @field_validator("keys", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        if isinstance(value, str):
            return tuple(key.strip() for key in value.split(",") if key.strip())
        return value


GROUPS = {
    "Storage": ("data", "database", "store"),
    "Cluster": ("cluster", "certs", "workers", "worker_memory", "coordinate", "attempts", "ingest_memory"),
    "API": ("host", "port", "keys", "matte_memory", "request_memory", "request_seconds"),
    "Limits": ("upload_bytes", "unpacked_bytes", "capture_frames", "capture_pixels", "backdrop_bytes"),
    "Quotas": ("owner_captures", "owner_jobs", "owner_bytes", "store_bytes"),
    "Retention": ("upload_seconds", "capture_seconds", "matte_seconds", "job_seconds"),
    "Webhooks": ("webhook_secret", "webhook_private"),
    "Logging": ("log", "log_level"),
}
"""The settings in the order in which people read about them."""
OF_OTHERS = ("url", "key", "image", "listen")
"""What the environment, or .env, may hold for commands that talk to a service, and for docker/compose.yaml."""


def warn_of_unknown() -> None:
    """Log which variables and lines of .env set nothing: a misspelt limit would be none."""
    unknown = unknown_variables({*Settings.model_fields, *OF_OTHERS})
    if unknown:
        logger.warning(
            "no settings of envmatte, and ignored: %s; `envmatte serve --help` lists all", ", ".join(unknown)
        )


class Setting(NamedTuple):
    """A setting as people read about it."""

    variable: str
    default: str
    description: str
    group: str


def describe_settings(model: type[DataSettings] = Settings) -> list[Setting]:
    """The settings of a model: environment variable, default, description and group."""
    described = []
    for group, names in GROUPS.items():
        for name in names:
            if name in model.model_fields:
                field = model.model_fields[name]
                assert isinstance(field.json_schema_extra, dict)
                default = str(field.json_schema_extra["unset"]) or _text(field.default)
                described.append(Setting(PREFIX + name.upper(), default, str(field.description), group))
    return described


def _text(value: object) -> str:
    """A default as people write it; large powers of two in binary units as well."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int):
        for shift, unit in ((30, "GiB"), (20, "MiB")):
            if value >= 1 << shift and value % (1 << shift) == 0:
                return f"{value} ({value >> shift} {unit})"
    return str(value)


def _has_port(netloc: str) -> bool:
    """Whether a host comes with a port."""
    try:
        return bool(urlsplit(f"//{netloc}").port)
    except ValueError:
        return False
