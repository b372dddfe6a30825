"""The settings of the service: one object, built at the edge and passed in."""

import os
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlsplit

from distributed.security import Security
from distributed.system import MEMORY_LIMIT
from pydantic import Field, field_validator, model_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict
from sqlalchemy import make_url
from sqlalchemy.exc import ArgumentError

from services.runtime.addresses import is_loopback
from services.runtime.certificates import security_of
from services.runtime.webhook_signature import signing_key
from storage.errors import InvalidInput
from workflows.untrusted.limits import Limits


class ClusterSettings(BaseSettings):
    """What every process of a cluster is told; each an environment variable ``ENVMATTE_…`` and a line in ``.env``."""

    model_config = SettingsConfigDict(
        env_prefix="ENVMATTE_",
        env_file=".env",
        env_ignore_empty=True,  # as compose passes on what is not set
        extra="ignore",
        frozen=True,
    )

    data: Path = Field(Path("envmatte-data"), description="Folder of the database and of everything stored.")
    cluster: str | None = Field(
        None,
        description="Address of a dask scheduler, tls://HOST:PORT, or tcp://127.0.0.1:PORT on one machine. "
        "Without one the service has a cluster of its own.",
    )
    certs: Path | None = Field(
        None,
        description="Folder that `envmatte certs` made, for a cluster. Default: certs in the data folder, if there.",
    )
    workers: int = Field(
        default_factory=lambda: os.cpu_count() or 1,
        ge=1,
        description="Worker processes on this machine, one thread each. Default: one a core.",
    )
    worker_memory: int = Field(
        default_factory=lambda settings: MEMORY_LIMIT // settings["workers"],
        ge=0,
        description="Bytes that a worker process may take before it is ended and started again; 0 sets no limit. "
        "Default: the machine's memory, shared out among the workers.",
    )

    log: Literal["text", "json"] = Field(
        "text", description="Form of the logs on stderr: text, or json, an object a line."
    )
    log_level: Literal["DEBUG", "INFO", "WARNING", "ERROR"] = Field(
        "INFO", description="The lowest level that is logged; debug has a line for every tile."
    )

    @model_validator(mode="after")
    def _trusted(self) -> "ClusterSettings":
        """No address without TLS but on loopback, and none with TLS but with certificates."""
        if self.cluster is None:
            return self
        url = urlsplit(self.cluster)
        if url.scheme not in ("tcp", "tls") or not url.hostname or not _port(url.netloc):
            raise ValueError(f"cluster {self.cluster!r}: give it as tls://HOST:PORT, or tcp://127.0.0.1:PORT")
        if url.scheme == "tcp" and not is_loopback(url.hostname):
            raise ValueError(
                f"cluster {self.cluster}: without TLS only on loopback, for whoever reaches it may run what he likes: "
                "make certificates with `envmatte certs DIR`, give every process of the cluster a copy with --certs, "
                f"and name it tls://{url.netloc}"
            )
        if url.scheme == "tls":
            try:
                self.security()
            except InvalidInput as error:
                raise ValueError(error.detail) from error
        return self

    @property
    def certificates(self) -> Path | None:
        """The folder of the certificates, or None if there is none."""
        made = self.data / "certs"
        return self.certs or (made if made.is_dir() else None)

    def security(self) -> Security | None:
        """What this process needs to talk to the cluster; None for one without TLS.

        Raises
        ------
        InvalidInput
            If the certificates can't be used.
        """
        if self.cluster is None or not self.cluster.startswith("tls://"):
            return None
        if self.certificates is None:
            raise InvalidInput(
                f"cluster {self.cluster} speaks TLS, and there are no certificates: name the folder that "
                "`envmatte certs` made for it with --certs"
            )
        return security_of(self.certificates)


