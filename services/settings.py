"""The settings of the service: one object, built at the edge and passed in."""

import ipaddress
import os
from pathlib import Path
from typing import Annotated

from pydantic import Field, field_validator, model_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from workflows.ingest.bundle import Limits


class Settings(BaseSettings):
    """Every setting is an environment variable ``ENVMATTE_…`` too, and a line in ``.env``."""

    model_config = SettingsConfigDict(env_prefix="ENVMATTE_", env_file=".env", extra="ignore", frozen=True)

    data: Path = Field(Path("envmatte-data"), description="Folder of the database and of everything stored.")
    host: str = Field("127.0.0.1", description="Address to listen on. Other than loopback only with keys.")
    port: int = Field(8000, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    keys: Annotated[tuple[str, ...], NoDecode] = Field(
        (), description="API keys, separated by commas. With none the service is open, and on loopback alone."
    )
    workers: int = Field(
        default_factory=lambda: os.cpu_count() or 1,
        ge=1,
        description="Worker processes of the embedded cluster, one thread each. Default: one a core.",
    )
    upload_bytes: int = Field(8 << 30, ge=1, description="Bytes of the largest archive that is taken.")
    upload_seconds: int = Field(
        86_400, ge=1, description="How long a resumable upload is kept after the last byte of it came."
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
    attempts: int = Field(3, ge=1, description="How often a tile is tried before its job fails.")

    @field_validator("keys", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        if isinstance(value, str):
            return tuple(key.strip() for key in value.split(",") if key.strip())
        return value

    @model_validator(mode="after")
    def _no_open_door(self) -> "Settings":
        if not self.keys and not _is_loopback(self.host):
            raise ValueError(
                f"asked to listen on {self.host} without a key, where anyone on the network could use the service: "
                "set ENVMATTE_KEYS to one or more keys, separated by commas, or listen on 127.0.0.1"
            )
        return self

    @property
    def database_url(self) -> str:
        """Where the ledger is, as SQLAlchemy takes it."""
        return f"sqlite:///{self.data.resolve() / 'envmatte.db'}"

    @property
    def store_url(self) -> str:
        """Where captures and mattes are, as `storage.objects.Objects` takes it."""
        return (self.data.resolve() / "store").as_uri()

    @property
    def limits(self) -> Limits:
        """What a bundle may cost."""
        return Limits(unpacked=self.unpacked_bytes, memory=self.ingest_memory)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