class Settings(ClusterSettings):
    """All of them."""

    database: str | None = Field(
        None,
        description="URL of the database, postgresql://USER:PASSWORD@HOST/NAME or sqlite:////FILE. "
        "Default: a file in the data folder.",
    )
    store: str | None = Field(
        None,
        description="URL of the object store, s3://BUCKET/PREFIX or file:///FOLDER. Default: in the data folder.",
    )
    coordinate: bool = Field(True, description="Whether this process drives jobs, and not the API alone.")
    host: str = Field("127.0.0.1", description="Address to listen on. Other than loopback only with keys.")
    port: int = Field(8000, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    keys: Annotated[tuple[str, ...], NoDecode] = Field(
        (),
        description="API keys, separated by commas, besides those of `envmatte keys`: of scope admin and the default "
        "owner. With none at all the service is open, and on loopback alone.",
    )
    upload_bytes: int = Field(
        8 << 30, ge=1, description="Bytes of the largest archive or clip that is taken."
    )
    upload_seconds: int = Field(
        86_400, ge=1, description="How long a resumable upload is kept after the last byte of it came."
    )
    capture_seconds: int | None = Field(
        None,
        ge=1,
        description="How long a capture is kept from when it was made. Default: until it is deleted.",
    )
    matte_seconds: int | None = Field(
        None,
        ge=1,
        description="How long a matte is kept from when it was asked for. Default: until it is deleted.",
    )
    job_seconds: int | None = Field(
        None,
        ge=1,
        description="How long a job is kept after it has ended, with its log, and the video of a composite; that of an "
        "ingest or a recovery at least as long as the capture or the matte. Default: until it is deleted.",
    )
    capture_frames: int = Field(20_000, ge=1, description="Frames of a capture.")
    capture_pixels: int = Field(100_000_000, ge=1, description="Pixels of a frame of a capture.")
    owner_captures: int | None = Field(
        None,
        ge=1,
        description="Captures that an owner may have, uploads under way among them. Default: no limit.",
    )
    owner_jobs: int | None = Field(
        None,
        ge=1,
        description="Jobs of an owner that may be queued or running at once, ingests among them. Default: no limit.",
    )
    owner_bytes: int | None = Field(
        None, ge=1, description="Bytes stored that an owner may have. Default: no limit."
    )
    store_bytes: int | None = Field(
        None,
        ge=1,
        description="Bytes stored that all owners together may have. Default: what the disk has room for.",
    )
    unpacked_bytes: int = Field(64 << 30, ge=1, description="Bytes that an archive may unpack to.")
    ingest_memory: int = Field(
        512 << 20,
        ge=1 << 20,
        description="Bytes of frames that one worker may hold while it ingests, whatever the size of the stack, "
        "besides some 50 MB that compressing takes; a single frame may take a quarter of them.",
    )
    backdrop_bytes: int = Field(
        128 << 20, ge=1, description="Bytes that a backdrop may have, as it is sent and again decoded."
    )
    matte_memory: int = Field(
        1 << 30, ge=0, description="Bytes of mattes that a service keeps in memory to composite them again."
    )
    webhook_secret: str | None = Field(
        None,
        min_length=16,
        description="Signs webhooks: whsec_ and a key in Base64, or any text of 16 characters or more. Without one, "
        "requests with a webhook are refused.",
    )
    webhook_private: bool = Field(
        False, description="Whether webhooks may be at addresses that are not public, and without TLS."
    )
    attempts: int = Field(3, ge=1, description="How often a tile is tried before its job fails.")

    @field_validator("keys", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        if isinstance(value, str):
            return tuple(key.strip() for key in value.split(",") if key.strip())
        return value

    @field_validator("webhook_secret")
    @classmethod
    def _stands_for_a_key(cls, value: str | None) -> str | None:
        if value is not None:
            signing_key(value)
        return value

    @field_validator("database")
    @classmethod
    def _database_known(cls, value: str | None) -> str | None:
        try:
            known = value is None or make_url(value).get_backend_name() in ("sqlite", "postgresql")
        except ArgumentError:
            known = False
        if not known:  # without showing the URL, which may hold a password
            raise ValueError("give it as postgresql://USER:PASSWORD@HOST/NAME or sqlite:////FILE")
        return value

    @field_validator("store")
    @classmethod
    def _store_known(cls, value: str | None) -> str | None:
        url = urlsplit(value or "file:///")
        if not (url.scheme == "file" and not url.netloc and url.path) and not (
            url.scheme == "s3" and url.netloc
        ):
            raise ValueError(f"{value!r}: give it as s3://BUCKET/PREFIX or file:///FOLDER")
        return value

    @model_validator(mode="after")
    def _store_shared(self) -> "Settings":
        if self.cluster and self.store is None and not is_loopback(str(urlsplit(self.cluster).hostname)):
            raise ValueError(
                f"the workers of {self.cluster} can't reach a folder of this machine: name the store that they share "
                "with it, s3://BUCKET/PREFIX or file:///FOLDER, with --store"
            )
        return self

    @property
    def database_url(self) -> str:
        """Where the ledger is, as SQLAlchemy takes it."""
        return self.database or f"sqlite:///{self.data.resolve() / 'envmatte.db'}"

    @property
    def store_url(self) -> str:
        """Where captures and mattes are, as `storage.objects.store.Objects` takes it."""
        return self.store or (self.data.resolve() / "store").as_uri()

    @property
    def alone(self) -> bool:
        """Whether all that belongs to the service is in its data folder: then no other can have a part in it."""
        return self.cluster is None and self.database is None and self.store is None

    @property
    def limits(self) -> Limits:
        """What a bundle may cost."""
        return Limits(
            unpacked=self.unpacked_bytes,
            memory=self.ingest_memory,
            frames=self.capture_frames,
            pixels=self.capture_pixels,
        )


def _port(netloc: str) -> bool:
    """Whether a host comes with a port."""
    try:
        return bool(urlsplit(f"//{netloc}").port)
    except ValueError:
        return False
